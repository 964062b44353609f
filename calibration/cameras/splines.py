"""A smooth displacement of the image that the distortion polynomial does not describe.

    pixel = projection + sum_k c_k B_k(pixel)         B: products of uniform cubic B-splines, a coefficient per axis

As in splined camera models; typically some hundredths of a pixel that vary over a third of the image.
"""

from dataclasses import dataclass

import numpy as np
import scipy

from calibration.kit.types import Array

_STEPS = 12  # of a fixed point that converges by the slope of the field, some hundredths, per step


@dataclass(frozen=True)
class LensField:
    """Displacement of image points in both cameras."""

    coefficients: Array  # (2 cameras, 2 axes, ny, nx) [px]
    spacing: float  # [px] of the grid; its first node lies one spacing before pixel 0

    def _sums(self, coefficients: Array, pixels: Array) -> Array:
        """Sums (..., k) of the splines with coefficients (ny, nx, k), at pixels (..., 2)."""
        y, x = (self.spacing * (np.arange(n + 4) - 3.0) for n in coefficients.shape[:2])  # knots
        splines = scipy.interpolate.NdBSpline((y, x), coefficients, 3)
        return np.asarray(splines(np.asarray(pixels, float)[..., ::-1]), np.float64)

    def splines(self, pixels: Array) -> Array:
        """Values (n, ny nx) of the splines of an axis at pixels (n, 2)."""
        shape = self.coefficients.shape[2:]
        return self._sums(np.eye(shape[0] * shape[1]).reshape(*shape, -1), pixels)

    def displacement(self, pixels: Array, camera: int) -> Array:
        """Displacement [px] (..., 2) of image points at `pixels` (..., 2) from the polynomial; NaN stays NaN."""
        return self._sums(np.moveaxis(self.coefficients[camera], 0, -1), pixels)

    def corrected(self, pixels: Array) -> Array:
        """Pixels (..., 2 cameras, m, 2) without the displacement, as the polynomial alone predicts them."""
        moved = [self.displacement(pixels[..., camera, :, :], camera) for camera in (0, 1)]
        return pixels - np.stack(moved, axis=-3)

    def distorted(self, pixels: Array) -> Array:
        """Inverse of `corrected`, to 1e-9 px for fields of some pixels."""
        seen = np.asarray(pixels, float)
        for _ in range(_STEPS):
            seen = seen + pixels - self.corrected(seen)
        return seen
