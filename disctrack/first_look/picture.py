"""The picture of a check: the table view with the axes it defines, and frames with the fitted disc."""

from pathlib import Path

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from calibration.board.chessboard import luminance, reduced
from disctrack.first_look.check import Check
from disctrack.frames import CAMERAS
from disctrack.recording.readers.decoding import decode
from disctrack.track.pictures import INK
from disctrack.track.video_overlay import draw_pair


def check_figure(seen: Check) -> Figure | None:
    """Table view and frames, left and right; None if nothing could be read."""
    table = _table_view(seen)
    frames = [
        (f"frame {trajectory.frame[row]}", draw_pair(images, trajectory, row)[..., ::-1])
        for trajectory, row, images in seen.shown
    ]
    if not frames:
        frames = [("disc not found", np.hstack([_shown(image) for image in images])) for images in seen.raw[:1]]
    n = len(frames) + (table is not None)
    if n == 0:
        return None
    figure = Figure(figsize=(9.5, 4.6 * n), layout="constrained")
    panels = list(figure.subplots(n, 1, squeeze=False)[:, 0])
    if table is not None:
        _draw_table(panels.pop(0), table, seen)
    for axes, (title, picture) in zip(panels, frames, strict=True):
        axes.imshow(picture)
        axes.set_title(f"{title}: fitted rim, dots and contact; {' | '.join(CAMERAS)}", fontsize=9, color=INK)
    for axes in figure.axes:
        axes.set_axis_off()
    return figure


def _table_view(seen: Check) -> tuple[NDArray, NDArray] | None:
    found = seen.calibration
    if found is None or found.table_view is None:
        return None
    names = found.view_names[found.table_view]
    if not all(Path(name).is_file() for name in names):
        return None
    left, right = (_shown(np.asarray(luminance(decode(Path(n).read_bytes(), n))[0])) for n in names)
    return left, right


def _draw_table(axes: Axes, images: tuple[NDArray, NDArray], seen: Check) -> None:
    found = seen.calibration
    assert found is not None
    axes.imshow(np.hstack(images))
    square = float(np.ptp(found.board.points, axis=0).max()) / 2.7
    ends = np.array([[0, 0, 0], [square, 0, 0], [0, square, 0], [0, 0, square]])
    pixels, offset = found.rig.project(ends), 0.0
    for camera, image in enumerate(images):
        scale = image.shape[1] / found.rig.cameras[camera].image_size[0]
        origin, *tips = pixels[camera] * scale + [offset, 0.0]
        for tip, name, colour in zip(tips, "xyz", ("#D55E00", "#009E73", "#56B4E9"), strict=True):
            axes.annotate("", tip, origin, arrowprops={"arrowstyle": "->", "color": colour, "linewidth": 2})
            axes.text(tip[0], tip[1], name, color=colour, fontsize=11, fontweight="bold")
        offset += image.shape[1]
    axes.set_title("the table view and the axes it defines: does the board lie flat on the table here?", fontsize=9)


def _shown(image: NDArray) -> NDArray[np.uint8]:
    """(h, w, 3) for display, stretched to 8 bit and reduced."""
    grey = np.asarray(cv2.normalize(image.astype(np.float32), None, 0, 255, cv2.NORM_MINMAX), np.uint8)  # type: ignore[call-overload]
    return np.asarray(np.repeat(reduced(grey)[0][..., None], 3, axis=-1), np.uint8)
