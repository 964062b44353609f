"""Calibration from files to a file: the views of a recording or of two file patterns, or a rig to be used again."""

import dataclasses
import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from calibration import BoardTolerances, StereoCalibration, StereoRig, calibrate_stereo
from calibration.board import corner_fit
from calibration.board.search import Progress
from calibration.board.target import Target, described
from calibration.kit.brief import Brief
from calibration.kit.types import AnyArray, Thickness, checked
from calibration.rig_file import Record, complete_rig, read_rig, read_rig_file, rig_bytes
from disctrack.analyse.declaration import Boards
from disctrack.errors import CalibrationError, OutputError, RecordingError, RigFileError
from disctrack.files.whole import keep, refuse_input, write_whole
from disctrack.findings import Finding, Kind, Severity, of_kind
from disctrack.frames import CAMERAS
from disctrack.progress import compiling, progress_bar
from disctrack.recording.declaration import CalibrationViews, Recording
from disctrack.recording.readers import open_frames
from disctrack.recording.readers.base import FrameReader, Part, Parts, cut_out
from disctrack.recording.readers.decoding import decode
from disctrack.recording.readers.files import IMAGES, content_of, file_number, match_files, split_member
from disctrack.recording.readers.flat_field import FlatField, FlatFields, flat_fields
from disctrack.report.blocks import Facts, Report
from disctrack.track import run_summary as summary
from disctrack.trajectory.file import Provenance

MOST_VIEWS = 500  # ten times as many as a calibration needs; the time is proportional to the number


@dataclass(frozen=True)
class FrameView:
    """A view that is one frame of a file with many."""

    file: Path
    reader: FrameReader
    index: int

    def __str__(self) -> str:
        return self.reader.describe(self.index)

    @property
    def name(self) -> str:
        """The frame, for messages that already name the file."""
        return f"frame {self.index}"


View = Path | FrameView


@dataclass(frozen=True, repr=False)
class TargetImages(Brief):
    """Synchronised views; views i of left and right show the board in the same pose."""

    left: tuple[View, ...]
    right: tuple[View, ...]
    fields: FlatFields = (None, None)  # corrections of grey views of the size of the frames
    parts: Parts = (None, None)  # of the images that are used

    def __len__(self) -> int:
        return len(self.left)

    @property
    def place(self) -> Path:
        """Location of the left views, for messages."""
        first = self.left[0]
        return first.file if isinstance(first, FrameView) else first.parent

    def sha256(self) -> str:
        """SHA-256 (hex) of all views' content, in order."""
        digest = hashlib.sha256()
        for side, flat, part in zip((self.left, self.right), self.fields, self.parts, strict=True):
            if flat is not None:
                digest.update(flat.sha256.encode())
            if part is not None:
                digest.update(str(list(part)).encode())
            for view in side:
                if not isinstance(view, FrameView):
                    digest.update(hashlib.sha256(content_of(view, str(view))).digest())
                elif view.index == 0:
                    digest.update(view.reader.content_sha256(0, len(side)).encode())
        return digest.hexdigest()


@checked
def find_views(
    left: str, right: str, folder: str | Path, fields: FlatFields = (None, None), parts: Parts = (None, None)
) -> TargetImages:
    """Views that the two patterns match, paired by their order: a file each, or all frames of one file each.

    fields : of both cameras, if their views are to be corrected for gains and offsets of the pixels
    parts : of the images that belong to each camera; images of the size of their part are used whole
    Raises RecordingError if they do not pair up.

        >>> len(find_views("calibration/left/*.png", "calibration/right/*.png", "clip"))
        18
    """
    sides = [views_of(pattern, Path(folder), camera) for pattern, camera in zip((left, right), CAMERAS, strict=True)]
    numbers = [[view.index if isinstance(view, FrameView) else file_number(view) for view in side] for side in sides]
    alone = [
        [view.name for view, number in zip(side, own, strict=True) if number not in other]
        for side, own, other in zip(sides, numbers, reversed(numbers), strict=True)
    ]
    views = TargetImages(sides[0], sides[1], fields, parts)
    # without common numbers, the cameras count from different starts
    if len(sides[0]) != len(sides[1]) or 0 < len(alone[0]) < len(sides[0]):
        odd = [f"{camera} {', '.join(names[:3])}" for camera, names in zip(CAMERAS, alone, strict=True) if names]
        raise RecordingError(
            f"{views.place}: {len(sides[0])} left and {len(sides[1])} right calibration views do not pair up"
            + (f": without a partner are {' and '.join(odd)}" if odd else "")
            + ". Views are pairs, one image of each camera: add the missing ones, or move these away."
        )
    return views


def declared_views(recording: Recording, declared: CalibrationViews) -> TargetImages:
    """The calibration views of a recording. Raises RecordingError if they do not pair up."""
    fields = flat_fields(recording.folder, recording.sensors)
    return find_views(declared.left, declared.right, recording.folder, fields, recording.parts)


def views_of(pattern: str, folder: Path, camera: str, most: float = MOST_VIEWS) -> tuple[View, ...]:
    """Views of one camera, a file each or all frames of one file. Raises RecordingError, also if there are too many."""
    files = match_files(split_member(pattern)[0], folder, camera)
    suffix = files[0].suffix.lower()
    if suffix in IMAGES and not (len(files) == 1 and suffix in (".tif", ".tiff")):
        return tuple(files)
    reader = open_frames(pattern, folder, camera)
    if suffix in IMAGES and len(reader) == 1:
        return tuple(files)
    if len(reader) > most:
        raise RecordingError(
            f"{files[0]}: {len(reader)} frames for the {camera} camera, and every frame is a view of the chessboard. "
            f"Export at most {most} of them; 15 to 40 in different places are enough."
        )
    return tuple(FrameView(files[0], reader, index) for index in range(len(reader)))


@checked
def calibrate_views(
    views: TargetImages,
    target: Target,
    table_view: int | None = None,
    board_thickness: Thickness = 0.0,
    tolerances: BoardTolerances | None = None,
    progress: Progress | None = None,
) -> tuple[StereoCalibration, tuple[str, ...]]:
    """Calibrate from files; unreadable views are skipped, and named in the second item.

    table_view : index among all views; board_thickness [m]
    Raises RecordingError if the table view cannot be read, CalibrationError if the views do not allow a calibration.

        >>> views = find_views("calibration/left/*.png", "calibration/right/*.png", "clip")
        >>> board = read_recording("clip").chessboard
        >>> found, problems = calibrate_views(views, board, table_view=0, board_thickness=3e-3)
        >>> round(found.rig.baseline, 4), problems
        (0.2955, ())
    """
    if table_view is not None and not 0 <= table_view < len(views):
        raise RecordingError(
            f"{views.place}: [table] view = {table_view}, but there are {len(views)} calibration views, "
            "counted from 0. Name the view whose board lies flat on the table."
        )
    read: dict[int, tuple[AnyArray, ...]] = {}
    problems = []
    for i, pair in enumerate(zip(views.left, views.right, strict=True)):
        try:
            read[i] = tuple(map(_pixels, pair, views.fields, views.parts))
        except RecordingError as error:
            if i == table_view:
                raise RecordingError(f"{error} It is the table view: without it there is no lab frame.") from error
            problems.append(f"left out: {error}")
    names = [(str(views.left[i]), str(views.right[i])) for i in read]
    position = None if table_view is None else list(read).index(table_view)
    left, right = ([pair[side] for pair in read.values()] for side in (0, 1))
    found = calibrate_stereo(left, right, target, tolerances, position, board_thickness, names, progress)
    return found, tuple(problems)


def pixels_of(view: View) -> AnyArray:
    """Grey values or colours of a view as stored. Raises RecordingError."""
    if isinstance(view, FrameView):
        return view.reader.read(view.index)
    return decode(content_of(view, str(view)), str(view))


def _pixels(view: View, flat: FlatField | None, part: Part | None) -> AnyArray:
    """Corrected grey values or colours of a view. Raises RecordingError, which names the file or frame."""
    image = pixels_of(view)
    whole = flat.corrected(image) if flat is not None and flat.fits(image) else image
    return whole if part is None else cut_out(whole, part, str(view))


@dataclass(frozen=True)
class CalibrationSource:
    """All inputs of a calibration."""

    name: str
    views: TargetImages
    board: Target
    table_view: int | None
    board_thickness: float  # [m]
    tolerances: BoardTolerances

    def calibrated(self, progress: Progress | None) -> tuple[StereoCalibration, tuple[str, ...]]:
        """Result of `calibrate_views`."""
        table = self.table_view, self.board_thickness
        return calibrate_views(self.views, self.board, *table, self.tolerances, progress)

    @property
    def provenance(self) -> Provenance:
        """Identity of the inputs; reads the content of the views."""
        return Provenance(
            recording=self.name,
            inputs={"calibration views": self.views.sha256()},
            settings={
                **described(self.board),
                "table_view": self.table_view,
                "board_thickness_m": self.board_thickness,
                "tolerances": dataclasses.asdict(self.tolerances),
            },
        )


def source_of(recording: Recording) -> CalibrationSource:
    """Views, board and table of a recording. Raises RecordingError if it names a rig file instead."""
    views, table = recording.views, recording.table
    if views is None or table is None:
        raise RecordingError(
            f"{recording.file}: [calibration] names a rig file, so there are no views to calibrate from. "
            "Use that rig as it is, or give left, right, inner_corners and square_mm instead."
        )
    images, tolerances = declared_views(recording, views), recording.board_tolerances
    return CalibrationSource(recording.name, images, views.target, table.view, table.board_thickness, tolerances)


@checked
def calibrate_recording(
    recording: Recording, progress: Progress | None = None
) -> tuple[StereoCalibration, tuple[str, ...]]:
    """`calibrate_views` with the views, board and table of a recording. Raises RecordingError without them.

    >>> found, problems = calibrate_recording("clip")
    >>> round(found.rig.baseline, 4)
    0.2955
    """
    return source_of(recording).calibrated(progress)


def boards_in(rig_file: Path, recording: Recording) -> Boards | None:
    """Poses of the board in the views of a rig file; None if it has none. Raises RigFileError."""
    _, record = read_rig_file(rig_file)
    if record is None:
        return None
    return boards_of(record, None if recording.views is None else declared_views(recording, recording.views))


def boards_of(record: Record, views: TargetImages | None) -> Boards:
    """Poses of the board; views are numbered as in `views`, of which only some may have been used."""
    known = {} if views is None else {str(view): i for i, view in enumerate(views.left)}
    found = [known.get(left, i) for i, (left, _) in enumerate(record["view_names"])]
    places = dict(zip(found, zip(record["R_left_board"], record["t_left_board"], strict=True), strict=False))
    view = None if record["table_view"] is None else found[record["table_view"]]
    return Boards(places, view, record["board_thickness"], noticed_in(record))


def noticed_in(record: Mapping[str, Any]) -> tuple[Finding, ...]:
    """`doubts` and `warnings` of a calibration as findings."""
    doubts = of_kind(Kind.CALIBRATION, Severity.DOUBT, record.get("doubts", ()))
    return doubts + of_kind(Kind.CALIBRATION, Severity.WARNING, record.get("warnings", ()))


def given_rig(file: Path) -> tuple[StereoRig, Report]:
    """A rig from a file, and its report. Raises RigFileError."""
    keep(file)
    rig = read_rig(file)
    return rig, Report("", f"{file}: baseline {rig.baseline * 1e3:.3f} mm.")


def calibrate_into(
    path: Path, source: CalibrationSource, overwrite: bool, figures: bool, force: bool = False
) -> tuple[StereoRig, Report]:
    """Calibrate, or reuse an existing rig; write rig and figure.

    force : also write an unusable rig; otherwise raises CalibrationError
    returns : the rig, and a report with the files that were written
    Raises OutputError if `path` contains something else and may not be replaced.
    """
    refuse_input(path)
    provenance = source.provenance
    if path.exists() and not overwrite:
        summarised = _reusable(path, provenance)
        if summarised is None:
            raise OutputError(
                f"{path}: exists, and is not the complete result of these views, settings and version. Keep it and "
                "choose another place with -o, or replace it with --overwrite."
            )
        summarised["rows"].append(("reused", f"{path}: complete result of the same views, settings and version"))
        return read_rig(path), _report(summarised, [path])
    with compiling("corners", 8):
        corner_fit.prepare()
    with progress_bar("calibrate", 2 * len(source.views), "image") as advance:
        found, problems = source.calibrated(lambda stage, done, total: advance(1))
    found = dataclasses.replace(found, warnings=(*problems, *found.warnings))
    if found.assessment.beyond_use and not force:
        said = "; ".join([found.assessment.verdict, *found.warnings])
        raise CalibrationError(
            f"{source.views.place}: the rig is beyond use and was not written. {said}. Take better views; `disctrack "
            "calibrate --force` writes it as it is."
        )
    summarised = {
        "verdict": f"{found.assessment.verdict}.",
        "accuracy": found.assessment.figures,
        "rows": list(summary.calibration_rows(found, problems)),
        "doubts": found.doubts,
        "warnings": found.warnings,
    }
    write_whole(path, rig_bytes(found, {**provenance.as_attributes(), "summary": json.dumps(summarised)}))
    files = [path]
    if figures:
        from disctrack.calibrate.figures import residuals_figure
        from disctrack.report.figures import save_figure

        prefix = "calibration" if path.stem == "rig" else f"{path.stem}_calibration"
        files.append(save_figure(residuals_figure(found), path.with_name(f"{prefix}_residuals.png")))
    return found.rig, _report(summarised, files)


def _report(kept: Mapping[str, Any], files: Sequence[Path]) -> Report:
    """The report of a calibration, from the summary in its rig file."""
    return Report("", kept["verdict"], kept["accuracy"], noticed_in(kept), blocks=[Facts(kept["rows"])], files=files)


def is_rig_of(path: Path, source: CalibrationSource) -> bool:
    """True if `path` is the complete rig of these views, settings and version, so that it can be reused."""
    try:
        return path.is_file() and _reusable(path, source.provenance) is not None
    except RigFileError:
        return False


def _reusable(path: Path, provenance: Provenance) -> dict[str, Any] | None:
    """Summary of the rig in `path` if it is from the same inputs; None otherwise. Raises RigFileError."""
    with complete_rig(path, "calibrate --overwrite") as file:
        same = file.attrs.get("fingerprint") == provenance.fingerprint
        return dict(json.loads(file.attrs["summary"])) if same else None
