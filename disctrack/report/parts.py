"""Pages of HTML that need no other file: one frame, one style for light, dark, phone and print.

Text is escaped here; what is HTML already is a `Markup`.
"""

import re
from collections.abc import Iterable, Sequence
from html import escape

from disctrack.report.blocks import Markup
from disctrack.report.figures import Drawn
from disctrack.report.html import STYLE


def text(item: str) -> Markup:
    """The item as HTML, set as people write it: µm, ± and m² for what a terminal shows as um, +- and m^2."""
    return item if isinstance(item, Markup) else Markup(escape(typeset(item)))


def as_typed(said: str) -> Markup:
    """Names and formulas that people wrote and will look for: letter by letter."""
    return Markup(escape(said))


def typeset(said: str) -> str:
    """Signs in place of what stands for them in plain text; units only after a number, a bracket or a space.

    Angles are Greek where they are words of a sentence or formula; in the name of a key (state.theta) they stay.
    """
    said = said.replace(" +- ", " ± ").replace("^2", "²").replace("^3", "³").replace(" -> ", " → ")
    said = re.sub(r"(?<=[\d \[(])u(?=(?:m|rad|s|N m)\b)", "µ", said)
    said = re.sub(r"(?<![\w.+])(\d+(?:\.\d+)?e-\d+) (m|rad|s|N)(?=[,;)]|\.(?!\w)| \(|$)", _prefixed, said)
    said = re.sub(r"(?<![\w.+])(\d+(?:\.\d+)?)e([+-]?)0*(\d+)(?![\w…])", _power, said)
    return re.sub(r"(?<![\w./-])(psi|theta|phi)(dot)?(?![\w/-]|\.\w)", _angle, said)


def _prefixed(found: re.Match[str]) -> str:
    """A small length, angle, time or force: 2.6e-07 m is 0.26 µm. Of compound units powers of ten stay."""
    number, unit = found.groups()
    digits = len(number.partition("e")[0].replace(".", ""))
    for size, prefix in ((1e-3, "m"), (1e-6, "µ"), (1e-9, "n")):
        if float(number) >= 0.1 * size:
            return f"{float(number) / size:.{max(digits, 3)}g} {prefix}{unit}"
    return found[0]


def _power(found: re.Match[str]) -> str:
    """Of ten: 2.6e-07 is 2.6 × 10⁻⁷."""
    number, sign, digits = found.groups()
    return number + "\N{NO-BREAK SPACE}×\N{NO-BREAK SPACE}10" + (sign.replace("+", "") + digits).translate(_RAISED)


def _angle(found: re.Match[str]) -> str:
    name, dot = found.groups()
    return _GREEK[name] + ("\N{COMBINING DOT ABOVE}" if dot else "")


_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_GREEK = {"psi": "ψ", "theta": "θ", "phi": "φ"}


def page(title: str, parts: Iterable[str], *, head: str = "") -> str:
    """A whole page. parts : HTML, one below the other; empty ones are left out.   head : HTML for its head"""
    return (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><style>{STYLE}</style>{head}</head>\n'
        f"<body><main><h1>{escape(title)}</h1>\n" + "\n".join(p for p in parts if p) + "\n</main></body></html>\n"
    )


def section(title: str, parts: Iterable[str]) -> Markup:
    """A part of a page under its own heading; nothing where there is nothing to show."""
    inner = "\n".join(p for p in parts if p)
    return Markup(f"<section><h2>{escape(title)}</h2>\n{inner}</section>" if inner else "")


def paragraph(said: str, kind: str = "") -> Markup:
    """A paragraph. kind : "lead" for the one that begins a page"""
    return Markup(f"<p{f' class={kind}' if kind else ''}>{text(said)}</p>" if said else "")


def bullets(items: Iterable[str]) -> Markup:
    """A list; nothing if it is empty."""
    inner = "".join(f"<li>{text(item)}</li>" for item in items)
    return Markup(f"<ul>{inner}</ul>" if inner else "")


def warning(title: str, items: Iterable[str]) -> Markup:
    """A box that is not to be overlooked; nothing where nothing is to be said."""
    inner = bullets(items)
    return Markup(f"<div class=warn><b>{escape(title)}</b>{inner}</div>" if inner else "")


def tiles(named: Iterable[tuple[str, str]]) -> Markup:
    """The few numbers that come first: (name, value)."""
    inner = "".join(f"<div class=tile><b>{text(value)}</b><span>{text(name)}</span></div>" for name, value in named)
    return Markup(f"<div class=tiles>{inner}</div>")


def table(
    caption: str, header: Sequence[str], rows: Iterable[Sequence[str]], classes: Sequence[str] | None = None
) -> Markup:
    """A table that scrolls by itself where the screen is narrow; a column with sentences wraps.

    classes : CSS class of each row
    """
    rows = list(rows)
    kinds = [f" class={escape(kind, quote=True)}" for kind in classes] if classes else [""] * len(rows)
    said = [" class=said" if any(map(_sentence, column)) else "" for column in zip(*rows, strict=True)]
    top = "".join(f"<th>{text(cell)}</th>" for cell in header)
    body = "".join(
        f"<tr{kind}>" + "".join(f"<td{kind}>{text(cell)}</td>" for kind, cell in zip(said, row, strict=True)) + "</tr>"
        for kind, row in zip(kinds, rows, strict=True)
    )
    above = f"<caption><span>{text(caption)}</span></caption>" if caption else ""
    return Markup(f"<div class=scroll><table>{above}<thead><tr>{top}</tr></thead><tbody>{body}</tbody></table></div>")


SENTENCE = 48  # characters of a cell from which on it is no number, name or link


def _sentence(cell: str) -> bool:
    return len(cell) > SENTENCE and not isinstance(cell, Markup)


def details(title: str, parts: Iterable[str]) -> Markup:
    """What opens when its title is clicked."""
    return Markup(f"<details><summary>{escape(title)}</summary>{''.join(parts)}</details>")


def gallery(figures: Sequence[Drawn], pictures: dict[str, str]) -> Markup:
    """Figures with their captions; `pictures` holds a data URI per figure's name."""
    items = "".join(
        f'<figure><img src="{pictures[drawn.name]}" alt="{escape(drawn.title)}">'
        f"<figcaption><b>{escape(drawn.title)}.</b> {text(drawn.caption)}</figcaption></figure>"
        for drawn in figures
    )
    return Markup(f"<div class=gallery>{items}</div>" if items else "")
