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
from disctrack.discrepancy.held_out import HeldOut
from disctrack.frames import nodal_axes_world
from disctrack.report.figures import NO_TITLE, Drawn, dress, panels, plain_powers
from disctrack.report.palette import AMBER, BLUE, GRID, INK, MUTED, RED

N_TRIED = 14


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
    system, diagnosis = result.system, result.diagnosis
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
    styles: tuple[dict[str, Any], ...] = (
        {"ls": "--", "lw": 1.3, "color": RED, "label": "model before"},
        {"ls": "-", "lw": 1.0, "color": BLUE, "label": "model after"},
    )
    for fit, style in zip((diagnosis.before, result.after_fit), styles, strict=True):
        if fit is diagnosis.before and fit is result.after_fit:  # nothing was added
            continue
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
    """Measured minus fitted pose, before and after, with the band of the noise."""
    system, diagnosis = result.system, result.diagnosis
    figure, grid = panels(9.5, 6.2, 4, 2, (0.95, 0.15, 0.55, 0.3), sharex=True)
    rows = [("x", 1e6, "µm"), ("y", 1e6, "µm"), ("z", 1e6, "µm"), ("θ", 1e3 * np.degrees(1), "mdeg")]
    for column, (fit, name, colour) in enumerate(
        ((diagnosis.before, "before", RED), (result.after_fit, "after", BLUE))
    ):
        delta, sigma = system.pose_difference(fit.values)
        e1 = nodal_axes_world(*system.poses(fit.values)[:, 3:5].T)[0]
        theta = np.sum(e1 * delta[:, 3:], axis=1), np.sqrt(np.sum((e1 * sigma[:, 3:]) ** 2, axis=1))
        series = [*((delta[:, i], sigma[:, i]) for i in range(3)), theta]
        for row, ((label, scale, unit), (value, noise)) in enumerate(zip(rows, series, strict=True)):
            axes = grid[2 * row + column]
            axes.fill_between(system.time, -2 * scale * noise, 2 * scale * noise, color=GRID, lw=0)
            axes.plot(system.time, scale * value, lw=0.7, color=colour)
            axes.set_ylabel(f"{label} ({unit})")
        grid[column].set_title(name, fontsize=10, color=INK)
        grid[column - 2].set_xlabel("time (s)")
    caption = "Measured minus fitted pose. The grey band is two standard deviations of a frame's noise."
    return Drawn("residuals", "Residual before and after", caption, figure)


def free_run(result: DiscDiagnosis, before: HeldOut, after: HeldOut) -> Drawn:
    """Error of the free run over the part that the fit has not seen."""
    system = result.system
    figure, (left, right) = panels(9.5, 3.4, 1, 2, NO_TITLE)
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
    for axes, label in ((left, "error of the position (mm)"), (right, "error of the nutation (deg)")):
        axes.axvline(last, color=AMBER, lw=1)
        axes.set_xlabel("time (s)")
        axes.set_ylabel(label)
    left.legend(frameon=False, fontsize=9)
    caption = (
        "Fitted up to the vertical line, left alone after it: the free run's error before and after, and the noise."
    )
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
    axes.set_xlabel("decrease of chi-square when it is added to the model (red: what noise can do with one number)")
    for row in np.flatnonzero(beyond):
        axes.annotate("without it nothing fits", (gains[row], row), (-4, 0), textcoords="offset points", fontsize=8,
                      ha="right", va="center", color="white")  # fmt: skip
    caption = "The candidates that gain most. Blue: chosen; amber: cannot be told from it."
    return Drawn("candidates", "What was tried", caption, figure)


def moment(result: DiscDiagnosis, missing: MissingMoment, of_law: MissingMoment | None) -> Drawn:
    """Moment that the model fails to supply, with its two-sigma band, and what the effects found add to it."""
    figure, grid = panels(9.5, 5.4, 3, margins=NO_TITLE, sharex=True)
    law = None if of_law is None or not result.diagnosis.found else (of_law.time, of_law.moment)
    if result.learned is not None and all(c.startswith("M") for c in result.learned.law.formulas):
        system, values = result.system, result.learned.fit.values
        own = {result.learned.law.candidate.effect}
        law = system.time, moment_about_contact(system, values, simulated(system, values), own)
    for i, (axes, name) in enumerate(zip(grid, ("n0", "m0", "k"), strict=True)):
        value, sigma = 1e6 * missing.moment[:, i], 1e6 * missing.sigma[:, i]
        axes.fill_between(missing.time, value - 2 * sigma, value + 2 * sigma, color=GRID, lw=0)
        axes.plot(missing.time, value, lw=1.3, color=RED, label="missing")
        if law is not None:
            axes.plot(law[0], 1e6 * law[1][:, i], lw=1.0, color=BLUE, label="added by what was found")
        # the band, and all of the law that is not a spike at the ends, where splines of short moments run away
        inner = np.empty(0) if law is None else 1e6 * law[1][len(law[1]) // 20 : -(len(law[1]) // 20) or None, i]
        _frame(axes, np.concatenate([value - 2 * sigma, value + 2 * sigma, inner]))
        axes.axhline(0.0, color=MUTED, lw=0.7)
        axes.set_ylabel(f"along {name} (µN m)")
    grid[0].legend(facecolor="white", edgecolor="none", fontsize=9, ncols=2, loc="upper right")
    grid[-1].set_xlabel("time (s)")
    caption = (
        "Contact moment M_n, M_m, M_z that the model before fails to supply, with two standard deviations: what short "
        "moments would have to be for the dots to fall where they did. A missing force, inertia or an error of the "
        "measurement shows as the moment that does the same."
        + (
            " Blue, for a law outside the catalogue, is the whole of its moment; red holds only what the start and the "
            "other fitted numbers cannot take up, so that a steady part, along n0 above all, is smaller in red."
            if result.learned is not None
            else " Blue is what was found, read in the same way: within the band it is what was missing."
            if law is not None
            else ""
        )
    )
    return Drawn("missing_moment", "The missing moment", caption, figure)


def course(known: LawCourse) -> Drawn:
    """Moment about the contact of all laws, with the band of the learned law's coefficients and form."""
    figure, grid = panels(9.5, 5.4, 3, margins=NO_TITLE, sharex=True)
    for i, (axes, name) in enumerate(zip(grid, ("n0", "m0", "k"), strict=True)):
        value, sigma = 1e6 * known.moment[:, i], 1e6 * known.sigma[:, i]
        axes.fill_between(known.time, value - 2 * sigma, value + 2 * sigma, color=GRID, lw=0)
        axes.plot(known.time, value, lw=0.8, marker=".", ms=5, color=BLUE)
        axes.axhline(0.0, color=MUTED, lw=0.7)
        axes.set_ylabel(f"along {name} (µN m)")
    grid[-1].set_xlabel("time (s)")
    caption = (
        "Moment about the contact of all laws of the model and of the law outside the catalogue, a force at the centre "
        "included as the moment that it has about the contact, at the points shown. The band is two standard "
        f"deviations, with what the law's form may be off by ({100 * known.misfit:.2g} % of the law) and the other "
        "laws that fit as well."
    )
    return Drawn("course_of_the_laws", "How well the laws are known along the recording", caption, figure)


def force(result: DiscDiagnosis, measured: ModelFreeForces) -> Drawn:
    """Force on the disc that the model fails to supply, from the accelerations alone, and what was found adds to it."""
    system = result.system
    before, after = force_of(system, result.diagnosis.before), force_of(system, result.after_fit)
    figure, grid = panels(9.5, 5.4, 3, margins=NO_TITLE, sharex=True)
    for i, (axes, name) in enumerate(zip(grid, ("n0", "m0", "k"), strict=True)):
        value, sigma = 1e3 * (measured.force - before)[:, i], 1e3 * measured.force_sigma[:, i]
        axes.fill_between(system.time, value - 2 * sigma, value + 2 * sigma, color=GRID, lw=0)
        axes.plot(system.time, value, lw=1.1, color=RED, label="missing")
        if result.diagnosis.found or result.learned is not None:
            axes.plot(system.time, 1e3 * (after - before)[:, i], lw=1.0, color=BLUE, label="added by what was found")
        axes.axhline(0.0, color=MUTED, lw=0.7)
        axes.set_ylabel(f"along {name} (mN)")
        inner = slice(len(value) // 20, -(len(value) // 20) or None)  # derivatives at the ends of a film are poor
        _frame(axes, np.concatenate([value[inner], 1e3 * (after - before)[:, i]]))
    grid[0].legend(facecolor="white", edgecolor="none", fontsize=9, ncols=2, loc="upper right")
    grid[-1].set_xlabel("time (s)")
    caption = (
        "Force on the disc, measured minus that of the model before, with two standard deviations: mass times the "
        "acceleration of the centre, from the poses alone."
    )
    return Drawn("missing_force", "The missing force", caption, figure)


def spectrum(result: DiscDiagnosis) -> Drawn:
    """Periodogram of the pose residual before and after, with the frequencies at which effects show."""
    system = result.system
    present = system.weights >= 6
    rate = float(1.0 / np.median(np.diff(system.time)))
    figure, (axes,) = panels(9.5, 3.2, margins=NO_TITLE)
    for fit, colour, name in ((result.diagnosis.before, RED, "before"), (result.after_fit, BLUE, "after")):
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
