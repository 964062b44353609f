"""Figures of a diagnosis: model and measurement superposed, the residual before and after, what was tried."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from disctrack.diagnosis.diagnose import DiscDiagnosis
from disctrack.diagnosis.held_out import HeldOut
from disctrack.diagnosis.learned import MissingMoment, learned_moment
from disctrack.figures import AMBER, BLUE, GRID, INK, MUTED, RED, Drawn
from disctrack.frames import nodal_axes_world

Array = NDArray[np.float64]

N_TRIED = 14


def all_figures(result: DiscDiagnosis) -> tuple[Drawn, ...]:
    """Every figure of a diagnosis whose base fit converged; none otherwise."""
    held = result.diagnosis.held_out_before, result.after_held_out
    if held[0] is None or held[1] is None:
        return (candidates(result),) if result.diagnosis.tried else ()
    found = [superposed(result), residuals(result), free_run(result, held[0], held[1]), candidates(result)]
    if result.moment is not None:
        found.append(moment(result, result.moment))
    return tuple(found)


def _dress(axes: Axes) -> None:
    axes.grid(True, color=GRID, linewidth=0.7)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(colors=INK, labelsize=9)


def superposed(result: DiscDiagnosis) -> Drawn:
    """Nutation, precession rate and path: measurement, model before, model after."""
    system, diagnosis = result.system, result.diagnosis
    q = system.trajectory.q[system.rows]
    before, after = system.poses(diagnosis.before.values), system.poses(result.after_fit.values)
    figure = Figure(figsize=(9.5, 3.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    for axes in (left, right):
        _dress(axes)
    time = system.time
    left.plot(time, np.degrees(q[:, 4]), ".", ms=3, color=MUTED, label="measured")
    left.plot(time, np.degrees(before[:, 4]), "--", lw=1.2, color=RED, label="model before")
    left.plot(time, np.degrees(after[:, 4]), "-", lw=1.0, color=BLUE, label="model after")
    left.set_xlabel("time [s]")
    left.set_ylabel("nutation angle [deg]")
    left.legend(frameon=False, fontsize=9)
    right.plot(1e3 * q[:, 0], 1e3 * q[:, 1], ".", ms=3, color=MUTED)
    right.plot(1e3 * before[:, 0], 1e3 * before[:, 1], "--", lw=1.2, color=RED)
    right.plot(1e3 * after[:, 0], 1e3 * after[:, 1], "-", lw=1.0, color=BLUE)
    right.set_aspect("equal", adjustable="datalim")
    right.set_xlabel("x [mm]")
    right.set_ylabel("y [mm]")
    caption = "Nutation angle and path of the centre: measurement, and the model fitted to it before and after."
    return Drawn("01_model_and_measurement", "Model and measurement", caption, figure)


def residuals(result: DiscDiagnosis) -> Drawn:
    """Measured minus fitted pose, before and after, with the band of the noise."""
    system, diagnosis = result.system, result.diagnosis
    figure = Figure(figsize=(9.5, 6.2), layout="constrained")
    grid = figure.subplots(4, 2, sharex=True)
    rows = [("x", 1e6, "um"), ("y", 1e6, "um"), ("z", 1e6, "um"), ("theta", 1e3 * np.degrees(1), "mdeg")]
    for column, (fit, name, colour) in enumerate(
        ((diagnosis.before, "before", RED), (result.after_fit, "after", BLUE))
    ):
        delta, sigma = system.pose_difference(fit.values)
        e1 = nodal_axes_world(*system.poses(fit.values)[:, 3:5].T)[0]
        theta = np.sum(e1 * delta[:, 3:], axis=1), np.sqrt(np.sum((e1 * sigma[:, 3:]) ** 2, axis=1))
        series = [*((delta[:, i], sigma[:, i]) for i in range(3)), theta]
        for row, ((label, scale, unit), (value, noise)) in enumerate(zip(rows, series, strict=True)):
            axes = grid[row, column]
            _dress(axes)
            axes.fill_between(system.time, -2 * scale * noise, 2 * scale * noise, color=GRID, lw=0)
            axes.plot(system.time, scale * value, lw=0.7, color=colour)
            axes.set_ylabel(f"{label} [{unit}]")
        grid[0, column].set_title(name, fontsize=10, color=INK)
        grid[-1, column].set_xlabel("time [s]")
    caption = "Measured minus fitted pose. The grey band is two standard deviations of a frame's noise."
    return Drawn("02_residuals", "Residual before and after", caption, figure)


def free_run(result: DiscDiagnosis, before: HeldOut, after: HeldOut) -> Drawn:
    """Error of the free run over the part that the fit has not seen."""
    system = result.system
    figure = Figure(figsize=(9.5, 3.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    last = system.time[~before.test_rows & (system.weights > 0)].max()
    for held, colour, name in ((before, RED, "before"), (after, BLUE, "after")):
        delta, sigma = system.pose_difference(held.train.values)
        e1 = nodal_axes_world(*system.poses(held.train.values)[:, 3:5].T)[0]
        theta = np.abs(np.sum(e1 * delta[:, 3:], axis=1))
        left.semilogy(system.time, 1e3 * np.linalg.norm(delta[:, :3], axis=1), lw=0.8, color=colour, label=name)
        right.semilogy(system.time, np.degrees(theta), lw=0.8, color=colour, label=name)
    noise = np.sqrt(np.sum(e1**2 * sigma[:, 3:] ** 2, axis=1))
    left.semilogy(system.time, 1e3 * np.linalg.norm(sigma[:, :3], axis=1), lw=1, color=MUTED, label="noise")
    right.semilogy(system.time, np.degrees(noise), lw=1, color=MUTED, label="noise")
    for axes, label in ((left, "error of the position [mm]"), (right, "error of the nutation [deg]")):
        _dress(axes)
        axes.axvline(last, color=AMBER, lw=1)
        axes.set_xlabel("time [s]")
        axes.set_ylabel(label)
    left.legend(frameon=False, fontsize=9)
    caption = (
        "Fitted up to the vertical line, left alone after it: the free run's error before and after, and the noise."
    )
    return Drawn("03_free_run", "Free run over held-out data", caption, figure)


def candidates(result: DiscDiagnosis) -> Drawn:
    """Gain of each candidate at the base fit, largest first."""
    diagnosis = result.diagnosis
    tried = diagnosis.tried[:N_TRIED]
    figure = Figure(figsize=(9.5, 0.6 + 0.28 * max(len(tried), 3)), layout="constrained")
    axes = figure.add_subplot()
    _dress(axes)
    gains = [max(t.gain if t.gain is not None else t.score, 1e-2) for t in tried]
    named = {f.candidate.name for f in diagnosis.found}
    alike = {r.candidate.name for f in diagnosis.found for r in f.cannot_be_told_from}
    colours = [BLUE if t.candidate.name in named else AMBER if t.candidate.name in alike else MUTED for t in tried]
    axes.barh(range(len(tried)), gains, color=colours)
    axes.set_yticks(range(len(tried)), [t.candidate.name for t in tried])
    axes.invert_yaxis()
    axes.set_xscale("log")
    axes.axvline(15.0, color=RED, lw=1)
    axes.set_xlabel("decrease of chi-square when it is added to the model (red: what noise can do)")
    caption = "The candidates that gain most. Blue: chosen; amber: cannot be told from it."
    return Drawn("04_candidates", "What was tried", caption, figure)


def moment(result: DiscDiagnosis, missing: MissingMoment) -> Drawn:
    """Moment that the model fails to supply, with its two-sigma band, and the law learned from it."""
    figure = Figure(figsize=(9.5, 5.4), layout="constrained")
    grid = figure.subplots(3, 1, sharex=True)
    law = None
    if result.learned is not None:
        law = learned_moment(result.system, result.learned.fit, result.learned.law)
    for i, (axes, name) in enumerate(zip(grid, ("n0", "m0", "k"), strict=True)):
        _dress(axes)
        value, sigma = 1e6 * missing.moment[:, i], 1e6 * missing.sigma[:, i]
        axes.fill_between(missing.time, value - 2 * sigma, value + 2 * sigma, color=GRID, lw=0)
        axes.plot(missing.time, value, lw=1.1, color=RED, label="missing")
        if law is not None:
            axes.plot(result.system.time, 1e6 * law[:, i], lw=1.0, color=BLUE, label="law")
        axes.set_ylabel(f"along {name} [uN m]")
    grid[0].legend(frameon=False, fontsize=9)
    grid[-1].set_xlabel("time [s]")
    caption = "Contact moment that the model before fails to supply, with two standard deviations, and the law for it."
    return Drawn("05_missing_moment", "The missing moment", caption, figure)
