"""`disctrack batch`: many recordings side by side."""

from __future__ import annotations

import argparse
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from disctrack.batch import BatchOptions, BatchOutcome, Shard


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `disctrack batch`."""
    from disctrack.commands._outputs import _positive, add_calibration_options
    from disctrack.commands.analyse import _seconds

    parser.add_argument("folders", type=Path, nargs="+", metavar="FOLDER", help="recordings are sought at any depth")
    where = "folder for all results (default: RECORDING/results, and FOLDER/batch_results)"
    parser.add_argument("-o", "--output", type=Path, help=where)
    parser.add_argument("-j", "--jobs", type=_positive, metavar="N", help="processes side by side (default: cores)")
    parser.add_argument("--shard", type=_shard, metavar="i/N", help="only every N-th recording, from the i-th (1...N)")
    parser.add_argument("--cluster", metavar="ADDRESS", help="scheduler of a dask cluster that does the work")
    parser.add_argument("--summary-only", action="store_true", help="measure nothing; sum up what there is")
    parser.add_argument("--no-report", action="store_true", help="numbers only, no report and figures per recording")
    parser.add_argument("--diagnose", action="store_true", help="also ask of each which effect the model lacks")
    parser.add_argument("--overwrite", action="store_true", help="measure anew what is done already")
    parser.add_argument("--window", type=_seconds, default=0.5, help="last seconds for the exponents (default: 0.5)")
    add_calibration_options(parser)


def _shard(text: str) -> Shard:
    from disctrack.batch import Shard

    number, slash, of = text.partition("/")
    if not (slash and number.isdecimal() and of.isdecimal() and 1 <= int(number) <= int(of)):
        raise argparse.ArgumentTypeError(f"'{text}' is no shard; give e.g. 2/8 for the second of eight (1/8 to 8/8)")
    return Shard(int(number), int(of))


def run(arguments: argparse.Namespace) -> int:
    """Measure, say what became of each recording; returns the exit code."""
    from disctrack.batch import run_batch, summarise_batch
    from disctrack.commands import DONE, FAILED, INCOMPLETE
    from disctrack.commands import _outputs as outputs
    from disctrack.track import summary

    options = _options(arguments)
    if arguments.summary_only:
        outcome = summarise_batch(arguments.folders, options, arguments.output)
    else:
        before = signal.signal(signal.SIGTERM, _interrupt)  # as queueing systems end a job whose time is over
        try:
            outcome = run_batch(
                arguments.folders, options, arguments.output, arguments.jobs, arguments.shard, arguments.cluster
            )
        finally:
            signal.signal(signal.SIGTERM, before)
    files = [outputs.relative(file) for file in outcome.files]
    print("\n".join([*outcome.lines(), *summary.file_lines(files)]))
    _tell_problems(outcome)
    if outcome.interrupted:
        raise KeyboardInterrupt
    return FAILED if outcome.failed else INCOMPLETE if outcome.incomplete else DONE


def _options(arguments: argparse.Namespace) -> BatchOptions:
    from disctrack.batch import BatchOptions

    return BatchOptions(
        distortion=arguments.distortion,
        board=arguments.board,
        window=arguments.window,
        report=not arguments.no_report,
        diagnose=arguments.diagnose,
        overwrite=arguments.overwrite,
    )


def _tell_problems(outcome: BatchOutcome) -> None:
    sys.stdout.flush()
    for problem in outcome.problems:
        print(f"disctrack: {problem}", file=sys.stderr)
    if outcome.failed and not outcome.interrupted:
        print("disctrack: not everything was measured (see above). The same command tries it again.", file=sys.stderr)
    elif outcome.incomplete and not outcome.interrupted:
        print("disctrack: some of the input could not be used (see above).", file=sys.stderr)


def _interrupt(number: int, frame: object) -> None:
    raise KeyboardInterrupt
