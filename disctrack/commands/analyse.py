"""`disctrack analyse`: from a trajectory file to the physics."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `disctrack analyse`."""
    parser.add_argument("trajectory", type=Path, help="file written by disctrack track; it gets four more groups")
    parser.add_argument(
        "-o", "--output", type=Path, help="folder for the report (default: NAME_analysis beside the file)"
    )
    parser.add_argument(
        "--window", type=_seconds, default=0.5, help="last seconds before collapse for the exponents (default: 0.5)"
    )
    parser.add_argument(
        "--circle", type=_seconds, default=0.6, help="last seconds for the circle through the contact (default: 0.6)"
    )
    parser.add_argument(
        "--rerun",
        action="store_true",
        help="also write motion.rrd for the 3-D viewer (needs rerun-sdk)",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an older report")


def _seconds(text: str) -> float:
    value = float(text)
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} is not a positive number of seconds")
    return value


def run(arguments: argparse.Namespace) -> int:
    """Analyse, write, and say what was found; returns the exit code."""
    from disctrack.analyse.stage import run_analyse
    from disctrack.commands import DONE
    from disctrack.files.reuse import origin_of, remember, reusable
    from disctrack.progress import stage

    path = arguments.trajectory
    folder = arguments.output or path.with_name(f"{path.stem}_analysis")
    motion = folder / "motion.rrd"
    if arguments.rerun:
        from disctrack.analyse.viewer import require_rerun, write_rerun

        require_rerun(motion)  # at once: the analysis takes a while
    origin = origin_of(path, {"window": arguments.window, "circle": arguments.circle})
    told = None if arguments.overwrite or (arguments.rerun and not motion.exists()) else reusable(folder, origin)
    if told is not None:
        print(
            "\n".join([f"reused        {folder}: complete result of the same trajectory, settings and version", *told])
        )
        return DONE
    again = arguments.overwrite or reusable(folder, origin) is not None
    with stage("analyse"):
        outcome = run_analyse(path, folder, window=arguments.window, circle_duration=arguments.circle, overwrite=again)
    lines = outcome.lines()
    if arguments.rerun:
        write_rerun(motion, outcome.analysis)
        lines.append(f"              {motion}")
    remember(folder, origin, lines, (outcome.report, *outcome.figures))
    print("\n".join(lines))
    return DONE
