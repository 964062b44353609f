"""Pictures of a validation: error against nutation, scatter against the bound, what each disturbance does."""

from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from calibration.kit.arrays import Array
from disctrack.pages.palette import AMBER, BLUE, GREEN, INK, MUTED, PURPLE, RED
from disctrack.validate.comparison import PoseErrors, joined
from disctrack.validate.efficiency import Efficiency
from disctrack.validate.stress import CLAIM_POSITION, CLAIM_ROTATION, Stress
from disctrack.validate.trial import TrialRecording

_UM, _DEG = 1e6, 180 / np.pi
AXES = (BLUE, AMBER, RED)


def error_figure(trials: Sequence[TrialRecording], law: float) -> Figure:
    """|error| of every pose seen by both cameras against nutation, with the claim and the law of psi and phi."""
    parts = [(trial.static.own.part(trial.static.cameras == 2), "o") for trial in trials]
    parts += [(m.own.part(m.cameras == 2), ".") for trial in trials for m in trial.rolling.values()]
    figure = Figure(figsize=(13, 4.6), layout="constrained")
    left, middle, right = figure.subplots(1, 3, sharex=True)
    _points(left, parts, lambda c: np.abs(c.error[:, :3]) * _UM, AXES, "xyz")
    _claim(left, CLAIM_POSITION * _UM, "claim 5 µm")
    left.set(title="position", ylabel="|error| (µm)")
    _points(middle, parts, lambda c: np.abs(c.error[:, 3:]) * _DEG, AXES, "xyz")
    _claim(middle, CLAIM_ROTATION * _DEG, "claim 0.05°")
    middle.set(title="rotation vector, world axes", ylabel="|error| (deg)")
    _points(right, parts, lambda c: np.abs(c.angles) * _DEG, (PURPLE, MUTED, GREEN), ("ψ", "θ", "φ"))
    theta = np.geomspace(0.45, 90, 200)
    right.plot(theta, law * _DEG / np.sin(np.radians(theta)), color=INK, lw=1.2,
               label=f"σ = {law * _DEG * 1e3:.2f} mdeg / sin θ")  # fmt: skip
    _claim(right, CLAIM_ROTATION * _DEG, "claim 0.05°")
    right.set(title="Euler angles", ylabel="|error| (deg)")
    for axes in (left, middle, right):
        axes.set(xscale="log", yscale="log", xlabel="nutation θ (deg)", xlim=(0.45, 92))
        axes.set_xticks([0.5, 1, 2, 5, 10, 20, 50], ["0.5", "1", "2", "5", "10", "20", "50"])
        axes.minorticks_off()
        top = axes.get_ylim()[1]
        axes.set_ylim(top / 10**4.5, top)  # the smallest errors are luck
        axes.legend(fontsize=8, loc="lower left" if axes is right else "best", ncols=2)
        axes.grid(alpha=0.25)
    figure.suptitle("Errors through the recordings' own calibrations (circles: static, dots: rolling)")
    return figure


def _points(
    axes: Axes,
    parts: Sequence[tuple[PoseErrors, str]],
    values: Callable[[PoseErrors], Array],
    colours: Sequence[str],
    names: Sequence[str],
) -> None:
    for marker in ("o", "."):
        chosen = [c for c, m in parts if m == marker]
        if not chosen:
            continue
        comparison = joined(chosen)
        comparison = comparison.part(comparison.usable)
        size = values(comparison)
        for k, (colour, name) in enumerate(zip(colours, names, strict=True)):
            axes.plot(np.degrees(comparison.q[:, 4]), size[:, k], marker, color=colour, ms=4 if marker == "o" else 3.5,
                      alpha=0.75, ls="", mew=0, label=name if marker == "o" else None)  # fmt: skip


def _claim(axes: Axes, value: float, label: str) -> None:
    axes.axhline(value, color=INK, lw=1.2, ls="--", label=label)


def bound_figure(e: Efficiency) -> Figure:
    """Measured scatter beside the bounds as functions of nutation, and their ratio."""
    figure = Figure(figsize=(13, 4.6), layout="constrained")
    axes = figure.subplots(1, 3)
    theta = np.degrees(e.q[:, 4])
    panels = (
        ("position, rms of the axes", "µm", _UM, [0, 1, 2], BLUE),
        ("rotation, per axis", "mdeg", _DEG * 1e3, [6], RED),
        ("ψ", "mdeg", _DEG * 1e3, [3], PURPLE),
    )
    for panel, (title, unit, scale, columns, colour) in zip(axes, panels, strict=True):
        marks = (
            (e.bound_image, "_", MUTED, "bound, whole image"),
            (e.bound, "_", INK, "bound, dots"),
            (e.reported, "x", colour, "reported σ"),
        )
        for values, mark, ink, label in marks:  # no lines: every pose has its own psi, phi and place
            panel.plot(theta, scale * _rms(values, columns), mark, color=ink, label=label, ms=9 if mark == "_" else 5,
                       mew=1.8 if mark == "_" else 1.2)  # fmt: skip
        scatter = scale * _rms(e.scatter, columns)
        # n copies and k columns tell a standard deviation to 1 / sqrt(2 k (n - 1)) of itself
        error = scatter / np.sqrt(2 * max(len(columns), 3 if columns == [6] else 1) * (e.copies - 1))
        panel.errorbar(theta, scatter, error, fmt="o", color=colour, ms=5, label=f"scatter of {e.copies} copies")
        panel.set(xscale="log", yscale="log" if title == "ψ" else "linear", title=title, xlabel="nutation θ (deg)",
                  ylabel=f"σ ({unit})")  # fmt: skip
        panel.set_xticks([0.5, 1, 2, 5, 10, 20, 50], ["0.5", "1", "2", "5", "10", "20", "50"])
        panel.minorticks_off()
        if title != "ψ":
            panel.set_ylim(0, None)
        panel.grid(alpha=0.25)
        panel.legend(fontsize=8)
    figure.suptitle(
        f"Scatter beside the Cramér-Rao bound: efficiency {e.efficiency:.2f} ± {e.efficiency_uncertainty:.2f}"
    )
    return figure


def stress_ticks(level: Array) -> list[float]:
    """Round numbers over the range of the levels."""
    candidates = [m * 10.0**e for e in range(-2, 4) for m in (1, 1.5, 2, 3, 5, 7)]
    inside = [x for x in candidates if 0.8 * level.min() <= x <= 1.25 * level.max()]
    return inside if len(inside) <= 5 else inside[:: -(-len(inside) // 5)]


def _rms(values: Array, columns: Sequence[int]) -> Array:
    return np.asarray(np.sqrt(np.mean(values[:, columns] ** 2, axis=1)))


def stress_figure(stresses: Sequence[Stress]) -> Figure:
    """Errors in units of the claim as each disturbance is raised; crosses: more poses lost than allowed."""
    columns = min(4, len(stresses))
    rows = -(-len(stresses) // columns)
    figure = Figure(figsize=(3.6 * columns, 3.6 * rows), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for panel, stress in zip(panels, stresses, strict=False):
        level = np.array([s.level for s in stress.levels])
        for values, colour, label in (
            (np.array([s.position for s in stress.levels]) / CLAIM_POSITION, BLUE, "position"),
            (np.array([s.rotation for s in stress.levels]) / CLAIM_ROTATION, RED, "rotation"),
        ):
            panel.plot(level, values, "o-", color=colour, ms=4, label=label)
        lost = np.array([s.lost for s in stress.levels])
        panel.axhline(1, color=INK, ls="--", lw=1, label="claim")
        for x, share in zip(level[lost > 0], lost[lost > 0], strict=True):
            panel.annotate(f"{100 * share:.0f} % lost", (x, 0.97), xycoords=("data", "axes fraction"), fontsize=7,
                           rotation=90, ha="right", va="top", color=INK)  # fmt: skip
        low, high = stress.fails_between
        if np.isfinite(high):
            panel.axvspan(max(low, level[0] * 0.5), high, color=RED, alpha=0.15, lw=0)
        panel.set(xscale="log", yscale="log", title=stress.name, xlabel=stress.unit, ylabel="rms / claim")
        panel.set_xticks(stress_ticks(level), [f"{x:g}" for x in stress_ticks(level)])
        panel.xaxis.set_minor_formatter(NullFormatter())
        panel.set_xlim(0.85 * level[0], 1.2 * level[-1])
        panel.title.set_fontsize(9)
        panel.grid(alpha=0.25)
    panels[0].legend(fontsize=8)
    for panel in panels[len(stresses) :]:
        panel.set_visible(False)
    figure.suptitle("Each disturbance raised until the claim of 0.005 mm / 0.05 deg fails (red band)")
    return figure
