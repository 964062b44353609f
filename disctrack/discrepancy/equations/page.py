"""The page of an answer: its report with figures."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy import signal

from disctrack.discrepancy.equations.law import LearnedForce
from disctrack.numbers import in_unit
from disctrack.report.blocks import Drawn
from disctrack.report.figures import BAND, Curve, chart, panels
from disctrack.report.html import write_page
from disctrack.report.palette import BLUE, MUTED, RED

if TYPE_CHECKING:
    from disctrack.discrepancy.equations.answer import Answer

_MOST_POINTS = 6000  # of a curve: more are not visible on a page
_MOST_STRETCHES = 6


def write_answer(answer: "Answer", path: Path) -> list[Path]:
    """Write the page; returns the figures that were written beside it. Raises OutputError."""
    drawn = [_drawn(answer, c, name) for c, name in enumerate(answer.system.formulas.channels)]
    law = [] if answer.law is None else [_law(answer, answer.law)]
    return write_page(path, answer.report((*law, *drawn)), ("png",))


def _law(answer: "Answer", law: LearnedForce) -> Drawn:
    """The learned law with its confidence band."""
    along, added = law.along, f"added to d{law.along.equation}/dt"
    named = ("time",) if along.of_time else along.variables
    labels = [in_unit(name, unit) for name, unit in zip(named, along.units(answer.equations.units), strict=True)]
    if len(labels) == 1:
        course = Curve(law.variable, law.force, BLUE, f"learned, ± {BAND:g} σ", sigma=law.sigma)
        picture = chart(labels[0], (added, [course]), size=(9, 3.5))
    else:
        picture, (axes,) = panels(7, 4)
        points = axes.scatter(law.variable[:, 0], law.variable[:, 1], 9, law.force, cmap="coolwarm")
        picture.colorbar(points, label=added)
        axes.set(xlabel=labels[0], ylabel=labels[1])
    held = f", beyond {' and '.join(law.held)} as declared" if law.held else ""
    return Drawn("law", "law", f"{law.along.title}, learned from the residuals{held}.", picture)


def _drawn(answer: "Answer", channel: int, name: str) -> Drawn:
    """Data and model, and the residuals in time and frequency, of the first stretches."""
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
    caption = f"{name}: measured and modelled; residuals before and after, in time and in frequency."
    return Drawn(name, name, caption, picture)
