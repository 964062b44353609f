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
        "--rerun", action="store_true", help="also write motion.rrd for the 3-D viewer rerun (needs disctrack[viewer])"
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
    from disctrack.cli import DONE

    outcome = run_analyse(
        arguments.trajectory,
        arguments.output,
        window=arguments.window,
        circle_duration=arguments.circle,
        overwrite=arguments.overwrite,
    )
    print("\n".join(outcome.lines()))
    if arguments.rerun:
        from disctrack.analyse.viewer import write_rerun

        recording = outcome.report.with_name("motion.rrd")
        write_rerun(recording, outcome.analysis)
        print(f"              {recording}")
    return DONE
