"""Problems that a run would meet, found on a few views and a few frames in seconds.

Each step examines one topic, records its observations and adds findings. A step that depends on a failed one is
skipped, which is reported.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from calibration import StereoCalibration, StereoRig
from calibration.kit.types import AnyArray, evenly
from calibration.rig_file import record_of
from disctrack.analyse.declaration import Boards, across, contradictions, lost_pairs, turned_board
from disctrack.calibrate.stage import boards_in, boards_of, given_rig, noticed_in, source_of
from disctrack.errors import DiscTrackError, RecordingError
from disctrack.findings import Finding, Kind, Remedy, Severity, Subject, in_doubt, leading
from disctrack.frames import CAMERAS
from disctrack.recording.declaration import Recording, read_recording
from disctrack.recording.readers.blocks import NotRead
from disctrack.report.blocks import Facts, Report, Section
from disctrack.track.follow.tracking import Measurement, Taken, track
from disctrack.track.measurement import ImagePairs, TrackingSettings, as_declared, check_rig, images_lost, open_pairs
from disctrack.track.run_summary import left_out, sigma_text
from disctrack.trajectory import Trajectory, joined

KEYS_EXPLAINED = Path(__file__).resolve().parents[1] / "docs" / "recording-toml.md"  # installed with the package
VIEWS_LOOKED_AT = 12  # of the chessboard: half as many as a good rig needs
PLACES = (0.1, 0.45, 0.9)  # fractions of the recording at which frames are examined
FRAMES_AT_EACH = 60  # enough to detect a jump of the clock


@dataclass
class Check:
    """Observations and findings; images for the picture."""

    recording: Recording | None = None
    seen: list[tuple[str, str]] = field(default_factory=list)  # heading, observation
    findings: list[Finding] = field(default_factory=list)
    calibration: StereoCalibration | None = None
    boards: Boards | None = None
    shown: list[tuple[Trajectory, int, AnyArray]] = field(default_factory=list)  # trajectory, row, images (2, h, w)
    raw: list[AnyArray] = field(default_factory=list)  # image pairs in which the disc was not found
    not_read: NotRead = field(default_factory=dict)

    def add(self, kind: Kind, text: str, advice: str = "", severity: Severity = Severity.REFUSAL) -> None:
        """Add a finding, by default one that a run would fail with."""
        remedies = (Remedy(action=advice),) if advice else ()
        self.findings.append(Finding(kind, severity, text, Subject("check"), remedies=remedies))

    def images(self, pairs: ImagePairs, frames: Iterable[int]) -> list[AnyArray]:
        """(2, h, w) images of these frames; unreadable ones are skipped, and recorded in `not_read`."""
        blocks = (block for i in frames for block in pairs.reading(self.not_read)(i, i + 1))
        return [block.images[0].copy() for block in blocks if not block.unreadable]

    @contextmanager
    def refusing(self, kind: Kind, advice: str = "") -> Iterator[None]:
        """Convert an error that ends this step to a finding: a run would fail with it."""
        try:
            yield
        except DiscTrackError as error:
            self.add(kind, str(error), advice)

    def report(self, files: Sequence[Path] = ()) -> Report:
        """The causes, and, with `-v`, all observations."""
        findings = leading(self.findings)
        verdict = "A run would meet no problem."
        if in_doubt(findings):
            verdict = "Something has to be put right before a run."
        elif findings and findings[0].severity == Severity.WARNING:
            verdict = "A run would work; look at the warnings."
        place = "" if self.recording is None else self.recording.folder
        then = "" if in_doubt(findings) else f"disctrack run {place}"
        blocks = [Section("What was seen", [Facts(self.seen)])]
        name = "check" if self.recording is None else f"{self.recording.name}: check"
        return Report(name, verdict, findings=findings, blocks=blocks, files=files, then=then)


def run_check(folder: Path, progress: Callable[[str], None] = lambda step: None) -> Check:
    """Examine declaration, frames, views, light and motion of a recording.

    progress is called with the name of each step. Errors of the recording are findings and not raised.
    """
    seen, pairs, rig = Check(), None, None
    progress("declaration")
    with seen.refusing(Kind.DECLARATION, f"every key: {KEYS_EXPLAINED}"):
        seen.recording = read_recording(folder)
    if (recording := seen.recording) is None:
        return seen
    seen.seen.append(("declaration", f"{recording.file} is complete"))
    with seen.refusing(Kind.READING):
        pairs = open_pairs(recording)
        width, height = pairs.left.image_size
        lasts = f"{len(pairs) / recording.frame_rate:.3g} s at {recording.frame_rate:g} Hz"
        size = f"{width} x {height} px, {pairs.left.bit_depth} bit"
        seen.seen.append(("frames", f"{len(pairs)} pairs of {size}, {lasts}"))
        seen.findings += pairs.findings
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
        seen.seen.append(("dots", "not looked for: that needs the cameras' calibration"))
    else:
        with seen.refusing(Kind.CALIBRATION):
            check_rig(rig, pairs)
            progress("dots")
            _motion(seen, recording, rig, pairs)
    seen.findings += images_lost(seen.not_read)
    return seen


def _rig(seen: Check, recording: Recording) -> StereoRig:
    if recording.rig_file is not None:
        rig, _ = given_rig(recording.rig_file)
        seen.seen.append(("rig", f"{recording.rig_file}: baseline {1e3 * rig.baseline:.3f} mm"))
        seen.boards = boards_in(recording.rig_file, recording)
        seen.findings += seen.boards.findings if seen.boards else ()
        return rig
    source = source_of(recording)
    views, table = source.views, source.table_view
    assert table is not None
    if table >= len(views):
        raise RecordingError(f"[table] view = {table}, but there are {len(views)} views, counted from 0")
    chosen = sorted({*evenly(len(views), VIEWS_LOOKED_AT), table})
    some = replace(views, left=tuple(views.left[i] for i in chosen), right=tuple(views.right[i] for i in chosen))
    found, problems = replace(source, views=some, table_view=chosen.index(table)).calibrated(None)
    seen.calibration, seen.boards = found, boards_of(record_of(found), views)
    used = len(chosen) - len(problems) - len(found.rejected_views)
    text = f"found in {used} of {len(chosen)} pairs of views looked at ({len(views)} in all)"
    seen.seen.append(("chessboard", f"{text}, {found.assessment.verdict}, baseline {1e3 * found.rig.baseline:.1f} mm"))
    if used < 0.7 * len(chosen):
        advice = "the whole board must be in view of both cameras, with a light rim round it"
        seen.add(Kind.CALIBRATION, f"the chessboard was {text}", advice, Severity.WARNING)
    said = (*left_out(found), *problems, *found.warnings)
    seen.findings += noticed_in({"doubts": found.doubts, "warnings": said})
    return found.rig


def _light(seen: Check, pairs: ImagePairs) -> None:
    images = np.array(seen.images(pairs, [round(place * (len(pairs) - 1)) for place in PLACES]))
    if not len(images):
        seen.add(Kind.UNREADABLE, "none of the frames looked at can be read", "copy the frames again")
        return
    for camera, name in enumerate(CAMERAS):
        low, high = np.percentile(images[:, camera], [1.0, 99.0])
        text = f"{name}: grey values {low:.0f} to {high:.0f}"
        if high - low < 1:
            seen.add(Kind.LIGHT, f"{text}: the images are of one grey", "is the lens cap on, is the lamp lit?")
        seen.seen.append(("light", text))


def _motion(seen: Check, recording: Recording, rig: StereoRig, pairs: ImagePairs) -> None:
    done: list[tuple[range, Measurement]] = []
    noticed: list[Finding] = []
    total, lost = 0, ""
    for place in PLACES:
        n = min(FRAMES_AT_EACH, len(pairs))
        first = pairs.start + min(max(round(place * len(pairs)) - n // 2, 0), len(pairs) - n)
        frames = range(first, first + n)
        if any(frames.start < other.stop for other, _ in done):
            continue
        total += n
        try:
            settings, _ = as_declared(TrackingSettings(first_pass=False), recording, pairs)
            taken = Taken(frames, recording.frame_rate, recording.gravity, None, settings, recording.chessboard)
            tracking = track(pairs.reading(seen.not_read), taken, rig, recording.disc)
            done.append((frames, tracking))
            noticed += [*tracking.trajectory.findings, *lost_pairs(tracking.trajectory)]
        except DiscTrackError as error:
            lost = str(error)
            noticed += getattr(error, "findings", ())
            seen.raw += seen.images(pairs, [frames.start])
        if any(Kind.DISC_NOT_FOUND in finding.explains for finding in noticed):
            break  # the images are not of the declared cameras: so are those elsewhere
    noticed = _once(noticed)
    if not done:
        seen.add(Kind.DISC_NOT_FOUND, "the disc was found nowhere; compare [markers] with the picture", lost)
        seen.findings += noticed
        return
    measured = sum(int(tracking.trajectory.measured.sum()) for _, tracking in done)
    if measured < total:
        severity = Severity.DOUBT if 2 * measured < total else Severity.WARNING
        seen.add(Kind.FRAMES_LOST, f"{total - measured} of {total} frames looked at have no pose", lost, severity)
    seen.seen.append(("dots", f"disc measured in {measured} of {total} frames looked at"))
    for frames, tracking in done:
        row = len(frames) // 2
        seen.shown += [(tracking.trajectory, row, images) for images in seen.images(pairs, [frames[row]])]
    whole = joined([tracking.trajectory for _, tracking in done])
    blur_px = done[len(done) // 2][1].details["blur_px"]
    for finding in contradictions(whole, recording.disc, recording, noticed, seen.boards, blur_px):
        severity = Severity.DOUBT if finding.kind == Kind.DOT_UNSEEN else finding.severity
        seen.findings.append(replace(finding, severity=severity))
    if measured:
        for camera, blur, width in zip(CAMERAS, blur_px, across(whole), strict=True):
            seen.seen.append(("sharpness", f"{camera}: dots {width:.1f} px across, blur {blur:.2f} px (sigma)"))
        seen.seen.append(("accuracy", sigma_text(whole)))


def _once(findings: Iterable[Finding]) -> list[Finding]:
    """The most severe finding of each kind and camera."""
    first: dict[tuple[Kind, str], Finding] = {}
    for finding in sorted(findings, key=lambda f: -f.severity):
        first.setdefault((finding.kind, finding.subject.camera), finding)
    return list(first.values())
