"""Grey levels of images: step, full scale, saturation, and the pattern of a colour filter.

A camera of 12 bits writes files of 16 bits, with unchanged values or shifted to the upper end; an 8-bit image may have
been multiplied by 257. The step between neighbouring values sets the rounding error, and is the natural unit of grey
values. A sensor with a colour filter may also write grey images, with a pattern of 2 x 2 gains.
"""

import cv2
import numpy as np

from calibration.kit.types import AnyArray

# Number of different values below which they may share a factor by chance.
_ENOUGH_LEVELS = 16
# Ratio of the number of pixels at the saturation level to that at any of the levels just below.
_PILE, _PILE_PIXELS = 8, 30
# Difference of gains of neighbouring pixels, above which they indicate a colour filter: odd and even rows of a sensor
# differ by a few 0.1 %, illumination that halves across the image gives less than 0.1 %.
_MOSAIC = 0.02


def level_step(image: AnyArray) -> int:
    """Greatest common divisor of the grey values of an image; 1 for 8-bit images and for those with few levels."""
    if image.dtype != np.uint16:
        return 1
    values = np.flatnonzero(np.bincount(image.reshape(-1), minlength=2))
    values = values[values > 0]
    return int(np.gcd.reduce(values)) if len(values) >= _ENOUGH_LEVELS else 1


def full_scale(image: AnyArray) -> int:
    """Largest grey value of the camera, with the fewest bits, but at least 8, that the image needs."""
    step = level_step(image)
    bits = max(8, int(image.max() // step).bit_length())
    return step * (2**bits - 1)


def saturation_level(images: AnyArray) -> int | None:
    """Grey value at which pixels saturate: the largest, if it is full scale or has far more pixels than those below.

    images : any shape, uint8 or uint16; better detected in several images of a recording. None if it is not detected:
    then hardly any pixel is saturated.
    """
    bins = int(images.max(initial=0)) + 1
    counts = np.zeros(bins, np.int64)  # of pixels; cv2 is ten times as fast as bincount, and counts in singles
    for image in images.reshape(-1, *images.shape[-2:]):
        counts += cv2.calcHist([np.ascontiguousarray(image)], [0], None, [bins], [0, bins]).ravel().astype(np.int64)
    levels = np.flatnonzero(counts)
    if len(levels) < _ENOUGH_LEVELS or counts[-1] < _PILE_PIXELS:
        return None
    below = counts[levels[-_ENOUGH_LEVELS:-1]]
    found = levels[-1] == full_scale(images) or counts[-1] >= _PILE * int(below.max())
    return int(levels[-1]) if found else None


def mosaic_gains(images: AnyArray) -> AnyArray | None:
    """(2, 2) gains, with mean 1, of pixels in even and odd rows and columns, if they indicate a colour filter.

    images : (n, height, width) of a grey scene, uint8 or uint16. The gains are medians over the lighter half of each
    image. None if any two images have different patterns, or have no pattern.
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
        if np.ptp(found[-1]) < 0.25 * _MOSAIC:  # a filter is visible in every image
            return None
    if not found:
        return None
    gains = np.median(found, axis=0)
    same = np.abs(np.array(found) - gains).max() < 0.5 * _MOSAIC
    return gains / gains.mean() if same and np.ptp(gains) > _MOSAIC else None
