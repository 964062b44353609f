"""`disctrack calibrate`: views of a chessboard become a stereo rig."""

import argparse
from pathlib import Path

from calibration import Board, BoardTolerances
from disctrack.calibrate.stage import CalibrationSource, calibrate_into, find_views, source_of
from disctrack.commands import _outputs as outputs
from disctrack.errors import RecordingError
from disctrack.recording.declaration import read_recording

VIEWS = ("--left", "--right", "--corners", "--square-mm")
TABLE = ("--table-view", "--board-thickness-mm")


def run(arguments: argparse.Namespace) -> int:
    """Calibrate; returns the exit code."""
    given = [name for name in VIEWS + TABLE if getattr(arguments, name[2:].replace("-", "_")) is not None]
    if arguments.recording is None:
        source = _source_of_patterns(arguments, given)
        path = arguments.output or Path("rig.h5")
    else:
        if given:
            raise RecordingError(
                f"{', '.join(given)}: a recording's own recording.toml says this. Change it there, or give no folder."
            )
        source = source_of(read_recording(arguments.recording))
        path = arguments.output or arguments.recording / outputs.RESULTS / "rig.h5"
    outputs.check_writable(path.parent)
    _, report = calibrate_into(path, source, arguments.overwrite, not arguments.no_figures, arguments.force)
    return outputs.finish(report, arguments, path.parent)


def _source_of_patterns(arguments: argparse.Namespace, given: list[str]) -> CalibrationSource:
    """Views named on the command line by the options `given`. Raises RecordingError."""
    if missing := [name for name in VIEWS if name not in given]:
        raise RecordingError(f"{', '.join(missing)} missing: give a recording's folder, or all of {', '.join(VIEWS)}.")
    return CalibrationSource(
        arguments.left,
        find_views(arguments.left, arguments.right, Path()),
        Board(arguments.corners, arguments.square_mm * 1e-3),
        arguments.table_view,
        (arguments.board_thickness_mm or 0.0) * 1e-3,
        BoardTolerances(),
    )
