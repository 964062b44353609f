"""Figures of a diagnosis: model and measurement superposed, the residual before and after, what was tried."""

from dataclasses import replace

import numpy as np
from matplotlib.figure import Figure
from scipy.signal import periodogram

from calibration.kit.types import Array
from disctrack.diagnosis.answer import DiscDiagnosis
from disctrack.diagnosis.errors import frequencies, simulated
from disctrack.diagnosis.missing_force import Course
from disctrack.diagnosis.supplement import Supplement, force_of
from disctrack.discrepancy.fit import Fit
from disctrack.discrepancy.held_out import HeldOut
from disctrack.discrepancy.search import threshold
from disctrack.report.blocks import Drawn
from disctrack.report.figures import BAND, Curve, chart, panels, plain_powers
from disctrack.report.palette import AMBER, BLUE, GRID, INK, MUTED, RED

N_TRIED = 14
MISSING_MOMENT = (
    "Contact moment M_n, M_m, M_z that is missing from the model before, estimated from the residuals of the dots by "
    "its impulse response. A missing force, inertia or an error of the measurement appears as the equivalent moment."
)
OF_LAW = " Blue: moment of the effects found, estimated in the same way; within the band it explains the residuals."
MISSING_FORCE = (
    "Force on the disc, measured minus that of the model before. Measured: mass times the acceleration of the centre, "
    "the second derivative of the poses."
)
COURSE_OF_LAWS = (
    "Moment about the contact of all laws of the model and of the law outside the catalogue; forces at the centre are "
    "included. The band contains the uncertainty of the law's form ({:.2g} % of the law) and the other laws that fit "
    "as well."
)

Side = tuple[Fit, HeldOut | None, str, str]  # fit of a model, its free run, name and colour


def _sides(result: DiscDiagnosis) -> list[Side]:
    """The models that are shown: before and after, or the only one if nothing was added to it."""
    after = result.diagnosis.after, result.diagnosis.held_out_after
    if not result.has_more:
        return [(*after, "model", BLUE)]
    before = result.diagnosis.before, result.diagnosis.held_out_before
    return [(*before, "model before", RED), (*after, "model after", BLUE)]


def all_figures(result: DiscDiagnosis, more: Supplement | None) -> tuple[Drawn, ...]:
    """All figures of a diagnosis whose base fit converged; otherwise only that of the candidates."""
    if more is None:
        return (candidates(result),) if result.diagnosis.tried else ()
    over_time, path = superposed(result, more)
    found = [over_time, residuals(result), spectrum(result), free_run(result)]
    found += [*_missing(result, more), candidates(result), path]
    return tuple(replace(d, name=f"{i:02d}_{d.name}") for i, d in enumerate(found, start=1))


def superposed(result: DiscDiagnosis, more: Supplement) -> tuple[Drawn, Drawn]:
    """Nutation, precession rate and path: measurement, model before, model after (figures 17 and 18 of the paper)."""
    system, time = result.system, result.system.time
    q = system.trajectory.q[system.rows]
    rate = np.full(len(time), np.nan) if more.psidot is None else more.psidot
    theta, (x, y) = np.degrees(q[:, 4]), 1e3 * q[:, :2].T
    measured = (time, theta), (time, rate), (x, y)
    nutation, precession, path = ([Curve(x, y, MUTED, "measured", ".")] for x, y in measured)
    for (fit, _, name, colour), style in zip(_sides(result), ("--", "-"), strict=False):
        motion = simulated(system, fit.values)
        instants, (x, y) = time[: len(motion)], 1e3 * motion.q[:, :2].T
        nutation.append(Curve(instants, np.degrees(motion.q[:, 4]), colour, name, style))
        precession.append(Curve(instants, motion.qdot[:, 3], colour, name, style))
        path.append(Curve(x, y, colour, name, style))
    rows = ("nutation angle (deg)", nutation), ("precession rate (rad/s)", precession)
    over_time = chart("time (s)", *rows, size=(9.5, 6.4))
    for axes, values in zip(over_time.axes, (theta, rate), strict=True):
        known = values[np.isfinite(values)]
        if known.size:  # limits by the data, with room for the legend; a model far from them may leave the axes
            low, high = float(known.min()), float(known.max())
            axes.set_ylim(low - 0.08 * (high - low or 1.0), high + 0.25 * (high - low or 1.0))
    caption = (
        "Nutation angle and precession rate: measured, and the model fitted to the measurement. "
        "The measured rate is the derivative of the poses, without any model."
    )
    in_plane = chart("x (mm)", ("y (mm)", path), size=(6.0, 6.0), equal=True)
    drawn = Drawn("model_and_measurement", "Model and measurement", caption, over_time)
    return drawn, Drawn("path", "Path of the centre", "Path of the centre: measured, and fitted.", in_plane)


def residuals(result: DiscDiagnosis) -> Drawn:
    """Measured minus fitted pose, a column per model, with the band of the noise."""
    system, sides = result.system, _sides(result)
    n = len(sides)
    figure, grid = panels(9.5, 6.2, 4, n, top=0.3, sharex=True)
    rows = [(0, "x", 1e6, "µm"), (1, "y", 1e6, "µm"), (2, "z", 1e6, "µm"), (4, "θ", 1e3 * np.degrees(1), "mdeg")]
    for column, (fit, _, name, colour) in enumerate(sides):
        error, sigma = system.coordinate_errors(fit.values)
        for row, (i, label, scale, unit) in enumerate(rows):
            axes, noise = grid[n * row + column], 2 * scale * sigma[:, i]
            axes.fill_between(system.time, -noise, noise, color=GRID, lw=0)
            axes.plot(system.time, scale * error[:, i], lw=0.7, color=colour)
            axes.set_ylabel(f"{label} ({unit})")
        grid[column].set_title(name, fontsize=10, color=INK)
        grid[column - n].set_xlabel("time (s)")
    caption = "Measured minus fitted pose. The grey band is ± 2 σ of a frame's noise."
    return Drawn("residuals", "Residuals of the poses", caption, figure)


def free_run(result: DiscDiagnosis) -> Drawn:
    """Error of the free run over the held-out data."""
    system, runs = result.system, list[tuple[Array, str, str]]()
    for _, held, name, colour in _sides(result):
        assert held is not None
        error, sigma = system.coordinate_errors(held.train.values)
        runs.append((error, colour, name))
        last = system.time[~held.test_rows & (system.weights > 0)].max()
    runs.append((sigma, MUTED, "noise, 1 σ"))
    position = [Curve(system.time, 1e3 * np.linalg.norm(e[:, :3], axis=1), colour, name) for e, colour, name in runs]
    nutation = [Curve(system.time, np.degrees(np.abs(e[:, 4])), colour) for e, colour, _ in runs]
    rows = ("error of position (mm)", position), ("error of nutation (deg)", nutation)
    figure = chart("time (s)", *rows, size=(9.5, 4.4))
    for axes in figure.axes:
        axes.set_yscale("log")
        axes.axvline(last, color=AMBER, lw=1)
    caption = "Error of the free run: the model is fitted up to the vertical line and predicts the frames after it."
    return Drawn("free_run", "Free run over held-out data", caption, figure)


def candidates(result: DiscDiagnosis) -> Drawn:
    """Gain of each candidate at the base fit, largest first."""
    diagnosis = result.diagnosis
    tried = diagnosis.tried[:N_TRIED]
    figure, (axes,) = panels(9.5, 0.6 + 0.28 * max(len(tried), 3))
    gains = np.array([max(t.gain if t.gain is not None else t.score, 1e-2) for t in tried])
    beyond = ~np.isfinite(gains)  # without it nothing fits: the longest bar
    gains[beyond] = 10.0 * max([100.0, *gains[~beyond]])
    named = {f.candidate.name for f in diagnosis.found}
    alike = {r.candidate.name for f in diagnosis.found for r in f.cannot_be_told_from}
    colours = [BLUE if t.candidate.name in named else AMBER if t.candidate.name in alike else MUTED for t in tried]
    axes.barh(range(len(tried)), gains, color=colours)
    more = np.where(beyond, ": without it nothing fits", "")
    axes.set_yticks(range(len(tried)), [f"{t.candidate.name}{said}" for t, said in zip(tried, more, strict=True)])
    axes.invert_yaxis()
    axes.set_xscale("log")
    axes.axvline(threshold(result.system, diagnosis.settings, 1), color=RED, lw=1)
    plain_powers(axes.xaxis)
    line = "red line: what noise alone can reach with one number"
    axes.set_xlabel(f"decrease of chi-square when it is added to the model\n({line})")
    caption = "The candidates that explain most. Blue: found; amber: indistinguishable alternatives."
    return Drawn("candidates", "What was tried", caption, figure)


def _along_the_contact(known: Course, added: Array | None, label: str, scale: float, unit: str) -> Figure:
    """The missing moment or force along n0, m0 and k with its band, and that added by the effects found.

    Without the ends, where derivatives are poorly determined.
    """
    rows, inner = [], slice(len(known.time) // 20, len(known.time) - len(known.time) // 20)
    for i, axis in enumerate(("n0", "m0", "k")):
        value, sigma = scale * known.values[inner, i], scale * known.sigma[inner, i]
        curves = [Curve(known.time[inner], value, RED, f"{label}, ± {BAND:g} σ", sigma=sigma)]
        if added is not None:
            curves.append(Curve(known.time[inner], scale * added[inner, i], BLUE, "added by what was found"))
        rows.append((f"along {axis} ({unit})", curves))
    return chart("time (s)", *rows, size=(9.5, 5.4))


def _missing(result: DiscDiagnosis, more: Supplement) -> list[Drawn]:
    """The moment and the force missing from the model before, and the laws with their uncertainty."""
    found, learned, d = list[Drawn](), result.learned, result.diagnosis
    if more.moment is not None:
        added, of_law = (None, "") if more.moment_of_law is None else (more.moment_of_law.values, OF_LAW)
        figure = _along_the_contact(more.moment, added, "missing", 1e6, "µN m")
        found.append(Drawn("missing_moment", "The missing moment", f"{MISSING_MOMENT}{of_law}", figure))
    if more.force is not None:
        added = force_of(result.system, d.after) - force_of(result.system, d.before) if result.has_more else None
        figure = _along_the_contact(more.force, added, "missing", 1e3, "mN")
        found.append(Drawn("missing_force", "The missing force", MISSING_FORCE, figure))
    if learned is not None and learned.course is not None:
        title, caption = "How well the laws are known along the recording", COURSE_OF_LAWS.format(100 * learned.misfit)
        figure = _along_the_contact(learned.course, None, "all laws", 1e6, "µN m")
        found.append(Drawn("course_of_the_laws", title, caption, figure))
    return found


def spectrum(result: DiscDiagnosis) -> Drawn:
    """Periodogram of the pose residual before and after, with the frequencies at which effects show."""
    system, rate, curves = result.system, result.system.rate, list[Curve]()
    for fit, _, name, colour in _sides(result):
        residual = system.pose_residual(fit.values)[system.weights >= 6]
        if np.isfinite(residual).all():
            frequency, power = periodogram(residual, rate, axis=0)
            # white noise of variance 1 has the same power at every frequency: 2 / rate
            curves.append(Curve(frequency[1:], (power[1:] * rate / 2).mean(axis=1), colour, name))
    figure = chart("frequency (Hz)", ("power over that of noise", curves), size=(9.5, 3.2))
    (axes,) = figure.axes
    axes.set_yscale("log")
    axes.axhline(1.0, color=MUTED, lw=1)
    lines = {name: f for name, f in frequencies(system, result.diagnosis.after.values).items() if f < rate / 2}
    for f in lines.values():
        axes.axvline(f, color=AMBER, lw=0.8)
    axes.set_xlim(0, min(rate / 2, 6 * max([4.0, *lines.values()])))
    plain_powers(axes.yaxis)
    shown = ", ".join(f"{name} {f:.3g} Hz" for name, f in lines.items())
    caption = f"Mean periodogram of the six whitened numbers of the pose residual; noise lies at 1. Amber: {shown}."
    return Drawn("spectrum", "Spectrum of the residual", caption, figure)
