"""A report as text for a terminal: at most ten lines, or complete."""

import os
import shutil
import sys
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain

from disctrack.files.text import printable
from disctrack.report.blocks import Block, Cell, Facts, Figures, Listing, Markup, Report, Section, shown

MOST_LINES = 10
WIDTH = 100  # of lines in a file, and at most in a terminal
_HEAD = 13  # characters of the first column
_MOST_OF_ONE = 4  # lines of the verdict, and of one finding; `full` has all
_COLOURS = {"refusal": "31;1", "doubt": "31;1", "warning": "33", "verdict": "1"}


def short(report: Report, width: int = WIDTH, *, colour: bool = False) -> list[str]:
    """Doubts, verdict, accuracy, other findings, page and next command, in at most MOST_LINES."""
    first = _entry("verdict", report.verdict, width, _MOST_OF_ONE) + _entry("accuracy", report.accuracy, width, 2)
    last = _facts([("page", str(report.page or "")), ("next", report.then)], width)
    entries = [_entry(finding.grave, finding.sentence, width, _MOST_OF_ONE) for finding in report.graver_first()]
    room = MOST_LINES - len(first) - len(last)
    while sum(map(len, entries)) > room - (len(entries) < len(report.findings)) and len(entries) > 1:
        entries.pop()
    more = len(report.findings) - len(entries)
    also = _entry("", f"and {more} more: -v shows {'it' if more == 1 else 'them'}" if more else "", width)
    lines = [*_around(first, entries, report), *also, *last]
    return [_coloured(line) for line in lines] if colour else lines


def full(report: Report, width: int = WIDTH) -> list[str]:
    """The complete report."""
    lines = [report.title, ""] if report.title else []
    first = _facts([("verdict", report.verdict), ("accuracy", report.accuracy)], width)
    lines += _around(first, [_entry(f.grave, f.sentence, width) for f in report.graver_first()], report)
    lines += [*_facts(report.facts, width), *_blocks(shown(report.blocks, (Figures, Markup)), width)]
    files = [("" if i else "files", str(file)) for i, file in enumerate(report.files)]
    return lines + _facts([("page", str(report.page or "")), *files, ("next", report.then)], width)


def _around(result: list[str], entries: list[list[str]], report: Report) -> list[str]:
    """Entries of the doubts, then the result, then entries of the other findings."""
    n = sum(finding.doubtful for finding in report.findings)
    return [*chain(*entries[:n]), *result, *chain(*entries[n:])]


def show(report: Report, *, verbose: bool = False) -> None:
    """Print the report; in colour if stdout is a terminal and NO_COLOR is not set (https://no-color.org)."""
    width = min(WIDTH, shutil.get_terminal_size((WIDTH, 24)).columns)
    colour = sys.stdout.isatty() and not os.environ.get("NO_COLOR") and os.environ.get("TERM") != "dumb"
    lines = full(report, width) if verbose else short(report, width, colour=colour)
    print("\n".join(lines), flush=True)


def _coloured(line: str) -> str:
    head = line[:_HEAD].rstrip()
    return f"\x1b[{_COLOURS[head]}m{head}\x1b[0m{line[len(head) :]}" if head in _COLOURS else line


def _entry(head: str, said: Cell, width: int, most: int | None = None) -> list[str]:
    """A heading with its text, wrapped to its right; empty without text.   most : lines, the last with an ellipsis"""
    if not said or isinstance(said, Markup):
        return []
    return _wrapped(str(said), max(width, 40), f"{head:<{_HEAD}} ", " " * (_HEAD + 1), most)


def _wrapped(said: str, width: int, first: str = "", then: str = "", most: int | None = None) -> list[str]:
    return textwrap.wrap(
        printable(said), width, initial_indent=first, subsequent_indent=then, break_long_words=False,
        break_on_hyphens=False, max_lines=most, placeholder=" …",
    )  # fmt: skip


def _blocks(blocks: Iterable[Block], width: int) -> Iterator[str]:
    for block in blocks:
        if isinstance(block, Section):
            yield from ["", block.title, *_blocks(block.blocks, width)]
        elif isinstance(block, str):
            yield from _wrapped(block, width)
        elif isinstance(block, list):
            for said in block:
                yield from _wrapped(said, width, "- ", "  ")
        elif isinstance(block, Facts):
            yield from _facts(block.rows, width)
        else:
            yield from _table(block, width)


def _facts(rows: Iterable[tuple[str, Cell]], width: int) -> list[str]:
    return [line for name, value in rows for line in _entry(name, value, width)]


def _table(listing: Listing, width: int) -> list[str]:
    """Columns as wide as their content; the last one, which may contain sentences, is not wrapped."""
    rows: list[Sequence[str]] = [listing.header]
    for row in listing.rows:
        rows.append(["" if isinstance(cell, Markup) else printable(str(cell)) for cell in row])
    widths = [max(len(row[i]) for row in rows) for i in range(len(listing.header))]
    lines = ["  ".join(cell.ljust(n) for cell, n in zip(row, widths, strict=True)).rstrip() for row in rows]
    return [*_wrapped(listing.caption or listing.folded, width), *lines]
