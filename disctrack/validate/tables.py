"""The result of a validation, and its output as Markdown, as JSON and as a section of a page."""

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from datetime import date
from multiprocessing import get_context
from pathlib import Path
from time import perf_counter
from typing import TypeVar

import numpy as np

from disctrack.errors import OutputError
from disctrack.files.json_text import json_file
from disctrack.files.software import __version__
from disctrack.files.whole import make_folder, write_whole

Case = TypeVar("Case")
Outcome = TypeVar("Outcome")


def table(title: str, head: Sequence[str], rows: Iterable[Sequence[object]], note: str = "", form: str = ".3g") -> str:
    """Markdown table of text and numbers with a title above and a note below.

    form : format of floats; a dash replaces those that are not finite
    """

    def text(cell: object) -> str:
        if isinstance(cell, float):
            return format(cell, form) if np.isfinite(cell) else "-"
        return str(cell)

    lines = [head, ["---"] * len(head), *(map(text, row) for row in rows)]
    shown = "\n".join("| " + " | ".join(line) + " |" for line in lines)
    return f"## {title}\n\n{shown}\n" + (f"\n{note}\n" if note else "")


@dataclass(frozen=True)
class Validation:
    """Summary of planted, measured and compared cases."""

    name: str
    headline: str
    tables: Sequence[str]  # from `table`
    outcomes: Sequence[object]  # one per case, or summaries
    complaints: Sequence[str] = ()  # failures
    remarks: Sequence[str] = ()  # for the attention of the reader

    def markdown(self) -> str:
        """The headline, failures, remarks and all tables."""
        lists = ["\n".join(f"- {line}" for line in lines) + "\n" for lines in (self.complaints, self.remarks) if lines]
        return "\n".join([f"{self.headline}\n", *lists, *self.tables])


def measure_all(
    measure: Callable[[Case], Outcome], cases: Sequence[Case], processes: int, say: Callable[[str], object]
) -> list[Outcome]:
    """Outcomes in the order of the cases; `say` gets messages on the progress."""
    began, outcomes = perf_counter(), []
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        for outcome in map(measure, cases) if processes == 1 else pool.map(measure, cases):
            outcomes.append(outcome)
            say(f"{perf_counter() - began:6.0f} s  {len(outcomes)} of {len(cases)} recordings")
    return outcomes


def write_validation(folder: Path, validation: Validation) -> list[Path]:
    """Write NAME.md and NAME.json; returns the files. Raises OutputError."""
    make_folder(folder)
    files = [folder / f"{validation.name}.md", folder / f"{validation.name}.json"]
    write_whole(files[0], validation.markdown().encode())
    tree = {"units": "SI, radians unless named", "headline": validation.headline, "complaints": validation.complaints}
    outcomes = [vars(outcome) for outcome in validation.outcomes]
    write_whole(files[1], json_file(tree | {"outcomes": outcomes}))
    return files


def write_into(page: Path, validation: Validation, command: str) -> None:
    """Write the tables, with date, version and command, between the page's marks of this validation, or at its end."""
    begin, end = f"<!-- validation: {validation.name} -->", f"<!-- end of {validation.name} -->"
    text = page.read_text(encoding="utf-8") if page.exists() else ""
    before, begun, rest = text.partition(begin)
    _, ended, after = rest.partition(end)
    if begun and not ended:
        raise OutputError(f"{page}: '{begin}' without '{end}' below; expected both, or neither for a new section")
    source = f"Written by `{command}`, disctrack {__version__}, {date.today().isoformat()}."
    tables = "\n".join(f"#{table}" for table in validation.tables)  # under a heading of the page
    write_whole(page, f"{before}{begin}\n{validation.headline}\n\n{tables}\n{source}\n{end}{after or chr(10)}".encode())
