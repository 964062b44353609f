"""A report as a self-contained HTML page, with one style for light, dark, phone and print.

Text is escaped here, except `Markup`.
"""

import base64
from collections.abc import Iterable, Iterator, Mapping, Sequence
from html import escape
from pathlib import Path
from urllib.parse import quote

from disctrack.files.text import printable
from disctrack.files.whole import seen_from, write_whole
from disctrack.report.blocks import Block, Cell, Drawn, Facts, Figures, Listing, Markup, Report, Section, shown
from disctrack.report.palette import AMBER, BLUE, GRID, INK, RED

LARGE = 400_000  # [bytes] larger vector graphics, of thousands of points, are embedded as a bitmap
SENTENCE = 48  # characters; a longer cell is a sentence, not a number, name or link


def write_page(path: Path, report: Report, kinds: Sequence[str] = ()) -> list[Path]:
    """Write the page, and files of its figures of these kinds ("png", "pdf"); returns those. Raises OutputError."""
    folder, drawn = path.parent / "figures", [*_figures_in(report.blocks)]
    files = {folder / f"{figure.name}.{kind}": figure.encoded(kind) for figure in drawn for kind in kinds}
    for file, content in [*files.items(), (path, page(report).encode())]:
        write_whole(file, content)
    return [*files]


def _figures_in(blocks: Iterable[Block]) -> Iterator[Drawn]:
    """All figures of the blocks, in order."""
    for block in blocks:
        yield from block.drawn if isinstance(block, Figures) else []
        yield from _figures_in(block.blocks) if isinstance(block, Section) else []


def page(report: Report, head: str = "") -> str:
    """The whole page. head : HTML for its head"""
    title = escape(report.title)
    findings = "".join(f"<li class={f.grave}><b>{f.grave}</b>{_text(f.sentence)}</li>" for f in report.graver_first())
    tiles = "".join(
        f"<div class=tile><b>{_text(value)}</b><span>{escape(name)}</span></div>" for name, value in report.facts
    )
    parts = [
        f"<h1>{title}</h1>{NAV[0]}{NAV[1]}",
        f"<ul class=findings>{findings}</ul>" if findings else "",
        f"<p class=lead>{_text(report.verdict)}</p>" if report.verdict else "",
        *map(_html, shown([report.accuracy])),
        f"<div class=tiles>{tiles}</div>" if tiles else "",
        *map(_html, shown(report.blocks)),
    ]
    return (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><style>{STYLE}</style>{head}</head>\n'
        "<body><main>" + "\n".join(p for p in parts if p) + "\n</main></body></html>\n"
    )


def link_pages(pages: Mapping[str, Path]) -> None:
    """Write links to the other pages into each existing page. pages : title -> file"""
    existing = {name: path for name, path in pages.items() if path.is_file()}
    for own in (path for path in existing.values() if path.suffix == ".html"):
        before, start, rest = own.read_text(encoding="utf-8").partition(NAV[0])
        _, end, after = rest.partition(NAV[1])
        links = "".join(
            f'<a href="{quote(seen_from(own.parent, path).as_posix())}">{escape(name)}</a>'
            for name, path in existing.items()
            if path != own
        )
        if end:
            write_whole(own, "".join([before, start, links, end, after]).encode())


NAV = "<nav>", "</nav>"


def _text(said: Cell) -> str:
    return said if isinstance(said, Markup) else escape(printable(str(said)))


def _html(block: Block) -> str:
    """HTML of a block that has content."""
    if isinstance(block, Section):
        inner = "\n".join(map(_html, block.blocks))
        return f"<section><h2>{escape(block.title)}</h2>\n{inner}</section>"
    if isinstance(block, str):
        return block if isinstance(block, Markup) else f"<p>{_text(block)}</p>"
    if isinstance(block, list):
        return f"<ul>{''.join(f'<li>{_text(said)}</li>' for said in block)}</ul>"
    if isinstance(block, Facts):
        return _table(Listing(("", ""), block.rows))
    if isinstance(block, Figures):
        drawn = (
            f'<figure><img src="{_uri(d)}" alt="{escape(d.title)}">'
            f"<figcaption><b>{escape(d.title)}.</b> {escape(d.caption)}</figcaption></figure>"
            for d in block.drawn
        )
        return f"<div class=gallery>{''.join(drawn)}</div>"
    return _table(block)


def _uri(drawn: Drawn) -> str:
    """The figure as a data URI: vector graphics, or a bitmap if those exceed LARGE."""
    kind, content = "svg+xml", drawn.encoded("svg")
    if len(content) >= LARGE:
        kind, content = "png", drawn.encoded("png")
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def _table(listing: Listing) -> str:
    """A table that scrolls on narrow screens; a column with sentences wraps."""
    kinds = [f" class={escape(kind, quote=True)}" for kind in listing.classes] or [""] * len(listing.rows)
    said = [" class=said" if any(map(_sentence, column)) else "" for column in zip(*listing.rows, strict=True)]
    top = "".join(f"<th>{escape(cell)}</th>" for cell in listing.header)
    body = "".join(
        f"<tr{kind}>" + "".join(f"<td{wide}>{_text(cell)}</td>" for wide, cell in zip(said, row, strict=True)) + "</tr>"
        for kind, row in zip(kinds, listing.rows, strict=True)
    )
    above = f"<caption><span>{_text(listing.caption)}</span></caption>" if listing.caption else ""
    header = f"<thead><tr>{top}</tr></thead>" if any(listing.header) else ""
    made = f"<div class=scroll><table>{above}{header}<tbody>{body}</tbody></table></div>"
    return f"<details><summary>{escape(listing.folded)}</summary>{made}</details>" if listing.folded else made


def _sentence(cell: Cell) -> bool:
    return isinstance(cell, str) and len(cell) > SENTENCE and not isinstance(cell, Markup)


STYLE = f"""
:root{{color-scheme:light dark;--ink:{INK};--soft:#4d5a67;--back:#f5f7f9;--card:#fff;--line:{GRID};--mark:{BLUE};
--warn:#fff6e5;--edge:{AMBER};--bad:{RED};--shade:#0003}}
@media (prefers-color-scheme:dark){{:root{{--ink:#e6ebf0;--soft:#aab5c0;--back:#14191f;--card:#1c232b;--line:#323c47;
--mark:#6db9e8;--warn:#33290f;--bad:#ff9a5c;--shade:#000a}}}}
html{{color:var(--ink);background:var(--back);font:16px/1.55 system-ui,-apple-system,"Segoe UI",Roboto,sans-serif}}
body{{margin:0}}main{{max-width:1180px;margin:0 auto;padding:2rem 1.5rem 4rem}}
h1{{font-size:1.7rem;line-height:1.25;margin:.2rem 0 1rem}}h2{{font-size:1.25rem;margin:0 0 .8rem}}
a{{color:var(--mark)}}
section{{background:var(--card);border:1px solid var(--line);border-radius:10px;padding:1.3rem 1.5rem;margin:1.4rem 0}}
.lead{{font-size:1.05rem;max-width:60rem}}
.tiles{{display:grid;grid-template-columns:repeat(auto-fit,minmax(210px,1fr));gap:.9rem;margin:1.2rem 0}}
.tile{{background:var(--card);border:1px solid var(--line);border-radius:10px;padding:.8rem 1rem}}
.tile b{{display:block;font-size:1.15rem}}.tile span{{color:var(--soft);font-size:.88rem}}
.findings{{list-style:none;padding:0;margin:1.2rem 0;overflow-wrap:anywhere}}
.findings li{{background:var(--card);border:1px solid var(--line);border-left:6px solid var(--soft);border-radius:6px;
padding:.6rem 1rem;margin:.5rem 0}}.findings b{{margin-right:.6rem}}
.findings .warning{{background:var(--warn);border-color:var(--edge)}}
.findings .doubt,.findings .refusal{{border-color:var(--bad)}}
.findings .doubt b,.findings .refusal b{{color:var(--bad)}}
nav{{color:var(--soft);font-size:.88rem}}nav a{{margin-right:1rem}}
.gallery{{columns:2 420px;column-gap:1.6rem}}
figure{{margin:0 0 1.3rem;break-inside:avoid}}
figure img{{width:100%;height:auto;display:block;background:#fff;border-radius:4px}}
figcaption{{color:var(--soft);font-size:.88rem;line-height:1.45;margin-top:.35rem}}
.scroll{{overflow-x:auto;background:linear-gradient(90deg,var(--card) 30%,transparent) 0/2rem 100% no-repeat local,
linear-gradient(270deg,var(--card) 30%,transparent) 100%/2rem 100% no-repeat local,
linear-gradient(90deg,var(--shade),transparent) 0/.7rem 100% no-repeat scroll,
linear-gradient(270deg,var(--shade),transparent) 100%/.7rem 100% no-repeat scroll}}
table{{border-collapse:collapse;font-size:.85rem;margin:.6rem 0 1rem}}
caption{{text-align:left;color:var(--soft);padding-bottom:.35rem}}
caption span{{position:sticky;left:0;display:inline-block;max-width:min(100%,calc(100vw - 4rem))}}
th,td{{text-align:left;padding:.28rem .9rem .28rem 0;border-bottom:1px solid var(--line);white-space:nowrap;
font-variant-numeric:tabular-nums}}
td:first-child{{white-space:normal;min-width:9em}}td.said{{white-space:normal;min-width:22em}}
th{{color:var(--soft);font-weight:600;white-space:normal;vertical-align:bottom}}
tr.failed td,tr.not td{{color:var(--bad)}}
details{{margin:.6rem 0}}summary{{cursor:pointer;color:var(--mark)}}
@media (max-width:40rem){{main{{padding:1rem .8rem 3rem}}section{{padding:1rem .9rem}}h1{{font-size:1.35rem}}
.gallery{{columns:1}}td.said{{min-width:16em}}td:first-child{{min-width:8em}}}}
@page{{margin:14mm 15mm}}
@media print{{:root{{color-scheme:light;--ink:#000;--soft:#333;--back:#fff;--card:#fff;--line:#ccc;--warn:#fff;
--mark:#000;--bad:#000;--shade:transparent}}html{{font-size:11.5px}}main{{max-width:none;padding:0}}
section{{border:0;padding:0}}.scroll{{overflow:visible;background:none}}.gallery{{columns:auto}}
figure img{{width:auto;max-width:100%;max-height:98mm}}h1,h2,summary,caption{{break-after:avoid}}
tr{{break-inside:avoid}}.tiles{{grid-template-columns:repeat(4,1fr)}}td,th{{white-space:normal}}td:first-child{{min-width:11em}}
td.said{{min-width:16em}}details>*{{display:block}}
details::details-content{{content-visibility:visible;block-size:auto}}}}
"""
