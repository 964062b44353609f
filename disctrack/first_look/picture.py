"""The picture of a check: the table view with the axes it defines, and frames with the fitted disc."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from calibration import StereoCalibration
from calibration.board.chessboard import luminance
from calibration.kit.types import AnyArray
from disctrack.first_look.check import Check
from disctrack.frames import CAMERAS
from disctrack.recording.readers.decoding import decode
from disctrack.report.palette import INK
from disctrack.track.video_overlay import draw_pair

TABLE = "the table view and the axes it defines: does the board lie flat on the table here?"


def check_figure(seen: Check) -> Figure | None:
    """Table view and frames, left and right; None if nothing could be read."""
    frames = [
        (f"frame {trajectory.frame[row]}", draw_pair(images, trajectory, row)[..., ::-1])
        for trajectory, row, images in seen.shown
    ] or [("disc not found", _beside(images)) for images in seen.raw[:1]]
    shown = [(f"{what}: fitted rim, dots and contact; {' | '.join(CAMERAS)}", picture) for what, picture in frames]
    found = seen.calibration
    table = [] if found is None else _table_view(found)
    shown = [(TABLE, _beside(table)), *shown] if table else shown
    if not shown:
        return None
    figure = Figure(figsize=(9.5, 4.6 * len(shown)), layout="constrained")
    for i, (title, picture) in enumerate(shown, start=1):
        axes = figure.add_subplot(len(shown), 1, i)
        axes.imshow(picture, cmap="gray")
        axes.set_title(title, fontsize=9, color=INK)
        axes.set_axis_off()
    if table and found is not None:
        _draw_axes(figure.axes[0], found)
    return figure


def _beside(images: Iterable[AnyArray]) -> AnyArray:
    """The images side by side, each up to its own brightest pixel: a dim one is seen as well."""
    return np.hstack([image / np.float32(max(image.max(), 1)) for image in images])


def _table_view(found: StereoCalibration) -> list[AnyArray]:
    """Its images, left and right; none without such a view, or where they are not files."""
    names = () if found.table_view is None else found.view_names[found.table_view]
    images = (luminance(decode(Path(name).read_bytes(), name))[0] for name in names)
    return [*images] if all(Path(name).is_file() for name in names) else []


def _draw_axes(axes: Axes, found: StereoCalibration) -> None:
    """The axes of the table in both images."""
    square = float(np.ptp(found.board.points, axis=0).max()) / 2.7
    ends = np.array([[0, 0, 0], [square, 0, 0], [0, square, 0], [0, 0, square]])
    right = [found.rig.left.image_size[0], 0.0]
    for origin, *tips in found.rig.project(ends) + np.array([[[0.0, 0.0]], [right]]):
        for tip, name, colour in zip(tips, "xyz", ("#D55E00", "#009E73", "#56B4E9"), strict=True):
            axes.annotate("", tip, origin, arrowprops={"arrowstyle": "->", "color": colour, "linewidth": 2})
            axes.text(tip[0], tip[1], name, color=colour, fontsize=11, fontweight="bold")
