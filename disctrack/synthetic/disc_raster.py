"""The disc in the cells of one camera's sensor: what the lens would draw of it without blur.

A pixel that no edge crosses is one value. A crossed pixel is cut into s x s cells, and in each the area of every
surface is found from signed distances (`areas`); the error is of third order in the cell's size. Compiled, because
cells are many: 20 ms for a disc that fills a third of 512 x 512 with s = 5.
"""

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

_FAR = -1e3  # [m] signed distance of a ray that does not meet the plane ahead of the camera
_N_FIELDS = 11


@part
def _disc_fields(
    rx: float, ry: float, R: Array, eye: Point, radius: float, h: float, cap: float, paper: Array, dots: Array,
    dot_radius: float, fields: Array, row: int, column: int,
) -> None:  # fmt: skip
    """Signed distances [m] at one ray, positive inside, into fields[row, column].

    0 the visible cap, 1 paper, 2 nearest dot, 3 the other cap, 4 side; 5 = 1 where the ray passes the axis between
    the caps; 6, 7 and 8, 9 the ray's foot in the cap's and in the other plane; 10 the number of the nearest dot.
    """
    dx, dy, dz = ray_in_body(R, rx, ry)
    x, y, ahead = plane_point(eye, dx, dy, dz, cap)
    fields[row, column, 6], fields[row, column, 7] = x, y
    fields[row, column, 0] = fields[row, column, 1] = fields[row, column, 2] = _FAR
    if ahead:
        fields[row, column, 0] = radius - np.sqrt(x * x + y * y)
        fields[row, column, 1] = paper[2] - np.sqrt((x - paper[0]) ** 2 + (y - paper[1]) ** 2)
        best = 1e6
        for k in range(dots.shape[0]):
            square = (x - dots[k, 0]) ** 2 + (y - dots[k, 1]) ** 2
            if square < best:
                best, fields[row, column, 10] = square, k
        fields[row, column, 2] = dot_radius - np.sqrt(best)
    x, y, ahead = plane_point(eye, dx, dy, dz, -cap)
    fields[row, column, 8], fields[row, column, 9] = x, y
    fields[row, column, 3] = radius - np.sqrt(x * x + y * y) if ahead else _FAR
    across = dx * dx + dy * dy
    fields[row, column, 4], fields[row, column, 5] = _FAR, 0.0
    if across > 1e-18:
        fields[row, column, 4] = radius - abs(eye[0] * dy - eye[1] * dx) / np.sqrt(across)
        z = eye[2] - (eye[0] * dx + eye[1] * dy) / across * dz
        fields[row, column, 5] = 1.0 if -h <= z <= h else 0.0


@part
def _diagonal(edge: Array, column: int, k: int) -> float:
    """The longer diagonal of the quadrilateral of the feet (k, k + 1) at a pixel's corners, and a fifth for safety."""
    last = column + 1
    return 1.2 * max(
        np.sqrt((edge[1, last, k] - edge[0, column, k]) ** 2 + (edge[1, last, k + 1] - edge[0, column, k + 1]) ** 2),
        np.sqrt((edge[1, column, k] - edge[0, last, k]) ** 2 + (edge[1, column, k + 1] - edge[0, last, k + 1]) ** 2),
    )


@part
def _uncut(edge: Array, column: int, k: int, slack: float) -> bool:
    """No edge of surface k passes between four corners of one sign, but for a bulge of less than `slack`."""
    a, b, c, d = edge[0, column, k], edge[0, column + 1, k], edge[1, column, k], edge[1, column + 1, k]
    low, high = min(min(a, b), min(c, d)), max(max(a, b), max(c, d))
    return low > slack or high < -slack


@part
def _fill_circle(
    cells: Array32, y0: int, x0: int, s: int, weight: float, rays: Array, v: int, u: int, R: Array, eye: Point,
    cap: float, circle: tuple[float, float, float], inner: float, outer: float, f: Array,
) -> None:  # fmt: skip
    """Add a pixel of the cap that only the circle (x, y, radius) crosses; f is (2, s + 1) of workspace."""
    for i in range(s + 1):
        for j in range(s + 1):
            f[0, j] = f[1, j]
            f[1, j] = _circle_distance(rays, v, u, i / s, j / s, R, eye, cap, circle)
        if i == 0:
            continue
        for j in range(s):
            middle = _circle_distance(rays, v, u, (i - 0.5) / s, (j + 0.5) / s, R, eye, cap, circle)
            area, m_x, m_y = cell_part(middle, f[0, j], f[0, j + 1], f[1, j], f[1, j + 1])
            step = weight * (inner - outer)
            deposit(cells, y0 + i - 1, x0 + j, weight * outer + step * area, step * m_x, step * m_y)


@part
def _circle_distance(
    rays: Array, v: int, u: int, p: float, q: float, R: Array, eye: Point, cap: float,
    circle: tuple[float, float, float],
) -> float:  # fmt: skip
    rx, ry = between(rays, v, u, p, q)
    dx, dy, dz = ray_in_body(R, rx, ry)
    t = (cap - eye[2]) / dz
    x, y = eye[0] + t * dx - circle[0], eye[1] + t * dy - circle[1]
    return circle[2] - np.sqrt(x * x + y * y)


@njit(cache=True, **RULES)
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
    eye = seen_from(R, t)
    cap = -h if eye[2] < 0.0 else h  # the plane of the cap that looks to the camera
    cap_visible, upper = abs(eye[2]) > h, eye[2] > 0.0
    ring, side = (grey[2] if upper else grey[4]), grey[3]
    paper_circle = (paper[0], paper[1], paper[2])
    smallest = min(dot_radius, paper[2])
    line, f = np.empty((2, s + 1)), np.empty((s + 1, s + 1, _N_FIELDS))
    centre = np.empty((1, 1, _N_FIELDS))
    shape = (R, eye, radius, h, cap, paper, dots, dot_radius)
    rows, columns = cells.shape[0] // s, cells.shape[1] // s
    edge = np.empty((2, columns + 1, _N_FIELDS))  # fields at the pixels' corners, upper and lower line
    for row in range(-1, rows):
        edge[0] = edge[1]
        for column in range(columns + 1):
            v, u = corner[0] + row + 1, corner[1] + column
            _disc_fields(rays[v, u, 0], rays[v, u, 1], *shape, edge, 1, column)
        if row < 0:
            continue
        for column in range(columns):
            y0, x0 = row * s, column * s
            reach = _diagonal(edge, column, 6)
            slack = reach * reach / (4.0 * smallest)  # twice the sagitta of an arc as long as the pixel's diagonal
            whole_cap = cap_visible and edge[0, column, 0] > 0.0 and _uncut(edge, column, 0, slack)
            if whole_cap:
                inside_paper, inside_dot = upper and edge[0, column, 1] > 0.0, upper and edge[0, column, 2] > 0.0
                no_paper_edge = not upper or _uncut(edge, column, 1, slack)
                no_dot_edge = not upper or _uncut(edge, column, 2, slack)
                if no_paper_edge and no_dot_edge:
                    value = weight * (grey[1] if inside_dot else (grey[0] if inside_paper else ring))
                    for i in range(s):
                        for j in range(s):
                            cells[y0 + i, x0 + j] += value
                    continue
            elif edge[0, column, 0] < 0.0 and _uncut(edge, column, 0, slack):
                far_slack = _diagonal(edge, column, 8) ** 2 / (4.0 * smallest)
                first = edge[0, column, 5]
                between_caps = first == edge[0, column + 1, 5] == edge[1, column, 5] == edge[1, column + 1, 5]
                if between_caps and _uncut(edge, column, 3, far_slack) and _uncut(edge, column, 4, 1e-6):
                    solid = edge[0, column, 3] > 0.0 or (edge[0, column, 4] > 0.0 and first > 0.0)
                    for i in range(s):
                        for j in range(s):
                            cells[y0 + i, x0 + j] += weight * (side if solid else background[y0 + i, x0 + j])
                    continue
            v, u = corner[0] + row, corner[1] + column
            if whole_cap and (no_paper_edge or no_dot_edge):
                if no_dot_edge:
                    circle, inner, outer = paper_circle, grey[0], ring
                else:
                    k = int(edge[0, column, 10])
                    circle, inner, outer = (dots[k, 0], dots[k, 1], dot_radius), grey[1], grey[0]
                _fill_circle(cells, y0, x0, s, weight, rays, v, u, R, eye, cap, circle, inner, outer, line)
                continue
            for i in range(s + 1):
                for j in range(s + 1):
                    rx, ry = between(rays, v, u, i / s, j / s)
                    _disc_fields(rx, ry, *shape, f, i, j)
            for i in range(s):
                for j in range(s):
                    rx, ry = between(rays, v, u, (i + 0.5) / s, (j + 0.5) / s)
                    _disc_fields(rx, ry, *shape, centre, 0, 0)
                    value, m_x, m_y = _disc_cell(
                        centre, f, i, j, background[y0 + i, x0 + j], grey, ring, upper, cap_visible
                    )
                    deposit(cells, y0 + i, x0 + j, weight * value, weight * m_x, weight * m_y)


@part
def _larger(first: tuple[float, float, float], second: tuple[float, float, float]) -> tuple[float, float, float]:
    return first if first[0] >= second[0] else second


@part
def _part(centre: Array, f: Array, i: int, j: int, k: int) -> tuple[float, float, float]:
    """`cell_part` of surface k."""
    return cell_part(centre[0, 0, k], f[i, j, k], f[i, j + 1, k], f[i + 1, j, k], f[i + 1, j + 1, k])


@part
def _disc_cell(
    centre: Array, f: Array, i: int, j: int, back: float, grey: Array, ring: float, upper: bool, cap_visible: bool,
) -> tuple[float, float, float]:  # fmt: skip
    """Mean grey of one cell and its first moments from the fields at its centre and corners.

    Painted from behind: table, body, visible cap, paper, dot; each lies within the one before.
    """
    cap = _part(centre, f, i, j, 0)
    body = _larger(cap, _part(centre, f, i, j, 3))
    if centre[0, 0, 5] > 0.0:
        body = _larger(body, _part(centre, f, i, j, 4))
    step = grey[3] - back
    value, m_x, m_y = back + step * body[0], step * body[1], step * body[2]
    if not cap_visible:
        return value, m_x, m_y
    step = ring - grey[3]
    value, m_x, m_y = value + step * cap[0], m_x + step * cap[1], m_y + step * cap[2]
    if not upper:
        return value, m_x, m_y
    paper = _part(centre, f, i, j, 1)
    step = grey[0] - ring
    value, m_x, m_y = value + step * min(paper[0], cap[0]), m_x + step * paper[1], m_y + step * paper[2]
    dot = _part(centre, f, i, j, 2)
    step = grey[1] - grey[0]
    return value + step * min(dot[0], paper[0], cap[0]), m_x + step * dot[1], m_y + step * dot[2]


def prepare() -> None:
    """Compile what draws the disc, or load it."""
    cells, number, row, rows = types.float32[:, ::1], types.float64, types.float64[::1], types.float64[:, ::1]
    corner = types.UniTuple(types.int64, 2)
    draw_disc.compile((cells, cells, corner, RAYS, types.int64, number, rows, row, number, number,
                       row, rows, number, row))  # fmt: skip
