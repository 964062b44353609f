"""What all examples share: their command line, the two files that each writes, and how errors end."""

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from disctrack.errors import DiscTrackError
from disctrack.files.json_text import json_file
from disctrack.files.whole import refuse_existing, write_whole
from disctrack.report.figures import save_figure


@dataclass(frozen=True)
class Outcome:
    """What an example has to say."""

    table: str  # for people
    document: dict[str, Any]  # diagnosis.json
    figure: Figure


def command(name: str, data: str | None, diagnose: Callable[..., Outcome], words: Sequence[str] | None = None) -> int:
    """Run one example: print its table, write diagnosis.json and NAME.png where asked for; returns the exit code.

    data : what the folder that is given to `diagnose` holds; None for data that come with the sources
    """
    parser = argparse.ArgumentParser(prog=f"python -m disctrack.examples.{name}", description=diagnose.__doc__)
    if data is not None:
        parser.add_argument("folder", type=Path, help=f"folder with {data}")
    parser.add_argument("-o", "--output", type=Path, help="folder for diagnosis.json and the figure")
    parser.add_argument("--overwrite", action="store_true", help="replace an earlier result")
    given = parser.parse_args(words)
    try:
        if given.output is not None:
            refuse_existing(given.output / "diagnosis.json", given.overwrite)
        outcome = diagnose() if data is None else diagnose(given.folder)
        print(outcome.table)
        if given.output is not None:
            write_whole(given.output / "diagnosis.json", json_file(outcome.document))
            save_figure(outcome.figure, given.output / f"{name}.png")
    except DiscTrackError as error:
        print(f"{name}: {error}", file=sys.stderr)
        return 1
    return 0
