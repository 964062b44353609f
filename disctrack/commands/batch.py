"""`disctrack batch`: many recordings in parallel."""

import argparse
import sys
from dataclasses import fields
from pathlib import Path

from disctrack.batch import BatchOptions, run_batch, summarise_batch
from disctrack.commands import DONE, FAILED, INCOMPLETE
from disctrack.commands import _outputs as outputs
from disctrack.files.text import printable


def run(arguments: argparse.Namespace) -> int:
    """Measure, and print the result of each recording; returns the exit code."""
    options = BatchOptions(**{field.name: getattr(arguments, field.name) for field in fields(BatchOptions)})
    if arguments.summary_only:
        outcome = summarise_batch(arguments.folders, options, arguments.output)
    else:
        how = arguments.jobs, arguments.shard, arguments.cluster
        outcome = run_batch(arguments.folders, options, arguments.output, *how)
    outputs.show_report(outcome.report(), arguments, Path())
    sys.stdout.flush()
    for problem in outcome.problems:
        print(f"disctrack: {printable(problem)}", file=sys.stderr)
    if outcome.interrupted:
        raise KeyboardInterrupt
    if outcome.failed:
        print("disctrack: not everything was measured (see above). The same command tries it again.", file=sys.stderr)
    elif outcome.incomplete:
        print("disctrack: some of the input could not be used (see above).", file=sys.stderr)
    return FAILED if outcome.failed else INCOMPLETE if outcome.incomplete else DONE
