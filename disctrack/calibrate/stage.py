"""Calibration from files to a file: source of the views, reuse of a rig, the rig file, the figure."""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from calibration import BoardTolerances, StereoCalibration, StereoRig
from calibration.board import corner_fit
from calibration.board.search import Progress
from calibration.board.target import Target, described
from calibration.kit.types import checked
from calibration.rig_file import Record, complete_rig, read_rig, read_rig_file, rig_bytes
from disctrack.analyse.declaration import Boards
from disctrack.calibrate.views import TargetImages, calibrate_views, declared_views
from disctrack.errors import CalibrationError, OutputError, RecordingError, RigFileError
from disctrack.files.whole import keep, refuse_input, write_whole
from disctrack.findings import Finding, Kind, Severity, of_kind
from disctrack.progress import compiling, progress_bar
from disctrack.recording.declaration import Recording
from disctrack.report.blocks import Facts, Report
from disctrack.track import run_summary as summary
from disctrack.trajectory.file import Provenance


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
