"""`disctrack calibrate`: views of a chessboard become a stereo rig."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `disctrack calibrate`."""
    from disctrack.commands._outputs import add_calibration_options

    parser.add_argument("recording", type=Path, nargs="?", help="folder with a recording.toml that names the views")
    parser.add_argument("-o", "--output", type=Path, help="rig file (default: RECORDING/results/rig.h5)")
    without = parser.add_argument_group("without a recording")
    without.add_argument("--left", metavar="PATTERN", help="left views, e.g. 'left*.jpg'")
    without.add_argument("--right", metavar="PATTERN", help="right views, in the same order")
    without.add_argument("--corners", type=_corners, metavar="NxM", help="inner corners, long side first, e.g. 9x6")
    without.add_argument("--square-mm", type=_length, metavar="MM", help="side of a square")
    without.add_argument("--table-view", type=int, metavar="I", help="view whose board lies flat on the table, from 0")
    without.add_argument("--board-thickness-mm", type=_length_or_zero, default=0.0, metavar="MM")
    parser.add_argument("--overwrite", action="store_true", help="replace a rig made from other views or settings")
    parser.add_argument("--no-figures", action="store_true", help="no pictures")
    add_calibration_options(parser)


def run(arguments: argparse.Namespace) -> int:
    """Calibrate; returns the exit code."""
    from disctrack.commands import DONE
    from disctrack.commands import _calibration as calibration
    from disctrack.commands import _outputs as outputs
    from disctrack.track import summary

    if arguments.recording is None:
        source = calibration.source_of_patterns(arguments)
        path = arguments.output or Path("rig.h5")
    else:
        source = calibration.source_of_recording(arguments)
        path = arguments.output or arguments.recording / outputs.RESULTS / "rig.h5"
    outputs.check_writable(path.parent)
    result = calibration.calibrate_into(path, source, arguments.overwrite, figures=not arguments.no_figures)
    print("\n".join([*result.lines, *summary.file_lines([outputs.relative(file) for file in result.files])]))
    return DONE


def _corners(text: str) -> tuple[int, int]:
    first, times, second = text.lower().partition("x")
    if not (times and first.isdecimal() and second.isdecimal() and min(int(first), int(second)) >= 2):
        raise argparse.ArgumentTypeError(f"'{text}' is no grid of inner corners; give e.g. 9x6")
    return int(first), int(second)


def _length(text: str) -> float:
    length = _length_or_zero(text)
    if length == 0:
        raise argparse.ArgumentTypeError("the length must be above 0 mm")
    return length


def _length_or_zero(text: str) -> float:
    try:
        length = float(text)
    except ValueError:
        length = -1.0
    if not 0 <= length < float("inf"):
        raise argparse.ArgumentTypeError(f"'{text}' is no length in mm")
    return length
