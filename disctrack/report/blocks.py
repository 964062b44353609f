"""Blocks of a report: each stage fills them, and the writers format them (terminal, HTML, JSON).

A paragraph is a string, a list of sentences a list of strings; other blocks are instances of the classes.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from disctrack.files.json_text import plain
from disctrack.findings import Finding, finding_from_json
from disctrack.numbers import Measured

if TYPE_CHECKING:
    from disctrack.report.figures import Drawn

Cell = str | Measured


class Markup(str):
    """HTML that is put into a page unchanged; other writers omit it."""


@dataclass(frozen=True)
class Facts:
    """List of named numbers and short answers; a row without a name belongs to the one above."""

    rows: Sequence[tuple[str, Cell]]


@dataclass(frozen=True)
class Listing:
    """A table of numbers and words; a column without header contains the names of the rows."""

    header: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    caption: str = ""
    folded: str = ""  # title under which a long table is folded away on a page
    classes: Sequence[str] = ()  # of each row: "failed" is set in red


@dataclass(frozen=True)
class Figures:
    """Figures with captions, on pages only."""

    drawn: Sequence[Drawn]


@dataclass(frozen=True)
class Section:
    """Blocks under a heading; omitted if all are empty."""

    title: str
    blocks: Sequence[Any]  # Block


@dataclass(frozen=True)
class Report:
    """Report of a stage: verdict, accuracy, then details."""

    title: str  # of the page
    verdict: str
    accuracy: str = ""  # in one line
    findings: Sequence[Finding] = ()
    facts: Sequence[tuple[str, Cell]] = ()  # the few numbers at the top of a page
    blocks: Sequence[Any] = ()  # Block
    files: Sequence[Path] = ()
    page: Path | None = None  # with the details
    then: str = ""  # the next command
    data: Mapping[str, Any] = field(default_factory=dict)  # of the stage, for programs: part of the JSON document

    def graver_first(self) -> list[Finding]:
        """The findings, most severe first; the order within a severity is kept."""
        return sorted(self.findings, key=lambda f: -f.severity)


def is_empty(block: Any) -> bool:
    """True if a block has no content."""
    if isinstance(block, (str, list)):
        return not block
    content = next(value for name, value in vars(block).items() if name not in ("title", "header"))
    return all(map(is_empty, content)) if isinstance(block, Section) else not content


def figures_in(blocks: Iterable[Any]) -> Iterator[Drawn]:
    """All figures of the blocks, in order."""
    for block in blocks:
        yield from block.drawn if isinstance(block, Figures) else []
        yield from figures_in(block.blocks) if isinstance(block, Section) else []


def document(report: Report) -> dict[str, Any]:
    """The report in types of JSON."""
    found = {
        "title": report.title,
        "verdict": report.verdict,
        "accuracy": report.accuracy,
        "findings": [finding.as_json() for finding in report.graver_first()],
        "facts": {name: _cell(value) for name, value in report.facts},
        "blocks": [shown for block in report.blocks if (shown := _block(block))],
        "files": [str(file) for file in report.files],
        "page": None if report.page is None else str(report.page),
        "next": report.then,
        **report.data,
    }
    return dict(plain(found))


def restored(kept: Mapping[str, Any], data: Mapping[str, Any]) -> Report:
    """The report from its document and the data of its stage."""
    findings = [finding_from_json(finding) for finding in kept["findings"]]
    files = [Path(file) for file in kept["files"]]
    page = Path(kept["page"]) if kept["page"] else None
    head = kept["title"], kept["verdict"], kept["accuracy"]
    return Report(*head, findings, files=files, page=page, then=kept["next"], data={**kept, **data})


def _cell(cell: Cell) -> Any:
    if isinstance(cell, Measured):
        return {"value": cell.value, "sigma": cell.sigma, "unit": cell.unit}
    return "" if isinstance(cell, Markup) else str(cell)


def _block(block: Any) -> dict[str, Any] | None:
    if isinstance(block, Section):
        inner = [shown for b in block.blocks if (shown := _block(b))]
        return {"title": block.title, "blocks": inner} if inner else None
    if is_empty(block) or isinstance(block, (Figures, Markup)):
        return None
    if isinstance(block, Facts):
        facts: dict[str, list[object]] = {}
        for name, value in block.rows:
            facts.setdefault(name or next(reversed(facts), ""), []).append(_cell(value))
        return {"facts": {name: cells if len(cells) > 1 else cells[0] for name, cells in facts.items()}}
    if isinstance(block, Listing):
        rows = [[_cell(cell) for cell in row] for row in block.rows]
        return {"caption": block.caption or block.folded, "header": list(block.header), "rows": rows}
    return {"text": block}
