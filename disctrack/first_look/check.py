"""Problems that a run would meet, found on a few views and a few frames in seconds.

Each step looks at one thing, says what was seen and adds findings. A step that cannot be made because an earlier one
failed is left out and named.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration import CalibrationSettings, StereoCalibration, StereoRig
from calibration.kit.arrays import evenly
from calibration.kit.grey_levels import saturation_level
from calibration.rig_file import record_of
from disctrack.analyse.declaration import Boards, contradictions_of, turned_board
from disctrack.calibrate.stage import boards_in, boards_of, given_rig, source_of
from disctrack.disc import Disc
from disctrack.errors import DiscTrackError, RecordingError
from disctrack.findings import (
    Finding,
    Kind,
    Remedy,
    Severity,
    Subject,
    in_doubt,
    leading,
    of_kind,
)
from disctrack.frames import CAMERAS, rotation_from_quaternion
from disctrack.recording.declaration import Recording, read_recording
from disctrack.recording.readers.blocks import Unreadable
from disctrack.report.blocks import Facts, Report, Section
from disctrack.track.follow.tracking import Tracking, TrackingSettings, track
from disctrack.track.measurement import ImagePairs, check_rig, images_lost, open_pairs
from disctrack.track.run_summary import left_out
from disctrack.trajectory import Trajectory

KEYS_EXPLAINED = Path(__file__).resolve().parents[1] / "docs" / "recording-toml.md"  # it is installed with the package
VIEWS_LOOKED_AT = 12  # of the chessboard: half of what a good rig takes
PLACES = (0.1, 0.5, 0.9)  # of the recording where frames are looked at
FRAMES_AT_EACH = 40
CLAIM = 5e-6  # [m] the accuracy that is claimed for a position
LAB_FRAME = 20e-6  # [m] to which it is known where a board on a table lies, with no particular care
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
    raw: list[NDArray] = field(default_factory=list)  # pairs in which the disc was not found
    not_read: dict[tuple[int, int], Unreadable] = field(default_factory=dict)  # by frame and camera

    def warn(self, kind: Kind, text: str, advice: str = "", severity: Severity = Severity.WARNING) -> None:
        """Add a finding, by default one that deserves a look."""
        remedies = (Remedy(action=advice),) if advice else ()
        self.findings.append(Finding(kind, severity, text, Subject("check"), remedies=remedies))

    def refuse(self, kind: Kind, text: str, advice: str = "") -> None:
        """Add what a run would end with."""
        self.warn(kind, text, advice, Severity.REFUSAL)

    def images(self, pairs: ImagePairs, frames: Iterable[int]) -> list[NDArray]:
        """(2, h, w) images of each of these frames; those that cannot be read are left out, and named."""
        blocks = (block for i in frames for block in pairs.reading(self.not_read)(i, i + 1))
        return [block.images[0].copy() for block in blocks if not block.unreadable]

    @contextmanager
    def refusing(self, kind: Kind, advice: str = "") -> Iterator[None]:
        """An error that ends this step would end a run."""
        try:
            yield
        except DiscTrackError as error:
            self.refuse(kind, str(error), advice)

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
    seen, pairs, rig = Check(), None, None
    progress("declaration")
    with seen.refusing(Kind.DECLARATION, f"every key: {KEYS_EXPLAINED}"):
        seen.recording = read_recording(folder)
    if (recording := seen.recording) is None:
        return seen
    seen.seen.append(("declaration", f"{recording.file} is complete"))
    with seen.refusing(Kind.READING):
        pairs = _frames(seen, recording)
    progress("chessboard")
    with seen.refusing(Kind.CALIBRATION):
        rig = _rig(seen, recording)
    if pairs is None:
        return seen
    progress("light")
    _light(seen, pairs)
    if rig is None:
        if recording.chessboard is not None:
            seen.findings += turned_board(recording.chessboard.inner_corners)
        seen.warn(Kind.DISC_NOT_FOUND, "the dots were not looked for: that needs the cameras' calibration")
    else:
        with seen.refusing(Kind.CALIBRATION):
            check_rig(rig, pairs)
            progress("dots")
            _motion(seen, recording, rig, pairs)
    seen.findings += images_lost(seen.not_read.values())
    return seen


def _frames(seen: Check, recording: Recording) -> ImagePairs:
    pairs = open_pairs(recording)
    width, height = pairs.left.image_size
    lasts = f"{len(pairs) / recording.frame_rate:.3g} s at {recording.frame_rate:g} Hz"
    seen.seen.append(("frames", f"{len(pairs)} pairs of {width} x {height} px, {pairs.left.bit_depth} bit, {lasts}"))
    seen.findings += pairs.findings
    return pairs


def _rig(seen: Check, recording: Recording) -> StereoRig:
    if recording.rig_file is not None:
        rig, told = given_rig(recording.rig_file)
        seen.seen.append(("rig", told.verdict))
        seen.boards = boards_in(recording.rig_file, recording)
        return rig
    source = source_of(recording, CalibrationSettings())
    views, table = source.views, source.table_view
    assert table is not None
    if table >= len(views):
        raise RecordingError(f"[table] view = {table}, but there are {len(views)} views, counted from 0")
    chosen = sorted({*evenly(len(views), VIEWS_LOOKED_AT), table})
    some = replace(views, left=tuple(views.left[i] for i in chosen), right=tuple(views.right[i] for i in chosen))
    found, problems = replace(source, views=some, table_view=chosen.index(table)).calibrated(None)
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


def _light(seen: Check, pairs: ImagePairs) -> None:
    images = np.array(seen.images(pairs, [round(place * (len(pairs) - 1)) for place in PLACES]))
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
            done.append((frames, _track(seen, recording, rig, pairs, frames)))
        except DiscTrackError as error:
            lost.append(Finding(Kind.DISC_NOT_FOUND, Severity.WARNING, str(error), Subject("check")))
            lost += getattr(error, "findings", ())
            seen.raw += seen.images(pairs, [frames.start])
    seen.findings += _once(lost)
    if not done:
        seen.refuse(Kind.DISC_NOT_FOUND, "the disc was found nowhere", "compare [markers] with the picture")
        return
    for frames, tracking in done:
        row = len(frames) // 2
        seen.shown += [(tracking.trajectory, row, images) for images in seen.images(pairs, [frames[row]])]
    measured = sum(int(tracking.trajectory.measured.sum()) for _, tracking in done)
    total = sum(len(frames) for frames, _ in done)
    seen.seen.append(("dots", f"disc measured in {measured} of {total} frames looked at"))
    if measured < total:
        seen.warn(Kind.FRAMES_LOST, f"the disc was measured in {measured} of {total} frames looked at")
    whole = _together([tracking.trajectory for _, tracking in done])
    noticed = _once(finding for _, tracking in done for finding in tracking.findings)
    for finding in contradictions_of(recording, whole, noticed, seen.boards):
        graver = Severity.DOUBT if finding.kind == Kind.DOT_UNSEEN else finding.severity
        seen.findings.append(replace(finding, severity=graver))
    tracking = done[len(done) // 2][1]
    if tracking.trajectory.measured.any():
        _sharpness(seen, recording.disc, tracking)
        _accuracy(seen, tracking.trajectory)
    seen.findings += noticed


def _once(findings: Iterable[Finding]) -> list[Finding]:
    """Of the places looked at, one finding for each kind and camera: the gravest."""
    first: dict[tuple[Kind, str], Finding] = {}
    for finding in sorted(findings, key=lambda f: -f.severity):
        first.setdefault((finding.kind, finding.subject.camera), finding)
    return list(first.values())


def _track(seen: Check, recording: Recording, rig: StereoRig, pairs: ImagePairs, frames: range) -> Tracking:
    """Track a stretch."""
    settings = TrackingSettings(refine_markers=False, first_pass=False)
    rate, gravity = recording.frame_rate, recording.gravity
    return track(pairs.reading(seen.not_read), frames, rig, recording.disc, rate, gravity=gravity, settings=settings)


def _together(stretches: list[Trajectory]) -> Trajectory:
    """The stretches one after the other, as one trajectory with gaps in time."""
    first = stretches[0]
    names = [name for name, value in vars(first).items() if isinstance(value, np.ndarray)]
    joined: dict[str, Any] = {name: np.concatenate([getattr(t, name) for t in stretches]) for name in names}
    return replace(first, **joined)


def _sharpness(seen: Check, disc: Disc, tracking: Tracking) -> None:
    """Blur of the dots' edges against the dots' width, where the disc is in the middle of a stretch."""
    trajectory = tracking.trajectory
    rows = np.flatnonzero(trajectory.measured)
    row = rows[len(rows) // 2]
    axis = rotation_from_quaternion(trajectory.quaternion[row])[:, 2]
    for camera, (name, (R, t)) in enumerate(zip(CAMERAS, trajectory.rig.camera_poses(), strict=True)):
        centre, blur = R @ trajectory.q[row, :3] + t, tracking.law.edges[camera].blur_px
        width = trajectory.rig.cameras[camera].fx * disc.marker_diameter / float(centre[2])
        across = width * abs(float(R @ axis @ centre)) / float(np.linalg.norm(centre))
        text = f"{name}: dots {width:.0f} px wide, {across:.1f} px across, blur {blur:.2f} px (sigma)"
        seen.seen.append(("sharpness", text))
        if 6 * blur > across:  # three sigma on each side
            advice = "larger dots, sharper focus, a shorter exposure, or cameras that look more steeply"
            seen.warn(Kind.SHARPNESS, f"{text}: the blur of opposite edges overlaps", advice)


def _accuracy(seen: Check, trajectory: Trajectory) -> None:
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
