"""What the grey values of an image can be: their step, their full scale, and where pixels saturate.

A camera of 12 bits writes files of 16 bits, with the values as they are or shifted to the upper end; an 8-bit image may
have been multiplied by 257. The step between neighbouring values is what rounding costs, and it is the unit in which
images of any depth look alike. A sensor with a colour filter writes grey values, too, in a pattern of 2 x 2 gains.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

# Fewer different values than this may share a factor by chance.
_ENOUGH_LEVELS = 16
# At the saturation level pixels pile up: so many times more of them than at any of the levels just below.
_PILE, _PILE_PIXELS = 8, 30
# Gains of neighbouring pixels that differ by more are a colour filter: odd and even rows of one sensor by a few 0.1 %,
# light that falls off by a half across the image, by less than 0.1 %.
_MOSAIC = 0.02


def level_step(image: NDArray) -> int:
    """Largest whole number that divides all grey values of an image; 1 for 8-bit images and for those of few levels."""
    if image.dtype != np.uint16:
        return 1
    values = np.flatnonzero(np.bincount(image.reshape(-1), minlength=2))
    values = values[values > 0]
    return int(np.gcd.reduce(values)) if len(values) >= _ENOUGH_LEVELS else 1


def full_scale(image: NDArray) -> int:
    """Largest grey value of the camera that took an image: of 8 bits, or of as few more as the image needs."""
    if image.dtype == np.uint8:
        return 255
    step = level_step(image)
    bits = max(8, int(image.max() // step).bit_length())
    return step * (2**bits - 1)


def _counts(images: NDArray) -> NDArray[np.int64]:
    """How many pixels have each grey value, up to the largest."""
    bins = int(images.max()) + 1 if images.size else 1  # cv2 is ten times as fast as bincount, and counts in singles
    counts = np.zeros(bins, np.int64)
    for image in np.atleast_2d(images).reshape(-1, *np.atleast_2d(images).shape[-2:]):
        counts += cv2.calcHist([np.ascontiguousarray(image)], [0], None, [bins], [0, bins]).ravel().astype(np.int64)
    return counts


def saturation_level(images: NDArray) -> int | None:
    """Grey value at which pixels saturate, where it shows: the largest, if it is full scale or pixels pile up there.

    images : any shape, uint8 or uint16; several images of a recording together show it sooner. None where it does not
    show: then nothing is clipped, or nearly nothing.
    """
    counts = _counts(images)
    levels = np.flatnonzero(counts)
    if len(levels) < _ENOUGH_LEVELS or counts[-1] < _PILE_PIXELS:
        return None
    below = counts[levels[-_ENOUGH_LEVELS:-1]]
    found = levels[-1] == full_scale(images) or counts[-1] >= _PILE * int(below.max())
    return int(levels[-1]) if found else None


def mosaic_gains(images: NDArray) -> NDArray | None:
    """(2, 2) gains, of mean 1, of the pixels at even and odd rows and columns where a colour filter sets them apart.

    images : (n, height, width) of a grey scene, uint8 or uint16. The gains are medians over the lighter half of each
    image. None where any two images tell of different patterns, or of none.
    """
    found = []
    for image in images:
        height, width = (2 * (size // 2) for size in image.shape)
        planes = [[image[i:height:2, j:width:2].astype(np.float32) for j in (0, 1)] for i in (0, 1)]
        mean = (planes[0][0] + planes[0][1] + planes[1][0] + planes[1][1]) / np.float32(4)
        light = mean >= max(float(np.median(mean)), 1.0)
        if not light.any():
            return None
        found.append([[np.median(plane[light] / mean[light]) for plane in row] for row in planes])
        if np.ptp(found[-1]) < 0.25 * _MOSAIC:  # a filter shows in every image
            return None
    if not found:
        return None
    gains = np.median(found, axis=0)
    same = np.abs(np.array(found) - gains).max() < 0.5 * _MOSAIC
    return gains / gains.mean() if same and np.ptp(gains) > _MOSAIC else None
