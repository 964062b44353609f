"""`disctrack check`: problems that a run would meet."""

import argparse

from disctrack.commands import DONE, FAILED
from disctrack.commands import _outputs as outputs
from disctrack.findings import in_doubt
from disctrack.first_look.check import run_check
from disctrack.progress import steps


def run(arguments: argparse.Namespace) -> int:
    """Examine, draw, report; exit code 1 if a run would fail or its result be in doubt."""
    with steps("check") as step:
        seen = run_check(arguments.recording, step)
    files = []
    if seen.recording is not None and not arguments.no_figures:
        from disctrack.first_look.picture import check_figure
        from disctrack.report.figures import save_figure

        path = arguments.output or seen.recording.folder / outputs.RESULTS / "check.png"
        figure = check_figure(seen)
        files = [save_figure(figure, path)] if figure is not None else []
    outputs.show_report(seen.report(files), arguments, arguments.recording)
    return FAILED if in_doubt(seen.findings) else DONE
