"""Areas on either side of an edge within one cell of the sensor, and the ray's foot in a plane: compiled helpers.

An edge is the zero of a signed distance on the surface that carries it, sampled at a cell's corners and centre; the
area on either side of the straight line through it is exact, curvature is allowed for in second order.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]


@numba.njit(cache=True, nogil=True)
def half_plane_area(f0: float, a: float, b: float) -> float:
    """Part of the unit square [-1/2, 1/2]^2 on which f0 + a x + b y > 0."""
    a, b = abs(a), abs(b)
    if a < b:
        a, b = b, a
    if f0 >= 0.5 * (a + b):
        return 1.0
    if f0 <= -0.5 * (a + b):
        return 0.0
    if b < 1e-6 * a:
        return min(max(f0 / a + 0.5, 0.0), 1.0)
    # twice integrated step function at the four corners
    p, q = 0.5 * (a + b), 0.5 * (a - b)
    total = max(f0 + p, 0.0) ** 2 - max(f0 + q, 0.0) ** 2 - max(f0 - q, 0.0) ** 2 + max(f0 - p, 0.0) ** 2
    return min(max(total / (2.0 * a * b), 0.0), 1.0)


@numba.njit(cache=True, nogil=True)
def cell_area(c: float, f00: float, f01: float, f10: float, f11: float) -> float:
    """Area of the cell with f > 0 from f at the centre and the corners [row][column]; curvature in second order."""
    mean = 0.25 * (f00 + f01 + f10 + f11)
    return half_plane_area(c + (mean - c) / 3.0, 0.5 * (f01 + f11 - f00 - f10), 0.5 * (f10 + f11 - f00 - f01))


@numba.njit(cache=True, nogil=True)
def plane_point(eye: Array, dx: float, dy: float, dz: float, height: float) -> tuple[float, float, bool]:
    """Point (x, y) of the ray eye + t d in the plane z = height, and whether it lies ahead."""
    if dz == 0.0:
        return 0.0, 0.0, False
    t = (height - eye[2]) / dz
    return eye[0] + t * dx, eye[1] + t * dy, t > 0.0


@numba.njit(cache=True, nogil=True)
def between(corners: tuple[Array, Array, Array, Array], p: float, q: float) -> tuple[float, float]:
    """Bilinear interpolation at row fraction p, column fraction q of directions at a pixel's corners 00, 01, 10, 11."""
    r00, r01, r10, r11 = corners
    a, b, c, d = (1 - p) * (1 - q), (1 - p) * q, p * (1 - q), p * q
    return (
        a * r00[0] + b * r01[0] + c * r10[0] + d * r11[0],
        a * r00[1] + b * r01[1] + c * r10[1] + d * r11[1],
    )


@numba.njit(cache=True, nogil=True)
def ray_in_body(R: Array, rx: float, ry: float) -> tuple[float, float, float]:
    """Direction R^T (rx, ry, 1) in the axes of a body, R = R_camera_body."""
    return (
        R[0, 0] * rx + R[1, 0] * ry + R[2, 0],
        R[0, 1] * rx + R[1, 1] * ry + R[2, 1],
        R[0, 2] * rx + R[1, 2] * ry + R[2, 2],
    )
