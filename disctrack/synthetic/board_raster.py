"""The chessboard in the cells of one camera's sensor; as `disc_raster`, and cells with two edges sampled 16 x 16."""

from __future__ import annotations

import numpy as np
from numba import types

from calibration.kit.arrays import Array, Array32
from calibration.kit.compiled import njit
from disctrack.synthetic.areas import (
    RAYS,
    RULES,
    Point,
    between,
    cell_part,
    deposit,
    part,
    plane_point,
    ray_in_body,
    seen_from,
)


@part
def _board_colour(x: float, y: float, n_x: int, n_y: int, margin: float) -> int:
    """0 outside the board, 1 white, 2 black, at (x, y) in squares from the lower left inner corner."""
    if x < -1.0 - margin or x > n_x + margin or y < -1.0 - margin or y > n_y + margin:
        return 0
    i, j = int(np.floor(x)), int(np.floor(y))
    if i < -1 or i >= n_x or j < -1 or j >= n_y:
        return 1
    return 2 if (i + j) % 2 == 0 else 1


@part
def _nearest_line(x: float, n: int, margin: float) -> float:
    """The board's straight edge nearest to coordinate x: a line between squares or the paper's edge."""
    line = min(max(np.round(x), -1.0), float(n))
    for edge in (-1.0 - margin, n + margin):
        if abs(x - edge) < abs(x - line):
            line = edge
    return line


@part
def _board_grid(
    grid: Array, p0: float, q0: float, size: float, rays: Array, row: int, column: int, R: Array, eye: Point,
    bent: Array,
) -> bool:  # fmt: skip
    """Board coordinates of 3 x 3 points of a cell (size: of the pixel), and whether the rays all meet the board.

    bent : bow, middle and half length along the long side, stretch, in squares: the face lies bow (1 - u^2) above its
           plane, u = (x - middle) / half length
    """
    ahead = True
    for i in range(3):
        for j in range(3):
            p, q = p0 + 0.5 * i * size, q0 + 0.5 * j * size
            rx, ry = between(rays, row, column, p, q)
            dx, dy, dz = ray_in_body(R, rx, ry)
            x, y, meets = plane_point(eye, dx, dy, dz, 0.0)
            if bent[0] != 0.0:
                for _ in range(3):  # the height changes little along the ray
                    u = (x - bent[1]) / bent[2]
                    x, y, meets = plane_point(eye, dx, dy, dz, bent[0] * (1.0 - u * u))
            x /= 1.0 + bent[3]
            ahead = ahead and meets
            grid[i, j, 0], grid[i, j, 1] = x, y
    return ahead


@part
def _beyond(grid: Array, k: int, line: float) -> tuple[float, float, float]:
    """`cell_part` of what lies beyond a line of coordinate k."""
    return cell_part(
        grid[1, 1, k] - line, grid[0, 0, k] - line, grid[0, 2, k] - line, grid[2, 0, k] - line, grid[2, 2, k] - line
    )


@part
def _within(grid: Array, k: int, p: float, q: float) -> float:
    """Coordinate k at row fraction p and column fraction q of a cell."""
    return (1 - p) * ((1 - q) * grid[0, 0, k] + q * grid[0, 2, k]) + p * ((1 - q) * grid[2, 0, k] + q * grid[2, 2, k])


@part
def _board_cell(grid: Array, colours: Array, n_x: int, n_y: int, margin: float) -> tuple[float, float, float]:
    """Mean grey of one cell that lines may cross, and its first moments."""
    x, y = grid[1, 1, 0], grid[1, 1, 1]
    line_x, line_y = _nearest_line(x, n_x, margin), _nearest_line(y, n_y, margin)
    part_x, part_y = _beyond(grid, 0, line_x), _beyond(grid, 1, line_y)
    cut_x, cut_y = 0.0 < part_x[0] < 1.0, 0.0 < part_y[0] < 1.0
    if cut_x and cut_y:
        value = m_x = m_y = 0.0
        for i in range(16):
            for j in range(16):
                p, q = (i + 0.5) / 16, (j + 0.5) / 16
                x, y = _within(grid, 0, p, q), _within(grid, 1, p, q)
                grey = colours[_board_colour(x, y, n_x, n_y, margin)] / 256.0
                value, m_x, m_y = value + grey, m_x + grey * (q - 0.5), m_y + grey * (p - 0.5)
        return value, m_x, m_y
    if not (cut_x or cut_y):
        return colours[_board_colour(x, y, n_x, n_y, margin)], 0.0, 0.0
    if cut_x:
        part = part_x
        high = colours[_board_colour(line_x + 1e-6, y, n_x, n_y, margin)]
        low = colours[_board_colour(line_x - 1e-6, y, n_x, n_y, margin)]
    else:
        part = part_y
        high = colours[_board_colour(x, line_y + 1e-6, n_x, n_y, margin)]
        low = colours[_board_colour(x, line_y - 1e-6, n_x, n_y, margin)]
    step = high - low
    return low + step * part[0], step * part[1], step * part[2]


@njit(cache=True, **RULES)
def draw_board(
    cells: Array32, background: Array32, rays: Array, s: int, R: Array, t: Array, square: float, n_x: int, n_y: int,
    margin: float, white: float, black: float, bent: Array,
) -> None:  # fmt: skip
    """Add the chessboard before the background to `cells`; arguments as in `draw_disc`.

    R, t     : R_camera_board, t_camera_board; the board's origin is its lower left inner corner
    n_x, n_y : inner corners along the long and the short side; `margin` in squares; bent: see `_board_grid`
    """
    x, y, z = seen_from(R, t)
    eye = (x / square, y / square, z / square)
    colours = np.array([0.0, white, black])
    grid = np.empty((3, 3, 2))
    for row in range(cells.shape[0] // s):
        for column in range(cells.shape[1] // s):
            ahead = _board_grid(grid, 0.0, 0.0, 1.0, rays, row, column, R, eye, bent)
            x, y = grid[1, 1, 0], grid[1, 1, 1]
            y0, x0 = row * s, column * s
            if not ahead or abs(x) > 1e3 or abs(y) > 1e3:
                for i in range(s):
                    for j in range(s):
                        cells[y0 + i, x0 + j] += background[y0 + i, x0 + j]
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
                        cells[y0 + i, x0 + j] += colours[colour] if colour else background[y0 + i, x0 + j]
                continue
            for i in range(s):
                for j in range(s):
                    _board_grid(grid, i / s, j / s, 1.0 / s, rays, row, column, R, eye, bent)
                    colours[0] = background[y0 + i, x0 + j]
                    value, m_x, m_y = _board_cell(grid, colours, n_x, n_y, margin)
                    deposit(cells, y0 + i, x0 + j, value, m_x, m_y)


def prepare() -> None:
    """Compile what draws the chessboard, or load it."""
    cells, number, row, rows = types.float32[:, ::1], types.float64, types.float64[::1], types.float64[:, ::1]
    draw_board.compile((cells, cells, RAYS, types.int64, rows, row, number, types.int64,
                        types.int64, number, number, number, row))  # fmt: skip
