"""Figures of a diagnosis: model and measurement superposed, the residual before and after, what was tried."""

from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.signal import periodogram
from scipy.stats import chi2

from calibration.kit.arrays import Array
from disctrack.diagnosis.answer import DiscDiagnosis
from disctrack.diagnosis.errors import frequencies, simulated
from disctrack.diagnosis.form_misfit import LawCourse, moment_about_contact
from disctrack.diagnosis.free_runs import ModelFreeEvidence, ModelFreeForces, force_of
from disctrack.diagnosis.missing_force import MissingMoment
from disctrack.discrepancy.fit import Fit
from disctrack.discrepancy.held_out import HeldOut
from disctrack.frames import nodal_axes_world
from disctrack.report.figures import NO_TITLE, Drawn, dress, panels, plain_powers
from disctrack.report.palette import AMBER, BLUE, GRID, INK, MUTED, RED

N_TRIED = 14


Side = tuple[Fit, str, str]  # the fit of a model, its name, its colour


def _sides(result: DiscDiagnosis) -> list[Side]:
    """The models that are shown: before and after, or the only one where nothing was added to it."""
    after = result.after_fit
    if not result.has_more:
        return [(after, "model", BLUE)]
    return [(result.diagnosis.before, "model before", RED), (after, "model after", BLUE)]


def all_figures(result: DiscDiagnosis, beside: ModelFreeEvidence | None) -> tuple[Drawn, ...]:
    """Every figure of a diagnosis whose base fit converged; of another what was tried."""
    held = result.diagnosis.held_out_before, result.after_held_out
    if beside is None or held[0] is None or held[1] is None:
        return (candidates(result),) if result.diagnosis.tried else ()
    found = [superposed(result, beside), residuals(result), spectrum(result), free_run(result, held[0], held[1])]
    if beside.moment is not None:
        found.append(moment(result, beside.moment, beside.moment_of_law))
    if beside.measured is not None:
        found.append(force(result, beside.measured))
    if result.learned is not None and result.learned.course is not None:
        found.append(course(result.learned.course))
    found.append(candidates(result))
    return tuple(replace(d, name=f"{i:02d}_{d.name}") for i, d in enumerate(found, start=1))


def superposed(result: DiscDiagnosis, beside: ModelFreeEvidence) -> Drawn:
    """Nutation, precession rate and path: measurement, model before, model after (figures 17 and 18 of the paper)."""
    system = result.system
    figure = Figure(figsize=(9.5, 6.4), layout="constrained")
    grid = figure.add_gridspec(2, 2, width_ratios=(1.5, 1))
    theta, rate = figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[1, 0])
    path = figure.add_subplot(grid[:, 1])
    q, time = system.trajectory.q[system.rows], system.time
    dots: dict[str, Any] = {"linestyle": "", "marker": ".", "ms": 4, "color": MUTED, "label": "measured"}
    theta.plot(time, np.degrees(q[:, 4]), **dots)
    path.plot(1e3 * q[:, 0], 1e3 * q[:, 1], **dots)
    if beside.measured is not None:
        rate.plot(time, beside.measured.psidot, **dots)
    for (fit, name, colour), line in zip(_sides(result), ("--", "-"), strict=False):
        style: dict[str, Any] = {"ls": line, "lw": 1.2, "color": colour, "label": name}
        motion = simulated(system, fit.values)
        instants = time[: len(motion)]
        theta.plot(instants, np.degrees(motion.q[:, 4]), **style)
        rate.plot(instants, motion.qdot[:, 3], **style)
        path.plot(1e3 * motion.q[:, 0], 1e3 * motion.q[:, 1], **style)
    labels = ((theta, "nutation angle (deg)"), (rate, "precession rate (rad/s)"), (path, "y (mm)"))
    for axes, label in labels:
        dress(axes)
        axes.set_xlabel("time (s)")
        axes.set_ylabel(label)
    _frame(theta, np.degrees(q[:, 4]))
    if beside.measured is not None:
        _frame(rate, beside.measured.psidot)
    path.set_aspect("equal")
    path.set_xlabel("x (mm)")
    theta.legend(frameon=False, fontsize=9, loc="upper right", ncols=3)
    caption = (
        "Nutation angle, precession rate and path of the centre: measured, and the model fitted to the measurement. "
        "The measured rate is the derivative of the poses, without any model."
    )
    return Drawn("model_and_measurement", "Model and measurement", caption, figure)


def _frame(axes: Axes, values: Array) -> None:
    """The data decide what is shown, with room for the legend; a model that misses them may leave the picture."""
    known = values[np.isfinite(values)]
    if known.size:
        low, high = float(known.min()), float(known.max())
        axes.set_ylim(low - 0.08 * (high - low or 1.0), high + 0.25 * (high - low or 1.0))


def residuals(result: DiscDiagnosis) -> Drawn:
    """Measured minus fitted pose, a column per model, with the band of the noise."""
    system, sides = result.system, _sides(result)
    n = len(sides)
    figure, grid = panels(9.5, 6.2, 4, n, (0.95, 0.15, 0.55, 0.3), sharex=True)
    rows = [("x", 1e6, "µm"), ("y", 1e6, "µm"), ("z", 1e6, "µm"), ("θ", 1e3 * np.degrees(1), "mdeg")]
    for column, (fit, name, colour) in enumerate(sides):
        delta, sigma = system.pose_difference(fit.values)
        e1 = nodal_axes_world(*system.poses(fit.values)[:, 3:5].T)[0]
        theta = np.sum(e1 * delta[:, 3:], axis=1), np.sqrt(np.sum((e1 * sigma[:, 3:]) ** 2, axis=1))
        series = [*((delta[:, i], sigma[:, i]) for i in range(3)), theta]
        for row, ((label, scale, unit), (value, noise)) in enumerate(zip(rows, series, strict=True)):
            axes = grid[n * row + column]
            axes.fill_between(system.time, -2 * scale * noise, 2 * scale * noise, color=GRID, lw=0)
            axes.plot(system.time, scale * value, lw=0.7, color=colour)
            axes.set_ylabel(f"{label} ({unit})")
        grid[column].set_title(name, fontsize=10, color=INK)
        grid[column - n].set_xlabel("time (s)")
    caption = "Measured minus fitted pose. The grey band is ± 2 σ of a frame's noise."
    return Drawn("residuals", "Residuals of the poses", caption, figure)


def free_run(result: DiscDiagnosis, before: HeldOut, after: HeldOut) -> Drawn:
    """Error of the free run over the part that the fit has not seen."""
    system = result.system
    figure, (left, right) = panels(9.5, 3.4, 1, 2, NO_TITLE)
    last = system.time[~before.test_rows & (system.weights > 0)].max()
    runs = (before, after)[-len(_sides(result)) :]
    for held, (_, name, colour) in zip(runs, _sides(result), strict=True):
        delta, sigma = system.pose_difference(held.train.values)
        e1 = nodal_axes_world(*system.poses(held.train.values)[:, 3:5].T)[0]
        theta = np.abs(np.sum(e1 * delta[:, 3:], axis=1))
        left.semilogy(system.time, 1e3 * np.linalg.norm(delta[:, :3], axis=1), lw=0.8, color=colour, label=name)
        right.semilogy(system.time, np.degrees(theta), lw=0.8, color=colour, label=name)
    noise = np.sqrt(np.sum(e1**2 * sigma[:, 3:] ** 2, axis=1))
    left.semilogy(system.time, 1e3 * np.linalg.norm(sigma[:, :3], axis=1), lw=1, color=MUTED, label="noise, 1 σ")
    right.semilogy(system.time, np.degrees(noise), lw=1, color=MUTED, label="noise, 1 σ")
    for axes, label in ((left, "error of the position (mm)"), (right, "error of the nutation (deg)")):
        axes.axvline(last, color=AMBER, lw=1)
        axes.set_xlabel("time (s)")
        axes.set_ylabel(label)
    left.legend(frameon=False, fontsize=9)
    caption = "Error of the free run: the model is fitted up to the vertical line and continues alone after it."
    return Drawn("free_run", "Free run over held-out data", caption, figure)


def candidates(result: DiscDiagnosis) -> Drawn:
    """Gain of each candidate at the base fit, largest first."""
    diagnosis = result.diagnosis
    tried = diagnosis.tried[:N_TRIED]
    figure, (axes,) = panels(9.5, 0.6 + 0.28 * max(len(tried), 3))
    gains = np.array([max(t.gain if t.gain is not None else t.score, 1e-2) for t in tried])
    beyond = ~np.isfinite(gains)  # without it nothing fits: its bar ends beyond all others
    gains[beyond] = 10.0 * max([100.0, *gains[~beyond]])
    named = {f.candidate.name for f in diagnosis.found}
    alike = {r.candidate.name for f in diagnosis.found for r in f.cannot_be_told_from}
    colours = [BLUE if t.candidate.name in named else AMBER if t.candidate.name in alike else MUTED for t in tried]
    axes.barh(range(len(tried)), gains, color=colours)
    axes.set_yticks(range(len(tried)), [t.candidate.name for t in tried])
    axes.invert_yaxis()
    axes.set_xscale("log")
    level = diagnosis.settings.false_alarm / max(len(result.system.candidates), 1)
    axes.axvline(float(chi2.isf(level, 1)), color=RED, lw=1)
    plain_powers(axes.xaxis)
    axes.set_xlabel(
        "decrease of chi-square when it is added to the model (red line: what noise alone can reach with one number)"
    )
    for row in np.flatnonzero(beyond):
        axes.annotate("without it nothing fits", (gains[row], row), (-4, 0), textcoords="offset points", fontsize=8,
                      ha="right", va="center", color="white")  # fmt: skip
    caption = "The candidates that gain most. Blue: found; amber: indistinguishable alternatives."
    return Drawn("candidates", "What was tried", caption, figure)


Along = tuple[Array, Array] | None  # time (k,), values along n0, m0 and k (k, 3)


def _along_the_contact(known: Along, sigma: Array, added: Along, scale: float, unit: str, name: str) -> Figure:
    """What is missing along n0, m0 and k with its band of two sigmas, and what was found adds to it."""
    figure, grid = panels(9.5, 5.4, 3, margins=NO_TITLE, sharex=True)
    assert known is not None
    time, values = known[0], scale * known[1]
    for i, (axes, axis) in enumerate(zip(grid, ("n0", "m0", "k"), strict=True)):
        value, band = values[:, i], 2 * scale * sigma[:, i]
        axes.fill_between(time, value - band, value + band, color=GRID, lw=0)
        axes.plot(time, value, lw=1.2, color=RED, label=name)
        # the band but for its ends, where derivatives are poor and splines of short moments run away
        edge = len(value) // 20 if len(value) > 100 else 0
        inner = slice(edge, -edge or None)
        shown = [(value - band)[inner], (value + band)[inner]]
        if added is not None:
            law, cut = scale * added[1][:, i], len(added[0]) // 20
            axes.plot(added[0], law, lw=1.0, color=BLUE, label="added by what was found")
            shown.append(law[cut : -cut or None])
        _frame(axes, np.concatenate(shown))
        axes.axhline(0.0, color=MUTED, lw=0.7)
        axes.set_ylabel(f"along {axis} ({unit})")
    grid[0].legend(facecolor="white", edgecolor="none", fontsize=9, ncols=2, loc="upper right")
    grid[-1].set_xlabel("time (s)")
    return figure


def moment(result: DiscDiagnosis, missing: MissingMoment, of_law: MissingMoment | None) -> Drawn:
    """Moment that the model fails to supply, with its two-sigma band, and what the effects found add to it."""
    law = None if of_law is None or not result.diagnosis.found else (of_law.time, of_law.moment)
    if result.learned is not None and all(c.startswith("M") for c in result.learned.law.formulas):
        system, values = result.system, result.learned.fit.values
        own = {result.learned.law.candidate.effect}
        law = system.time, moment_about_contact(system, values, simulated(system, values), own)
    known = missing.time, missing.moment
    figure = _along_the_contact(known, missing.sigma, law, 1e6, "µN m", "missing, ± 2 σ")
    caption = (
        "Contact moment M_n, M_m, M_z that the model before fails to supply: what short moments would have to be for "
        "the dots to lie where they did. A missing force, inertia or an error of the measurement shows as the moment "
        "that does the same."
    )
    if result.learned is not None:
        caption += (
            " Blue, for a law outside the catalogue, is the whole of its moment; red holds only what the start and the "
            "other fitted numbers cannot absorb, so that a steady part, along n0 above all, is smaller in red."
        )
    elif law is not None:
        caption += " Blue is what was found, computed in the same way: within the band it is what was missing."
    return Drawn("missing_moment", "The missing moment", caption, figure)


def course(known: LawCourse) -> Drawn:
    """Moment about the contact of all laws, with the band of the learned law's coefficients and form."""
    figure = _along_the_contact((known.time, known.moment), known.sigma, None, 1e6, "µN m", "all laws, ± 2 σ")
    caption = (
        "Moment about the contact of all laws of the model and of the law outside the catalogue, a force at the centre "
        "included as the moment that it has about the contact. The band holds what the law's form may be off by "
        f"({100 * known.misfit:.2g} % of the law) and the other laws that fit as well."
    )
    return Drawn("course_of_the_laws", "How well the laws are known along the recording", caption, figure)


def force(result: DiscDiagnosis, measured: ModelFreeForces) -> Drawn:
    """Force on the disc that the model fails to supply, from the accelerations alone, and what was found adds to it."""
    time, before = result.system.time, force_of(result.system, result.diagnosis.before)
    added = (time, force_of(result.system, result.after_fit) - before) if result.has_more else None
    known = time, measured.force - before
    figure = _along_the_contact(known, measured.force_sigma, added, 1e3, "mN", "missing, ± 2 σ")
    caption = (
        "Force on the disc, measured minus that of the model before: mass times the acceleration of the centre, from "
        "the poses alone."
    )
    return Drawn("missing_force", "The missing force", caption, figure)


def spectrum(result: DiscDiagnosis) -> Drawn:
    """Periodogram of the pose residual before and after, with the frequencies at which effects show."""
    system = result.system
    present = system.weights >= 6
    rate = float(1.0 / np.median(np.diff(system.time)))
    figure, (axes,) = panels(9.5, 3.2, margins=NO_TITLE)
    for fit, name, colour in _sides(result):
        residual = system.pose_residual(fit.values)[present]
        if np.isfinite(residual).all():
            frequency, power = periodogram(residual, rate, axis=0)
            # white noise of variance 1 has the same power at every frequency: 2 / rate
            axes.semilogy(frequency[1:], (power[1:] * rate / 2).mean(axis=1), lw=0.9, color=colour, label=name)
    axes.axhline(1.0, color=MUTED, lw=1, label="noise")
    lines = {name: f for name, f in frequencies(system, result.after_fit.values).items() if f < rate / 2}
    top = min(rate / 2, 6 * max([4.0, *lines.values()]))
    for f in lines.values():
        axes.axvline(f, color=AMBER, lw=0.8)
    for names, f in _joined(lines, 0.02 * top):
        axes.annotate(names, (f, 1.0), (2, -2), xycoords=("data", "axes fraction"), textcoords="offset points",
                      rotation=90, va="top", fontsize=8, color=INK,
                      bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 0.5})  # fmt: skip
    axes.set_xlim(0, top)
    axes.set_xlabel("frequency (Hz)")
    axes.set_ylabel("power over that of noise")
    plain_powers(axes.yaxis)
    axes.legend(frameon=False, fontsize=9, loc="upper right")
    caption = "Mean periodogram of the six whitened numbers of the pose residual; white noise lies at 1."
    return Drawn("spectrum", "Spectrum of the residual", caption, figure)


def _joined(lines: dict[str, float], apart: float) -> list[tuple[str, float]]:
    """Names of lines, those that lie too near to each other for two labels in one."""
    found: list[tuple[str, float]] = []
    for name, f in sorted(lines.items(), key=lambda item: item[1]):
        if found and f - found[-1][1] < apart:
            found[-1] = (f"{found[-1][0]}, {name}", found[-1][1])
        else:
            found.append((name, f))
    return found
