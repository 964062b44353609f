"""The answer on one HTML page that needs nothing else."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy import signal

from disctrack.discrepancy.equations.law import NAME, LearnedForce
from disctrack.report.figures import Drawn, draw, panels
from disctrack.report.palette import BLUE, MUTED, RED
from disctrack.report.parts import Markup, as_typed, bullets, gallery, page, paragraph, section, table

if TYPE_CHECKING:
    from disctrack.discrepancy.equations.answer import Answer

_MOST_POINTS = 6000  # of a curve: a page shows no more
_MOST_STRETCHES = 6


def written_page(answer: Answer, folder: Path) -> tuple[str, list[Path]]:
    """The whole page, and the figures that were written beside it. Raises OutputError."""
    d = answer.diagnosis
    drawings = [_drawn(answer, c, name) for c, name in enumerate(answer.system.formulas.channels)]
    if answer.law is not None:
        drawings.insert(0, _law(answer, answer.law))
    files, pictures = draw(folder, drawings, ("png",))
    equations = [as_typed(f"d{k}/dt = {v}") for k, v in answer.equations.rates.items()]
    parts = [
        paragraph(answer.sentence, "lead"),
        paragraph(f"Verdict: {d.verdict}. {_sentence(d.reason)}"),
        bullets(equations),
        *(paragraph(_sentence(n, _named(answer))) for n in answer.notes),
        section("Before and after", [_before_after(answer)]),
        section("Fitted numbers", [_fitted(answer)]),
        section("In pictures", [gallery(drawings, pictures)]),
        section("What was tried", [_tried(answer)]),
    ]
    return page(f"{answer.equations.name}: what is missing?", parts), files


def _named(answer: Answer) -> set[str]:
    """What the user's equations call by names, of which c is not C."""
    e = answer.equations
    return {*e.rates, *e.parameters, *e.constants, *e.inputs, *answer.system.formulas.channels}


def _sentence(said: str, names: Collection[str] = ()) -> str:
    first = said.partition(" ")[0]
    return f"{said}." if first in names or not first.isalpha() else f"{said[:1].upper()}{said[1:]}."


def _before_after(answer: Answer) -> Markup:
    d = answer.diagnosis
    rows = []
    for c in answer.system.formulas.channels:
        b, a = answer.before[c], answer.after[c]
        unit = answer.equations.units.get(c, "1")
        rows.append([f"rms of {c} [{unit}]", f"{b.rms:.4g}", f"{a.rms:.4g}", f"{a.noise:.4g}"])
        rows.append([f"free run of {c}, held out [{unit}]", f"{b.held_out:.4g}", f"{a.held_out:.4g}", ""])
    chi = [f"{f.reduced_chi_square / d.noise:.4g}" for f in (d.before, d.after)]
    rows.append(["chi-square per degree of freedom", *chi, "1"])
    rows.append(["Ljung-Box: probability of so much memory in noise", "", f"{answer.whiteness:.2g}", ""])
    return table("", ["", "before", "after", "noise"], rows)


def _fitted(answer: Answer) -> Markup:
    d = answer.diagnosis
    rows = []
    for q in d.after.quantities:
        if not q.name.startswith(("state.", f"{NAME}.")):  # a law is shown by its course
            old = f"{d.before.values[q.name]:.6g} +- {d.before.sigma(q.name):.2g}" if q.name in d.before.names else ""
            new = f"{d.after.values[q.name]:.6g} +- {d.after.sigma(q.name):.2g}"
            rows.append([as_typed(q.name), old, new, "" if q.unit == "1" else q.unit])
    return table("", ["", "before", "after", "unit"], rows)


def _tried(answer: Answer) -> Markup:
    rows = []
    for t in answer.diagnosis.tried:
        numbers = (_number(x) for x in (t.score, t.gain, t.held_out_gain))
        rows.append([as_typed(t.candidate.name), t.candidate.title, *numbers, t.reason])
    return table("", ["term", "", "score", "refitted", "held out", "outcome"], rows)


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.4g}"


def _law(answer: Answer, law: LearnedForce) -> Drawn:
    """The law that was learned with its band, and what known terms make at the same places."""
    units = answer.equations.units
    picture, (axes,) = panels(9, 3.5)
    axes.fill_between(law.variable, law.force - 2 * law.sigma, law.force + 2 * law.sigma, color=BLUE, alpha=0.25, lw=0)
    axes.plot(law.variable, law.force, color=BLUE, lw=1.2, label="learned, 95 %")
    if law.theirs is not None:
        known = " + ".join(c.name for c in law.replaces)
        axes.plot(law.variable, law.theirs, "--", color=RED, lw=1.0, label=f"known terms: {known}")
    of = "time" if law.along.variable == "t" else law.along.variable
    unit = units.get(law.along.variable, "s" if law.along.variable == "t" else "")
    axes.set(xlabel=f"{of} ({unit})" if unit else of, ylabel=f"added to d{law.along.equation}/dt")
    axes.legend(frameon=False, fontsize=8)
    held = f", beyond {' and '.join(law.held)} as declared" if law.held else ""
    return Drawn("law", "law", f"{law.along.title}, learned from what is left{held}.", picture)


def _drawn(answer: Answer, channel: int, name: str) -> Drawn:
    """Data and model, and what is left in time and frequency: the first stretches."""
    unit = answer.equations.units.get(name, "")
    picture, (top, middle, bottom) = panels(9, 7, 3)
    sides = [answer.predicted(f)[:_MOST_STRETCHES] for f in (answer.diagnosis.before, answer.diagnosis.after)]
    for i, ((s, old), (_, new)) in enumerate(zip(*sides, strict=True)):
        thin = slice(None, None, max(1, len(s.time) // _MOST_POINTS))
        top.plot(s.time[thin], s.data[thin, channel], ".", ms=2, color=MUTED, label="" if i else "measured")
        for seen, colour, side in ((old, RED, "before"), (new, BLUE, "after")):
            label = "" if i else side
            left = s.data[:, channel] - seen[:, channel]
            top.plot(s.time[thin], seen[thin, channel], lw=0.9, color=colour, label=label)
            middle.plot(s.time[thin], left[thin], lw=0.8, color=colour, label=label)
            if i == 0 and np.isfinite(left).sum() > 64:
                rate = (len(s.time) - 1) / (s.time[-1] - s.time[0])
                frequency, power = signal.periodogram(np.nan_to_num(left), rate)
                shown = slice(1, None, max(1, len(frequency) // _MOST_POINTS))
                bottom.loglog(frequency[shown], np.sqrt(power[shown]), lw=0.7, color=colour, label=label)
    top.set(ylabel=f"{name} {f'({unit})' if unit else ''}")
    middle.set(ylabel="measured - model", xlabel="time (s)")
    middle.set_yscale("symlog", linthresh=max(3 * answer.after[name].noise, 1e-12))
    bottom.set(xlabel="frequency (Hz)", ylabel="residual per root Hz")
    for axes in (top, middle, bottom):
        if axes.get_legend_handles_labels()[1]:
            axes.legend(frameon=False, fontsize=8)
    caption = f"{name}: measured, modelled, and what is left before and after, in time and in frequency."
    return Drawn(name, name, caption, picture)
