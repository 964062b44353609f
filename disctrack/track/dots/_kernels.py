"""Compiled inner loops of marker location and tracking (numba); their meaning is told in `dots` and `follow`.

They are compiled because a recording needs about 12 fits of 700 pixels per pair at the camera's own rate of 1000
pairs/s. What is done per pixel is written so that the compiler makes vector code of it: loops over rows of single
precision without a branch, in pixels as the unit of length (rounding moves a centre by less than 1e-6 px).

What compiling costs grows with every level of calls, for each level is optimised anew with all that it calls. So the
large functions are compiled apart, and given to those that call them (`compiled_for`); whole slices are not assigned
(the text of the error that numba prepares for unequal shapes takes longer to compile than the loop).
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike

from calibration.kit.arrays import Array
from calibration.kit.compiled import compiled_apart, njit
from disctrack.trajectory import MarkerStatus

# No NaN is ever tested inside the sums, so the fast floating-point rules change the last digit only.
_RULES: dict[str, Any] = {"error_model": "numpy", "fastmath": {"contract", "arcp", "nsz", "reassoc"}}
_entry = njit(cache=True, nogil=True, **_RULES)  # called from Python
# Called from compiled code, always inlined: of a function that is not, two copies may be optimised differently (its own
# and its caller's), and which of them runs would depend on whether the code was compiled now or loaded.
_part = njit(**_RULES | {"no_cpython_wrapper": True, "no_cfunc_wrapper": True, "forceinline": True})


class Cameras(NamedTuple):
    """The cameras of a rig, a camera a row."""

    parameters: Array  # (c, 9) INTRINSIC_PARAMETERS
    R: Array  # (c, 3, 3) R_camera_world
    t: Array  # (c, 3) t_camera_world [m]


class TemplateLimits(NamedTuple):
    """When a converged fit is refused."""

    misfit: float = 6.0  # rms residual over the pixel noise; speckle of real print reaches 3
    share: float = 0.02  # rms residual over the contrast: a misfit counts only if it exceeds this too
    clipped: float = 0.15  # part of the pixels that do not fit: an object in front of the dot
    radius: float = 0.20  # relative departure of the fitted radius
    blur: float = 3.0  # fitted blur, in typical blurs (plus 1 px): an image smeared beyond use


class Expected(NamedTuple):
    """What is known of the dots, and of each camera's images of them."""

    centres: Array  # (m, 3) in body axes [m]
    radius: float  # of a dot [m]
    rim: float  # about the dots' origin [m]: no blur of an edge as wide may reach the pixels used
    blur: Array  # (c,) sigma of an edge [px]
    noise: Array  # (c, 3): variance = [0] + [1] grey, and the square of the grey values' step
    limits: TemplateLimits


class Heading(NamedTuple):
    """The last three poses, the latest first, from which the next is predicted (`_predict`)."""

    R: Array  # (3, 3, 3)
    t: Array  # (3, 3) [m]


# A dot as it was found. Beside the status, nothing holds unless a fit has converged.
DOT = np.dtype(
    [(name, float) for name in ("u", "v", "var_u", "var_v", "cov_uv", "misfit", "blur", "radius", "level", "contrast",
                                "clipped", "n_pixels")]
    + [("status", np.uint8)], align=True,
)  # fmt: skip


class _Template(NamedTuple):
    """What is fitted to a dot, in the order of the normal equations."""

    a: float  # shift on the plane from the expected centre
    b: float
    radius: float
    blur: float
    level: float
    slope_x: float
    slope_y: float
    contrast: float


class _Map(NamedTuple):
    """The map pixel -> plane near a pixel."""

    xu: float  # d plane / d pixel
    xv: float
    yu: float
    yv: float
    # relative change, per 10 px, of the length that a pixel spans along the direction moved: -2 d log w, w the
    # denominator of the projective map
    near_u: float
    near_v: float
    det: float
    steepest: float  # longest step that one pixel can mean


class _Ellipse(NamedTuple):
    """What the blurred image of a dot is built from."""

    u: float  # centre from that of the window [px]
    v: float
    ux: float  # plane -> pixel
    uy: float
    vx: float
    vy: float
    along_x: float  # unit vector of the long axis in the image
    along_y: float
    long: float  # semi-axes over the radius
    short: float


class Work(NamedTuple):
    """Working memory of one thread."""

    pixels: Array  # (_PIXEL_ROWS, k)
    matrix: Array  # (8, 8) of the normal equations
    right: Array  # (8,)
    step: Array  # (8,)
    told: Array  # (2,) what a function that is compiled apart tells beside a number


# Rows of what is kept of every pixel: place on the plane from the expected centre [px], place in the image from there
# [10 px], grey value, distance from the edge; derivatives by the template's eight numbers and residual, over the
# pixel's sigma; weight, one over that. The rows of the derivatives also hold the pixels that are to be chosen from.
_X, _Y, _OFFSET_X, _OFFSET_Y, _GREY, _DISTANCE, _JACOBIAN = range(7)
_RESIDUAL, _WEIGHT, _PIXEL_ROWS = range(_JACOBIAN + 8, _JACOBIAN + 11)
# Pixels of a dot of 60 px; more are made room for. No power of two: rows would fall on one another's cache
_PIXELS = 4096 + 64
_MAX_SELECTIONS = 4
_MAX_ITERATIONS = 20
_CONVERGED_PX = 2e-4  # length of the step that would come next: a twentieth of the noise of the best dots
# The pixels are chosen anew where the centre moved farther: a band that lies unevenly about the edge, by 0.25 to 0.7
# px, shifts it by 3e-4 to 5e-4 px (dots declared off their places: in all frames alike)
_SETTLED_PX = 0.2
_CLIP_SIGMA = 5.0
# Semi-minor axis in blurs, or in pixels: below, the two long edges melt into one another and what one edge looks like
# errs by more than the centre's sigma; the whole blurred ellipse is the template then, 10 to 20 times as slow.
_MIN_SEMI_MINOR = 4.5
_LEAST_SEMI_MINOR = 1.0  # below even that one fails: nothing but a blot is left
_RADIUS_PRIOR = 0.1  # relative standard deviation: a blot's size, darkness and blur cannot be told apart
_NODES = 64  # at most, over the length of an ellipse
# [rad] farther from the expected attitude a pair is looked at once more: 3e-3 move centres by 4e-4 to 1e-3 px, in every
# frame alike where the prediction lags
_ATTITUDE_TOLERANCE = 6e-4

# numba takes a literal for double precision, and with it all that it touches
_f = np.float32
_0, _1, _2, _HALF, _TINY = _f(0), _f(1), _f(2), _f(0.5), _f(1e-15)
_LEAST_BEND = _f(-0.3)
_INV_SQRT_2PI = _f(1.0 / math.sqrt(2.0 * math.pi))
# Abramowitz & Stegun 7.1.26: erfc(x) = (a1 t + ... + a5 t^5) exp(-x^2), t = 1 / (1 + p x), to 1.5e-7
_T = _f(0.3275911 / math.sqrt(2.0))
_ERFC = tuple(_f(0.5 * a) for a in (0.254829592, -0.284496736, 1.421413741, -1.453152027, 1.061405429))
# exp(-z^2 / 2) = e^16, e = exp(-z^2 / 32) a polynomial: 6e-8 for |z| < 6
_Z2_MAX, _PER_Z2 = _f(36.0), _f(1.0 / 32.0)
_EXP = tuple(
    _f(c)
    for c in np.polynomial.Chebyshev.interpolate(lambda t: np.exp(-t), 6, domain=[0.0, 36.0 / 32.0])
    .convert(kind=np.polynomial.Polynomial)
    .coef
)


@_part
def _project_point(camera, X, Y, Z):
    """Pixel (u, v) of one point in camera axes; camera = the nine INTRINSIC_PARAMETERS. Twin of camera.project."""
    a, b = X / Z, Y / Z
    r2 = a * a + b * b
    radial = 1.0 + r2 * (camera[4] + r2 * (camera[5] + r2 * camera[8]))
    xd = a * radial + 2 * camera[6] * a * b + camera[7] * (r2 + 2 * a * a)
    yd = b * radial + camera[6] * (r2 + 2 * b * b) + 2 * camera[7] * a * b
    return camera[0] * xd + camera[2], camera[1] * yd + camera[3]


@_part
def _project_point_jacobian(camera, X, Y, Z, J):
    """Pixel of one point in camera axes and J (2, 3) = d pixel / d point."""
    iz = 1.0 / Z
    a, b = X * iz, Y * iz
    r2 = a * a + b * b
    radial = 1.0 + r2 * (camera[4] + r2 * (camera[5] + r2 * camera[8]))
    slope = camera[4] + r2 * (2 * camera[5] + 3 * camera[8] * r2)
    p1, p2 = camera[6], camera[7]
    xd = a * radial + 2 * p1 * a * b + p2 * (r2 + 2 * a * a)
    yd = b * radial + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b
    xd_a = radial + 2 * a * a * slope + 2 * p1 * b + 6 * p2 * a
    xd_b = 2 * a * b * slope + 2 * p1 * a + 2 * p2 * b
    yd_b = radial + 2 * b * b * slope + 6 * p1 * b + 2 * p2 * a
    J[0, 0], J[0, 1], J[0, 2] = camera[0] * xd_a * iz, camera[0] * xd_b * iz, -camera[0] * (xd_a * a + xd_b * b) * iz
    J[1, 0], J[1, 1], J[1, 2] = camera[1] * xd_b * iz, camera[1] * yd_b * iz, -camera[1] * (xd_b * a + yd_b * b) * iz
    return camera[0] * xd + camera[2], camera[1] * yd + camera[3]


@_part
def _turned(R, x, y, z):
    """The vector (x, y, z) in the other axes."""
    return (
        R[0, 0] * x + R[0, 1] * y + R[0, 2] * z,
        R[1, 0] * x + R[1, 1] * y + R[1, 2] * z,
        R[2, 0] * x + R[2, 1] * y + R[2, 2] * z,
    )


@_part
def _times(A, B, out):
    """A B of matrices (3, 3)."""
    for i in range(3):
        for j in range(3):
            out[i, j] = A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j]


@_part
def _times_transposed(A, B, out):
    """A B^T."""
    for i in range(3):
        for j in range(3):
            out[i, j] = A[i, 0] * B[j, 0] + A[i, 1] * B[j, 1] + A[i, 2] * B[j, 2]


@_part
def _copy(out, values):
    """Copy a matrix."""
    for i in range(values.shape[0]):
        for j in range(values.shape[1]):
            out[i, j] = values[i, j]


@_part
def _substitute(L, x):
    """Replace x by the solution of L L^T x = x for a Cholesky factor L (lower triangle)."""
    n = L.shape[0]
    for i in range(n):
        s = x[i]
        for k in range(i):
            s -= L[i, k] * x[k]
        x[i] = s / L[i, i]
    for i in range(n - 1, -1, -1):
        s = x[i]
        for k in range(i + 1, n):
            s -= L[k, i] * x[k]
        x[i] = s / L[i, i]


@_part
def _solve_in_place(M, x):
    """Solve the symmetric positive definite M x = x by Cholesky; False where M (lower triangle) is not so."""
    for i in range(M.shape[0]):
        for j in range(i + 1):
            s = M[i, j]
            for k in range(j):
                s -= M[i, k] * M[j, k]
            if i == j:
                if not s > 0.0:
                    return False
                M[i, i] = math.sqrt(s)
            else:
                M[i, j] = s / M[j, j]
    _substitute(M, x)
    return True


@_part
def _on_plane(map_x, map_y, P, iu, iv):
    """The point of the plane that the pixel (iu, iv) shows, and the denominator of the map there."""
    x, y, w = _turned(P, map_x[iv, iu], map_y[iv, iu], 1.0)
    return x / w, y / w, w


@_part
def _map_near(map_x, map_y, P, iu, iv, unit):
    """Derivatives of the exact map by central differences, in `unit`s of the plane."""
    _, _, w = _on_plane(map_x, map_y, P, iu, iv)
    x0, y0, w0 = _on_plane(map_x, map_y, P, iu - 1, iv)
    x1, y1, w1 = _on_plane(map_x, map_y, P, iu + 1, iv)
    x2, y2, w2 = _on_plane(map_x, map_y, P, iu, iv - 1)
    x3, y3, w3 = _on_plane(map_x, map_y, P, iu, iv + 1)
    half = 0.5 / unit
    xu, xv, yu, yv = half * (x1 - x0), half * (x3 - x2), half * (y1 - y0), half * (y3 - y2)
    det, norm2 = xu * yv - xv * yu, xu * xu + xv * xv + yu * yu + yv * yv
    steepest = math.sqrt(0.5 * (norm2 + math.sqrt(max(norm2 * norm2 - 4 * det * det, 0.0))))
    return _Map(xu, xv, yu, yv, 10.0 * (w1 - w0) / w, 10.0 * (w3 - w2) / w, det, steepest)


@_part
def _edge_distance(dx, dy, radius, xu, xv, yu, yv, det2):
    """Signed distance [px] of a pixel from the dot's edge (positive outside), with what its derivatives need.

    rho = |(dx, dy)| on the plane, F = rho - radius, g = |grad_u F|. To second order the foot point lies at
    d = F/g (1 + t), t = h F/(2 g^2); inside, 1/(1 - t) has the same order and keeps its sign in slender ellipses.
    Returns d, dd/drho, the unit radius (nx, ny), 1/g and the curvature of the level line in the image, det^2/(rho g^3).
    """
    inv_rho = _1 / (math.sqrt(dx * dx + dy * dy) + _TINY)
    rho = (dx * dx + dy * dy) * inv_rho
    nx, ny = dx * inv_rho, dy * inv_rho
    gx, gy = xu * nx + yu * ny, xv * nx + yv * ny
    inv_g2 = _1 / (gx * gx + gy * gy)
    inv_g = math.sqrt(inv_g2)
    # h = (m . G ghat)^2 / rho with m perpendicular to n
    along = nx * (yu * gx + yv * gy) - ny * (xu * gx + xv * gy)
    F = rho - radius
    bend = _HALF * along * along * F * inv_rho * inv_g2 * inv_g2
    curvature = det2 * inv_rho * inv_g2 * inv_g
    shrink = _1 / (_1 - max(bend, _LEAST_BEND))  # the expansion ends well before the dot's own centre, where rho = 0
    outside = rho > radius
    factor = _1 + bend if outside else shrink
    slope = _1 + _2 * bend if outside else shrink * shrink
    return F * inv_g * factor, inv_g * slope, nx, ny, inv_g, curvature


@_part
def _edge_profile(z):
    """Fraction of the dot seen z sigmas outside its edge, and the bell that is minus its slope; both to 5e-7."""
    E, A = _EXP, _ERFC
    z2 = min(z * z, _Z2_MAX)
    e = z2 * _PER_Z2
    e = E[0] + e * (E[1] + e * (E[2] + e * (E[3] + e * (E[4] + e * (E[5] + e * E[6])))))
    e *= e
    e *= e
    e *= e
    e *= e
    t = _1 / (_1 + _T * abs(z))
    tail = t * (A[0] + t * (A[1] + t * (A[2] + t * (A[3] + t * A[4])))) * e
    return tail if z > _0 else _1 - tail, _INV_SQRT_2PI * e


@_part
def _conic(g, longest, shortest):
    """The form (xx, xy, yy), 1 on the ellipse of these semi-axes along those of the map."""
    xx, xy, yy = g.xu * g.xu + g.yu * g.yu, g.xu * g.xv + g.yu * g.yv, g.xv * g.xv + g.yv * g.yv
    steepest2 = g.steepest * g.steepest
    apart = steepest2 - g.det * g.det / steepest2
    along, across = 1.0 / (longest * longest), 1.0 / (shortest * shortest)
    slope = (across - along) / apart if apart > 1e-9 * steepest2 else 0.0
    level = across - slope * steepest2
    return slope * xx + level, slope * xy, slope * yy + level


def _select(image, map_x, map_y, P, start, window, rim, neighbours, g, unit, p, u0, v0, work):
    """Fill the first rows of pixels with those in a band round the edge; returns their number.

    unit: plane units per pixel. work.told receives the mean grey values in and outside.
    """
    left, right, top, bottom = window
    start_x, start_y, start_radius, _, _ = start
    pixels = work.pixels
    candidates = pixels[_JACOBIAN:]
    band = 3.0 * p.blur + 1.0
    # Of each row the pixels between two ellipses, longer and shorter by the band than the dot's own, by the linear map:
    # its scale changes over the window, and a pixel is one more in doubt. In the ring of both nothing is decided by
    # branches, so that it is vector code.
    doubt = 0.05 * math.hypot(right - left, bottom - top) * math.hypot(g.near_u, g.near_v)
    longest, shortest = p.radius * g.steepest / abs(g.det), p.radius / g.steepest
    more, less = band + 1.0, band + 2.0
    rim_xx, rim_xy, rim_yy = _conic(g, longest * (1.0 + doubt) + more, shortest * (1.0 + doubt) + more)
    hole_xx, hole_xy, hole_yy = _conic(
        g, max(longest * (1.0 - doubt) - less, 0.1), max(shortest * (1.0 - doubt) - less, 0.1)
    )
    x_from, y_from = start_x / unit, start_y / unit
    X0, X1, X2, Y0, Y1, Y2 = P[0, 0], P[0, 1], P[0, 2], P[1, 0], P[1, 1], P[1, 2]
    w0, w1, w2 = unit * P[2, 0], unit * P[2, 1], unit * P[2, 2]
    n = 0
    for y in range(top, bottom + 1):
        dy = y - v0
        reach2 = (rim_xy * rim_xy - rim_xx * rim_yy) * dy * dy + rim_xx
        hole2 = (hole_xy * hole_xy - hole_xx * hole_yy) * dy * dy + hole_xx
        if reach2 < 0.0:
            continue
        middle, hole_middle = u0 - rim_xy / rim_xx * dy, u0 - hole_xy / hole_xx * dy
        reach, hole = math.sqrt(reach2) / rim_xx, math.sqrt(max(hole2, 0.0)) / hole_xx
        first, end = max(int(math.ceil(middle - reach)), left), min(int(middle + reach) + 1, right + 1)
        hole_from = min(int(math.ceil(hole_middle - hole)), end) if hole2 > 0.0 else end
        hole_to = max(int(hole_middle + hole) + 1, first) if hole2 > 0.0 else end
        for part in range(2):
            lo, hi = (first, hole_from) if part == 0 else (hole_to, end)
            if lo >= hi:
                continue
            # views, for an index that is a sum might be negative, and is looked at one by one
            xs, ys, greys = map_x[y, lo:hi], map_y[y, lo:hi], image[y, lo:hi]
            X_row, Y_row, x_row = candidates[0, n:], candidates[1, n:], candidates[2, n:]
            y_row, grey_row = candidates[3, n:], candidates[4, n:]
            for k in range(hi - lo):  # one loop, of few pixels at a time: there are some ten
                w = 1.0 / (w0 * xs[k] + w1 * ys[k] + w2)
                X_row[k] = (X0 * xs[k] + X1 * ys[k] + X2) * w - x_from
                Y_row[k] = (Y0 * xs[k] + Y1 * ys[k] + Y2) * w - y_from
                x_row[k], y_row[k], grey_row[k] = 0.1 * (lo + k - u0), 0.1 * dy, greys[k]
            n += hi - lo
    # which of the dot's surroundings can come near any pixel at all
    reach = unit * (p.radius + band * g.steepest + math.hypot(p.a, p.b))
    blur = p.blur * g.steepest * unit
    crowded = math.hypot(start_x, start_y) + reach > rim - 2.5 * blur
    for j in range(neighbours.shape[0]):
        apart = math.hypot(start_x - neighbours[j, 0], start_y - neighbours[j, 1])
        crowded |= apart - reach - start_radius < 3.0 * blur
    xu, xv, yu, yv = _f(g.xu), _f(g.xv), _f(g.yu), _f(g.yv)
    shift_x, shift_y, radius = _f(p.a), _f(p.b), _f(p.radius)
    for i in range(n):
        d, _, _, _, inv_g, _ = _edge_distance(
            candidates[0, i] - shift_x, candidates[1, i] - shift_y, radius, xu, xv, yu, yv, _0
        )
        candidates[5, i], candidates[6, i] = d, inv_g
    kept, nearest, farthest = 0, _f(-band - 1.0), _f(band)
    for i in range(n):
        d = candidates[5, i]
        good = nearest < d < farthest  # not so for NaN either: a pixel without a ray
        if crowded and good:
            X, Y = start_x + unit * candidates[0, i], start_y + unit * candidates[1, i]
            blur = p.blur * unit / candidates[6, i]
            good = math.hypot(X, Y) <= rim - 2.5 * blur
            for j in range(neighbours.shape[0]):
                good &= math.hypot(X - neighbours[j, 0], Y - neighbours[j, 1]) - start_radius >= 3.0 * blur
        for row in range(_JACOBIAN):
            pixels[row, kept] = candidates[row, i]
        kept += 1 if good else 0
    inside_sum, inside_n, outside_sum, outside_n = 0.0, 0.0, 0.0, 0.0
    well_inside, well_outside = _f(-min(1.2 * p.blur, 0.4 * p.radius / g.steepest)), _f(1.2 * p.blur)
    for i in range(kept):
        d, grey = pixels[_DISTANCE, i], pixels[_GREY, i]
        is_in, is_out = _1 if d < well_inside else _0, _1 if d > well_outside else _0
        inside_n += is_in
        outside_n += is_out
        inside_sum += is_in * grey
        outside_sum += is_out * grey
    work.told[0] = inside_sum / inside_n if inside_n >= 3 else np.nan
    work.told[1] = outside_sum / outside_n if outside_n >= 8 else np.nan
    return float(kept)


def _whiten(work, n, p, g, ellipse, blurred, clip):
    """Fill the pixels' rows of d model / d p and of the residual, each over the pixel's sigma; returns chi-square.

    By the edge, or `blurred` by the whole ellipse. Pixels whose squared whitened residual exceeds clip get zeros, and
    count as clip; work.told[0] receives their number.
    """
    if blurred:
        chi2, n_clipped = _whitened_ellipse(work.pixels, n, p, ellipse, clip)
    else:
        chi2, n_clipped = _whitened_edge(work.pixels, n, p, g, clip)
    work.told[0] = n_clipped
    return float(chi2)


@_part
def _whitened_edge(pixels, n, p, g, clip):
    """The model (level + slopes . offset) * (1 - contrast * S(z)), S the blurred edge: erfc of the distance over sigma.

    Returns chi-square and the number of clipped pixels.
    """
    xu, xv, yu, yv, det2 = _f(g.xu), _f(g.xv), _f(g.yu), _f(g.yv), _f(g.det * g.det)
    near_x, near_y = _f(g.near_u), _f(g.near_v)
    a, b, radius, contrast = _f(p.a), _f(p.b), _f(p.radius), _f(p.contrast)
    inv_sigma, sigma, half_sigma = _f(1.0 / p.blur), _f(p.blur), _f(0.5 * p.blur)
    level, slope_x, slope_y, limit = _f(p.level), _f(p.slope_x), _f(p.slope_y), _f(clip)
    half_step = _f(0.05)
    jacobian = pixels[_JACOBIAN:]
    chi2, n_clipped = _0, _0
    for i in range(n):
        x, y = pixels[_OFFSET_X, i], pixels[_OFFSET_Y, i]
        d, slope, nx, ny, inv_g, curvature = _edge_distance(
            pixels[_X, i] - a, pixels[_Y, i] - b, radius, xu, xv, yu, yv, det2
        )
        # the gradient was taken at the dot's centre: perspective changes the scale over the dot, and what counts is the
        # scale half way between the pixel and the edge (at the pixel itself it would shift centres by 5e-4 px)
        half = half_step * d * inv_g
        mid_x, mid_y = x - half * (xu * nx + yu * ny), y - half * (xv * nx + yv * ny)
        d *= _1 + near_x * mid_x + near_y * mid_y
        # a curved edge blurred by sigma looks shifted inwards by sigma^2 / (2 radius of curvature)
        z = d * inv_sigma + half_sigma * curvature
        s, bell = _edge_profile(z)
        light = level + slope_x * x + slope_y * y
        weight = pixels[_WEIGHT, i]
        r = weight * (pixels[_GREY, i] - light * (_1 - contrast * s))
        squared = r * r
        fits = _1 if squared <= limit else _0
        chi2 += min(squared, limit)
        n_clipped += _1 - fits
        weight *= fits
        seen = (_1 - contrast * s) * weight
        edge = -light * contrast * bell * inv_sigma * weight  # - d model / d distance
        jacobian[0, i], jacobian[1, i], jacobian[2, i] = edge * nx * slope, edge * ny * slope, edge * slope
        jacobian[3, i] = edge * (z - curvature * sigma)
        jacobian[4, i], jacobian[5, i], jacobian[6, i] = seen, seen * x, seen * y
        jacobian[7, i] = -light * s * weight
        pixels[_RESIDUAL, i] = r * fits
    return chi2, n_clipped


@_part
def _ellipse_of(map_x, map_y, P, g, u, v, radius, reach, u0, v0, unit):
    """The image of a dot as an ellipse about its own centroid, to second order of the map.

    reach: pixels over which the map's second derivatives are taken.
    """
    iu, iv = int(u0 + 0.5), int(v0 + 0.5)
    ux, uy, vx, vy = g.yv / g.det, -g.xv / g.det, -g.yu / g.det, g.xu / g.det
    c_uu, c_uv, c_vv = ux * ux + uy * uy, ux * vx + uy * vy, vx * vx + vy * vy
    half_sum, half_difference = 0.5 * (c_uu + c_vv), 0.5 * (c_uu - c_vv)
    angle = 0.5 * math.atan2(c_uv, half_difference)
    longer = math.sqrt(half_sum + math.hypot(half_difference, c_uv))
    # second derivatives of pixel -> plane, in the pixel's own frame: q = - G^-1 d2 plane
    uu_x, uu_y, vv_x, vv_y, uv_x, uv_y = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for du in range(-1, 2):
        for dv in range(-1, 2):
            a, b, _ = _on_plane(map_x, map_y, P, iu + reach * du, iv + reach * dv)
            uu = (1.0 if du != 0 else -2.0) if dv == 0 else 0.0
            vv = (1.0 if dv != 0 else -2.0) if du == 0 else 0.0
            uv = 0.25 * du * dv
            uu_x, uu_y, vv_x, vv_y = uu_x + uu * a, uu_y + uu * b, vv_x + vv * a, vv_y + vv * b
            uv_x, uv_y = uv_x + uv * a, uv_y + uv * b
    scale = -1.0 / (reach * reach * unit)
    s_uu, t_uu = scale * (ux * uu_x + uy * uu_y), scale * (vx * uu_x + vy * uu_y)
    s_vv, t_vv = scale * (ux * vv_x + uy * vv_y), scale * (vx * vv_x + vy * vv_y)
    s_uv, t_uv = scale * (ux * uv_x + uy * uv_y), scale * (vx * uv_x + vy * uv_y)
    # the dot's points x = x0 + s(x0): their mean is <s> + <x0 div s>, with the ellipse's second moments r^2 c / 4
    quarter = 0.25 * radius * radius
    div_u, div_v = s_uu + t_uv, s_uv + t_vv
    shift_u = quarter * (0.5 * (s_uu * c_uu + s_vv * c_vv) + s_uv * c_uv + c_uu * div_u + c_uv * div_v)
    shift_v = quarter * (0.5 * (t_uu * c_uu + t_vv * c_vv) + t_uv * c_uv + c_uv * div_u + c_vv * div_v)
    return _Ellipse(
        u - u0 + shift_u, v - v0 + shift_v, ux, uy, vx, vy, math.cos(angle), math.sin(angle), longer,
        1.0 / (abs(g.det) * longer),
    )  # fmt: skip


@_part
def _whitened_ellipse(pixels, n, p, e, clip):
    """As `_whitened_edge` by the integral of the Gaussian over the whole ellipse.

    Along the long axis x = a sin t, where the trapezoidal rule converges exponentially; across it the error function.
    """
    nodes = np.empty((3, _NODES), np.float32)
    in_sigma = 1.0 / p.blur
    a, b = p.radius * e.long * in_sigma, p.radius * e.short * in_sigma
    n_nodes = min(int(3.2 * a) + 8, _NODES)
    every = math.pi / n_nodes
    for k in range(n_nodes):
        t = (k + 0.5) * every - 0.5 * math.pi
        nodes[0, k], nodes[1, k], nodes[2, k] = a * math.sin(t), b * math.cos(t), a * every * math.cos(t)
    round_edge = _f(a * b * every)
    from_x, from_y = _f(e.u + e.ux * p.a + e.uy * p.b), _f(e.v + e.vx * p.a + e.vy * p.b)
    along_x, along_y = _f(e.along_x * in_sigma), _f(e.along_y * in_sigma)
    A_along = _f(in_sigma * (e.along_x * e.ux + e.along_y * e.vx))
    A_across = _f(in_sigma * (e.along_x * e.vx - e.along_y * e.ux))
    B_along = _f(in_sigma * (e.along_x * e.uy + e.along_y * e.vy))
    B_across = _f(in_sigma * (e.along_x * e.vy - e.along_y * e.uy))
    inv_radius, inv_sigma, ten = _f(1.0 / p.radius), _f(in_sigma), _f(10.0)
    contrast, level, slope_x, slope_y = _f(p.contrast), _f(p.level), _f(p.slope_x), _f(p.slope_y)
    limit = _f(clip)
    jacobian = pixels[_JACOBIAN:]
    chi2, n_clipped = _0, _0
    for i in range(n):
        x, y = pixels[_OFFSET_X, i], pixels[_OFFSET_Y, i]
        from_u, from_v = ten * x - from_x, ten * y - from_y
        along, across = along_x * from_u + along_y * from_v, along_x * from_v - along_y * from_u
        covered, d_along, d_across, edge = _0, _0, _0, _0
        for k in range(n_nodes):
            beside = along - nodes[0, k]
            if beside * beside > _Z2_MAX:
                continue
            _, bell = _edge_profile(beside)
            above, bell_above = _edge_profile(-across - nodes[1, k])
            below, bell_below = _edge_profile(nodes[1, k] - across)
            column = nodes[2, k] * bell
            covered += column * (above - below)
            d_along -= beside * column * (above - below)
            d_across += column * (bell_above - bell_below)
            edge += bell * (bell_above + bell_below)
        edge *= round_edge
        light = level + slope_x * x + slope_y * y
        weight = pixels[_WEIGHT, i]
        r = weight * (pixels[_GREY, i] - light * (_1 - contrast * covered))
        squared = r * r
        fits = _1 if squared <= limit else _0
        chi2 += min(squared, limit)
        n_clipped += _1 - fits
        weight *= fits
        seen = (_1 - contrast * covered) * weight
        dark = light * contrast * weight
        jacobian[0, i] = dark * (d_along * A_along + d_across * A_across)
        jacobian[1, i] = dark * (d_along * B_along + d_across * B_across)
        jacobian[2, i] = -dark * edge * inv_radius
        jacobian[3, i] = dark * (along * d_along + across * d_across + edge) * inv_sigma
        jacobian[4, i], jacobian[5, i], jacobian[6, i] = seen, seen * x, seen * y
        jacobian[7, i] = -light * covered * weight
        pixels[_RESIDUAL, i] = r * fits
    return chi2, n_clipped


@_part
def _normal_equations(pixels, n, matrix, right):
    """Fill matrix (8, 8), lower triangle, and right (8,) with the sums over n pixels."""
    for j in range(0, 8, 2):  # two by two: what is loaded serves twice
        row, next_row = pixels[_JACOBIAN + j], pixels[_JACOBIAN + j + 1]
        for k in range(0, j + 1, 2):
            column, next_column = pixels[_JACOBIAN + k], pixels[_JACOBIAN + k + 1]
            a, b, c, d = _0, _0, _0, _0
            for i in range(n):
                a += row[i] * column[i]
                b += row[i] * next_column[i]
                c += next_row[i] * column[i]
                d += next_row[i] * next_column[i]
            matrix[j, k], matrix[j, k + 1], matrix[j + 1, k], matrix[j + 1, k + 1] = a, b, c, d
        residual = pixels[_RESIDUAL]
        a, b = _0, _0
        for i in range(n):
            a += row[i] * residual[i]
            b += next_row[i] * residual[i]
        right[j], right[j + 1] = a, b


@_part
def _descend(whiten, work, n, p, g, ellipse, radius, blurred, clip):
    """Levenberg-Marquardt on the template; returns converged, the template, chi-square and the clipped pixels.

    blurred: take the whole ellipse, with the expected radius as a prior, and not one edge at a time.
    On convergence work.matrix holds the Cholesky factor of J^T W J at the minimum.
    """
    matrix, right, step = work.matrix, work.right, work.step
    px_per_unit, prior = g.steepest / abs(g.det), 1.0 / (_RADIUS_PRIOR * radius) ** 2 if blurred else 0.0
    damping, last, rejected, converged = 1e-7, np.inf, False, False
    before = np.inf  # length of the last step: the ratio of two tells how fast the iteration contracts
    previous, n_clipped = p, 0.0
    for _ in range(_MAX_ITERATIONS + 1):
        chi2 = whiten(work, n, p, g, ellipse, blurred, clip) + prior * (p.radius - radius) ** 2
        n_clipped = work.told[0]
        if converged:
            return True, p, chi2, n_clipped
        # the Jacobian leaves out how the curvature moves, so chi-square may creep by a trifle at the minimum
        if chi2 > 1.001 * last + 0.01 and not rejected:
            p = previous
            damping, rejected = max(1e-2, damping * 30.0), True
            if damping > 1e6:
                break
            continue
        if not rejected:
            damping = max(0.03 * damping, 1e-9)
        last, rejected = chi2, False
        _normal_equations(work.pixels, n, matrix, right)
        matrix[2, 2] += prior
        right[2] += prior * (radius - p.radius)
        for i in range(8):
            step[i] = right[i]
            matrix[i, i] *= 1.0 + damping
        if not _solve_in_place(matrix, step):
            break
        length = math.hypot(step[0], step[1])
        scale = min(1.0, 0.4 * radius / max(length, 1e-30))
        gain = 0.0
        for i in range(8):
            gain += step[i] * right[i]
            step[i] *= scale
        previous = p
        blur = min(max(p.blur + step[3], 0.4 * p.blur, 0.2), 2.0 * p.blur)
        p = _Template(
            p.a + step[0], p.b + step[1], p.radius + step[2], blur, p.level + step[4], p.slope_x + step[5],
            p.slope_y + step[6], p.contrast + step[7],
        )  # fmt: skip
        if not (0.5 * radius < p.radius < 1.6 * radius and p.blur < 20.0):
            break
        length *= px_per_unit
        contraction = min(length / before, 1.0) if before < np.inf else 1.0
        if length * contraction < _CONVERGED_PX and damping < 1e-3 and length < 0.1:
            if gain <= 0.5:
                return True, p, chi2, n_clipped
            converged = True  # but the sums were taken before a step that mattered to them
        before = length
    return False, p, last, 0.0


@_part
def _weigh(pixels, n, p, noise, light):
    """Grey values in the unit of `light`, and one over the sigma of each."""
    dark = p.level * (1.0 - p.contrast)
    read, gain, floor = _f(noise[0] / (light * light)), _f(noise[1] / light), _f(noise[2] / (12.0 * light * light))
    level, step, inv_sigma, in_light = _f(p.level), _f(dark - p.level), _f(1.0 / p.blur), 1.0 / light
    distance, weight, grey = pixels[_DISTANCE], pixels[_WEIGHT], pixels[_GREY]
    for i in range(n):
        # weights from the expected grey value: the noisy one would pull the fit towards dark pixels
        s, _ = _edge_profile(distance[i] * inv_sigma)
        weight[i] = _1 / math.sqrt(max(read + gain * (level + step * s), floor))
    for i in range(n):
        grey[i] *= in_light  # a product in double precision, rounded once


def _fit_dot(select, whiten, image, map_x, map_y, P, start, blur, noise, rim, neighbours, work, dot):
    """Fit the image of one circular dot to the grey values round its edge; fills `dot`, whose status tells of success.

    image (H, W); map_x, map_y (H, W): normalised coordinates of every pixel; P (3, 3): normalised image -> plane of the
    dot; start: x, y and radius on the plane, u, v in the image, as expected; blur: to start from [px]; noise (3,): see
    `Expected`; rim: radius of an edge about the plane's origin whose blur must not reach the pixels used, nor that of
    `neighbours` (k, 2), the other dots' centres. u and v of the dot are those of its centre on the plane: the caller
    projects it.
    """
    height, width = image.shape
    start_x, start_y, expected_radius, start_u, start_v = start
    u0, v0, unit = start_u, start_v, 1.0
    p = _Template(0.0, 0.0, expected_radius, blur, 1.0, 0.0, 0.0, 0.0)
    g = _Map(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    ellipse = _Ellipse(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    n, n_clipped, chi2, light, radius, settled = 0, 0.0, 0.0, 1.0, expected_radius, False
    for selection in range(_MAX_SELECTIONS):
        dot.status = MarkerStatus.OUTSIDE
        if not (2.0 < u0 < width - 3.0 and 2.0 < v0 < height - 3.0):
            return 0.0
        g = _map_near(map_x, map_y, P, int(u0 + 0.5), int(v0 + 0.5), unit)
        if selection == 0 and g.det != 0.0:
            unit = math.sqrt(abs(g.det))
            radius /= unit
            g = _map_near(map_x, map_y, P, int(u0 + 0.5), int(v0 + 0.5), unit)
            p = _Template(0.0, 0.0, radius, blur, 1.0, 0.0, 0.0, 0.0)
        shortest = radius / g.steepest
        if not abs(g.det) > 1e-9 * g.steepest**2 or shortest < _LEAST_SEMI_MINOR * max(p.blur, 1.0):
            dot.status = MarkerStatus.BLURRED
            return 0.0
        blurred = shortest < _MIN_SEMI_MINOR * max(p.blur, 1.0)
        band = 3.0 * p.blur + 1.0
        extent_x = radius * math.hypot(g.xv, g.yv) / abs(g.det) + band
        extent_y = radius * math.hypot(g.xu, g.yu) / abs(g.det) + band
        left, right = int(math.floor(u0 - extent_x)), int(math.ceil(u0 + extent_x))
        top, bottom = int(math.floor(v0 - extent_y)), int(math.ceil(v0 + extent_y))
        if left < 1 or top < 1 or right > width - 2 or bottom > height - 2:
            return 0.0
        room = (right - left + 1) * (bottom - top + 1) + 1
        if room > work.pixels.shape[1]:
            more = np.empty((_PIXEL_ROWS, room), np.float32)
            work = Work(more, work.matrix, work.right, work.step, work.told)
        window = left, right, top, bottom
        found = select(image, map_x, map_y, P, start, window, rim, neighbours, g, unit, p, u0, v0, work)
        n, inside, outside = int(found), work.told[0], work.told[1]
        if blurred:
            reach = max(1, int(0.5 * min(extent_x, extent_y)))
            ellipse = _ellipse_of(map_x, map_y, P, g, start_u, start_v, radius, reach, u0, v0, unit)
        if not (n >= 30 and math.isfinite(inside) and math.isfinite(outside)):
            dot.status = MarkerStatus.OCCLUDED
            return 0.0
        if selection == 0:
            light = max(inside, outside, 1e-6)  # the unit of grey from here on: no result depends on the file's own
            p = _Template(0.0, 0.0, radius, blur, outside / light, 0.0, 0.0, 1.0 - inside / max(outside, 1e-6))
        dark = p.level * (1.0 - p.contrast)
        variance = noise[0] / (light * light) + noise[1] / light * max(p.level, dark)
        if abs(p.level - dark) < 4.0 * math.sqrt(max(variance, 0.1 * noise[2] / (light * light))):
            dot.status = MarkerStatus.LOW_CONTRAST
            return 0.0
        _weigh(work.pixels, n, p, noise, light)
        limit = np.inf
        while True:  # once, and again without the pixels that do not belong
            converged, p, chi2, n_clipped = _descend(whiten, work, n, p, g, ellipse, radius, blurred, limit)
            if not converged:
                dot.status = MarkerStatus.NOT_CONVERGED
                return 0.0
            if limit < np.inf:
                chi2 -= n_clipped * limit
                break
            moved_u = start_u + (g.yv * p.a - g.xv * p.b) / g.det - u0
            moved_v = start_v + (g.xu * p.b - g.yu * p.a) / g.det - v0
            u0 += moved_u
            v0 += moved_v
            settled = math.hypot(moved_u, moved_v) < _SETTLED_PX
            if not blurred and shortest < _MIN_SEMI_MINOR * p.blur:
                settled = False  # more blurred than expected: once more, by the other template
            if not settled and selection < _MAX_SELECTIONS - 1:
                break
            # robust end: hot pixels and specks leave the sum; where the model misfits everywhere the limit follows
            limit = _CLIP_SIGMA * _CLIP_SIGMA * max(1.0, chi2 / n)
            worst, residual = _0, work.pixels[_RESIDUAL]
            for i in range(n):
                worst = max(worst, abs(residual[i]))
            if worst * worst <= limit:
                break
        if settled:
            break
    # covariance of the shift on the plane: the leading corner of (J^T W J)^-1
    x, y = work.right, work.step
    for i in range(8):
        x[i], y[i] = 1.0 if i == 0 else 0.0, 1.0 if i == 1 else 0.0
    _substitute(work.matrix, x)
    _substitute(work.matrix, y)
    a, b, c, d = g.yv / g.det, -g.xv / g.det, -g.yu / g.det, g.xu / g.det
    dot.var_u = a * a * x[0] + 2 * a * b * x[1] + b * b * y[1]
    dot.var_v = c * c * x[0] + 2 * c * d * x[1] + d * d * y[1]
    dot.cov_uv = a * c * x[0] + (a * d + b * c) * x[1] + b * d * y[1]
    dot.u, dot.v, dot.radius = start_x + unit * p.a, start_y + unit * p.b, unit * p.radius
    dot.misfit, dot.clipped, dot.n_pixels = chi2 / max(n - n_clipped - 8, 1), n_clipped / n, n
    dot.blur, dot.level, dot.contrast, dot.status = p.blur, light * p.level, p.contrast, MarkerStatus.MEASURED
    return 0.0


@_part
def _judge(dot, radius, blur, noise, limits):
    """Refuse a converged fit that does not look like the dot.

    A misfit counts when it is large beside the noise and beside the contrast: the template's own small errors must not
    condemn the dots of a sensor that hardly has any noise.
    """
    misfit, step = math.sqrt(max(dot.misfit, 0.0)), abs(dot.contrast * dot.level)
    middle = dot.level * (1.0 - 0.5 * dot.contrast)
    share = misfit * math.sqrt(max(noise[0] + noise[1] * middle, 0.0)) / max(step, 1e-12)
    unlike = (misfit > limits.misfit and share > limits.share) or dot.clipped > limits.clipped
    if unlike or abs(dot.radius / radius - 1.0) > limits.radius:
        dot.status = MarkerStatus.OCCLUDED
    elif dot.blur > limits.blur * blur + 1.0:
        dot.status = MarkerStatus.BLURRED


def _look(select, whiten, fit, images, readable, maps_x, maps_y, cameras, expected, R, t, work, dots):
    """Locate and judge the dots (c, m) in the images (c, H, W) of one instant, the disc being near the pose R, t.

    u and v are the image of the dot's own centre, not the centre of its elliptical image.
    """
    m = expected.centres.shape[0]
    R_cb, P, shift = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    neighbours = np.empty((max(m - 1, 0), 2))
    for c in range(images.shape[0]):
        R_cw, t_cw, camera = cameras.R[c], cameras.t[c], cameras.parameters[c]
        _times(R_cw, R, R_cb)
        shift[0], shift[1], shift[2] = _turned(R_cw, t[0], t[1], t[2])
        for k in range(3):
            shift[k] += t_cw[k]
        for i in range(m):
            dot = dots[c, i]
            if not readable[c]:
                dot.status = MarkerStatus.NOT_LOOKED_FOR
                continue
            x, y, z = expected.centres[i, 0], expected.centres[i, 1], expected.centres[i, 2]
            px, py, pz = _turned(R_cb, x, y, z)
            px, py, pz = px + shift[0], py + shift[1], pz + shift[2]
            if pz <= 0.0:
                dot.status = MarkerStatus.OUTSIDE
                continue
            if R_cb[0, 2] * px + R_cb[1, 2] * py + R_cb[2, 2] * pz >= 0.0:  # the camera sees the other face
                dot.status = MarkerStatus.OCCLUDED
                continue
            for k in range(3):  # inverse, but for a factor, of the columns e1, e2, z e3 + shift: their cross products
                a, b = (k + 1) % 3, (k + 2) % 3
                P[0, k] = z * R_cb[k, 0] + R_cb[a, 1] * shift[b] - R_cb[b, 1] * shift[a]
                P[1, k] = z * R_cb[k, 1] - R_cb[a, 0] * shift[b] + R_cb[b, 0] * shift[a]
                P[2, k] = R_cb[k, 2]
            u, v = _project_point(camera, px, py, pz)
            for k in range(m - 1):
                other = k + 1 if k >= i else k
                neighbours[k, 0], neighbours[k, 1] = expected.centres[other, 0], expected.centres[other, 1]
            start, blur, noise = (x, y, expected.radius, u, v), expected.blur[c], expected.noise[c]
            fit(select, whiten, images[c], maps_x[c], maps_y[c], P, start, blur, noise, expected.rim, neighbours, work,
                dot)  # fmt: skip
            if dot.status == MarkerStatus.MEASURED:
                px, py, pz = _turned(R_cb, dot.u, dot.v, z)
                dot.u, dot.v = _project_point(camera, px + shift[0], py + shift[1], pz + shift[2])
                _judge(dot, expected.radius, blur, noise, expected.limits)
    return 0.0


@_part
def _rotate_from_left(v, R, out):
    """Out = exp([v]x) R by Rodrigues' formula."""
    angle2 = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
    angle = math.sqrt(angle2)
    a, b = 1.0, 0.5
    if angle >= 1e-6:
        a, b = math.sin(angle) / angle, (1.0 - math.cos(angle)) / angle2
    E = np.empty((3, 3))
    for i in range(3):  # 1 + a [v]x + b (v v^T - v^2)
        j, k = (i + 1) % 3, (i + 2) % 3
        E[i, i] = 1.0 - b * (v[j] * v[j] + v[k] * v[k])
        E[j, k] = b * v[j] * v[k] - a * v[i]
        E[k, j] = b * v[j] * v[k] + a * v[i]
    _times(E, R, out)


@_part
def _dot_by_pose(cameras, c, centre, R, t, J, rows):
    """Image u, v and depth in camera c of a dot at `centre` (3,) on the disc; fills rows (2, 6), d (u, v) / d pose.

    The pose is a translation and a rotation vector in world axes. J (2, 3) is scratch. The rows mean nothing behind the
    camera.
    """
    R_cw, t_cw = cameras.R[c], cameras.t[c]
    a0, a1, a2 = _turned(R, centre[0], centre[1], centre[2])
    px, py, pz = _turned(R_cw, a0 + t[0], a1 + t[1], a2 + t[2])
    depth = pz + t_cw[2]
    u, v = _project_point_jacobian(
        cameras.parameters[c], px + t_cw[0], py + t_cw[1], depth if depth > 0.0 else np.nan, J
    )
    for axis in range(2):
        row = rows[axis]
        for i in range(3):
            row[i] = J[axis, 0] * R_cw[0, i] + J[axis, 1] * R_cw[1, i] + J[axis, 2] * R_cw[2, i]
        row[3] = a1 * row[2] - a2 * row[1]
        row[4] = a2 * row[0] - a0 * row[2]
        row[5] = a0 * row[1] - a1 * row[0]
    return u, v, depth


@_part
def _pose_step(dots, cameras, expected, R, t, step):
    """One Gauss-Newton step (translation, world rotation vector) of the disc's pose from the dots (c, m) of one pair.

    Huber weights keep one wrong dot from pulling the prediction away. Returns the rms residual before the step [px],
    or -1 where fewer than three dots or a singular system leave nothing to solve.
    """
    M, J, rows = np.zeros((6, 6)), np.empty((2, 3)), np.empty((2, 6))
    for i in range(6):
        step[i] = 0.0
    total, count = 0.0, 0
    for c in range(dots.shape[0]):
        for m in range(dots.shape[1]):
            dot = dots[c, m]
            if dot.status != MarkerStatus.MEASURED:
                continue
            u, v, depth = _dot_by_pose(cameras, c, expected.centres[m], R, t, J, rows)
            if depth <= 0.0:
                return -1.0
            du, dv = dot.u - u, dot.v - v
            distance = math.hypot(du, dv)
            total += distance * distance
            count += 1
            # 0.05 px is added: a prediction need not follow the noise of the best dots
            w = 1.0 / ((dot.var_u + dot.var_v + 0.0025) * max(distance, 1.0))
            for axis in range(2):
                r, row = w * (du if axis == 0 else dv), rows[axis]
                for i in range(6):
                    step[i] += row[i] * r
                    for j in range(i + 1):
                        M[i, j] += w * row[i] * row[j]
    if count < 3 or not _solve_in_place(M, step):
        return -1.0
    return math.sqrt(total / count)


@_part
def _settle(dots, cameras, expected, R, t):
    """Move the pose R, t onto the dots of one pair; returns the rms residual [px], negative without an answer."""
    step, R_new = np.empty(6), np.empty((3, 3))
    rms = -1.0
    for _ in range(5):
        rms = _pose_step(dots, cameras, expected, R, t, step)
        if rms < 0.0:
            return rms
        for i in range(3):
            t[i] += step[i]
        _rotate_from_left(step[3:], R, R_new)
        _copy(R, R_new)
        if abs(step[0]) + abs(step[1]) + abs(step[2]) < 1e-6:  # a micrometre: a prediction needs no more
            break
    # a step of Newton's towards the nearest rotation; without it a prediction would treble any departure
    D = np.empty((3, 3))
    _times_transposed(R, R, D)
    for i in range(3):
        for j in range(3):
            D[i, j] = (1.5 if i == j else 0.0) - 0.5 * D[i, j]
    _times(D, R, R_new)
    _copy(R, R_new)
    return rms


@_part
def _predict(heading, R, t):
    """The next pose if turn and shift change once more as they did: turn D1 D0^T D1 after D0 and then D1.

    A disc that rolls is as far beside it as its third differences, not its second: what a prediction is off by follows
    the acceleration, and so does what it leaves of itself in the centres (band and shape of the template), 1e-4 px.
    """
    last, before, older = heading.R[0], heading.R[1], heading.R[2]
    D, D_back, some, more = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    _times_transposed(last, before, D)
    _times_transposed(older, before, D_back)
    _times(D, last, some)
    _times(D_back, some, more)
    _times(D, more, R)
    for i in range(3):
        t[i] = 3.0 * (heading.t[0, i] - heading.t[1, i]) + heading.t[2, i]


def scratch() -> Work:
    """Working memory of one thread."""
    return Work(np.empty((_PIXEL_ROWS, _PIXELS), np.float32), np.empty((8, 8)), np.empty(8), np.empty(8), np.empty(2))


@_entry
def track_frames(compiled, images, readable, maps_x, maps_y, cameras, expected, heading, work, dots, R_out, t_out,
                 max_rms):  # fmt: skip
    """Follow the disc through a block of pairs, each predicted from the three before; `heading` is moved on.

    compiled: see `compiled_for`; images (n, c, H, W); readable (n, c); maps_x, maps_y (c, H, W): normalised coordinates
    of every pixel. Filled: dots (n, c, m) of DOT, R_out (n, 3, 3), t_out (n, 3). Returns the number of frames followed;
    less than n where the disc was lost at that frame.
    """
    select, whiten, fit, look = compiled
    R, t, R_expected = np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    for f in range(images.shape[0]):
        _predict(heading, R, t)
        rms = -1.0
        for _ in range(3):
            _copy(R_expected, R)
            look(select, whiten, fit, images[f], readable[f], maps_x, maps_y, cameras, expected, R, t, work,
                 dots[f])  # fmt: skip
            rms = _settle(dots[f], cameras, expected, R, t)
            turned = 0.0
            for i in range(3):
                for j in range(3):
                    turned += (R[i, j] - R_expected[i, j]) ** 2
            if rms < 0.0 or turned < 2.0 * _ATTITUDE_TOLERANCE**2:
                break
        if not 0.0 <= rms < max_rms:
            return f
        for k in range(2, 0, -1):
            _copy(heading.R[k], heading.R[k - 1])
            for i in range(3):
                heading.t[k, i] = heading.t[k - 1, i]
        _copy(heading.R[0], R)
        _copy(R_out[f], R)
        for i in range(3):
            heading.t[0, i], t_out[f, i] = t[i], t[i]
    return images.shape[0]


@_entry
def fit_dot(compiled, image, map_x, map_y, P, start, blur, noise, limits, rim, neighbours, work, dot):
    """`_fit_dot` for Python, judged."""
    select, whiten, fit, _ = compiled
    fit(select, whiten, image, map_x, map_y, P, start, blur, noise, rim, neighbours, work, dot)
    if dot.status == MarkerStatus.MEASURED:
        _judge(dot, start[2], blur, noise, limits)


@_entry
def look(compiled, images, readable, maps_x, maps_y, cameras, expected, R, t, work, dots):
    """`_look` for Python."""
    select, whiten, fit, look = compiled
    look(select, whiten, fit, images, readable, maps_x, maps_y, cameras, expected, R, t, work, dots)


# The same where Python calls them: compiled the first time that they are called.
project_point = _entry(_project_point.py_func)
project_point_jacobian = _entry(_project_point_jacobian.py_func)


@cache
def compiled_for(dtype: np.dtype) -> tuple[object, ...]:
    """`_select`, `_whiten`, `_fit_dot` and `_look` for images of this type: compiled now, or loaded."""
    images, flag, maps, _, cameras, expected, plane, vector, work, dots = nothing_to_see(dtype)
    template, near, ellipse = _Template(*[0.0] * 8), _Map(*[0.0] * 8), _Ellipse(*[0.0] * 10)
    place, image = (0.0, 0.0, 0.0, 0.0, 0.0), images[0]
    select = compiled_apart(_select, image, plane, plane, plane, place, (0, 0, 0, 0), 0.0, plane, near, 0.0, template,
                            0.0, 0.0, work, **_RULES)  # fmt: skip
    whiten = compiled_apart(_whiten, work, 0, template, near, ellipse, True, 0.0, **_RULES)
    fit = compiled_apart(_fit_dot, select, whiten, image, plane, plane, plane, place, 0.0, vector, 0.0, plane, work,
                         dots[0, 0], **_RULES)  # fmt: skip
    seen = compiled_apart(_look, select, whiten, fit, images, flag, maps, maps, cameras, expected, plane,
                          vector, work, dots, **_RULES)  # fmt: skip
    return select, whiten, fit, seen


def nothing_to_see(dtype):
    """Arguments of `look` with an image (1, 1) that cannot be read, of one camera and one dot."""
    plane, vector = np.eye(3), np.zeros(3)
    return (
        np.zeros((1, 1, 1), dtype), np.zeros(1, bool), plane[None], plane[None], Cameras(plane, plane[None], plane),
        Expected(plane[:1], 0.0, 0.0, vector, plane, TemplateLimits()), plane, vector, scratch(), np.zeros((1, 1), DOT),
    )  # fmt: skip


def prepare(dtype: DTypeLike = np.uint8) -> None:
    """Compile `look` for images of this type, or load it."""
    look(compiled_for(np.dtype(dtype)), *nothing_to_see(dtype))
