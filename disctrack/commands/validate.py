"""`disctrack validate`: the accuracy claim put to the test on rendered recordings with known truth."""

import argparse
import sys
import time

from disctrack.commands import DONE, FAILED
from disctrack.files.whole import make_folder, write_whole
from disctrack.validate import complaints, run_validate, verdict
from disctrack.validate.imperfect import imperfect_table, imperfect_trials
from disctrack.validate.run import FIRST_SEED, scene_of


def run(arguments: argparse.Namespace) -> int:
    """Validate, write, print the verdict; exit code 1 if a check failed."""
    began = time.perf_counter()

    def say(step: str) -> None:
        if not arguments.quiet:
            print(f"{time.perf_counter() - began:6.0f} s  {step}", file=sys.stderr, flush=True)

    first = FIRST_SEED if arguments.seed is None else arguments.seed
    if arguments.imperfect > 0:
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
