"""Areas on either side of an edge within one cell of the sensor, and the ray's foot in a plane: compiled helpers.

An edge is the zero of a signed distance on the surface that carries it, sampled at a cell's corners and centre; the
area on either side of the straight line through it and its first moments are exact; curvature is allowed for in
second order.
"""

from __future__ import annotations

from typing import Any

from numba import types

from calibration.kit.arrays import Array, Array32
from calibration.kit.compiled import njit

Point = tuple[float, float, float]
RAYS = types.Array(types.float64, 3, "C", readonly=True)  # `rays.corner_rays`
RULES: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
part = njit(no_cpython_wrapper=True, no_cfunc_wrapper=True, **RULES)  # called by compiled functions only


@part
def half_plane(f0: float, a: float, b: float) -> tuple[float, float, float]:
    """Area and first moments (in x, in y) of the part of the square [-1/2, 1/2]^2 on which f0 + a x + b y > 0.

    I = integral of max(f, 0) is a sum of cubes at the four corners; the area is dI/df0, the moments are dI/da, dI/db.
    """
    A, B = abs(a), abs(b)
    swapped = A < B
    if swapped:
        A, B = B, A
    if f0 >= 0.5 * (A + B):
        return 1.0, 0.0, 0.0
    if f0 <= -0.5 * (A + B):
        return 0.0, 0.0, 0.0
    if B < 1e-3 * A:  # as good as parallel to a side; the sums below would cancel
        area = min(max(f0 / A + 0.5, 0.0), 1.0)
        m, n = 0.5 * area * (1.0 - area), B / (12.0 * A)
    else:
        p, q = 0.5 * (A + B), 0.5 * (A - B)
        g0, g1, g2, g3 = max(f0 + p, 0.0), max(f0 + q, 0.0), max(f0 - q, 0.0), max(f0 - p, 0.0)
        product = A * B
        integral = (g0**3 - g1**3 - g2**3 + g3**3) / (6.0 * product)
        area = min(max((g0**2 - g1**2 - g2**2 + g3**2) / (2.0 * product), 0.0), 1.0)
        m = (g0**2 - g1**2 + g2**2 - g3**2) / (4.0 * product) - integral / A
        n = (g0**2 + g1**2 - g2**2 - g3**2) / (4.0 * product) - integral / B
    if swapped:
        m, n = n, m
    return area, m if a > 0.0 else -m, n if b > 0.0 else -n


@part
def cell_part(c: float, f00: float, f01: float, f10: float, f11: float) -> tuple[float, float, float]:
    """`half_plane` of the cell with f > 0 from f at its centre and corners [row][column]; curvature in second order."""
    mean = 0.25 * (f00 + f01 + f10 + f11)
    return half_plane(c + (mean - c) / 3.0, 0.5 * (f01 + f11 - f00 - f10), 0.5 * (f10 + f11 - f00 - f01))


@part
def deposit(cells: Array32, y: int, x: int, value: float, moment_x: float, moment_y: float) -> None:
    """Add light to a cell, its first moments to the neighbours: else an edge would lie on the cells' lattice.

    The error of a blurred edge falls from second to third order in the cell's size.
    """
    cells[y, x] += value
    if moment_x != 0.0 and 0 < x < cells.shape[1] - 1:
        cells[y, x - 1] -= 0.5 * moment_x
        cells[y, x + 1] += 0.5 * moment_x
    if moment_y != 0.0 and 0 < y < cells.shape[0] - 1:
        cells[y - 1, x] -= 0.5 * moment_y
        cells[y + 1, x] += 0.5 * moment_y


@part
def seen_from(R: Array, t: Array) -> Point:
    """The camera's centre in body axes, -R^T t, of R_camera_body, t_camera_body."""
    x = R[0, 0] * t[0] + R[1, 0] * t[1] + R[2, 0] * t[2]
    y = R[0, 1] * t[0] + R[1, 1] * t[1] + R[2, 1] * t[2]
    z = R[0, 2] * t[0] + R[1, 2] * t[1] + R[2, 2] * t[2]
    return -x, -y, -z


@part
def plane_point(eye: Point, dx: float, dy: float, dz: float, height: float) -> tuple[float, float, bool]:
    """Point (x, y) of the ray eye + t d in the plane z = height, and whether it lies ahead."""
    if dz == 0.0:
        return 0.0, 0.0, False
    t = (height - eye[2]) / dz
    return eye[0] + t * dx, eye[1] + t * dy, t > 0.0


@part
def between(rays: Array, v: int, u: int, p: float, q: float) -> tuple[float, float]:
    """Bilinear interpolation at row fraction p, column fraction q of directions at the corners of pixel (v, u)."""
    a, b, c, d = (1 - p) * (1 - q), (1 - p) * q, p * (1 - q), p * q
    return (
        a * rays[v, u, 0] + b * rays[v, u + 1, 0] + c * rays[v + 1, u, 0] + d * rays[v + 1, u + 1, 0],
        a * rays[v, u, 1] + b * rays[v, u + 1, 1] + c * rays[v + 1, u, 1] + d * rays[v + 1, u + 1, 1],
    )


@part
def ray_in_body(R: Array, rx: float, ry: float) -> tuple[float, float, float]:
    """Direction R^T (rx, ry, 1) in the axes of a body, R = R_camera_body."""
    return (
        R[0, 0] * rx + R[1, 0] * ry + R[2, 0],
        R[0, 1] * rx + R[1, 1] * ry + R[2, 1],
        R[0, 2] * rx + R[1, 2] * ry + R[2, 2],
    )
