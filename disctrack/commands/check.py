"""`disctrack check`: what would a run trip over?"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `disctrack check`."""
    parser.add_argument("recording", type=Path, help="folder with a recording.toml")
    parser.add_argument("-o", "--output", type=Path, help="the picture (default: RECORDING/results/check.png)")
    parser.add_argument("--no-figures", action="store_true", help="no picture")


def run(arguments: argparse.Namespace) -> int:
    """Look, tell, draw; exit code 1 where a run would fail or mislead."""
    from disctrack.commands import DONE, FAILED
    from disctrack.commands import _outputs as outputs
    from disctrack.first_look.check import run_check
    from disctrack.progress import steps

    with steps("check") as step:
        seen = run_check(arguments.recording, step)
    print("\n".join(seen.lines()))
    if seen.recording is not None and not arguments.no_figures:
        from disctrack.first_look.picture import check_figure
        from disctrack.pages.figures import save_figure

        path = arguments.output or seen.recording.folder / outputs.RESULTS / "check.png"
        figure = check_figure(seen)
        if figure is not None:
            print(f"{'':<5} {'picture':<12} {outputs.relative(save_figure(figure, path))}")
    if seen.worst == "fix":
        print("disctrack: check: something must be put right before a run (fix, above).", file=sys.stderr)
    return FAILED if seen.worst == "fix" else DONE
