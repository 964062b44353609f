"""Defective pixels of a sensor (hot, dead or stuck at a value), found in images of a moving scene.

A dot or a corner is fitted to a thousand pixels; one pixel that is wrong by half the range, in every image, shifts it
by more than the noise of all others. Some cameras replace such pixels by their neighbours; many do not.
"""

from collections.abc import Sequence
from functools import reduce

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.kit.types import AnyArray, Mask

OFF = 0.12  # of the images' range: least difference of a pixel from the median of its neighbours
STEADY = 0.04  # of the range: largest change of a stuck pixel over the images
MIN_IMAGES = 4
MOST = 0.01  # of all pixels: more are a pattern of the scene
PASSED = 0.3  # of the range: least change of the surroundings, by squares, or by a board and its background
OFTEN = 0.3  # of the views: least fraction in which such a pixel differs from its neighbours


def stuck_pixels(images: Sequence[AnyArray] | AnyArray, of_board: bool = False) -> Mask | None:
    """True for stuck pixels of images (height, width) or (height, width, channels).

    They are constant and differ from their neighbours in all images. In views of a board, squares are as dark as a
    dead pixel and as light as a hot one, so a stuck pixel differs from its neighbours only OFTEN, while its
    surroundings change; pixels of the background may be constant near an edge of the board.
    None if there are none, or so many that they belong to the scene.
    """
    if len(images) < MIN_IMAGES:
        return None
    around = [cv2.medianBlur(np.ascontiguousarray(image), 3) for image in images]
    scale = float(reduce(np.maximum, images).max()) - float(reduce(np.minimum, images).min())
    off = np.zeros(around[0].shape, np.int32)
    for image, level in zip(images, around, strict=True):
        off += np.abs(image.astype(np.int32) - level) > OFF * scale
    blind = off == len(images)
    if of_board:
        blind = (_changed(around) > PASSED * scale) & (off > OFTEN * len(images))
    found = blind & (_changed(images) <= STEADY * scale)
    return found if 0 < found.sum() <= MOST * found.size else None


def _changed(images: Sequence[AnyArray] | AnyArray) -> NDArray[np.int32]:
    """Range of each pixel's values over the images."""
    return reduce(np.maximum, images).astype(np.int32) - reduce(np.minimum, images)


def repaired_views(views: Sequence[AnyArray], camera: str) -> tuple[list[AnyArray], str]:
    """Copies of one camera's views of a board with stuck pixels replaced, and a warning ("": none).

    views : grey (height, width) or colour (height, width, channels), of one size and type; channels are independent.
    With a colour filter each value is interpolated from several pixels, so that a stuck one affects its neighbours.
    """
    alike = all(view.shape == views[0].shape and view.dtype in (np.uint8, np.uint16) for view in views)
    blind = stuck_pixels(views, of_board=True) if alike and all(view.ndim <= 3 for view in views) else None
    if blind is None:
        return list(views), ""
    mended = [view.copy() for view in views]
    for view in map(np.atleast_3d, mended):
        for channel, mask in enumerate(np.moveaxis(np.atleast_3d(blind), 2, 0)):
            repair(view[..., channel], mask)
    n = int(np.atleast_3d(blind).any(axis=2).sum())
    return mended, f"{camera} camera: {n} pixels show one value in all views; their neighbours stand in for them"


def repair(images: AnyArray, stuck: Mask) -> None:
    """Replace, in place, the stuck pixels of images (..., height, width) by the median of their good neighbours."""
    y, x = np.nonzero(stuck)
    steps = np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j])
    v, u = y[:, None] + steps[:, 0], x[:, None] + steps[:, 1]
    inside = (v >= 0) & (v < stuck.shape[0]) & (u >= 0) & (u < stuck.shape[1])
    v, u = np.where(inside, v, 0), np.where(inside, u, 0)
    good = inside & ~stuck[v, u]
    known = good.any(axis=1)
    around = np.where(good, images[..., v, u], np.nan)[..., known, :]
    images[..., y[known], x[known]] = np.nanmedian(around, axis=-1).astype(images.dtype)
