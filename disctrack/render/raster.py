"""Area of every surface in every cell of the sensor: what the lens would draw without blur.

A pixel that no edge crosses is one value. A crossed pixel is cut into s x s cells; in a cell an edge is the zero of a
signed distance on the surface that carries it, sampled at the cell's corners and centre, and the area on either side of
the straight line through it is exact (`_half_plane_area`). Errors are of third order in the cell's size; cells with two
edges are sampled 8 x 8. Compiled, because cells are many: 15 ms for a disc that fills a third of 512 x 512.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
_FAR = -1e3  # [m] signed distance of a ray that does not meet the plane ahead of the camera


@numba.njit(cache=True, nogil=True)
def _half_plane_area(f0: float, a: float, b: float) -> float:
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
def _cell_area(c: float, f00: float, f01: float, f10: float, f11: float) -> float:
    """Area of the cell with f > 0 from f at the centre and the corners [row][column]; curvature in second order."""
    mean = 0.25 * (f00 + f01 + f10 + f11)
    return _half_plane_area(c + (mean - c) / 3.0, 0.5 * (f01 + f11 - f00 - f10), 0.5 * (f10 + f11 - f00 - f01))


@numba.njit(cache=True, nogil=True)
def _plane_point(eye: Array, dx: float, dy: float, dz: float, height: float) -> tuple[float, float, bool]:
    """Point (x, y) of the ray eye + t d in the plane z = height, and whether it lies ahead."""
    if dz == 0.0:
        return 0.0, 0.0, False
    t = (height - eye[2]) / dz
    return eye[0] + t * dx, eye[1] + t * dy, t > 0.0


@numba.njit(cache=True, nogil=True)
def _disc_fields(
    rx: float, ry: float, R: Array, eye: Array, radius: float, h: float, cap: float, paper: Array, dots: Array,
    dot_radius: float, with_side: bool, out: Array,
) -> None:  # fmt: skip
    """Signed distances [m] at one ray, positive inside.

    out: 0 the visible cap, 1 paper, 2 nearest dot, 3 the other cap, 4 side; 5 = 1 where the ray passes the axis between
    the caps; 6, 7 and 8, 9 the ray's foot in the cap's and in the other plane. 3 to 5, 8, 9 only `with_side`.
    """
    dx = R[0, 0] * rx + R[1, 0] * ry + R[2, 0]
    dy = R[0, 1] * rx + R[1, 1] * ry + R[2, 1]
    dz = R[0, 2] * rx + R[1, 2] * ry + R[2, 2]
    x, y, ahead = _plane_point(eye, dx, dy, dz, cap)
    out[6], out[7] = x, y
    out[0] = out[1] = out[2] = _FAR
    if ahead:
        out[0] = radius - np.sqrt(x * x + y * y)
        out[1] = paper[2] - np.sqrt((x - paper[0]) ** 2 + (y - paper[1]) ** 2)
        best = 1e6
        for k in range(dots.shape[0]):
            best = min(best, (x - dots[k, 0]) ** 2 + (y - dots[k, 1]) ** 2)
        out[2] = dot_radius - np.sqrt(best)
    if not with_side:
        return
    x, y, ahead = _plane_point(eye, dx, dy, dz, -cap)
    out[8], out[9] = x, y
    out[3] = radius - np.sqrt(x * x + y * y) if ahead else _FAR
    across = dx * dx + dy * dy
    out[4], out[5] = _FAR, 0.0
    if across > 1e-18:
        out[4] = radius - abs(eye[0] * dy - eye[1] * dx) / np.sqrt(across)
        z = eye[2] - (eye[0] * dx + eye[1] * dy) / across * dz
        out[5] = 1.0 if -h <= z <= h else 0.0


@numba.njit(cache=True, nogil=True)
def _between(r00: Array, r01: Array, r10: Array, r11: Array, p: float, q: float) -> tuple[float, float]:
    """Bilinear interpolation of directions at row fraction p and column fraction q."""
    a, b, c, d = (1 - p) * (1 - q), (1 - p) * q, p * (1 - q), p * q
    return (
        a * r00[0] + b * r01[0] + c * r10[0] + d * r11[0],
        a * r00[1] + b * r01[1] + c * r10[1] + d * r11[1],
    )


@numba.njit(cache=True, nogil=True)
def _diagonal(a: Array, b: Array, c: Array, d: Array, k: int) -> float:
    """The longer diagonal of the quadrilateral of the feet (k, k + 1) at a pixel's corners, and a fifth for safety."""
    return 1.2 * max(
        np.sqrt((d[k] - a[k]) ** 2 + (d[k + 1] - a[k + 1]) ** 2),
        np.sqrt((c[k] - b[k]) ** 2 + (c[k + 1] - b[k + 1]) ** 2),
    )


@numba.njit(cache=True, nogil=True)
def draw_disc(
    cells: Array32, background: Array32, corner: tuple[int, int], rays: Array, s: int, weight: float, R: Array,
    t: Array, radius: float, h: float, paper: Array, dots: Array, dot_radius: float, grey: Array,
) -> None:  # fmt: skip
    """Add `weight` times the disc before the background to `cells`.

    cells, background : (rows * s, columns * s) grey values of the sensor's cells in a window
    corner            : row, column of the window's first pixel in `rays` (`rays.corner_rays`)
    R, t              : R_camera_body, t_camera_body
    paper             : centre x, y and radius of the paper on the upper face [m]
    dots              : (m, 2) true centres on the upper face [m]
    grey              : paper, dot, rim, side, underside
    """
    eye = -R.T @ t
    cap = -h if eye[2] < 0.0 else h  # the plane of the cap that looks to the camera
    cap_visible, upper = abs(eye[2]) > h, eye[2] > 0.0
    ring, side = (grey[2] if upper else grey[4]), grey[3]
    n = s + 1
    centre = np.empty(10)
    f = np.empty((n, n, 10))
    shape = (R, eye, radius, h, cap, paper, dots, dot_radius)
    rows, columns = cells.shape[0] // s, cells.shape[1] // s
    edge = np.empty((2, columns + 1, 10))  # fields at the pixels' corners, upper and lower line
    for row in range(-1, rows):
        edge[0] = edge[1]
        for column in range(columns + 1):
            r = rays[corner[0] + row + 1, corner[1] + column]
            _disc_fields(r[0], r[1], *shape, True, edge[1, column])
        if row < 0:
            continue
        for column in range(columns):
            a, b, c, d = edge[0, column], edge[0, column + 1], edge[1, column], edge[1, column + 1]
            # a signed distance changes by no more than the ray's foot moves
            reach = _diagonal(a, b, c, d, 6)
            y0, x0 = row * s, column * s
            inside_cap = cap_visible and a[0] > reach
            if inside_cap and (not upper or (abs(a[1]) > reach and (a[1] < 0.0 or abs(a[2]) > reach))):
                value = ring
                if upper and a[1] > 0.0:
                    value = grey[1] if a[2] > 0.0 else grey[0]
                for i in range(s):
                    for j in range(s):
                        cells[y0 + i, x0 + j] += weight * value
                continue
            if a[0] < -reach and abs(a[3]) > _diagonal(a, b, c, d, 8):
                reach_side = 1.5 * max(abs(b[4] - a[4]), abs(c[4] - a[4]), abs(d[4] - a[4]))
                solid = a[3] > 0.0 or (a[4] > 0.0 and a[5] > 0.0)
                if abs(a[4]) > reach_side and a[5] == b[5] == c[5] == d[5]:
                    for i in range(s):
                        for j in range(s):
                            cells[y0 + i, x0 + j] += weight * (side if solid else background[y0 + i, x0 + j])
                    continue
            r00, r01 = rays[corner[0] + row, corner[1] + column], rays[corner[0] + row, corner[1] + column + 1]
            r10, r11 = rays[corner[0] + row + 1, corner[1] + column], rays[corner[0] + row + 1, corner[1] + column + 1]
            for i in range(n):
                for j in range(n):
                    rx, ry = _between(r00, r01, r10, r11, i / s, j / s)
                    _disc_fields(rx, ry, *shape, not inside_cap, f[i, j])
            for i in range(s):
                for j in range(s):
                    rx, ry = _between(r00, r01, r10, r11, (i + 0.5) / s, (j + 0.5) / s)
                    _disc_fields(rx, ry, *shape, not inside_cap, centre)
                    value = _disc_cell(
                        centre, f[i, j], f[i, j + 1], f[i + 1, j], f[i + 1, j + 1],
                        background[y0 + i, x0 + j], grey, ring, upper, cap_visible, inside_cap,
                    )  # fmt: skip
                    cells[y0 + i, x0 + j] += weight * value


@numba.njit(cache=True, nogil=True)
def _disc_cell(
    centre: Array, a: Array, b: Array, c: Array, d: Array, back: float, grey: Array, ring: float, upper: bool,
    cap_visible: bool, inside_cap: bool,
) -> float:  # fmt: skip
    """Mean grey of one cell from the fields at its centre and corners: body before table, cap before side, ..."""
    area_cap = 1.0 if inside_cap else _cell_area(centre[0], a[0], b[0], c[0], d[0])
    area_body = area_cap
    if not inside_cap:
        area_body = max(area_body, _cell_area(centre[3], a[3], b[3], c[3], d[3]))
        if centre[5] > 0.0:
            area_body = max(area_body, _cell_area(centre[4], a[4], b[4], c[4], d[4]))
    if not cap_visible:
        area_cap = 0.0
    value = (1.0 - area_body) * back + grey[3] * (area_body - area_cap)
    if not upper:
        return value + ring * area_cap
    area_paper = min(area_cap, _cell_area(centre[1], a[1], b[1], c[1], d[1]))
    area_dot = min(area_paper, _cell_area(centre[2], a[2], b[2], c[2], d[2]))
    return value + ring * (area_cap - area_paper) + grey[0] * (area_paper - area_dot) + grey[1] * area_dot


@numba.njit(cache=True, nogil=True)
def _board_colour(x: float, y: float, n_x: int, n_y: int, margin: float) -> int:
    """0 outside the board, 1 white, 2 black, at (x, y) in squares from the lower left inner corner."""
    if x < -1.0 - margin or x > n_x + margin or y < -1.0 - margin or y > n_y + margin:
        return 0
    i, j = int(np.floor(x)), int(np.floor(y))
    if i < -1 or i >= n_x or j < -1 or j >= n_y:
        return 1
    return 2 if (i + j) % 2 == 0 else 1


@numba.njit(cache=True, nogil=True)
def _nearest_line(x: float, n: int, margin: float) -> float:
    """The board's straight edge nearest to coordinate x: a line between squares or the paper's edge."""
    line = min(max(np.round(x), -1.0), float(n))
    for edge in (-1.0 - margin, n + margin):
        if abs(x - edge) < abs(x - line):
            line = edge
    return line


@numba.njit(cache=True, nogil=True)
def _board_grid(
    grid: Array, p0: float, q0: float, size: float, r00: Array, r01: Array, r10: Array, r11: Array, R: Array, eye: Array
) -> bool:
    """Board coordinates of 3 x 3 points of a cell (size: of the pixel), and whether the rays all meet the board."""
    ahead = True
    for i in range(3):
        for j in range(3):
            p, q = p0 + 0.5 * i * size, q0 + 0.5 * j * size
            rx = (1 - p) * ((1 - q) * r00[0] + q * r01[0]) + p * ((1 - q) * r10[0] + q * r11[0])
            ry = (1 - p) * ((1 - q) * r00[1] + q * r01[1]) + p * ((1 - q) * r10[1] + q * r11[1])
            dx = R[0, 0] * rx + R[1, 0] * ry + R[2, 0]
            dy = R[0, 1] * rx + R[1, 1] * ry + R[2, 1]
            dz = R[0, 2] * rx + R[1, 2] * ry + R[2, 2]
            x, y, meets = _plane_point(eye, dx, dy, dz, 0.0)
            ahead = ahead and meets
            grid[i, j, 0], grid[i, j, 1] = x, y
    return ahead


@numba.njit(cache=True, nogil=True)
def _board_cell(grid: Array, colours: Array, n_x: int, n_y: int, margin: float) -> float:
    """Mean grey of one cell that lines may cross."""
    x, y = grid[1, 1]
    line_x, line_y = _nearest_line(x, n_x, margin), _nearest_line(y, n_y, margin)
    g = grid - np.array([line_x, line_y])
    area_x = _cell_area(g[1, 1, 0], g[0, 0, 0], g[0, 2, 0], g[2, 0, 0], g[2, 2, 0])
    area_y = _cell_area(g[1, 1, 1], g[0, 0, 1], g[0, 2, 1], g[2, 0, 1], g[2, 2, 1])
    cut_x, cut_y = 0.0 < area_x < 1.0, 0.0 < area_y < 1.0
    if cut_x and cut_y:
        total = 0.0
        for i in range(8):
            for j in range(8):
                p, q = (i + 0.5) / 8, (j + 0.5) / 8
                point = (1 - p) * ((1 - q) * grid[0, 0] + q * grid[0, 2]) + p * ((1 - q) * grid[2, 0] + q * grid[2, 2])
                total += colours[_board_colour(point[0], point[1], n_x, n_y, margin)]
        return total / 64.0
    if cut_x:
        high = colours[_board_colour(line_x + 1e-6, y, n_x, n_y, margin)]
        low = colours[_board_colour(line_x - 1e-6, y, n_x, n_y, margin)]
        return area_x * high + (1 - area_x) * low
    if cut_y:
        high = colours[_board_colour(x, line_y + 1e-6, n_x, n_y, margin)]
        low = colours[_board_colour(x, line_y - 1e-6, n_x, n_y, margin)]
        return area_y * high + (1 - area_y) * low
    return colours[_board_colour(x, y, n_x, n_y, margin)]


@numba.njit(cache=True, nogil=True)
def draw_board(
    cells: Array32, background: Array32, rays: Array, s: int, R: Array, t: Array, square: float, n_x: int, n_y: int,
    margin: float, white: float, black: float,
) -> None:  # fmt: skip
    """Write the chessboard before the background into `cells`; arguments as in `draw_disc`.

    R, t     : R_camera_board, t_camera_board; the board's origin is its lower left inner corner
    n_x, n_y : inner corners along the long and the short side; `margin` in squares
    """
    eye = -R.T @ t / square
    colours = np.array([0.0, white, black])
    grid = np.empty((3, 3, 2))
    for row in range(cells.shape[0] // s):
        for column in range(cells.shape[1] // s):
            r00, r01, r10, r11 = (
                rays[row, column],
                rays[row, column + 1],
                rays[row + 1, column],
                rays[row + 1, column + 1],
            )
            ahead = _board_grid(grid, 0.0, 0.0, 1.0, r00, r01, r10, r11, R, eye)
            x, y = grid[1, 1]
            y0, x0 = row * s, column * s
            if not ahead or abs(x) > 1e3 or abs(y) > 1e3:
                cells[y0 : y0 + s, x0 : x0 + s] = background[y0 : y0 + s, x0 : x0 + s]
                continue
            reach_x = 1.5 * max(
                abs(grid[0, 0, 0] - x), abs(grid[0, 2, 0] - x), abs(grid[2, 0, 0] - x), abs(grid[2, 2, 0] - x)
            )
            reach_y = 1.5 * max(
                abs(grid[0, 0, 1] - y), abs(grid[0, 2, 1] - y), abs(grid[2, 0, 1] - y), abs(grid[2, 2, 1] - y)
            )
            if abs(x - _nearest_line(x, n_x, margin)) > reach_x and abs(y - _nearest_line(y, n_y, margin)) > reach_y:
                colour = _board_colour(x, y, n_x, n_y, margin)
                for i in range(s):
                    for j in range(s):
                        cells[y0 + i, x0 + j] = colours[colour] if colour else background[y0 + i, x0 + j]
                continue
            for i in range(s):
                for j in range(s):
                    _board_grid(grid, i / s, j / s, 1.0 / s, r00, r01, r10, r11, R, eye)
                    colours[0] = background[y0 + i, x0 + j]
                    cells[y0 + i, x0 + j] = _board_cell(grid, colours, n_x, n_y, margin)
