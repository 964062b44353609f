"""Figures of a comparison: the runs over one another as the paper's figure 4, their spread, and what was fitted."""

import re
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from calibration.kit.arrays import Array
from disctrack.analyse.figures import INSET_DURATION, MIN_INSET_SHARE
from disctrack.pages.figures import Drawn, dress, panels
from disctrack.pages.palette import AMBER, BLUE, INK, MUTED, SERIES
from disctrack.repeats.averages import Average
from disctrack.repeats.compare import ExponentTable, RepeatGroup
from disctrack.repeats.runs import INDEX, QUANTITIES, AnalysedRun
from disctrack.repeats.spread import Spread

MOST_NAMED = 8  # runs in a legend
FITTED_LABELS = {"n_energy": "n_E", "n_theta": "n_θ", "n_psidot": "n_ψ̇", "k_m": "k_m (10⁻⁸ m s²)"}
FITTED_SCALES = {"n_energy": 1.0, "n_theta": 1.0, "n_psidot": 1.0, "k_m": 1e8}


def group_figures(group: RepeatGroup, number: int) -> tuple[Drawn, ...]:
    """Figures of a group that has a spread."""
    if group.spread is None:
        return ()
    stem = f"{number:02d}_{slug(group.name)}"
    return (
        _nutation(group, group.spread, stem),
        _spread(group, group.spread, stem),
        _deviations(group, group.spread, stem),
    )


def slug(name: str) -> str:
    """The name with what no file system minds."""
    return re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_") or "group"


def _colour(i: int) -> str:
    return SERIES[i % len(SERIES)]


def _lines(axes: Axes, time: Array, values: Array, runs: Sequence[AnalysedRun], width: float = 0.9) -> None:
    for i, (value, run) in enumerate(zip(values, runs, strict=True)):
        axes.plot(time, value, color=_colour(i), linewidth=width, label=run.name if i < MOST_NAMED else None)


def _nutation(group: RepeatGroup, found: Spread, stem: str) -> Drawn:
    figure, (axes,) = panels(7.2, 3.8)
    theta = np.degrees(found.value[:, :, INDEX["theta"]])
    _lines(axes, found.time, theta, group.runs)
    axes.set(xlabel=f"time from {group.alignment.zero} (s)", ylabel="nutation θ (deg)")
    axes.set_ylim(0, 1.3 * float(np.nanmax(theta)))
    axes.legend(frameon=False, fontsize=8, loc="upper left", ncols=2)
    span = np.ptp(found.time)
    if span > MIN_INSET_SHARE * INSET_DURATION:
        inset = axes.inset_axes((0.58, 0.55, 0.4, 0.38))
        dress(inset)
        last = found.time >= found.time[np.isfinite(theta).any(axis=0)][-1] - INSET_DURATION
        _lines(inset, found.time[last], theta[:, last], group.runs, 0.8)
        inset.tick_params(labelsize=7)
        inset.set_title(f"last {INSET_DURATION:g} s", fontsize=8, color=MUTED)
    part = found.parts[INDEX["theta"]]
    caption = (
        f"{len(group.runs)} runs on one clock; while all are there θ spreads by {_shown('theta', part.spread)} deg "
        f"(measurement {_shown('theta', part.noise)}, clock {_shown('theta', part.clock)}): {part.verdict}."
    )
    return Drawn(f"{stem}_nutation", f"Nutation angle, {group.name}", caption, figure)


def _shown(name: str, value: float) -> str:
    return f"{QUANTITIES[INDEX[name]].scale * value:.3g}"


def _spread(group: RepeatGroup, found: Spread, stem: str) -> Drawn:
    figure, grid = panels(9.5, 9.0, 4, 2, sharex=True)
    for i, (quantity, axes) in enumerate(zip(QUANTITIES, grid[::2] + grid[1::2], strict=True)):
        several = found.common
        for values, colour, label, style in (
            (found.std, INK, "spread of the runs", "-"),
            (found.noise, BLUE, "σ of the measurement", "-"),
            (found.clock, AMBER, "σ of the common clock", "--"),
        ):
            shown = np.where(several & (values[:, i] > 0), quantity.scale * values[:, i], np.nan)
            if np.isfinite(shown).any():
                axes.plot(found.time, shown, color=colour, linestyle=style, linewidth=0.9, label=label)
        axes.set_yscale("log")
        axes.set_ylabel(f"{quantity.symbol} ({quantity.unit})")
    for axes in grid[-2:]:
        axes.set_xlabel(f"time from {group.alignment.zero} (s)")
    handles, labels = grid[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=3, frameon=False, fontsize=9)
    caption = (
        f"Standard deviation over {len(group.runs)} runs as a function of time. x, y, ψ and φ without a constant "
        "offset per run" + ("; the paths were turned by the offset of ψ." if found.turned else ".")
    )
    return Drawn(f"{stem}_spread", f"Spread per coordinate, {group.name}", caption, figure)


def _deviations(group: RepeatGroup, found: Spread, stem: str) -> Drawn:
    figure, rows = panels(7.2, 6.0, 3, sharex=True)
    for axes, name in zip(rows, ("theta", "psidot", "energy"), strict=True):
        quantity, i = QUANTITIES[INDEX[name]], INDEX[name]
        several = np.where(found.common, 1.0, np.nan)
        deviation = quantity.scale * (found.value[:, :, i] - found.mean[:, i]) * several
        band = 3 * quantity.scale * found.noise[:, i] * several
        axes.fill_between(found.time, -band, band, color=MUTED, alpha=0.3, linewidth=0, label="± 3 σ of one run")
        _lines(axes, found.time, deviation, group.runs)
        axes.set_ylabel(f"{quantity.symbol} - mean ({quantity.unit})")
        reach = float(np.nanpercentile(np.abs(deviation), 99.5)) if np.isfinite(deviation).any() else 1.0
        if reach > 0:  # or they are copies of each other
            axes.set_ylim(-1.3 * reach, 1.3 * reach)
    rows[0].legend(frameon=False, fontsize=8, ncols=3)
    rows[-1].set_xlabel(f"time from {group.alignment.zero} (s)")
    caption = "Each run minus the mean of all. What leaves the band is no noise of the cameras."
    return Drawn(f"{stem}_deviations", f"Departure from the mean, {group.name}", caption, figure)


def fitted_figure(table: ExponentTable, number: int) -> Drawn | None:
    """Exponents and k_m of every run with their average."""
    shown = [name for name in FITTED_LABELS if table.averages[name].n > 1]
    if not shown:
        return None
    figure, grid = panels(9.5, 0.32 * len(table.rows) + 1.6, 1, len(shown), sharey=True)
    groups = list(dict.fromkeys(group for group, _, _ in table.rows))
    height = -np.arange(len(table.rows))
    for axes, name in zip(grid, shown, strict=True):
        scale, mean = FITTED_SCALES[name], table.averages[name]
        value, sigma = mean.best
        axes.axvspan(scale * (value - sigma), scale * (value + sigma), color=MUTED, alpha=0.25, lw=0)
        axes.axvline(scale * value, color=MUTED, linewidth=1.0)
        for i, (group, _, run) in enumerate(table.rows):
            item = run.fitted[name]
            face = "white" if i in mean.outliers else None
            axes.errorbar(
                scale * item.value, height[i], xerr=scale * item.sigma, fmt="o", markersize=4,
                color=_colour(groups.index(group)), markerfacecolor=face, linewidth=1.1,
            )  # fmt: skip
        axes.xaxis.set_major_locator(MaxNLocator(3))
        axes.ticklabel_format(axis="x", useOffset=False)
        axes.set_title(f"{FITTED_LABELS[name]}\n{plus_minus(mean, scale)}", fontsize=9, color=INK)
    grid[0].set_yticks(height, [f"{run.name}" for _, _, run in table.rows], fontsize=8)
    caption = "Fitted to each run, ± 1 σ; band: mean with its σ, weighted where runs agree. Open: away from all others."
    return Drawn(f"fitted_{number:02d}", f"Exponents and k_m. {table.title}", caption, figure)


def plus_minus(average: Average, scale: float = 1.0) -> str:
    """The mean to quote with its sigma."""
    return with_sigma(*(scale * v for v in average.best)) if average.n else "not determined"


def with_sigma(value: float, sigma: float) -> str:
    """Value ± sigma with two digits of the sigma, and four decimals at least."""
    if not np.isfinite(value):
        return "not determined"
    if not (np.isfinite(sigma) and sigma > 0):
        return f"{value:.4f}"
    decimals = int(np.clip(np.ceil(-np.log10(sigma)) + 1, 4, 9))
    return f"{value:.{decimals}f} ± {sigma:.{decimals}f}"
