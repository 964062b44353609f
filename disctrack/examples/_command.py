"""What all examples share: their command line, the two files that each writes, and how errors end."""

from __future__ import annotations

import argparse
import io
import json
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from disctrack.analyse.figures import GRID, INK
from disctrack.errors import DiscTrackError, OutputError
from disctrack.files.whole import write_whole

DPI = 150


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
        earlier = given.output / "diagnosis.json" if given.output is not None else None
        if earlier is not None and earlier.exists() and not given.overwrite:
            raise OutputError(f"{earlier}: exists. Choose another folder with -o, or replace with --overwrite.")
        outcome = diagnose() if data is None else diagnose(given.folder)
        print(outcome.table)
        if given.output is not None:
            write_whole(
                given.output / "diagnosis.json", (json.dumps(finite(outcome.document), indent=1) + "\n").encode()
            )
            write_whole(given.output / f"{name}.png", png(outcome.figure))
    except DiscTrackError as error:
        print(f"{name}: {error}", file=sys.stderr)
        return 1
    return 0


def finite(x: Any) -> Any:
    """The same with None for numbers that JSON does not know."""
    if isinstance(x, dict):
        return {k: finite(v) for k, v in x.items()}
    if isinstance(x, list | tuple):
        return [finite(v) for v in x]
    return None if isinstance(x, float) and not math.isfinite(x) else x


def png(figure: Figure) -> bytes:
    """The figure as a file."""
    FigureCanvasAgg(figure)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI)
    return buffer.getvalue()


def dress(axes: Axes) -> None:
    """Grid and spines as in the other figures."""
    axes.grid(True, color=GRID, linewidth=0.7)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(colors=INK, labelsize=9)
