"""`disctrack validate`: the accuracy claim put to the test on rendered recordings with known truth."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `disctrack validate`."""
    parser.add_argument(
        "--recordings", type=int, metavar="N", help="recordings, each with its own cameras and chessboards (default: 3)"
    )
    parser.add_argument(
        "-o", "--output", type=Path, default=Path("validation"), help="folder for tables and pictures (%(default)s)"
    )
    parser.add_argument("--quick", action="store_true", help="small images and few of everything: about a minute")
    parser.add_argument(
        "--imperfect", type=int, metavar="N", default=0, help="instead: N recordings of an imperfect laboratory"
    )
    parser.add_argument("--seed", type=int, help="of the first recording; the others count up from it")
    parser.add_argument("--quiet", action="store_true", help="do not tell of every step")


def run(arguments: argparse.Namespace) -> int:
    """Validate, write, print the verdict; exit code 1 if a check failed."""
    from disctrack.commands import DONE, FAILED
    from disctrack.errors import SceneError
    from disctrack.validate import complaints, run_validate, verdict
    from disctrack.validate.run import FIRST_SEED

    if arguments.recordings is not None and arguments.recordings < 1:
        raise SceneError(f"--recordings {arguments.recordings}: expected 1 or more")
    began = time.perf_counter()

    def say(step: str) -> None:
        if not arguments.quiet:
            print(f"{time.perf_counter() - began:6.0f} s  {step}", file=sys.stderr, flush=True)

    first = FIRST_SEED if arguments.seed is None else arguments.seed
    if arguments.imperfect > 0:
        from disctrack.files.whole import make_folder, write_whole
        from disctrack.validate.imperfect import imperfect_table, imperfect_trials
        from disctrack.validate.run import scene_of

        make_folder(arguments.output)
        scenes = [scene_of(first + k, arguments.quick) for k in range(arguments.imperfect)]
        table = imperfect_table(imperfect_trials(scenes, 60 if arguments.quick else 200, say))
        write_whole(arguments.output / "imperfect.md", table.encode())
        print(table)
        return DONE
    summary, files = run_validate(
        arguments.output,
        recordings=arguments.recordings,
        quick=arguments.quick,
        seed=first,
        say=say,
    )
    print(verdict(summary))
    print(f"Written: {', '.join(str(file) for file in files)}")
    failed = complaints(summary)
    for line in failed:
        print(f"disctrack: validation: {line}", file=sys.stderr)
    return FAILED if failed else DONE
