"""Problems that a run would meet, found on a few views and a few frames in seconds.

Each step looks at one thing, says what was seen and adds findings. A step that cannot be made because an earlier one
failed is left out and named.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration import CalibrationSettings, StereoCalibration, StereoRig
from calibration.board.search import evenly
from calibration.kit.grey_levels import saturation_level
from calibration.rig_file import read_rig, record_of
from disctrack.analyse.declaration import Boards, contradictions_of, turned_board
from disctrack.calibrate.stage import boards_in, boards_of
from disctrack.calibrate.views import calibrate_views, declared_views
from disctrack.errors import DiscTrackError, RecordingError
from disctrack.findings import (
    MISFITS,
    Finding,
    Kind,
    Number,
    Remedy,
    Severity,
    Subject,
    in_doubt,
    leading,
    of_kind,
)
from disctrack.frames import CAMERAS, rotation_from_quaternion
from disctrack.recording.declaration import Recording, read_recording
from disctrack.recording.readers.blocks import PairBlock, iter_pair_blocks
from disctrack.report.blocks import Facts, Report, Section
from disctrack.track.dots.template import locate_on_disc
from disctrack.track.follow.tracking import Tracking, TrackingSettings, track
from disctrack.track.measurement import ImagePairs, check_rig, open_pairs
from disctrack.track.refine.intrinsic_scatter import without_shared_faults
from disctrack.track.run_summary import left_out
from disctrack.trajectory import MarkerStatus, Trajectory

KEYS_EXPLAINED = Path(__file__).resolve().parents[1] / "docs" / "recording-toml.md"  # it is installed with the package
VIEWS_LOOKED_AT = 12  # of the chessboard: half of what a good rig takes
PLACES = (0.1, 0.5, 0.9)  # of the recording where frames are looked at
FRAMES_AT_EACH = 40  # twice what the free refinement of the clock needs
SLIPS = (-3, -2, -1, 1, 2, 3)  # frames that one camera may be ahead of the other
SLIP_FRAMES = 12
CLAIM = 5e-6  # [m] the accuracy that is claimed for a position
LAB_FRAME = 20e-6  # [m] to which it is known where a board on a table lies, with no particular care
NARROW_PX = 6.0  # a dot's shorter width; below, the blur of one edge reaches the other (three sigma on each side)
CLIPPED_SHARE = 0.002  # of an image's pixels that may be clipped: glints on the rim are


@dataclass
class Check:
    """What was seen; pictures for the page."""

    recording: Recording | None = None
    seen: list[tuple[str, str]] = field(default_factory=list)  # headings, and what was seen
    findings: list[Finding] = field(default_factory=list)
    calibration: StereoCalibration | None = None
    boards: Boards | None = None
    shown: list[tuple[Trajectory, int, NDArray]] = field(default_factory=list)  # trajectory, row, images (2, h, w)
    raw: NDArray | None = None  # (2, h, w) a pair in which the disc was not found

    def warn(self, kind: Kind, text: str, advice: str = "", severity: Severity = Severity.WARNING) -> None:
        """Add a finding, by default one that deserves a look."""
        remedies = (Remedy(action=advice),) if advice else ()
        self.findings.append(Finding(kind, severity, text, Subject("check"), remedies=remedies))

    def refuse(self, kind: Kind, text: str, advice: str = "") -> None:
        """Add what a run would end with."""
        self.warn(kind, text, advice, Severity.REFUSAL)

    def report(self, files: Sequence[Path] = ()) -> Report:
        """The causes, and with `-v` what was seen."""
        findings = leading(self.findings)
        verdict = "A run would meet no problem."
        if in_doubt(findings):
            verdict = "Something has to be put right before a run."
        elif findings and findings[0].severity == Severity.WARNING:
            verdict = "A run would work; look at the warnings."
        place = "" if self.recording is None else self.recording.folder
        then = "" if in_doubt(findings) else f"disctrack run {place}"
        blocks = [Section("What was seen", [Facts(self.seen)])]
        data = {"problems": [finding.as_json() for finding in findings]}
        name = "check" if self.recording is None else f"{self.recording.name}: check"
        return Report(name, verdict, findings=findings, blocks=blocks, files=files, then=then, data=data)


def run_check(folder: Path, progress: Callable[[str], None] = lambda step: None) -> Check:
    """Look at a recording's declaration, frames, views, light and motion.

    progress is called with what is looked at next. Raises nothing that belongs to the recording: that is a remark.
    """
    seen = Check()
    progress("declaration")
    try:
        recording = seen.recording = read_recording(folder)
    except RecordingError as error:
        seen.refuse(Kind.DECLARATION, str(error), f"every key: {KEYS_EXPLAINED}")
        return seen
    seen.seen.append(("declaration", f"{recording.file} is complete"))
    pairs = _frames(seen, recording)
    progress("chessboard")
    rig = _rig(seen, recording)
    if pairs is None:
        return seen
    progress("light")
    _light(seen, recording, pairs)
    if rig is None:
        if recording.chessboard is not None:
            seen.findings += turned_board(recording.chessboard.inner_corners)
        seen.warn(Kind.DISC_NOT_FOUND, "the dots were not looked for: that needs the cameras' calibration")
        return seen
    try:
        check_rig(rig, pairs, "the calibration")
    except RecordingError as error:
        seen.refuse(Kind.CALIBRATION, str(error))
        return seen
    progress("dots")
    _motion(seen, recording, rig, pairs)
    return seen


def _frames(seen: Check, recording: Recording) -> ImagePairs | None:
    try:
        pairs = open_pairs(recording)
    except RecordingError as error:
        seen.refuse(Kind.READING, str(error))
        return None
    width, height = pairs.left.image_size
    lasts = f"{len(pairs) / recording.frame_rate:.3g} s at {recording.frame_rate:g} Hz"
    seen.seen.append(("frames", f"{len(pairs)} pairs of {width} x {height} px, {pairs.left.bit_depth} bit, {lasts}"))
    seen.findings += pairs.findings
    return pairs


def _rig(seen: Check, recording: Recording) -> StereoRig | None:
    if recording.rig_file is not None:
        try:
            rig = read_rig(recording.rig_file)
        except DiscTrackError as error:
            seen.refuse(Kind.CALIBRATION, str(error))
            return None
        seen.seen.append(("rig", f"{recording.rig_file}: baseline {1e3 * rig.baseline:.1f} mm"))
        seen.boards = boards_in(recording.rig_file, recording)
        return rig
    declared, table = recording.views, recording.table
    assert declared is not None
    assert table is not None
    try:
        views = declared_views(recording, declared)
        if table.view >= len(views):
            raise RecordingError(f"[table] view = {table.view}, but there are {len(views)} views, counted from 0")
        chosen = sorted({*evenly(len(views), VIEWS_LOOKED_AT), table.view})
        some = replace(views, left=tuple(views.left[i] for i in chosen), right=tuple(views.right[i] for i in chosen))
        settings = CalibrationSettings()
        found, problems = calibrate_views(
            some, declared.target, chosen.index(table.view), table.board_thickness, settings
        )
    except DiscTrackError as error:
        seen.refuse(Kind.CALIBRATION, str(error))
        return None
    seen.calibration, seen.boards = found, boards_of(record_of(found), some, chosen)
    used = len(chosen) - len(problems) - len(found.rejected_views)
    text = f"found in {used} of {len(chosen)} pairs of views looked at ({len(views)} in all)"
    seen.seen.append(("chessboard", f"{text}, {found.assessment.verdict}, baseline {1e3 * found.rig.baseline:.1f} mm"))
    if used < 0.7 * len(chosen):
        advice = "the whole board must be in view of both cameras, with a light rim round it"
        seen.warn(Kind.CALIBRATION_VIEWS, f"the chessboard was {text}", advice)
    left = (*left_out(found.rejected_views), *problems)
    seen.findings += of_kind(Kind.CALIBRATION_VIEWS, Severity.WARNING, left)
    seen.findings += of_kind(Kind.CALIBRATION, Severity.WARNING, found.warnings)
    return found.rig


def _light(seen: Check, recording: Recording, pairs: ImagePairs) -> None:
    images = _pairs_at(pairs, [round(place * (len(pairs) - 1)) for place in PLACES])
    if not len(images):
        seen.refuse(Kind.UNREADABLE, "none of the frames looked at can be read", "copy the frames again")
        return
    for camera, name in enumerate(CAMERAS):
        side = images[:, camera]
        saturation = saturation_level(side)
        clipped = 0.0 if saturation is None else float(np.mean(side >= saturation))
        low, high = np.percentile(side, [1.0, 99.0])
        text = f"{name}: grey values {low:.0f} to {high:.0f}"
        if clipped > CLIPPED_SHARE:
            share = f"{100 * clipped:.1f} % of the pixels clipped at {saturation}"
            seen.warn(
                Kind.LIGHT, f"{text}, {share}", "expose for a shorter time, or close the aperture: clipped edges shift"
            )
        elif high - low < 1:
            seen.refuse(Kind.LIGHT, f"{text}: the images are of one grey", "is the lens cap on, is the lamp lit?")
        seen.seen.append(("light", text))


def _motion(seen: Check, recording: Recording, rig: StereoRig, pairs: ImagePairs) -> None:
    done: list[tuple[range, Tracking]] = []
    lost: list[Finding] = []
    for place in PLACES:
        n = min(FRAMES_AT_EACH, len(pairs))
        first = pairs.start + min(max(round(place * len(pairs)) - n // 2, 0), len(pairs) - n)
        frames = range(first, first + n)
        if any(frames.start < other.stop for other, _ in done):
            continue
        try:
            done.append((frames, _track(recording, rig, pairs, frames)))
        except DiscTrackError as error:
            lost.append(Finding(Kind.DISC_NOT_FOUND, Severity.WARNING, str(error), Subject("check")))
            lost += getattr(error, "findings", ())
            seen.raw = seen.raw if seen.raw is not None else _first(_pairs_at(pairs, [frames.start]))
    seen.findings += _once(lost)
    if not done:
        seen.refuse(Kind.DISC_NOT_FOUND, "the disc was found nowhere", "compare [markers] with the picture")
        return
    for frames, tracking in done:
        row = len(frames) // 2
        images = _first(_pairs_at(pairs, [frames[row]]))
        if images is not None:
            seen.shown.append((tracking.trajectory, row, images))
    measured = sum(int(tracking.trajectory.measured.sum()) for _, tracking in done)
    total = sum(len(frames) for frames, _ in done)
    seen.seen.append(("dots", f"disc measured in {measured} of {total} frames looked at"))
    if measured < total:
        seen.warn(Kind.FRAMES_LOST, f"the disc was measured in {measured} of {total} frames looked at")
    _dots(seen, [tracking for _, tracking in done])
    whole = _together([tracking.trajectory for _, tracking in done])
    noticed = _once(finding for _, tracking in done for finding in tracking.findings)
    for finding in contradictions_of(recording, whole, noticed, seen.boards):
        graver = Severity.DOUBT if finding.kind == Kind.DOT_UNSEEN else finding.severity
        seen.findings.append(replace(finding, severity=graver))
    _sharpness(seen, recording, rig, pairs, done[len(done) // 2])
    _synchronisation(seen, recording, rig, pairs, *done[len(done) // 2])
    seen.findings += noticed


def _once(findings: Iterable[Finding]) -> list[Finding]:
    """Of the places looked at, one finding for each kind and camera: the gravest."""
    first: dict[tuple[Kind, str], Finding] = {}
    for finding in sorted(findings, key=lambda f: -f.severity):
        first.setdefault((finding.kind, finding.subject.camera), finding)
    return list(first.values())


def _track(recording: Recording, rig: StereoRig, pairs: ImagePairs, frames: range, slip: int = 0) -> Tracking:
    """Track a stretch; slip: frames by which the right camera's are taken later than the left one's."""

    def read_blocks(start: int, stop: int) -> Iterator[PairBlock]:
        if slip == 0:
            yield from iter_pair_blocks(pairs.left, pairs.right, start, stop)
            return
        images = _pairs_at(pairs, list(range(start, stop)), slip)
        yield PairBlock(np.arange(start, start + len(images)), images)

    settings = TrackingSettings(refine_markers=False, first_pass=False)
    return track(read_blocks, frames, rig, recording.disc, recording.frame_rate, gravity=recording.gravity,
                 settings=settings)  # fmt: skip


def _together(stretches: list[Trajectory]) -> Trajectory:
    """The stretches one after the other, as one trajectory with gaps in time."""
    first = stretches[0]
    names = [name for name, value in vars(first).items() if isinstance(value, np.ndarray)]
    joined: dict[str, Any] = {name: np.concatenate([getattr(t, name) for t in stretches]) for name in names}
    return replace(first, **joined)


def _dots(seen: Check, tracks: list[Tracking]) -> None:
    """A camera that measures no dot."""
    status = np.concatenate([tracking.trajectory.marker_status for tracking in tracks])
    with_pose = np.concatenate([tracking.trajectory.measured for tracking in tracks])
    seen_share = np.mean(status[with_pose] == MarkerStatus.MEASURED, axis=0) if with_pose.any() else np.zeros((2, 1))
    for camera, name in enumerate(CAMERAS):
        if seen_share[camera].max() < 0.1:
            text = f"the {name} camera measures no dot"
            seen.warn(Kind.ONE_SIDED, text, "are left and right exchanged, does it see the upper face?", Severity.DOUBT)


def _sharpness(
    seen: Check, recording: Recording, rig: StereoRig, pairs: ImagePairs, looked: tuple[range, Tracking]
) -> None:
    frames, tracking = looked
    trajectory = tracking.trajectory
    rows = np.flatnonzero(trajectory.measured)
    if not len(rows):
        return
    row = int(rows[len(rows) // 2])
    images = _first(_pairs_at(pairs, [frames[row]]))
    if images is None:
        return
    R, t = rotation_from_quaternion(trajectory.quaternion[row]), trajectory.q[row, :3]
    for camera, (name, (R_cw, t_cw)) in enumerate(zip(CAMERAS, rig.camera_poses(), strict=True)):
        one = rig.cameras[camera]
        found = locate_on_disc(images[camera], one, R_cw @ R, R_cw @ t + t_cw, recording.disc,
                               noise=tracking.noise[camera], blur_px=tracking.blur_px[camera])  # fmt: skip
        if not np.isfinite(found.contrast).any():
            continue
        centre = R_cw @ t + t_cw
        tilt = abs(float((R_cw @ R)[:, 2] @ centre)) / float(np.linalg.norm(centre))
        width = one.fx * recording.disc.marker_diameter / float(centre[2])
        level, contrast = float(np.nanmedian(found.level)), float(np.nanmedian(found.contrast))
        noise = float(np.sqrt(tracking.noise[camera].variance(np.array(level))))
        text = (
            f"{name}: dots {width:.0f} px wide, blur {tracking.blur_px[camera]:.2f} px (sigma), contrast "
            f"{100 * abs(contrast):.0f} %, {level * abs(contrast) / noise:.0f} times the noise"
        )
        seen.seen.append(("sharpness", text))
        if width * tilt < NARROW_PX:
            advice = "larger dots, a longer lens, or cameras that look more steeply"
            seen.warn(Kind.SHARPNESS, f"{text}; only {width * tilt:.1f} px across", advice)
        elif 3 * tracking.blur_px[camera] > 0.5 * width * tilt:
            advice = "focus on the disc, close the aperture, expose for a shorter time"
            seen.warn(Kind.SHARPNESS, f"{text}: the blur of opposite edges overlaps", advice)
    sigma = np.nanmedian(trajectory.coordinate_sigma[:, :3], axis=0)
    shared = np.nanmedian(trajectory.calibration_sigma[:, :3], axis=0)
    text = (
        f"expected of a frame: {1e6 * sigma.max():.2g} um by noise, {1e6 * shared.max():.2g} um that all frames share "
        "(sigma of the worst of x, y, z; the run's own calibration uses all views)"
    )
    seen.seen.append(("accuracy", text))
    if sigma.max() > CLAIM:
        seen.warn(Kind.ACCURACY, text, "more light, sharper or larger dots")
    elif shared.max() > LAB_FRAME:
        seen.warn(Kind.ACCURACY, text, "more views of the board, tilted and all over; a board that is known better")


def _synchronisation(
    seen: Check, recording: Recording, rig: StereoRig, pairs: ImagePairs, frames: range, tracking: Tracking
) -> None:
    trajectory = tracking.trajectory
    rms = float(np.sqrt(np.nanmean(trajectory.reprojection_rms_px**2)))
    motion = np.linalg.norm(np.diff(trajectory.markers_px, axis=0), axis=-1)
    if not np.isfinite(motion).any():
        return
    speed = float(np.nanmedian(motion))
    if tracking.variance_factor > 4.0:  # dots disagree with every pose by more than twice their noise
        better = _slip(recording, rig, pairs, frames, rms)
        if better is not None:
            slip, its_rms = better
            text = (
                f"left frame i and right frame i{slip:+d} show the same instant: that leaves {its_rms:.3f} px, the "
                f"declared pairing {rms:.3f} px"
            )
            camera = CAMERAS[slip > 0]
            advice = (Remedy(action="export the same instants of both cameras"),)
            explains = (Kind.DELAY, Kind.DROPPED_FRAMES, *MISFITS)
            of = Subject("check", camera)
            seen.findings.append(
                Finding(Kind.DROPPED_FRAMES, Severity.DOUBT, text, of, {"images": Number(slip)}, advice, explains)
            )
            return
    moving = trajectory.rig.world_is_table and speed > 0.2
    faults = None
    if moving:
        R = rotation_from_quaternion(trajectory.quaternion)
        faults = without_shared_faults(trajectory.markers_px, trajectory.markers_covariance_px2, rig, recording.disc,
                                       R, trajectory.q[:, :3])  # fmt: skip
    if faults is None:
        text = f"dots move by {speed:.2f} px per frame here: too few or too slow to tell a delay"
        seen.seen.append(("clock", text))
        return
    offset = abs(faults.delay) * speed  # in pixels, against what the dots' noise leaves open
    noise = float(np.sqrt(np.nanmedian(np.trace(trajectory.markers_covariance_px2, axis1=-2, axis2=-1)) / 2))
    unsure = offset < 3 * max(noise, 0.02)  # 0.02 px: what a rig within its calibration leaves
    text = f"right camera {faults.delay:+.3f} frame periods after the left, by the dots' motion"
    seen.seen.append(("clock", f"no delay between the cameras shows ({text})" if unsure else text))
    if not unsure:
        seen.warn(Kind.DELAY, text, "are both cameras triggered by one signal, with one exposure time?")


def _slip(
    recording: Recording, rig: StereoRig, pairs: ImagePairs, frames: range, rms: float
) -> tuple[int, float] | None:
    """The slip that fits far better than none, if any, and the dots' rms [px] with it."""
    best: tuple[int, float] | None = None
    for slip in SLIPS:
        some = frames[max(0, -slip) : SLIP_FRAMES + max(0, -slip)]
        if some.stop + slip > len(pairs.right) or some.start + slip < 0:
            continue
        try:
            tried = _track(recording, rig, pairs, some, slip).trajectory
        except DiscTrackError:
            continue
        its = float(np.sqrt(np.nanmean(tried.reprojection_rms_px**2)))
        if tried.measured.all() and its < 0.5 * (rms if best is None else best[1]):
            best = (slip, its)
    return best


def _pairs_at(pairs: ImagePairs, indices: list[int], slip: int = 0) -> NDArray:
    """(k, 2, h, w) images of these frames; those that cannot be read are left out."""
    found = []
    for index in indices:
        try:
            found.append(np.stack([np.array(pairs.left.read(index)), np.array(pairs.right.read(index + slip))]))
        except (RecordingError, IndexError):
            continue
    return np.array(found)


def _first(images: NDArray) -> NDArray | None:
    return images[0] if len(images) else None
