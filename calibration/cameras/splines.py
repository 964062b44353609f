"""A smooth displacement of the image beyond what the distortion's polynomial describes.

    pixel = projection + sum_k c_k B_k(pixel)         B: products of uniform cubic B-splines, a coefficient per axis

As in splined camera models; here it takes up some hundredths of a pixel that vary over a third of the image.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.kit.arrays import Array

_STEPS = 12  # each takes the slope of the field, some hundredths, off the error


@dataclass(frozen=True)
class LensField:
    """Displacement of image points in both cameras."""

    coefficients: Array  # (2 cameras, 2 axes, ny, nx) [px]
    spacing: float  # [px] of the grid; its first node lies one spacing before pixel 0

    def displacement(self, pixels: Array, camera: int) -> Array:
        """By how much [px] (..., 2) an image point at `pixels` (..., 2) lies off the polynomial's; NaN stays NaN."""
        flat = np.asarray(pixels, float).reshape(-1, 2)
        index, weight = spline_weights(flat, self.spacing, self.coefficients.shape[2:])
        values = self.coefficients[camera].reshape(2, -1)[:, index]  # (2, n, 16)
        return np.sum(values * weight, axis=-1).T.reshape(np.shape(pixels))

    def corrected(self, pixels: Array) -> Array:
        """Pixels (..., 2 cameras, m, 2) where the polynomial alone would have them."""
        moved = [self.displacement(pixels[..., camera, :, :], camera) for camera in (0, 1)]
        return pixels - np.stack(moved, axis=-3)

    def distorted(self, pixels: Array) -> Array:
        """Inverse of `corrected`: where the lens shows them, to 1e-9 px for fields of some pixels."""
        seen = np.asarray(pixels, float)
        for _ in range(_STEPS):
            seen = seen + pixels - self.corrected(seen)
        return seen


def spline_weights(pixels: Array, spacing: float, shape: tuple[int, ...]) -> tuple[NDArray[np.intp], Array]:
    """Index into the (ny nx) coefficients and weight of the 16 splines that reach each of n pixels, both (n, 16)."""
    known = np.asarray(np.isfinite(pixels).all(axis=1))
    position = np.where(known[:, None], pixels, 0.0) / spacing
    cell = np.clip(np.floor(position), 0, np.array(shape[::-1]) - 4).astype(np.intp)
    t = position - cell
    one = 1.0 - t
    w = np.stack([one**3, 3 * t**3 - 6 * t**2 + 4, 3 * one**3 - 6 * one**2 + 4, t**3], axis=1) / 6.0  # (n, 4, xy)
    along = np.arange(4)
    index = (cell[:, 1, None] + along)[:, :, None] * shape[1] + (cell[:, 0, None] + along)[:, None, :]
    weight = w[:, :, None, 1] * w[:, None, :, 0]
    weight[~known] = np.nan
    return index.reshape(-1, 16), weight.reshape(-1, 16)
