"""`disctrack calibrate`: views of a chessboard become a stereo rig."""

from __future__ import annotations

import argparse
from pathlib import Path

from calibration import Board
from disctrack.calibrate.stage import CalibrationSource, calibrate_into, source_of
from disctrack.calibrate.views import find_views
from disctrack.commands import DONE
from disctrack.commands import _outputs as outputs
from disctrack.errors import RecordingError
from disctrack.recording.declaration import read_recording
from disctrack.track import summary


def run(arguments: argparse.Namespace) -> int:
    """Calibrate; returns the exit code."""
    if arguments.recording is None:
        source = _source_of_patterns(arguments)
        path = arguments.output or Path("rig.h5")
    else:
        source = source_of(read_recording(arguments.recording), outputs.calibration_settings(arguments))
        path = arguments.output or arguments.recording / outputs.RESULTS / "rig.h5"
    outputs.check_writable(path.parent)
    result = calibrate_into(path, source, arguments.overwrite, figures=not arguments.no_figures)
    print("\n".join([*result.lines, *summary.file_lines([outputs.relative(file) for file in result.files])]))
    return DONE


def _source_of_patterns(arguments: argparse.Namespace) -> CalibrationSource:
    """Views named on the command line. Raises RecordingError."""
    given = {
        "--left": arguments.left,
        "--right": arguments.right,
        "--corners": arguments.corners,
        "--square-mm": arguments.square_mm,
    }
    missing = [option for option, value in given.items() if value is None]
    if missing:
        raise RecordingError(f"{', '.join(missing)} missing: give a recording's folder, or all of {', '.join(given)}.")
    return CalibrationSource(
        arguments.left,
        find_views(arguments.left, arguments.right, Path()),
        Board(arguments.corners, arguments.square_mm * 1e-3),
        arguments.table_view,
        arguments.board_thickness_mm * 1e-3,
        outputs.calibration_settings(arguments),
    )
