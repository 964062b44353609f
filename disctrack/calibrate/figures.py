"""The figure of a calibration: residuals of the corners, and their coverage of the images."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from calibration import StereoCalibration
from calibration.judge.assessment import cells_of
from disctrack.frames import CAMERAS
from disctrack.report.figures import panels
from disctrack.report.palette import COLOURS, INK

_SHADES = LinearSegmentedColormap.from_list("coverage", ["#e8f1f8", "#a9c6dc"])


def residuals_figure(found: StereoCalibration) -> Figure:
    """Residuals of the corners as arrows in each image, over the cells that contain any, and their rms per view."""
    figure, grid = panels(12, 9, 2, 2, top=0.7, height_ratios=(3, 1))
    refinement = found.refinement
    lengths = np.linalg.norm(refinement.residuals[refinement.kept], axis=1)
    typical = float(np.median(lengths)) or 1.0
    # the typical arrow is about 1/40 of the image width; one significant digit
    scale = float(f"{found.rig.left.image_size[0] / 40 / typical:.0e}")
    for camera, (name, axes, views) in enumerate(zip(CAMERAS, grid[:2], grid[2:], strict=True)):
        _image_frame(axes, found, camera)
        _arrows(axes, found, camera, scale, 4.0 * typical)
        rms, share = found.rms_per_camera_px[camera], found.assessment.coverage[camera]
        axes.set_title(f"{name}: rms {rms:.4f} px, {share:.0%} of the cells hold a corner", color=INK, fontsize=10)
        of_views = np.nan_to_num(found.rms_per_view_px[:, camera])
        views.bar(range(len(of_views)), of_views, color=COLOURS[name])
        for view in found.rejected_views:
            views.text(view, 0, "not used", rotation=90, ha="center", va="bottom", fontsize=7, color=INK)
        views.xaxis.set_major_locator(MaxNLocator(integer=True))
        views.set(xlabel="view", ylabel="rms (px)", ylim=(0.0, 1.1 * np.nanmax(found.rms_per_view_px)))
    legend = f"arrows {scale:.0f} times longer; black: unused; shaded: cells with corners"
    figure.suptitle(f"Calibration residuals ({legend})")
    return figure


def _image_frame(axes: Axes, found: StereoCalibration, camera: int) -> None:
    """Outline of an image, with cells shaded by their number of corners; in empty cells distortion is extrapolated."""
    width, height = found.rig.cameras[camera].image_size
    counts = cells_of(found.refinement, camera)
    edges = [np.linspace(-0.5, size - 0.5, n + 1) for size, n in zip((width, height), counts.shape, strict=True)]
    axes.pcolormesh(*edges, np.where(counts > 0, counts, np.nan).T, cmap=_SHADES, vmin=0)
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal", xlabel="x (px)", ylabel="y (px)")


def _arrows(axes: Axes, found: StereoCalibration, camera: int, scale: float, most: float) -> None:
    """Arrows `scale` times as long as residuals, which are cut to `most` [px] for corners that were not used."""
    refinement, mine = found.refinement, found.refinement.observations.camera == camera
    kinds = (refinement.kept, COLOURS[CAMERAS[camera]], np.inf), (~refinement.kept, INK, most)
    for select, colour, longest in kinds:
        arrows = refinement.residuals[mine & select]
        length = np.linalg.norm(arrows, axis=1, keepdims=True)
        arrows = scale * arrows * np.minimum(1.0, longest / np.maximum(length, 1e-12))
        pixels = refinement.observations.pixels[mine & select]
        axes.quiver(*pixels.T, *arrows.T, angles="xy", scale_units="xy", scale=1, color=colour, width=0.0015, alpha=0.7)
