"""Published exponents with the curves along which each explanation moves the prediction."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy import stats

from calibration.arrays import Array
from disctrack.diagnosis.engine.system import Values
from disctrack.examples.exponent_analysis import THIN_DISC, Explanation
from disctrack.examples.exponent_report import Answer
from disctrack.examples.exponent_system import ExponentSystem, Series
from disctrack.pages.figures import dress
from disctrack.pages.palette import AMBER, BLUE, GREEN, INK, MUTED, PURPLE, RED, SKY

AXES = ((0, 1), (0, 2))  # pairs of exponents that are shown against each other
LABELS = (r"$n_\theta$", r"$n_{\dot\psi}$", "$n_E$")
FRACTIONS = (0.0, 0.5, 1.0)  # of the fitted size
_STYLES = ((BLUE, "o"), (RED, "s"), (GREEN, "^"), (AMBER, "D"), (PURPLE, "v"), (SKY, "P"))


def draw(system: ExponentSystem, answer: Answer) -> Figure:
    """One row per surface: trials, region of their mean, the model before, and each explanation's way from there."""
    figure = Figure(figsize=(10.5, 4.1 * len(system.series)), layout="constrained")
    grid = np.atleast_2d(figure.subplots(len(system.series), len(AXES)))
    base = answer.base.values
    for i, series in enumerate(system.series):
        ways = {n: _way(system, i, e, base) for n, e in answer.explanations.items()}
        for axes, (a, b) in zip(grid[i], AXES, strict=True):
            dress(axes)
            _draw_trials(axes, series, a, b)
            for k, (name, points) in enumerate(ways.items()):
                colour, marker = _STYLES[k % len(_STYLES)]
                axes.plot(points[:, a], points[:, b], "-", color=colour, lw=1)
                axes.plot(points[-1, a], points[-1, b], marker, color=colour, ms=7, alpha=0.8, mec="white", label=name)
            start = ways[next(iter(ways))][0]
            axes.plot(start[a], start[b], "s", color=INK, ms=8, label="simulated, $k_m$ alone")
            axes.plot(THIN_DISC[a], THIN_DISC[b], "*", color=INK, ms=13, label="thin disc: 2/3, $-$1/3, 2/3")
            axes.set(xlabel=LABELS[a], ylabel=LABELS[b])
            axes.set_title(f"{series.setup.surface}, last {series.setup.longest:g} s", color=INK, fontsize=10)
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right upper", fontsize=8, frameon=False)
    return figure


def _way(system: ExponentSystem, index: int, explanation: Explanation, base: Values) -> Array:
    """(n, 4) outcomes from the base fit to the fitted explanation."""
    end = explanation.fit.values
    start = {q.name: q.null for q in explanation.candidate.quantities} | dict(base)
    steps = [{n: start[n] + f * (end[n] - start[n]) for n in end} for f in FRACTIONS]
    return np.array([system.outcomes(index, values) for values in steps])


def _draw_trials(axes: Axes, series: Series, a: int, b: int) -> None:
    exponents = series.exponents
    axes.plot(exponents[:, a], exponents[:, b], ".", color=MUTED, label="trials")
    mean, n = series.mean, len(exponents)
    root = np.linalg.cholesky(np.cov(exponents[:, [a, b]].T) / n)
    circle = np.linspace(0, 2 * np.pi, 100)
    for probability, style in ((0.68, "-"), (0.95, "--")):
        radius = np.sqrt(2 * (n - 1) / (n - 2) * stats.f.ppf(probability, 2, n - 2))  # Hotelling
        ellipse = mean[[a, b]][:, None] + radius * root @ np.stack([np.cos(circle), np.sin(circle)])
        axes.plot(*ellipse, color=MUTED, ls=style, lw=1, label=f"their mean, {100 * probability:.0f} %")
    axes.plot(mean[a], mean[b], "+", color=MUTED, ms=10)
