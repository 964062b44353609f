"""Published exponents with the curves along which each explanation moves them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from disctrack.diagnosis.system import Values
from disctrack.examples.exponent_analysis import THIN_DISC, Explanation
from disctrack.examples.exponent_system import ExponentSystem, Series

Array = NDArray[np.float64]

AXES = ((0, 1), (0, 2))  # pairs of exponents that are shown against each other
LABELS = ("$n_\\theta$", "$n_{\\dot\\psi}$", "$n_E$")
FRACTIONS = (0.0, 0.5, 1.0)  # of the fitted size


def draw(system: ExponentSystem, explanations: Sequence[Explanation], base: Values, path: Path) -> None:
    """One row per surface; trials, their mean with its 68 and 95 % region, the models, the explanations."""
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 4.3 * len(system.series)), layout="constrained")
    FigureCanvasAgg(figure)
    grid = np.atleast_2d(figure.subplots(len(system.series), len(AXES)))
    colours = mpl.colormaps["tab10"].colors  # type: ignore[attr-defined]
    for i, series in enumerate(system.series):
        paths = {e.candidate.name: _path(system, i, e, base) for e in explanations}
        for axes, (a, b) in zip(grid[i], AXES, strict=True):
            _draw_trials(axes, series, a, b)
            axes.plot(THIN_DISC[a], THIN_DISC[b], "k*", ms=12, label="thin disc: 2/3, $-$1/3, 2/3")
            for k, (name, points) in enumerate(paths.items()):
                axes.plot(points[:, a], points[:, b], "-", color=colours[k], lw=1.2)
                axes.plot(points[-1, a], points[-1, b], "o", color=colours[k], ms=6, label=name)
            start = system.outcomes(i, base)
            axes.plot(start[a], start[b], "ks", ms=7, label="simulated, $k_m$ alone")
            axes.set(xlabel=LABELS[a], ylabel=LABELS[b], title=series.setup.surface)
    grid[0, 0].legend(fontsize=7, loc="best")
    figure.savefig(path, dpi=110, metadata={"Software": None})


def _path(system: ExponentSystem, index: int, explanation: Explanation, base: Values) -> Array:
    """(n, 4) outcomes on the way from the base fit to the fitted explanation."""
    end = explanation.fit.values
    null = {q.name: q.null for q in explanation.candidate.quantities}
    start = null | dict(base)
    steps = [{n: start[n] + f * (end[n] - start[n]) for n in end} for f in FRACTIONS]
    return np.array([system.outcomes(index, values) for values in steps])


def _draw_trials(axes: Any, series: Series, a: int, b: int) -> None:
    exponents = series.exponents
    axes.plot(exponents[:, a], exponents[:, b], ".", color="0.6", label="trials")
    mean, n = series.mean, len(exponents)
    root = np.linalg.cholesky(np.cov(exponents[:, [a, b]].T) / n)
    circle = np.exp(1j * np.linspace(0, 2 * np.pi, 100))
    for probability, style in ((0.68, "-"), (0.95, "--")):
        radius = np.sqrt(2 * (n - 1) / (n - 2) * stats.f.ppf(probability, 2, n - 2))  # Hotelling
        ellipse = mean[[a, b]][:, None] + radius * root @ np.stack([circle.real, circle.imag])
        axes.plot(*ellipse, color="0.3", ls=style, lw=1, label=f"their mean, {100 * probability:.0f} %")
    axes.plot(mean[a], mean[b], "+", color="0.3", ms=10)
