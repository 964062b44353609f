"""Arguments of each command.

Only argparse is imported here, so that --help and errors of usage are fast.
"""

import argparse
import re
from argparse import _ActionsContainer as Options  # a parser, or a group of its options
from collections.abc import Callable
from pathlib import Path
from typing import Any

PAPERS = ("a3", "a4", "letter")
UNKNOWN_TO_FILES = {
    "frame_rate_hz": "frames per second",
    "radius_mm": "radius of the disc",
    "thickness_mm": "its thickness",
    "mass_g": "its mass",
    "diameter_mm": "diameter of a dot",
    "square_mm": "side of a square of the board",
    "board_thickness_mm": "height of the board's printed face above the table",
}
RECORDING = "folder with a recording.toml"
EXTRA_FIGURES = "also write every figure of the report as PNG and PDF, into figures/"


def _number(kind: Callable[[str], float], least: float, what: str) -> Callable[[str], float]:
    """Parser of a finite number that is at least `least`."""

    def read(text: str) -> float:
        try:
            value = kind(text)
        except ValueError:
            value = -1
        if not least <= value < float("inf"):
            raise argparse.ArgumentTypeError(f"'{text}' is not {what}")
        return value

    return read


_positive = _number(int, 1, "a whole number above 0")
_seed = _number(int, 0, "a whole number from 0 on")
_positive_number = _number(float, 1e-300, "a positive number")
_length_or_zero = _number(float, 0, "a length in mm")


def _two(form: str, what: str, ordered: bool = False) -> Callable[[str], tuple[int | None, ...]]:
    """Parser of two whole numbers in a form; None for an empty one.   ordered : the first is not above the second"""

    def read(text: str) -> tuple[int | None, ...]:
        match = re.fullmatch(form, text.lower())
        if not match or (ordered and int(match[1]) > int(match[2])):
            raise argparse.ArgumentTypeError(f"'{text}' is {what}")
        return tuple(int(number) if number else None for number in match.groups())

    return read


_corners = _two(r"([2-9]|[1-9]\d+)x([2-9]|[1-9]\d+)", "no grid of inner corners; give e.g. 9x6")
_shard = _two(r"([1-9]\d*)/([1-9]\d*)", "no shard; give e.g. 2/8 for the second of eight (1/8 to 8/8)", ordered=True)
_frame_range = _two(r"(-?\d+)?:(-?\d+)?", "no range; give first:last, e.g. 100:200 or 100:")


def _value(options: Options, usage: str, read: Callable[[str], object], what: str, **more: Any) -> None:
    """An option with a value; usage : as "-j --jobs N"."""
    *names, shown = usage.split()
    options.add_argument(*names, type=read, metavar=shown, help=what, **more)


def _file(options: Options, name: str, what: str, **more: Any) -> None:
    options.add_argument(*name.split(), type=Path, help=what, **more)


def _flag(options: Options, name: str, what: str) -> None:
    options.add_argument(*name.split(), action="store_true", help=what)


def add_init(parser: argparse.ArgumentParser) -> None:
    """Arguments of `disctrack init`."""
    _file(parser, "folder", "folder with the frames of two cameras and views of a chessboard")
    what = "take disc, dots, board and table from this recording.toml where the files do not say"
    _file(parser, "--like", what, metavar="RECORDING")
    group = parser.add_argument_group("what no file says", "left to fill in where it is not given")
    for option, what in UNKNOWN_TO_FILES.items():
        number = _length_or_zero if option == "board_thickness_mm" else _positive_number
        _value(group, f"--{option.replace('_', '-')} {option.rsplit('_', 1)[-1].upper()}", number, what)


def add_sample(parser: argparse.ArgumentParser) -> None:
    """Arguments of `disctrack sample`."""
    _file(parser, "folder", "new folder for the recording")
    _flag(parser, "-q --quiet", "no progress bar")


def add_open(parser: argparse.ArgumentParser) -> None:
    """Arguments of `disctrack open`."""
    _file(parser, "recording", "folder of a recording, of its results, or of a batch")


def add_print(parser: argparse.ArgumentParser) -> None:
    """Arguments of `disctrack print`."""
    _file(parser, "recording", f"{RECORDING} (default: the disc of Ma et al. 2014 and a board of 9 x 6)", nargs="?")
    _file(parser, "-o --output", "folder for dots.pdf and board.pdf (here)", default=Path())
    parser.add_argument("--paper", choices=PAPERS, default="a4", help="size of the sheet (%(default)s)")
    _flag(parser, "--light-dots", "white dots in a black face")
    _flag(parser, "--overwrite", "replace older sheets")


def add_check(parser: argparse.ArgumentParser) -> None:
    """Arguments of `disctrack check`."""
    _recording_options(parser, "the picture (default: RECORDING/results/check.png)")
    _flag(parser, "--no-figures", "no picture")


def add_run(parser: argparse.ArgumentParser) -> None:
    """Arguments of `disctrack run`."""
    _recording_options(parser, "folder for the results (default: RECORDING/results)")
    _tracking_options(parser)


def add_calibrate(parser: argparse.ArgumentParser) -> None:
    """Arguments of `disctrack calibrate`."""
    _output_options(parser)
    _file(parser, "recording", f"{RECORDING} that names the views", nargs="?")
    _file(parser, "-o --output", "rig file (default: RECORDING/results/rig.h5)")
    without = parser.add_argument_group("without a recording")
    _value(without, "--left PATTERN", str, "left views, e.g. 'left*.jpg'")
    _value(without, "--right PATTERN", str, "right views, in the same order")
    _value(without, "--corners NxM", _corners, "inner corners, long side first, e.g. 9x6")
    _value(without, "--square-mm MM", _positive_number, "side of a square")
    _value(without, "--table-view I", int, "view whose board lies flat on the table, from 0")
    _value(without, "--board-thickness-mm MM", _length_or_zero, "(default: 0)")
    _flag(parser, "--overwrite", "replace a rig made from other views or settings")
    _flag(parser, "--force", "write a rig that is beyond use, too")
    _flag(parser, "--no-figures", "no pictures")


def add_track(parser: argparse.ArgumentParser) -> None:
    """Arguments of `disctrack track`."""
    _recording_options(parser, "trajectory file (default: RECORDING/results/trajectory.h5)")
    _file(parser, "--rig", "rig file (default: the recording's own, or results/rig.h5)")
    _tracking_options(parser)


def add_analyse(parser: argparse.ArgumentParser) -> None:
    """Arguments of `disctrack analyse`."""
    _output_options(parser)
    what = "file written by disctrack track, or a recording's folder; the file gets four more groups"
    _file(parser, "trajectory", what)
    _file(parser, "-o --output", "folder for the report (default: NAME_analysis beside the file)")
    _last_seconds(parser, "--window", 0.5, "last seconds before collapse for the exponents")
    _last_seconds(parser, "--circle", 0.6, "last seconds for the circle through the contact")
    _flag(parser, "--figures", EXTRA_FIGURES)
    what = "where the images for motion.html are (default: the folder that holds results/)"
    _file(parser, "--recording", what, metavar="FOLDER")
    _flag(parser, "--overwrite", "replace an older report")


def add_diagnose(parser: argparse.ArgumentParser) -> None:
    """Arguments of `disctrack diagnose`."""
    _output_options(parser)
    what = "trajectory file, or a recording's folder; the group diagnosis is added to it. Several: one answer"
    _file(parser, "trajectory", what, nargs="+")
    models = "paper (rolling with its k_m; default), none (no losses), or a saved model (TOML)"
    parser.add_argument("--model", default="paper", help=models)
    _flag(parser, "--figures", EXTRA_FIGURES)
    what = "folder for the results (default: NAME_diagnosis beside it; of several: together_diagnosis)"
    _file(parser, "-o --output", what)
    _flag(parser, "--plan", "also compute which further recordings would settle what is left open")
    _value(parser, "-j --jobs N", _positive, "processes for several files (default: cores)")
    _flag(parser, "--anyway", "even where a number is declared wrong")
    _flag(parser, "--overwrite", "replace an earlier diagnosis")


def add_batch(parser: argparse.ArgumentParser) -> None:
    """Arguments of `disctrack batch`."""
    _output_options(parser)
    _file(parser, "folders", "recordings are sought at any depth", nargs="+", metavar="FOLDER")
    _file(parser, "-o --output", "folder for all results (default: RECORDING/results, and FOLDER/batch_results)")
    _value(parser, "-j --jobs N", _positive, "processes side by side (default: cores)")
    _value(parser, "--shard i/N", _shard, "only every N-th recording, from the i-th (1...N)")
    parser.add_argument("--cluster", metavar="ADDRESS", help="scheduler of a dask cluster that does the work")
    _flag(parser, "--summary-only", "measure nothing; sum up what there is")
    what = "numbers only, no report and figures per recording"
    parser.add_argument("--no-report", dest="report", action="store_false", help=what)
    _flag(parser, "--diagnose", "also ask of each which effect the model lacks")
    _flag(parser, "--together", "also ask it of all together: one answer for many")
    _flag(parser, "--overwrite", "measure anew what is done already")
    _last_seconds(parser, "--window", 0.5, "last seconds for the exponents")


def add_simulate(parser: argparse.ArgumentParser) -> None:
    """Arguments of `disctrack simulate`."""
    _file(parser, "scene", 'TOML file whose motion.kind is "rolling"', nargs="?")
    _file(parser, "-o --output", "HDF5 file (default: SCENE_motion.h5 beside the scene)")
    _value(parser, "--duration S", _positive_number, "seconds (default: as long as the scene films)")
    _value(parser, "--rate HZ", _positive_number, "instants per second (default: the cameras')")
    _flag(parser, "--overwrite", "replace an older file")
    _flag(parser, "--list-effects", "print the catalogue of effects and stop")


def add_render(parser: argparse.ArgumentParser) -> None:
    """Arguments of `disctrack render`."""
    _file(parser, "scene", "TOML file; what it does not say takes its default", nargs="?")
    _file(parser, "-o --output", "new folder for the recording (default: SCENE beside the scene)")
    _file(parser, "--truth", "where the truth goes (default: truth.h5 in the folder)", metavar="FILE")
    _flag(parser, "--quiet", "no progress bar")
    _flag(parser, "--defaults", "print a scene with every key at its default and stop")


def add_convert(parser: argparse.ArgumentParser) -> None:
    """Arguments of `disctrack convert`."""
    what = "trajectory.h5, rig.h5, or a rig of another program; two files where it keeps one per camera, left first"
    _file(parser, "source", what, nargs="+")
    what = (
        "by its ending: a trajectory to .csv, .mat, .c3d, .trc, .tsv (QTM), xypts.csv (DLTdv8), .nc; a rig to "
        ".yml (OpenCV), .toml (Caliscope), .cameramodel (mrcal), camchain.yaml (Kalibr), .mat; these to .h5"
    )
    _file(parser, "target", what)
    parser.add_argument("--as", dest="form", metavar="FORMAT", help="where the ending does not say, e.g. Pose2Sim")
    _flag(parser, "--table", "the foreign rig's reference is the table, z up (else heights mean nothing)")
    what = "which two cameras of a Caliscope or Anipose file"
    parser.add_argument("--cameras", nargs=2, metavar=("LEFT", "RIGHT"), help=what)
    what = "[px] where an OpenCV file does not state it"
    parser.add_argument("--image-size", type=_positive, nargs=2, metavar=("WIDTH", "HEIGHT"), help=what)
    _value(parser, "--unit-mm UNIT_MM", _positive_number, "length of an OpenCV file's unit, where it does not state it")
    _flag(parser, "--overwrite", "replace the target")


def add_warm_up(parser: argparse.ArgumentParser) -> None:
    """Arguments of `disctrack warm-up`: none."""


def add_validate(parser: argparse.ArgumentParser) -> None:
    """Arguments of `disctrack validate`."""
    _value(parser, "--recordings N", _positive, "that are rendered and measured (default: 3)")
    _flag(parser, "--quick", "small images and few of everything: half a minute")
    _value(parser, "--imperfect N", _positive, "N of an imperfect laboratory instead", default=0)
    what = "instead: hide each of these effects (default: all known; nothing, prints, laboratory: none) and diagnose"
    parser.add_argument("--diagnosis", nargs="*", metavar="EFFECT[=SIZE]", help=what)
    what = "instead: plant every fault of a measurement into a rendered recording and into these, and run each"
    _file(parser, "--faults", what, nargs="*", metavar="RECORDING")
    _value(parser, "--seeds SEEDS", _positive, "recordings for each hidden effect (%(default)s)", default=6)
    _value(parser, "--pairs N", _positive, "hide N pairs of effects instead", default=0)
    rate = "to diagnose at, in Hz (%(default)s)"
    _value(parser, "--frame-rate FRAME_RATE", _positive_number, rate, default=1000.0)
    _value(parser, "--seed SEED", _seed, "of the first recording; the others count up from it")
    _value(parser, "-j --jobs JOBS", _positive, "processes (%(default)s)", default=1)
    _file(parser, "-o --output", "folder of tables (%(default)s)", default=Path("validation"))
    _file(parser, "--write", "also put the tables into this Markdown page", metavar="FILE")
    _flag(parser, "--quiet", "no progress bar")


def _last_seconds(parser: argparse.ArgumentParser, name: str, default: float, what: str) -> None:
    _value(parser, f"{name} S", _positive_number, f"{what} (default: %(default)s)", default=default)


def _recording_options(parser: argparse.ArgumentParser, output: str) -> None:
    """Common options of commands on one recording.   output : what they write"""
    _output_options(parser)
    _file(parser, "recording", RECORDING)
    _file(parser, "-o --output", output)


def _output_options(parser: argparse.ArgumentParser) -> None:
    group = parser.add_mutually_exclusive_group()
    _flag(group, "-v --verbose", "all that was found, as in summary.txt")
    _flag(group, "-q --quiet", "nothing but errors")
    _flag(group, "--json", "one JSON document on stdout")


def _tracking_options(parser: argparse.ArgumentParser) -> None:
    """Common options of `run` and `track`."""
    part = parser.add_mutually_exclusive_group()
    what = "measure frames A to B-1, no others; the file keeps the recording's length"
    _value(part, "--frames A:B", _frame_range, what)
    _flag(part, "--all", "measure every frame (default: not the rest before and after the motion)")
    _flag(parser, "--overwrite", "replace results of other inputs or settings")
    _flag(parser, "--csv", "also write the trajectory as a table (mm, deg)")
    _flag(parser, "--no-figures", "no pictures")
    _flag(parser, "--no-video", "no overlay video")
    _value(parser, "--threads THREADS", _positive, "threads that read and track (default: one per core)")
