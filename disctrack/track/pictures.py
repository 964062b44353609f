"""Pictures of a measurement: coordinates with their sigmas, reprojection error, residual per dot."""

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from disctrack.frames import CAMERAS
from disctrack.report.figures import BAND, Curve, chart, panels
from disctrack.report.palette import COLOURS, INK, MUTED
from disctrack.trajectory import FrameStatus, MarkerStatus, Trajectory

_NAMES = ("x", "y", "z", "precession ψ", "nutation θ", "spin φ")


def coordinates_figure(trajectory: Trajectory) -> Figure:
    """x, y, z, psi, theta, phi over time, each above its sigmas; frames without a pose are marked below."""
    time, sigma, shared = trajectory.time, trajectory.coordinate_sigma, trajectory.calibration_sigma
    rows = []
    for i, name in enumerate(_NAMES):
        unit, scale, small = ("mm", 1e3, "µm") if i < 3 else ("deg", 180 / np.pi, "mdeg")
        spreads = [Curve(time, 1e3 * scale * sigma[:, i], COLOURS["left"], "" if i else "this frame's noise")]
        if np.nanmax(shared[:, i], initial=0.0) > 0:
            label = "" if i else "calibration, shared by all"
            spreads.append(Curve(time, 1e3 * scale * shared[:, i], COLOURS["right"], label))
        value = Curve(time, scale * trajectory.q[:, i], INK, sigma=scale * sigma[:, i])
        rows += [(f"{name} ({unit})", [value]), (f"σ ({small})", spreads)]
    lost = f"{int(np.sum(~trajectory.measured))} of {len(trajectory)} frames without a pose"
    figure = chart(f"time (s); band ± {BAND:.0f} σ; {lost}", *rows, size=(9.0, 16.0), heights=(3.0, 1.3) * len(_NAMES))
    for axes in figure.axes[1::2]:
        low, high = axes.dataLim.intervaly
        if high > 30 * low > 0:
            axes.set_yscale("log")
        else:
            axes.set_ylim(bottom=0)
    figure.axes[1].legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=2, borderpad=0, frameon=False, fontsize=9)
    return _lost_marked(figure, trajectory)


def reprojection_figure(trajectory: Trajectory) -> Figure:
    """Root mean square of observed - projected dots per camera, reduced chi-square, and the dots used, over time."""
    time, error, used = trajectory.time, [], []
    for camera, name in enumerate(CAMERAS):
        rms = trajectory.reprojection_rms_px[:, camera]
        typical = f"{np.nanmedian(rms):.4f}" if np.isfinite(rms).any() else "no"
        error.append(Curve(time, rms, COLOURS[name], f"{name}, median {typical} px"))
        count = np.sum(trajectory.marker_status[:, camera] == MarkerStatus.MEASURED, axis=1)
        used.append(Curve(time, count, COLOURS[name]))
    chi = [Curve(time[[0, -1]], np.ones(2), MUTED, style="--"), Curve(time, trajectory.reduced_chi_square, INK)]
    rows = ("reprojection error, rms (px)", error), ("reduced χ²", chi), ("dots used", used)
    unreadable = int(np.sum(trajectory.frame_status == FrameStatus.UNREADABLE))
    below = "time (s)" + (f"; {unreadable} frames unreadable" if unreadable else "")
    figure = chart(below, *rows, size=(11, 7.5), heights=(3, 2, 1.5))
    for axes in figure.axes:
        axes.set_ylim(bottom=0)
    return _lost_marked(figure, trajectory)


def _lost_marked(figure: Figure, trajectory: Trajectory) -> Figure:
    """The figure with a tick for every frame without a pose."""
    lost = trajectory.time[~trajectory.measured]
    for axes in figure.axes if lost.size else ():
        below = axes.get_xaxis_transform()
        axes.plot(lost, 0 * lost, "|", color=COLOURS["right"], transform=below, clip_on=False, markersize=6)
    return figure


def dots_figure(trajectory: Trajectory) -> Figure:
    """Residual [px] (observed - projected) of every dot, a row per camera: cloud, mean and its standard error."""
    residuals, m = np.ma.masked_invalid(trajectory.markers_residual_px), trajectory.disc.n_markers
    figure, grid = panels(1.75 * m + 1.0, 5.0, 2, top=0.7)
    reach = 1.3 * float(np.percentile(np.abs(residuals.compressed()), 99.5)) if residuals.count() else 1.0
    middle = 2 * reach * np.arange(m)
    for row, (name, axes) in enumerate(zip(CAMERAS, grid, strict=True)):
        # one pair of axes for all dots, each in a cell of its own: axes and their ticks cost more than what is in them
        axes.grid(False)
        axes.axhline(0, color=MUTED, linewidth=0.6)
        of_dots = residuals[:, row]
        x, y = np.moveaxis(np.ma.masked_outside(of_dots, -reach, reach), -1, 0)
        axes.plot(middle + x, y, ".", color=COLOURS[name], markersize=2, alpha=0.35)
        seen, rms = of_dots.count(axis=0)[:, 0], np.sqrt((of_dots**2).mean(axis=(0, 2)))
        mean, error = of_dots.mean(axis=0), 3 * of_dots.std(axis=0) / np.sqrt(np.maximum(seen, 1))[:, None]
        for k, cell in enumerate(middle):
            axes.axvline(cell, color=MUTED, linewidth=0.6)
            axes.axvline(cell + reach, color=INK, linewidth=0.8)
            if seen[k]:
                axes.errorbar(cell + mean[k, 0], mean[k, 1], error[k, 1], error[k, 0], color=INK, linewidth=1.2)
            text = f"n {seen[k]}\nrms {rms[k]:.4f}" if seen[k] else "not seen"
            axes.text(cell - 0.94 * reach, 0.94 * reach, text, fontsize=7, va="top")
        axes.set_xlim(-reach, (2 * m - 1) * reach)
        axes.set_ylim(-reach, reach)
        axes.set_aspect("equal")
        axes.set_xticks(middle, [f"dot {marker}" for marker in range(m)])
        axes.yaxis.set_major_locator(MaxNLocator(5))
        axes.tick_params(labelsize=8)
        axes.set_ylabel(f"{name}: y (px)")
    title = "Observed minus projected, per dot and camera; x at the scale of y (cross: mean ± 3 standard errors)"
    figure.suptitle(title, fontsize=10)
    return figure


FIGURES = {"coordinates": coordinates_figure, "reprojection": reprojection_figure, "dots": dots_figure}
