"""The disc in the cells of one camera's sensor: what the lens would draw of it without blur.

A pixel that no edge crosses is one value. A crossed pixel is cut into s x s cells, and in each the area of every
surface is found from signed distances (`areas`); the error is of third order in the cell's size. Compiled, because
cells are many: 20 ms for a disc that fills a third of 512 x 512 with s = 5.
"""

from __future__ import annotations

import numpy as np

from calibration.arrays import Array, Array32
from calibration.compiled import njit
from disctrack.render.areas import between, cell_part, deposit, plane_point, ray_in_body

_FAR = -1e3  # [m] signed distance of a ray that does not meet the plane ahead of the camera
_N_FIELDS = 11


@njit(cache=True, nogil=True)
def _disc_fields(
    rx: float, ry: float, R: Array, eye: Array, radius: float, h: float, cap: float, paper: Array, dots: Array,
    dot_radius: float, out: Array,
) -> None:  # fmt: skip
    """Signed distances [m] at one ray, positive inside.

    out: 0 the visible cap, 1 paper, 2 nearest dot, 3 the other cap, 4 side; 5 = 1 where the ray passes the axis between
    the caps; 6, 7 and 8, 9 the ray's foot in the cap's and in the other plane; 10 the number of the nearest dot.
    """
    dx, dy, dz = ray_in_body(R, rx, ry)
    x, y, ahead = plane_point(eye, dx, dy, dz, cap)
    out[6], out[7] = x, y
    out[0] = out[1] = out[2] = _FAR
    if ahead:
        out[0] = radius - np.sqrt(x * x + y * y)
        out[1] = paper[2] - np.sqrt((x - paper[0]) ** 2 + (y - paper[1]) ** 2)
        best = 1e6
        for k in range(dots.shape[0]):
            square = (x - dots[k, 0]) ** 2 + (y - dots[k, 1]) ** 2
            if square < best:
                best, out[10] = square, k
        out[2] = dot_radius - np.sqrt(best)
    x, y, ahead = plane_point(eye, dx, dy, dz, -cap)
    out[8], out[9] = x, y
    out[3] = radius - np.sqrt(x * x + y * y) if ahead else _FAR
    across = dx * dx + dy * dy
    out[4], out[5] = _FAR, 0.0
    if across > 1e-18:
        out[4] = radius - abs(eye[0] * dy - eye[1] * dx) / np.sqrt(across)
        z = eye[2] - (eye[0] * dx + eye[1] * dy) / across * dz
        out[5] = 1.0 if -h <= z <= h else 0.0


@njit(cache=True, nogil=True)
def _diagonal(a: Array, b: Array, c: Array, d: Array, k: int) -> float:
    """The longer diagonal of the quadrilateral of the feet (k, k + 1) at a pixel's corners, and a fifth for safety."""
    return 1.2 * max(
        np.sqrt((d[k] - a[k]) ** 2 + (d[k + 1] - a[k + 1]) ** 2),
        np.sqrt((c[k] - b[k]) ** 2 + (c[k + 1] - b[k + 1]) ** 2),
    )


@njit(cache=True, nogil=True)
def _uncut(a: float, b: float, c: float, d: float, slack: float) -> bool:
    """No edge passes between four corners of one sign, but for a bulge of less than `slack`."""
    low, high = min(min(a, b), min(c, d)), max(max(a, b), max(c, d))
    return low > slack or high < -slack


@njit(cache=True, nogil=True)
def _fill_circle(
    cells: Array32, y0: int, x0: int, s: int, weight: float, corners: tuple[Array, Array, Array, Array], R: Array,
    eye: Array, cap: float, circle: tuple[float, float, float], inner: float, outer: float, f: Array,
) -> None:  # fmt: skip
    """Add a pixel of the cap that only the circle (x, y, radius) crosses; f is (2, s + 1) of workspace."""
    for i in range(s + 1):
        f[0] = f[1]
        for j in range(s + 1):
            f[1, j] = _circle_distance(corners, i / s, j / s, R, eye, cap, circle)
        if i == 0:
            continue
        for j in range(s):
            middle = _circle_distance(corners, (i - 0.5) / s, (j + 0.5) / s, R, eye, cap, circle)
            area, m_x, m_y = cell_part(middle, f[0, j], f[0, j + 1], f[1, j], f[1, j + 1])
            step = weight * (inner - outer)
            deposit(cells, y0 + i - 1, x0 + j, weight * outer + step * area, step * m_x, step * m_y)


@njit(cache=True, nogil=True)
def _circle_distance(
    corners: tuple[Array, Array, Array, Array], p: float, q: float, R: Array, eye: Array, cap: float,
    circle: tuple[float, float, float],
) -> float:  # fmt: skip
    rx, ry = between(corners, p, q)
    dx, dy, dz = ray_in_body(R, rx, ry)
    t = (cap - eye[2]) / dz
    x, y = eye[0] + t * dx - circle[0], eye[1] + t * dy - circle[1]
    return circle[2] - np.sqrt(x * x + y * y)


@njit(cache=True, nogil=True)
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
    paper_circle = (paper[0], paper[1], paper[2])
    smallest = min(dot_radius, paper[2])
    line, f = np.empty((2, s + 1)), np.empty((s + 1, s + 1, _N_FIELDS))
    centre = np.empty(_N_FIELDS)
    shape = (R, eye, radius, h, cap, paper, dots, dot_radius)
    rows, columns = cells.shape[0] // s, cells.shape[1] // s
    edge = np.empty((2, columns + 1, _N_FIELDS))  # fields at the pixels' corners, upper and lower line
    for row in range(-1, rows):
        edge[0] = edge[1]
        for column in range(columns + 1):
            r = rays[corner[0] + row + 1, corner[1] + column]
            _disc_fields(r[0], r[1], *shape, edge[1, column])
        if row < 0:
            continue
        for column in range(columns):
            a, b, c, d = edge[0, column], edge[0, column + 1], edge[1, column], edge[1, column + 1]
            y0, x0 = row * s, column * s
            reach = _diagonal(a, b, c, d, 6)
            slack = reach * reach / (4.0 * smallest)  # twice the sagitta of an arc as long as the pixel's diagonal
            whole_cap = cap_visible and a[0] > 0.0 and _uncut(a[0], b[0], c[0], d[0], slack)
            if whole_cap:
                inside_paper, inside_dot = upper and a[1] > 0.0, upper and a[2] > 0.0
                no_paper_edge = not upper or _uncut(a[1], b[1], c[1], d[1], slack)
                no_dot_edge = not upper or _uncut(a[2], b[2], c[2], d[2], slack)
                if no_paper_edge and no_dot_edge:
                    value = weight * (grey[1] if inside_dot else (grey[0] if inside_paper else ring))
                    for i in range(s):
                        for j in range(s):
                            cells[y0 + i, x0 + j] += value
                    continue
            elif a[0] < 0.0 and _uncut(a[0], b[0], c[0], d[0], slack):
                far_slack = _diagonal(a, b, c, d, 8) ** 2 / (4.0 * smallest)
                between_caps = a[5] == b[5] == c[5] == d[5]
                if between_caps and _uncut(a[3], b[3], c[3], d[3], far_slack) and _uncut(a[4], b[4], c[4], d[4], 1e-6):
                    solid = a[3] > 0.0 or (a[4] > 0.0 and a[5] > 0.0)
                    for i in range(s):
                        for j in range(s):
                            cells[y0 + i, x0 + j] += weight * (side if solid else background[y0 + i, x0 + j])
                    continue
            v, u = corner[0] + row, corner[1] + column
            corners = (rays[v, u], rays[v, u + 1], rays[v + 1, u], rays[v + 1, u + 1])
            if whole_cap and (no_paper_edge or no_dot_edge):
                if no_dot_edge:
                    circle, inner, outer = paper_circle, grey[0], ring
                else:
                    k = int(a[10])
                    circle, inner, outer = (dots[k, 0], dots[k, 1], dot_radius), grey[1], grey[0]
                _fill_circle(cells, y0, x0, s, weight, corners, R, eye, cap, circle, inner, outer, line)
                continue
            for i in range(s + 1):
                for j in range(s + 1):
                    rx, ry = between(corners, i / s, j / s)
                    _disc_fields(rx, ry, *shape, f[i, j])
            for i in range(s):
                for j in range(s):
                    rx, ry = between(corners, (i + 0.5) / s, (j + 0.5) / s)
                    _disc_fields(rx, ry, *shape, centre)
                    value, m_x, m_y = _disc_cell(
                        centre, f[i, j], f[i, j + 1], f[i + 1, j], f[i + 1, j + 1],
                        background[y0 + i, x0 + j], grey, ring, upper, cap_visible,
                    )  # fmt: skip
                    deposit(cells, y0 + i, x0 + j, weight * value, weight * m_x, weight * m_y)


@njit(cache=True, nogil=True)
def _larger(first: tuple[float, float, float], second: tuple[float, float, float]) -> tuple[float, float, float]:
    return first if first[0] >= second[0] else second


@njit(cache=True, nogil=True)
def _disc_cell(
    centre: Array, a: Array, b: Array, c: Array, d: Array, back: float, grey: Array, ring: float, upper: bool,
    cap_visible: bool,
) -> tuple[float, float, float]:  # fmt: skip
    """Mean grey of one cell and its first moments from the fields at its centre and corners.

    Painted from behind: table, body, visible cap, paper, dot; each lies within the one before.
    """
    cap = cell_part(centre[0], a[0], b[0], c[0], d[0])
    body = _larger(cap, cell_part(centre[3], a[3], b[3], c[3], d[3]))
    if centre[5] > 0.0:
        body = _larger(body, cell_part(centre[4], a[4], b[4], c[4], d[4]))
    step = grey[3] - back
    value, m_x, m_y = back + step * body[0], step * body[1], step * body[2]
    if not cap_visible:
        return value, m_x, m_y
    step = ring - grey[3]
    value, m_x, m_y = value + step * cap[0], m_x + step * cap[1], m_y + step * cap[2]
    if not upper:
        return value, m_x, m_y
    paper = cell_part(centre[1], a[1], b[1], c[1], d[1])
    step = grey[0] - ring
    value, m_x, m_y = value + step * min(paper[0], cap[0]), m_x + step * paper[1], m_y + step * paper[2]
    dot = cell_part(centre[2], a[2], b[2], c[2], d[2])
    step = grey[1] - grey[0]
    return value + step * min(dot[0], paper[0], cap[0]), m_x + step * dot[1], m_y + step * dot[2]
