"""`disctrack check`: what would a run trip over?"""

import argparse
import sys

from disctrack.commands import DONE, FAILED
from disctrack.commands import _outputs as outputs
from disctrack.first_look.check import run_check
from disctrack.progress import steps


def run(arguments: argparse.Namespace) -> int:
    """Look, tell, draw; exit code 1 where a run would fail or mislead."""
    with steps("check") as step:
        seen = run_check(arguments.recording, step)
    print("\n".join(seen.lines()))
    if seen.recording is not None and not arguments.no_figures:
        from disctrack.first_look.picture import check_figure
        from disctrack.report.figures import save_figure

        path = arguments.output or seen.recording.folder / outputs.RESULTS / "check.png"
        figure = check_figure(seen)
        if figure is not None:
            print(f"{'':<5} {'picture':<12} {outputs.relative(save_figure(figure, path))}")
    if seen.worst == "fix":
        print("disctrack: check: something must be put right before a run (fix, above).", file=sys.stderr)
    return FAILED if seen.worst == "fix" else DONE
