"""Blocks of a report: each stage fills them, and the writers format them (terminal, HTML, JSON).

A paragraph is a string, a list of sentences a list of strings; other blocks are instances of the classes.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from disctrack.files.json_text import plain
from disctrack.findings import Finding, finding_from_json
from disctrack.numbers import Measured

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Cell = str | Measured
Block = Any  # a string, a list of strings, or an instance of the classes below


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
class Drawn:
    """One figure with its caption."""

    name: str  # of the file
    title: str
    caption: str
    figure: "Figure"

    def encoded(self, kind: str) -> bytes:
        """The figure as a file of this kind ("png", "pdf", "svg")."""
        from disctrack.report.figures import encoded  # late, as it imports matplotlib

        return encoded(self.figure, kind)


@dataclass(frozen=True)
class Figures:
    """Figures with captions, on pages only."""

    drawn: Sequence[Drawn]


@dataclass(frozen=True)
class Section:
    """Blocks under a heading; omitted if all are empty."""

    title: str
    blocks: Sequence[Block]


@dataclass(frozen=True)
class Report:
    """Report of a stage: verdict, accuracy, then details."""

    title: str  # of the page
    verdict: str
    accuracy: str = ""  # in one line
    findings: Sequence[Finding] = ()
    facts: Sequence[tuple[str, Cell]] = ()  # the few numbers at the top of a page
    blocks: Sequence[Block] = ()
    files: Sequence[Path] = ()  # that were written
    then: str = ""  # the next command
    data: Mapping[str, Any] = field(default_factory=dict)  # of the stage, for programs: part of the JSON document

    @property
    def page(self) -> Path | None:
        """The file with the details: the first page or text among the files."""
        return next((file for file in self.files if file.suffix in (".html", ".txt")), None)

    def graver_first(self) -> list[Finding]:
        """The findings, most severe first; the order within a severity is kept."""
        return sorted(self.findings, key=lambda f: -f.severity)


def shown(blocks: Iterable[Block], omitted: tuple[type, ...] = ()) -> Iterator[Block]:
    """The blocks that have content, and those of sections likewise.   omitted : classes that a writer leaves out"""
    for block in blocks:
        found = replace(block, blocks=[*shown(block.blocks, omitted)]) if isinstance(block, Section) else block
        parts = vars(found).items() if not isinstance(found, (str, list)) else [("", found)]
        content = next(value for name, value in parts if name not in ("title", "header"))
        if content and not isinstance(found, omitted):
            yield found


def document(report: Report) -> dict[str, Any]:
    """The report in types of JSON."""
    found = {
        "title": report.title,
        "verdict": report.verdict,
        "accuracy": report.accuracy,
        "findings": [finding.as_json() for finding in report.graver_first()],
        "facts": {name: _cell(value) for name, value in report.facts},
        "blocks": [_block(block) for block in shown(report.blocks, (Figures, Markup))],
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
    head = kept["title"], kept["verdict"], kept["accuracy"]
    return Report(*head, findings, files=files, then=kept["next"], data={**kept, **data})


def _cell(cell: Cell) -> Cell:
    return "" if isinstance(cell, Markup) else cell


def _block(block: Block) -> dict[str, Any]:
    if isinstance(block, Section):
        return {"title": block.title, "blocks": [_block(b) for b in block.blocks]}
    if isinstance(block, Facts):
        facts: dict[str, list[object]] = {}
        for name, value in block.rows:
            facts.setdefault(name or next(reversed(facts), ""), []).append(_cell(value))
        return {"facts": {name: cells if len(cells) > 1 else cells[0] for name, cells in facts.items()}}
    if isinstance(block, Listing):
        rows = [[_cell(cell) for cell in row] for row in block.rows]
        return {"caption": block.caption or block.folded, "header": list(block.header), "rows": rows}
    return {"text": block}
