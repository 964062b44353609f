"""What a report is made of: each stage fills these blocks, and the writers set them (terminal, HTML, JSON).

A paragraph is a string, and a list of sentences a list of strings; all else is one of the classes.
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
    """HTML that goes into a page as it is; no other writer shows it."""


@dataclass(frozen=True)
class Facts:
    """Named numbers and short answers, one below the other; a row without a name belongs to the one above it."""

    rows: Sequence[tuple[str, Cell]]


@dataclass(frozen=True)
class Listing:
    """Rows of numbers and words; a row without a header names what stands in it."""

    header: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    caption: str = ""
    folded: str = ""  # title under which a long table is folded away on a page
    classes: Sequence[str] = ()  # of each row: "failed" is set in red


@dataclass(frozen=True)
class Figures:
    """Figures with their captions, on pages only."""

    drawn: Sequence[Drawn]


@dataclass(frozen=True)
class Section:
    """Blocks under a heading; nothing where all are empty."""

    title: str
    blocks: Sequence[Any]  # Block


@dataclass(frozen=True)
class Report:
    """What a stage tells: its answer first, then how good it is, then everything else."""

    title: str  # of the page
    verdict: str
    accuracy: str = ""  # in one line
    findings: Sequence[Finding] = ()
    facts: Sequence[tuple[str, Cell]] = ()  # the few numbers that come first on a page
    blocks: Sequence[Any] = ()  # Block
    files: Sequence[Path] = ()
    page: Path | None = None  # where to read on
    then: str = ""  # the next command
    data: Mapping[str, Any] = field(default_factory=dict)  # of the stage, for programs: a part of the JSON document

    def graver_first(self) -> list[Finding]:
        """The findings as they are told; a cause stays before what it explains."""
        return sorted(self.findings, key=lambda f: -f.severity)


def is_empty(block: Any) -> bool:
    """True where a block has nothing to show."""
    if isinstance(block, (str, list)):
        return not block
    content = next(value for name, value in vars(block).items() if name not in ("title", "header"))
    return all(map(is_empty, content)) if isinstance(block, Section) else not content


def figures_in(blocks: Iterable[Any]) -> Iterator[Drawn]:
    """All figures of the blocks, in their order."""
    for block in blocks:
        yield from block.drawn if isinstance(block, Figures) else []
        yield from figures_in(block.blocks) if isinstance(block, Section) else []


def document(report: Report) -> dict[str, Any]:
    """The report in JSON's types."""
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
    """A report from its document, made without the stage's own data, and these."""
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
        return {"facts": {name: told if len(told) > 1 else told[0] for name, told in facts.items()}}
    if isinstance(block, Listing):
        rows = [[_cell(cell) for cell in row] for row in block.rows]
        return {"caption": block.caption or block.folded, "header": list(block.header), "rows": rows}
    return {"text": block}
