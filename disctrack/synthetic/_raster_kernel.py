"""Rasterisation of shapes in the cells of one camera's sensor, before blur.

An image is composed of layers: the body over the table, its face over the body, the paper over the face, dots over the
paper; or the sheet of a chessboard over the table, black squares over the sheet. Each layer lies within the one below.
So light is additive: every shape adds its step of grey times the area of a cell that it covers.

A pixel without an edge is covered or not. A pixel with an edge is divided into s x s cells. The covered area of a cell
follows from signed distances at its corners and its centre. Area and first moments are exact for a straight edge, and
corrected for curvature to second order. The error of a blurred edge is of third order in the size of the cells.
"""

import numpy as np
from numba import types

from calibration.kit.compiled import exact_part, njit, owning_part
from calibration.kit.types import Array, Array32

_ROUND, _BODY, _SHEET = 0.0, 1.0, 2.0
_FAR = -1e3  # [m] signed distance of a ray that does not meet the plane in front of the camera
_CLEAR, _CLEAR_OF_TIPS = 0.6, 1.0  # mean distance over the range at a pixel's corners, above which no edge crosses it:
# 1/2 for a straight edge, 1 for a right angle that enters between two of the corners
_BENT = 0.02  # difference of centre and mean of the corners over their range, above which the edge has a corner
_SAMPLES = 16  # per side, of a cell with such a corner


def round_shape(height: float, centre: tuple[float, float], radius: float, within: float) -> Array:
    """A circle in the plane z = height of a body, restricted to distances from the axis below `within` [m]."""
    return np.array([_ROUND, height, *centre, radius, within, 0.0, 0.0])


def body_shape(radius: float, half_thickness: float) -> Array:
    """The outline of a cylinder about the third axis [m]."""
    return np.array([_BODY, half_thickness, radius, 0.0, 0.0, 0.0, 0.0, 0.0])


def sheet_shape(x: tuple[float, float], y: tuple[float, float], bow: tuple[float, float, float]) -> Array:
    """The rectangle x[0] ... x[1], y[0] ... y[1] of a sheet with the height bow[0] (1 - u^2) over its plane.

    u = (x - bow[1]) / bow[2]; all in metres
    """
    return np.array([_SHEET, *x, *y, *bow])


@exact_part
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
    if B < 1e-3 * A:  # nearly parallel to a side: the sums below would cancel
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


@exact_part
def between(grid: Array, row: int, column: int, p: float, q: float, k: int) -> float:
    """Bilinear value of component k at row + p, column + q."""
    upper = (1 - q) * grid[row, column, k] + q * grid[row, column + 1, k]
    lower = (1 - q) * grid[row + 1, column, k] + q * grid[row + 1, column + 1, k]
    return (1 - p) * upper + p * lower


@exact_part
def _foot(eye: Array, dx: float, dy: float, dz: float, height: float) -> tuple[float, float, bool]:
    """Point (x, y) of the ray eye + t d in the plane z = height, and whether t > 0."""
    if dz == 0.0:
        return 0.0, 0.0, False
    t = (height - eye[2]) / dz
    return eye[0] + t * dx, eye[1] + t * dy, t > 0.0


@exact_part
def _distance(rx: float, ry: float, R: Array, eye: Array, shape: Array) -> float:
    """Signed distance [m] of the ray (rx, ry, 1) of the camera from the edge of a shape, positive inside."""
    dx = R[0, 0] * rx + R[1, 0] * ry + R[2, 0]
    dy = R[0, 1] * rx + R[1, 1] * ry + R[2, 1]
    dz = R[0, 2] * rx + R[1, 2] * ry + R[2, 2]
    if shape[0] == _ROUND:
        x, y, ahead = _foot(eye, dx, dy, dz, shape[1])
        if not ahead:
            return _FAR
        own = shape[4] - np.sqrt((x - shape[2]) ** 2 + (y - shape[3]) ** 2)
        return min(own, shape[5] - np.sqrt(x * x + y * y))
    if shape[0] == _SHEET:
        x, y, ahead = _foot(eye, dx, dy, dz, 0.0)
        if shape[5] != 0.0:
            for _ in range(3):  # fixed-point iteration: the height changes little along the ray
                u = (x - shape[6]) / shape[7]
                x, y, ahead = _foot(eye, dx, dy, dz, shape[5] * (1.0 - u * u))
        return min(min(x - shape[1], shape[2] - x), min(y - shape[3], shape[4] - y)) if ahead else _FAR
    h, radius, found = shape[1], shape[2], _FAR
    for sign in (-1.0, 1.0):
        x, y, ahead = _foot(eye, dx, dy, dz, sign * h)
        if ahead:
            found = max(found, radius - np.sqrt(x * x + y * y))
    across = dx * dx + dy * dy
    if across > 1e-18 and abs(eye[2] - (eye[0] * dx + eye[1] * dy) / across * dz) <= h:  # nearest to the axis inside
        found = max(found, radius - abs(eye[0] * dy - eye[1] * dx) / np.sqrt(across))
    return found


@exact_part
def _at(rays: Array, row: int, column: int, p: float, q: float, R: Array, eye: Array, shape: Array) -> float:
    """`_distance` at row fraction p, column fraction q of a pixel."""
    return _distance(between(rays, row, column, p, q, 0), between(rays, row, column, p, q, 1), R, eye, shape)


@exact_part
def _deposit(cells: Array32, y: int, x: int, value: float, moment_x: float, moment_y: float) -> None:
    """Add light to a cell and its first moments to the neighbours.

    This reduces the error of a blurred edge from second to third order in the size of the cells.
    """
    cells[y, x] += value
    if moment_x != 0.0 and 0 < x < cells.shape[1] - 1:
        cells[y, x - 1] -= 0.5 * moment_x
        cells[y, x + 1] += 0.5 * moment_x
    if moment_y != 0.0 and 0 < y < cells.shape[0] - 1:
        cells[y - 1, x] -= 0.5 * moment_y
        cells[y + 1, x] += 0.5 * moment_y


@owning_part
def _add_crossed(
    cells: Array32, step: float, s: int, row: int, column: int, rays: Array, R: Array, eye: Array, shape: Array
) -> None:  # fmt: skip
    """Add a shape to the cells of a pixel with an edge."""
    f = np.empty((2, s + 1))  # distances at the corners of the cells, upper and lower line
    for i in range(-1, s):
        for j in range(s + 1):
            f[0, j], f[1, j] = f[1, j], _at(rays, row, column, (i + 1) / s, j / s, R, eye, shape)
        for j in range(s if i >= 0 else 0):
            a, b, c, d = f[0, j], f[0, j + 1], f[1, j], f[1, j + 1]
            mean, spread = 0.25 * (a + b + c + d), max(max(a, b), max(c, d)) - min(min(a, b), min(c, d))
            middle = _at(rays, row, column, (i + 0.5) / s, (j + 0.5) / s, R, eye, shape)
            if abs(mean) < spread and abs(middle - mean) > _BENT * spread:
                area = m_x = m_y = 0.0
                for k in range(_SAMPLES * _SAMPLES):
                    p, q = (k // _SAMPLES + 0.5) / _SAMPLES, (k % _SAMPLES + 0.5) / _SAMPLES
                    if _at(rays, row, column, (i + p) / s, (j + q) / s, R, eye, shape) > 0.0:
                        area, m_x, m_y = area + 1.0, m_x + q - 0.5, m_y + p - 0.5
                area, m_x, m_y = area / _SAMPLES**2, m_x / _SAMPLES**2, m_y / _SAMPLES**2
            else:
                middle += (mean - middle) / 3.0
                area, m_x, m_y = half_plane(middle, 0.5 * (b + d - a - c), 0.5 * (c + d - a - b))
            _deposit(cells, row * s + i, column * s + j, step * area, step * m_x, step * m_y)


@njit(cache=True, nogil=True, error_model="numpy")
def add_shape(cells: Array32, step: float, rays: Array, R: Array, eye: Array, shape: Array) -> None:
    """Add `step` times the covered part of each cell to `cells`.

    cells : (rows * s, columns * s) of some pixels   rays : (rows + 1, columns + 1, 2) at the corners of these
    R, eye : R_camera_body, and the camera's centre in body axes [m]   shape : of `round_shape` and the like
    """
    rows, columns = rays.shape[0] - 1, rays.shape[1] - 1
    s = cells.shape[0] // rows
    clear = _CLEAR_OF_TIPS if shape[0] == _SHEET else _CLEAR
    f = np.empty((2, columns + 1))  # distances at the corners of the pixels, upper and lower line
    for row in range(-1, rows):
        for k in range(columns + 1):
            f[0, k], f[1, k] = f[1, k], _distance(rays[row + 1, k, 0], rays[row + 1, k, 1], R, eye, shape)
        for k in range(columns if row >= 0 else 0):
            a, b, c, d = f[0, k], f[0, k + 1], f[1, k], f[1, k + 1]
            low, high = min(min(a, b), min(c, d)), max(max(a, b), max(c, d))
            if low < 0.0 < high or abs(0.25 * (a + b + c + d)) <= clear * (high - low):
                _add_crossed(cells, step, s, row, k, rays, R, eye, shape)
            elif low > 0.0:
                for i in range(row * s, (row + 1) * s):
                    for j in range(k * s, (k + 1) * s):
                        cells[i, j] += step


def prepare() -> None:
    """Compile or load the rasteriser."""
    number, row = types.float64, types.float64[::1]
    add_shape.compile((types.float32[:, :], number, number[:, :, :], number[:, ::1], row, row))
