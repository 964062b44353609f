"""The result of a validation, and its output as JSON and as section of a Markdown page."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from datetime import date
from multiprocessing import get_context
from pathlib import Path
from typing import TypeVar

import numpy as np
from tqdm import tqdm

from disctrack.errors import OutputError
from disctrack.files.json_text import json_file
from disctrack.files.software import __version__
from disctrack.files.whole import write_whole

Case = TypeVar("Case")
Outcome = TypeVar("Outcome")
Key = TypeVar("Key")


def table(title: str, of: str, rows: Mapping[str, Mapping[str, object]], note: str = "", form: str = ".3g") -> str:
    """Markdown table of text and numbers with a title above and a note below.

    rows : cells by the heads of their columns, by the name of what they are `of`
    form : format of floats; a dash replaces those that are missing or not finite
    """

    def text(cell: object) -> str:
        if isinstance(cell, float):
            return format(cell, form) if np.isfinite(cell) else "-"
        return str(cell)

    heads = dict.fromkeys(head for row in rows.values() for head in row)
    cells = [[name, *(text(row.get(head, np.nan)) for head in heads)] for name, row in rows.items()]
    lines = [[of, *heads], ["---"] * (1 + len(heads)), *cells]
    shown = "\n".join("| " + " | ".join(line) + " |" for line in lines)
    return f"### {title}\n\n{shown}\n" + (f"\n{note}\n" if note else "")


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


def grouped(outcomes: Iterable[Outcome], key: Callable[[Outcome], Key]) -> dict[Key, list[Outcome]]:
    """Outcomes with the same key, in the order of their first."""
    groups: dict[Key, list[Outcome]] = {}
    for outcome in outcomes:
        groups.setdefault(key(outcome), []).append(outcome)
    return groups


def measure_all(measure: Callable[[Case], Outcome], cases: Sequence[Case], jobs: int, quiet: bool) -> list[Outcome]:
    """Outcomes in the order of the cases, with a progress bar."""
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        outcomes = map(measure, cases) if jobs == 1 else pool.map(measure, cases)
        return list(tqdm(outcomes, "validate", len(cases), unit=" recordings", disable=quiet))


def write_validation(folder: Path, validation: Validation, command: str, page: Path | None = None) -> list[Path]:
    """Write NAME.json, NAME.md and, if given, the section of a page; returns the files. Raises OutputError.

    A section, with date, version and command, is between the marks of this validation, or at the page's end.
    """
    numbers = folder / f"{validation.name}.json"
    tree = {"units": "SI, radians unless named", "headline": validation.headline, "complaints": validation.complaints}
    write_whole(numbers, json_file(tree | {"outcomes": [vars(outcome) for outcome in validation.outcomes]}))
    begin, end = f"<!-- validation: {validation.name} -->", f"<!-- end of {validation.name} -->"
    source = f"Written by `{command}`, disctrack {__version__}, {date.today().isoformat()}."
    pages = [folder / f"{validation.name}.md", *([page] if page else [])]
    for file in pages:
        text = file.read_text(encoding="utf-8") if file.exists() else ""
        before, begun, rest = text.partition(begin)
        _, ended, after = rest.partition(end)
        if begun and not ended:
            raise OutputError(f"{file}: '{begin}' without '{end}' below; expected both, or neither for a new section")
        content = f"{before}{begin}\n{validation.markdown()}\n{source}\n{end}{after or chr(10)}"
        write_whole(file, content.encode())
    return [numbers, *pages]
