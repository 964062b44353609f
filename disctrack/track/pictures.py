"""Pictures of a measurement: coordinates with their sigmas, reprojection error, residual per dot."""

from collections.abc import Callable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, NullFormatter

from calibration.kit.arrays import Array
from disctrack.frames import CAMERAS
from disctrack.report.figures import lay_out
from disctrack.report.palette import COLOURS, INK, MUTED
from disctrack.trajectory import FrameStatus, MarkerStatus, Trajectory

BAND = 3.0  # sigmas shown as a band: one is thinner than the line in most recordings
_NAMES = ("x", "y", "z", "precession ψ", "nutation θ", "spin φ")


def coordinates_figure(trajectory: Trajectory) -> Figure:
    """x, y, z, psi, theta, phi over time above their sigmas; frames without a pose are marked below."""
    figure = Figure(figsize=(13, 8.5))
    lay_out(figure, (4, 3), gaps=(0.9, 0.2))
    grid = figure.add_gridspec(4, 3, height_ratios=(3, 1.3, 3, 1.3))
    sigma, shared = trajectory.coordinate_sigma, trajectory.calibration_sigma
    for i in range(len(_NAMES)):
        row, column = 2 * (i // 3), i % 3
        axes = figure.add_subplot(grid[row, column])
        below = figure.add_subplot(grid[row + 1, column], sharex=axes)
        _coordinate(axes, trajectory, i, sigma[:, i])
        _sigmas(below, trajectory, i, sigma[:, i], shared[:, i])
        axes.tick_params(labelbottom=False)
        below.tick_params(labelbottom=row == 2)
        axes.xaxis.set_major_locator(MaxNLocator(4))  # shared by both; ticks are what takes longest to draw
        axes.yaxis.set_major_locator(MaxNLocator(5))
        if row == 2:
            below.set_xlabel("time (s)")
    lost = int(np.sum(~trajectory.measured))
    figure.suptitle(
        f"Pose of the disc in {len(trajectory)} frames, {lost} without an answer; band ± {BAND:.0f} σ", color=INK
    )
    return figure


def _coordinate(axes: Axes, trajectory: Trajectory, i: int, sigma: Array) -> None:
    unit, scale = ("mm", 1e3) if i < 3 else ("deg", 180 / np.pi)
    time, values = trajectory.time, trajectory.q[:, i] * scale
    band = BAND * sigma * scale
    axes.fill_between(time, values - band, values + band, color=COLOURS["left"], alpha=0.35, linewidth=0)
    axes.plot(time, values, color=INK, linewidth=0.9)
    _mark_lost(axes, trajectory)
    axes.set_ylabel(f"{_NAMES[i]} ({unit})")
    axes.margins(x=0.01)
    axes.grid(alpha=0.25)


def _sigmas(axes: Axes, trajectory: Trajectory, i: int, sigma: Array, shared: Array) -> None:
    scale, unit = (1e6, "µm") if i < 3 else (180e3 / np.pi, "mdeg")
    axes.plot(trajectory.time, sigma * scale, color=COLOURS["left"], linewidth=0.9, label="this frame's noise")
    if np.nanmax(shared, initial=0.0) > 0:
        label = "calibration, shared by all"
        axes.plot(trajectory.time, shared * scale, color=COLOURS["right"], linewidth=0.9, label=label)
    finite = np.concatenate([sigma, shared])
    finite = finite[np.isfinite(finite) & (finite > 0)] * scale
    if finite.size and finite.max() > 30 * finite.min():
        axes.set_yscale("log")
        axes.yaxis.set_minor_formatter(NullFormatter())
    else:
        axes.set_ylim(bottom=0)
    axes.set_ylabel(f"σ ({unit})")
    axes.grid(alpha=0.25)
    if i == 0:
        axes.legend(fontsize=7, frameon=False)


def _mark_lost(axes: Axes, trajectory: Trajectory) -> None:
    lost = trajectory.time[~trajectory.measured]
    if lost.size:
        below = axes.get_xaxis_transform()
        axes.plot(lost, 0 * lost, "|", color=COLOURS["right"], transform=below, clip_on=False, markersize=6)


def reprojection_figure(trajectory: Trajectory) -> Figure:
    """Root mean square of observed - projected dots per camera, reduced chi-square, and the dots used, over time."""
    figure = Figure(figsize=(11, 7.5))
    lay_out(figure, (3, 1), gaps=(0.0, 0.2))
    error, chi, used = figure.subplots(3, 1, sharex=True, height_ratios=(3, 2, 1.5))
    for camera, name in enumerate(CAMERAS):
        rms = trajectory.reprojection_rms_px[:, camera]
        typical = f"{np.nanmedian(rms):.4f}" if np.isfinite(rms).any() else "no"
        error.plot(trajectory.time, rms, color=COLOURS[name], linewidth=0.8, label=f"{name}, median {typical} px")
        count = np.sum(trajectory.marker_status[:, camera] == MarkerStatus.MEASURED, axis=1)
        used.step(trajectory.time, count, color=COLOURS[name], linewidth=0.9, where="mid", label=name)
    error.set_ylabel("reprojection error, rms (px)")
    error.set_ylim(bottom=0)
    error.legend(frameon=False, fontsize=8)
    chi.plot(trajectory.time, trajectory.reduced_chi_square, color=INK, linewidth=0.8)
    chi.axhline(1.0, color=MUTED, linewidth=0.8, linestyle="--")
    chi.set_ylabel("reduced χ²")
    chi.set_ylim(bottom=0)
    used.set_ylabel("dots used")
    used.set_ylim(-0.3, trajectory.disc.n_markers + 0.3)
    used.set_xlabel("time (s)")
    for axes in (error, chi, used):
        _mark_lost(axes, trajectory)
        axes.grid(alpha=0.25)
        axes.margins(x=0.01)
    unreadable = int(np.sum(trajectory.frame_status == FrameStatus.UNREADABLE))
    figure.suptitle("Reprojection error over time" + (f"; {unreadable} frames unreadable" if unreadable else ""))
    return figure


def dots_figure(trajectory: Trajectory) -> Figure:
    """Residual [px] (observed - projected) of every dot, a row per camera: cloud, mean and its standard error."""
    residuals, m = trajectory.markers_residual_px, trajectory.disc.n_markers
    figure = Figure(figsize=(1.75 * m + 1.0, 5.0))
    lay_out(figure, (2, 1), gaps=(0.0, 0.3))
    finite = np.abs(residuals[np.isfinite(residuals)])
    reach = float(np.percentile(finite, 99.5)) * 1.3 if finite.size else 1.0
    for row, name in enumerate(CAMERAS):
        # one pair of axes for all dots, each in a cell of its own: axes and their ticks cost more than what is in them
        axes = figure.add_subplot(2, 1, row + 1)
        axes.axhline(0, color=MUTED, linewidth=0.6)
        for marker in range(m):
            _dot(axes, residuals[:, row, marker], COLOURS[name], reach, 2 * reach * marker)
        axes.set_xlim(-reach, (2 * m - 1) * reach)
        axes.set_ylim(-reach, reach)
        axes.set_aspect("equal")
        axes.set_xticks(2 * reach * np.arange(m), [f"dot {marker}" for marker in range(m)])
        axes.yaxis.set_major_locator(MaxNLocator(5))
        axes.tick_params(labelsize=8)
        axes.set_ylabel(f"{name}: y (px)")
    title = "Observed minus projected, per dot and camera; x at the scale of y (cross: mean ± 3 standard errors)"
    figure.suptitle(title, fontsize=10)
    return figure


def _dot(axes: Axes, residuals: Array, colour: str, reach: float, middle: float) -> None:
    """One dot's cloud about x = middle, in a cell of twice the reach."""
    seen = residuals[np.isfinite(residuals).all(axis=1)]
    shown = seen[(np.abs(seen) <= reach).all(axis=1)]
    axes.axvline(middle, color=MUTED, linewidth=0.6)
    axes.axvline(middle + reach, color=INK, linewidth=0.8)
    if len(seen) > 1:
        axes.plot(middle + shown[:, 0], shown[:, 1], ".", color=colour, markersize=2, alpha=0.35)
        mean, error = seen.mean(axis=0), 3 * seen.std(axis=0) / np.sqrt(len(seen))
        axes.errorbar(middle + mean[0], mean[1], error[1], error[0], color=INK, linewidth=1.2)
        text = f"n {len(seen)}\nrms {np.sqrt(np.mean(seen**2)):.4f}"
    else:
        text = "not seen"
    axes.text(middle - 0.94 * reach, 0.94 * reach, text, fontsize=7, va="top")


FIGURES: dict[str, Callable[[Trajectory], Figure]] = {
    "coordinates": coordinates_figure,
    "reprojection": reprojection_figure,
    "dots": dots_figure,
}
