"""What each command may be given.

Nothing but the parser is imported here, so that --help and a mistyped option are answered at once.
"""

import argparse
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


def _number(kind: type, least: float, what: str) -> Callable[[str], Any]:
    """What reads a finite number from `least` on."""

    def read(text: str) -> Any:
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


def add_init(parser: argparse.ArgumentParser) -> None:
    """Arguments of `disctrack init`."""
    parser.add_argument("folder", type=Path, help="folder with the frames of two cameras and views of a chessboard")
    what = "take disc, dots, board and table from this recording.toml where the files do not say"
    parser.add_argument("--like", type=Path, metavar="RECORDING", help=what)
    group = parser.add_argument_group("what no file says", "left to fill in where it is not given")
    for option, what in UNKNOWN_TO_FILES.items():
        number = _length_or_zero if option == "board_thickness_mm" else _positive_number
        group.add_argument(
            f"--{option.replace('_', '-')}", type=number, metavar=option.rsplit("_", 1)[-1].upper(), help=what
        )


def add_sample(parser: argparse.ArgumentParser) -> None:
    """Arguments of `disctrack sample`."""
    parser.add_argument("folder", type=Path, help="new folder for the recording")
    parser.add_argument("-q", "--quiet", action="store_true", help="no progress bar")


def add_open(parser: argparse.ArgumentParser) -> None:
    """Arguments of `disctrack open`."""
    parser.add_argument("recording", type=Path, help="folder of a recording, of its results, or of a batch")


def add_print(parser: argparse.ArgumentParser) -> None:
    """Arguments of `disctrack print`."""
    what = "folder with a recording.toml (default: the disc of Ma et al. 2014 and a board of 9 x 6)"
    parser.add_argument("recording", type=Path, nargs="?", help=what)
    parser.add_argument("-o", "--output", type=Path, default=Path(), help="folder for dots.pdf and board.pdf (here)")
    parser.add_argument("--paper", choices=PAPERS, default="a4", help="size of the sheet (%(default)s)")
    parser.add_argument("--light-dots", action="store_true", help="white dots in a black face")
    parser.add_argument("--overwrite", action="store_true", help="replace older sheets")


def add_check(parser: argparse.ArgumentParser) -> None:
    """Arguments of `disctrack check`."""
    _output_options(parser)
    parser.add_argument("recording", type=Path, help="folder with a recording.toml")
    parser.add_argument("-o", "--output", type=Path, help="the picture (default: RECORDING/results/check.png)")
    parser.add_argument("--no-figures", action="store_true", help="no picture")


def add_run(parser: argparse.ArgumentParser) -> None:
    """Arguments of `disctrack run`."""
    _output_options(parser)
    parser.add_argument("recording", type=Path, help="folder with a recording.toml")
    parser.add_argument("-o", "--output", type=Path, help="folder for the results (default: RECORDING/results)")
    _tracking_options(parser)
    _calibration_options(parser)


def add_calibrate(parser: argparse.ArgumentParser) -> None:
    """Arguments of `disctrack calibrate`."""
    _output_options(parser)
    parser.add_argument("recording", type=Path, nargs="?", help="folder with a recording.toml that names the views")
    parser.add_argument("-o", "--output", type=Path, help="rig file (default: RECORDING/results/rig.h5)")
    without = parser.add_argument_group("without a recording")
    without.add_argument("--left", metavar="PATTERN", help="left views, e.g. 'left*.jpg'")
    without.add_argument("--right", metavar="PATTERN", help="right views, in the same order")
    without.add_argument("--corners", type=_corners, metavar="NxM", help="inner corners, long side first, e.g. 9x6")
    without.add_argument("--square-mm", type=_positive_number, metavar="MM", help="side of a square")
    without.add_argument("--table-view", type=int, metavar="I", help="view whose board lies flat on the table, from 0")
    without.add_argument("--board-thickness-mm", type=_length_or_zero, metavar="MM", help="(default: 0)")
    parser.add_argument("--overwrite", action="store_true", help="replace a rig made from other views or settings")
    parser.add_argument("--force", action="store_true", help="write a rig that is beyond use, too")
    parser.add_argument("--no-figures", action="store_true", help="no pictures")
    _calibration_options(parser)


def add_track(parser: argparse.ArgumentParser) -> None:
    """Arguments of `disctrack track`."""
    _output_options(parser)
    parser.add_argument("recording", type=Path, help="folder with a recording.toml")
    parser.add_argument("--rig", type=Path, help="rig file (default: the recording's own, or results/rig.h5)")
    parser.add_argument("-o", "--output", type=Path, help="trajectory file (default: RECORDING/results/trajectory.h5)")
    _tracking_options(parser)


def add_analyse(parser: argparse.ArgumentParser) -> None:
    """Arguments of `disctrack analyse`."""
    _output_options(parser)
    what = "file written by disctrack track, or a recording's folder; the file gets four more groups"
    parser.add_argument("trajectory", type=Path, help=what)
    parser.add_argument(
        "-o", "--output", type=Path, help="folder for the report (default: NAME_analysis beside the file)"
    )
    what = "last seconds before collapse for the exponents (default: 0.5)"
    parser.add_argument("--window", type=_positive_number, default=0.5, metavar="S", help=what)
    what = "last seconds for the circle through the contact (default: 0.6)"
    parser.add_argument("--circle", type=_positive_number, default=0.6, metavar="S", help=what)
    parser.add_argument(
        "--figures", action="store_true", help="also write every figure of the report as PNG and PDF, into figures/"
    )
    what = "where the images for motion.html are (default: the folder that holds results/)"
    parser.add_argument("--recording", type=Path, metavar="FOLDER", help=what)
    parser.add_argument("--overwrite", action="store_true", help="replace an older report")


def add_diagnose(parser: argparse.ArgumentParser) -> None:
    """Arguments of `disctrack diagnose`."""
    _output_options(parser)
    files = "trajectory file, or a recording's folder; the group diagnosis is added to it. Several: one answer"
    parser.add_argument("trajectory", type=Path, nargs="+", help=files)
    models = "paper (rolling with its k_m; default), none (no losses), or a saved model (TOML)"
    parser.add_argument("--model", default="paper", help=models)
    parser.add_argument(
        "--figures", action="store_true", help="also write every figure of the report as PNG and PDF, into figures/"
    )
    where = "folder for the results (default: NAME_diagnosis beside it; of several: together_diagnosis)"
    parser.add_argument("-o", "--output", type=Path, help=where)
    plan = "also compute which further recordings would settle what is left open"
    parser.add_argument("--plan", action="store_true", help=plan)
    jobs = "processes for several files (default: cores)"
    parser.add_argument("-j", "--jobs", type=_positive, metavar="N", help=jobs)
    parser.add_argument("--anyway", action="store_true", help="even where a number is declared wrong")
    parser.add_argument("--overwrite", action="store_true", help="replace an earlier diagnosis")


def add_batch(parser: argparse.ArgumentParser) -> None:
    """Arguments of `disctrack batch`."""
    _output_options(parser)
    parser.add_argument("folders", type=Path, nargs="+", metavar="FOLDER", help="recordings are sought at any depth")
    where = "folder for all results (default: RECORDING/results, and FOLDER/batch_results)"
    parser.add_argument("-o", "--output", type=Path, help=where)
    parser.add_argument("-j", "--jobs", type=_positive, metavar="N", help="processes side by side (default: cores)")
    parser.add_argument("--shard", type=_shard, metavar="i/N", help="only every N-th recording, from the i-th (1...N)")
    parser.add_argument("--cluster", metavar="ADDRESS", help="scheduler of a dask cluster that does the work")
    parser.add_argument("--summary-only", action="store_true", help="measure nothing; sum up what there is")
    parser.add_argument(
        "--no-report", dest="report", action="store_false", help="numbers only, no report and figures per recording"
    )
    parser.add_argument("--diagnose", action="store_true", help="also ask of each which effect the model lacks")
    parser.add_argument("--together", action="store_true", help="also ask it of all together: one answer for many")
    parser.add_argument("--overwrite", action="store_true", help="measure anew what is done already")
    what = "last seconds for the exponents (default: 0.5)"
    parser.add_argument("--window", type=_positive_number, default=0.5, metavar="S", help=what)
    _calibration_options(parser)


def add_simulate(parser: argparse.ArgumentParser) -> None:
    """Arguments of `disctrack simulate`."""
    parser.add_argument("scene", type=Path, nargs="?", help='TOML file whose motion.kind is "rolling"')
    parser.add_argument("-o", "--output", type=Path, help="HDF5 file (default: SCENE_motion.h5 beside the scene)")
    parser.add_argument(
        "--duration", type=_positive_number, metavar="S", help="seconds (default: as long as the scene films)"
    )
    parser.add_argument(
        "--rate", type=_positive_number, metavar="HZ", help="instants per second (default: the cameras')"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an older file")
    parser.add_argument("--list-effects", action="store_true", help="print the catalogue of effects and stop")


def add_render(parser: argparse.ArgumentParser) -> None:
    """Arguments of `disctrack render`."""
    parser.add_argument("scene", type=Path, nargs="?", help="TOML file; what it does not say takes its default")
    parser.add_argument(
        "-o", "--output", type=Path, help="new folder for the recording (default: SCENE beside the scene)"
    )
    parser.add_argument(
        "--truth", type=Path, metavar="FILE", help="where the truth goes (default: truth.h5 in the folder)"
    )
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    parser.add_argument("--defaults", action="store_true", help="print a scene with every key at its default and stop")


def add_convert(parser: argparse.ArgumentParser) -> None:
    """Arguments of `disctrack convert`."""
    what = "trajectory.h5, rig.h5, or a rig of another program; two files where it keeps one per camera, left first"
    parser.add_argument("source", type=Path, nargs="+", help=what)
    parser.add_argument(
        "target",
        type=Path,
        help="by its ending: a trajectory to .csv, .mat, .c3d, .trc, .tsv (QTM), xypts.csv (DLTdv8), .nc; a rig to "
        ".yml (OpenCV), .toml (Caliscope), .cameramodel (mrcal), camchain.yaml (Kalibr), .mat; these to .h5",
    )
    parser.add_argument("--as", dest="form", metavar="FORMAT", help="where the ending does not say, e.g. Pose2Sim")
    what = "the foreign rig's reference is the table, z up (else heights mean nothing)"
    parser.add_argument("--table", action="store_true", help=what)
    parser.add_argument(
        "--cameras", nargs=2, metavar=("LEFT", "RIGHT"), help="which two cameras of a Caliscope or Anipose file"
    )
    what = "[px] where an OpenCV file does not state it"
    parser.add_argument("--image-size", type=_positive, nargs=2, metavar=("WIDTH", "HEIGHT"), help=what)
    parser.add_argument(
        "--unit-mm", type=_positive_number, help="length of an OpenCV file's unit, where it does not state it"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace the target")


def add_warm_up(parser: argparse.ArgumentParser) -> None:
    """Arguments of `disctrack warm-up`: none."""


def add_validate(parser: argparse.ArgumentParser) -> None:
    """Arguments of `disctrack validate`."""
    parser.add_argument("--recordings", type=_positive, metavar="N", help="that are rendered and measured (default: 3)")
    parser.add_argument("--quick", action="store_true", help="small images and few of everything: half a minute")
    parser.add_argument(
        "--imperfect", type=_positive, metavar="N", default=0, help="N of an imperfect laboratory instead"
    )
    what = "instead: hide each of these effects (default: all known; nothing, prints, laboratory: none) and diagnose"
    parser.add_argument("--diagnosis", nargs="*", metavar="EFFECT[=SIZE]", help=what)
    what = "instead: plant every fault of a measurement into a rendered recording and into these, and run each"
    parser.add_argument("--faults", type=Path, nargs="*", metavar="RECORDING", help=what)
    parser.add_argument("--seeds", type=_positive, default=6, help="recordings for each hidden effect (%(default)s)")
    parser.add_argument("--pairs", type=_positive, default=0, metavar="N", help="hide N pairs of effects instead")
    parser.add_argument(
        "--frame-rate", type=_positive_number, default=1000.0, help="to diagnose at, in Hz (%(default)s)"
    )
    parser.add_argument("--seed", type=_seed, help="of the first recording; the others count up from it")
    parser.add_argument("-j", "--jobs", type=_positive, default=1, help="processes (%(default)s)")
    parser.add_argument("-o", "--output", type=Path, default=Path("validation"), help="folder of tables (%(default)s)")
    parser.add_argument("--write", type=Path, metavar="FILE", help="also put the tables into this Markdown page")
    parser.add_argument("--quiet", action="store_true", help="no line for every recording")


def _corners(text: str) -> tuple[int, int]:
    first, times, second = text.lower().partition("x")
    if not (times and first.isdecimal() and second.isdecimal() and min(int(first), int(second)) >= 2):
        raise argparse.ArgumentTypeError(f"'{text}' is no grid of inner corners; give e.g. 9x6")
    return int(first), int(second)


def _shard(text: str) -> tuple[int, int]:
    number, slash, of = text.partition("/")
    if not (slash and number.isdecimal() and of.isdecimal() and 1 <= int(number) <= int(of)):
        raise argparse.ArgumentTypeError(f"'{text}' is no shard; give e.g. 2/8 for the second of eight (1/8 to 8/8)")
    return int(number), int(of)


def _output_options(parser: argparse.ArgumentParser) -> None:
    group = parser.add_mutually_exclusive_group()
    group.add_argument("-v", "--verbose", action="store_true", help="all that was found, as in summary.txt")
    group.add_argument("-q", "--quiet", action="store_true", help="nothing but errors")
    group.add_argument("--json", action="store_true", help="one JSON document on stdout")


def _tracking_options(parser: argparse.ArgumentParser) -> None:
    """Options that `run` and `track` have in common."""
    part = parser.add_mutually_exclusive_group()
    what = "measure frames A to B-1, no others; the file keeps the recording's length"
    part.add_argument("--frames", type=_frame_range, metavar="A:B", help=what)
    what = "measure every frame (default: not the rest before and after the motion)"
    part.add_argument("--all", action="store_true", help=what)
    parser.add_argument("--overwrite", action="store_true", help="replace results of other inputs or settings")
    parser.add_argument("--csv", action="store_true", help="also write the trajectory as a table (mm, deg)")
    parser.add_argument("--no-figures", action="store_true", help="no pictures")
    parser.add_argument("--no-video", action="store_true", help="no overlay video")
    parser.add_argument("--threads", type=_positive, help="threads that read and track (default: one per core)")


def _calibration_options(parser: argparse.ArgumentParser) -> None:
    """Options that `run` and `calibrate` have in common."""
    group = parser.add_argument_group("calibration")
    group.add_argument("--distortion", default="auto", metavar="TERMS", help="Brown's terms, e.g. 'k1 k2'; auto: all")
    group.add_argument("--board", default="auto", metavar="SHAPE", help="flat, warped or free; auto: by held-out error")


def _frame_range(text: str) -> tuple[int | None, int | None]:
    first, colon, last = text.partition(":")
    try:
        if not colon:
            raise ValueError
        return (int(first) if first else None), (int(last) if last else None)
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is no range; give first:last, e.g. 100:200 or 100:") from None
