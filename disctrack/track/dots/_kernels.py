"""Compiled inner loops of marker location and tracking (numba), explained in `template` and `following`.

They are compiled because each pair needs about 12 fits of 700 pixels, at the camera's rate of 1000 pairs/s. Loops over
pixels are written so that the compiler vectorises them: rows of single precision, no branches, and pixels as the unit
of length (rounding moves a centre by less than 1e-6 px).

The compile time grows with every function and every level of calls, as each level is optimised together with all that
it calls. So there are few functions; slices are not assigned (the error message that numba prepares for unequal shapes
takes longer to compile than a loop); and only functions that Python calls are Python entry points.
"""

import math
from collections import namedtuple
from typing import NamedTuple

import numpy as np

from calibration.cameras._projection import project_point
from calibration.kit._cholesky import solve_in_place, substitute
from calibration.kit.compiled import part as _part
from disctrack.track._pose_kernel import _copy, _entry, fit_pose
from disctrack.trajectory import MarkerStatus

MEASURED, OUTSIDE, LOW_CONTRAST, OCCLUDED, NOT_CONVERGED, BLURRED, _, NOT_LOOKED_FOR = map(int, MarkerStatus)

# Result of one dot: centre [px] and its covariance by the image noise; reduced chi-square of the grey values, in total,
# inside and outside the edge; sigma of the edge [px], motion blur included; radius [m]; grey value of the paper, and
# contrast with it, 1 - dark / light; fraction of clipped pixels; number of pixels.
_OF_DOT = ("u", "v", "var_u", "var_v", "cov_uv", "chi_square", "inside", "outside", "sigma", "radius", "level")
DOT = np.dtype([(name, float) for name in (*_OF_DOT, "contrast", "clipped", "n_pixels")])


class Limits(NamedTuple):
    """Limits beyond which a converged fit is refused."""

    misfit: float = 6.0  # rms residual over the pixel noise; speckle of real print reaches 3
    share: float = 0.02  # rms residual over the contrast: a misfit must exceed this, too
    clipped: float = 0.15  # fraction of clipped pixels: an object in front of the dot
    radius: float = 0.20  # relative deviation of the fitted radius
    blur: float = 3.0  # fitted blur in typical blurs (plus 1 px): motion blur beyond use


# Rows of numbers per pixel, (16, n) in single precision. The first eight are also the parameters of the template; these
# rows hold the derivatives by the parameters, over the pixel's sigma
Rows = namedtuple(
    "Rows",
    "a b radius sigma level slope_x slope_y contrast "  # a, b: shift of the centre on the plane
    "x y offset_x offset_y "  # from the expected centre: position on the plane [px], in the image [10 px]
    "grey distance residual weight",  # distance from the edge [px]; residual over sigma, and 1 / sigma of the pixel
)
ROW = Rows(*range(len(Rows._fields)))
_PIXELS = 4096 + 64  # for a dot of 60 px; grows if needed. Not a power of two, or rows would share cache lines
_MAX_ITERATIONS = 20  # of a fit, and of selections of its pixels
_CONVERGED_PX = 2e-4  # predicted length of the next step: a twentieth of the noise of the best dots
# Shift of the centre above which the pixels are selected again: a band that is off the edge by 0.25 to 0.7 px shifts
# the centre by 3e-4 to 5e-4 px (the same in all frames, if dots are declared at wrong positions)
_SETTLED_PX = 0.2
_CLIP_SIGMA = 5.0
# Semi-minor axis in blurs, or in pixels. Below, the two long edges overlap, and the model of a single edge errs by more
# than the centre's sigma; the template is then the whole blurred ellipse, 10 to 20 times as slow.
_MIN_SEMI_MINOR = 4.5
_RADIUS_PRIOR = 0.1  # relative standard deviation: size, contrast and blur of a small blurred dot are degenerate
_NODES = 64  # at most, along an ellipse
# [rad] difference from the expected attitude above which the dots are located again: 3e-3 shifts centres by 4e-4 to
# 1e-3 px, in every frame alike if the prediction lags
_ATTITUDE_TOLERANCE = 6e-4
_FOLLOWED_PX = 0.05  # sigma added to a dot while the disc is followed

# for numba a literal has double precision, and so has every expression with it
_f = np.float32
_0, _1, _2, _HALF, _TINY = _f(0), _f(1), _f(2), _f(0.5), _f(1e-15)
_LEAST_BEND = _f(-0.3)
_INV_SQRT_2PI = _f(1.0 / math.sqrt(2.0 * math.pi))
# Abramowitz & Stegun 7.1.26: erfc(x) = (a1 t + ... + a5 t^5) exp(-x^2), t = 1 / (1 + p x), to 1.5e-7
_T = _f(0.3275911 / math.sqrt(2.0))
_ERFC = tuple(_f(0.5 * a) for a in (0.254829592, -0.284496736, 1.421413741, -1.453152027, 1.061405429))
# exp(-z^2 / 2) = e^16, e = exp(-z^2 / 32) a polynomial in z^2: 6e-8 for |z| < 6
_Z2_MAX = _f(36.0)
_SERIES = np.polynomial.Chebyshev.interpolate(lambda z2: np.exp(-z2 / 32.0), 6, domain=[0.0, 36.0])
_EXP = tuple(map(_f, _SERIES.convert(kind=np.polynomial.Polynomial).coef))


@_part
def _view_of(camera, point, R, unit, P, G, J):
    """Image u, v of a dot's centre, and derivatives there; returns also the determinant of d plane point / d pixel.

    point (3,): the centre, and R (3, 3): body axes, in camera axes; unit: radius of the dot, the unit of lengths on the
    plane. P (3, 3) receives the homography from the normalised image to the plane, whose origin is the centre [m].
    G (5, 2): rows 0 and 1 are d plane point / d pixel, rows 3 and 4 their inverse; row 2 is the relative change, per
    10 px moved, of the squared number of pixels that a length spans. J (2, 3) is scratch.
    """
    for k in range(3):  # inverse of (e1, e2, point) by cofactors, up to a factor
        i, j = (k + 1) % 3, (k + 2) % 3
        P[0, k] = R[i, 1] * point[j] - R[j, 1] * point[i]
        P[1, k] = R[j, 0] * point[i] - R[i, 0] * point[j]
        P[2, k] = R[i, 0] * R[j, 1] - R[j, 0] * R[i, 1]
    deeper_x, deeper_y = unit * R[2, 0] / point[2], unit * R[2, 1] / point[2]  # relative change of the depth
    u, v = project_point(camera, point[0], point[1], point[2], J)
    for i in range(2):
        for k in range(2):
            G[3 + i, k] = unit * (J[i, 0] * R[0, k] + J[i, 1] * R[1, k] + J[i, 2] * R[2, k])
    det = 1.0 / (G[3, 0] * G[4, 1] - G[3, 1] * G[4, 0])
    G[0, 0], G[0, 1], G[1, 0], G[1, 1] = det * G[4, 1], -det * G[3, 1], -det * G[4, 0], det * G[3, 0]
    for axis in range(2):
        G[2, axis] = -20.0 * (deeper_x * G[0, axis] + deeper_y * G[1, axis])
    return u, v, det


@_part
def _edge_distance(dx, dy, radius, g00, g01, g10, g11, det2):
    """Signed distance [px] of a pixel from the dot's edge (positive outside), with terms for its derivatives.

    rho = |(dx, dy)| on the plane, F = rho - radius, g = |grad_u F|. To second order the foot point lies at
    d = F/g (1 + t), t = h F/(2 g^2); inside, 1/(1 - t) has the same order and keeps its sign in slender ellipses.
    Returns d, dd/drho, the unit radius (nx, ny), 1/g and the curvature of the level line in the image, det^2/(rho g^3).
    """
    inv_rho = _1 / (math.sqrt(dx * dx + dy * dy) + _TINY)
    rho = (dx * dx + dy * dy) * inv_rho
    nx, ny = dx * inv_rho, dy * inv_rho
    gx, gy = g00 * nx + g10 * ny, g01 * nx + g11 * ny
    inv_g2 = _1 / (gx * gx + gy * gy)
    inv_g = math.sqrt(inv_g2)
    # h = (m . G ghat)^2 / rho with m perpendicular to n
    along = nx * (g10 * gx + g11 * gy) - ny * (g00 * gx + g01 * gy)
    F = rho - radius
    bend = _HALF * along * along * F * inv_rho * inv_g2 * inv_g2
    curvature = det2 * inv_rho * inv_g2 * inv_g
    shrink = _1 / (_1 - max(bend, _LEAST_BEND))  # the expansion fails at the dot's centre, where rho = 0
    outside = rho > radius
    factor = _1 + bend if outside else shrink
    slope = _1 + _2 * bend if outside else shrink * shrink
    return F * inv_g * factor, inv_g * slope, nx, ny, inv_g, curvature


@_part
def _edge_profile(z):
    """Blurred step z sigmas outside the edge, and the Gaussian that is minus its derivative; both to 5e-7."""
    z2 = min(z * z, _Z2_MAX)
    e = _EXP[0] + z2 * (_EXP[1] + z2 * (_EXP[2] + z2 * (_EXP[3] + z2 * (_EXP[4] + z2 * (_EXP[5] + z2 * _EXP[6])))))
    e *= e
    e *= e
    e *= e
    e *= e
    t = _1 / (_1 + _T * abs(z))
    tail = t * (_ERFC[0] + t * (_ERFC[1] + t * (_ERFC[2] + t * (_ERFC[3] + t * _ERFC[4])))) * e
    return tail if z > _0 else _1 - tail, _INV_SQRT_2PI * e


@_part
def _select_pixels(image, map_x, map_y, P, face, own, window, G, steepest, p, u0, v0, pixels):
    """Select the pixels in a band around the edge; returns their number and the mean grey value inside and outside.

    steepest: largest length of a pixel on the plane, in radii of the dot.
    """
    (x_lo, x_hi, y_lo, y_hi), (centres, unit, rim) = window, face
    expected_x, expected_y = centres[own, 0], centres[own, 1]
    band = 3.0 * p[ROW.sigma] + 1.0
    radius = _f(p[ROW.radius])
    outer = p[ROW.radius] + band * steepest
    X0, X1, X2, Y0, Y1, Y2 = P[0, 0], P[0, 1], P[0, 2], P[1, 0], P[1, 1], P[1, 2]
    w0, w1, w2 = unit * P[2, 0], unit * P[2, 1], unit * P[2, 2]
    width = x_hi + 1 - x_lo
    n = width * (y_hi + 1 - y_lo)  # candidate pixels, stored in the rows of derivatives
    for y in range(y_lo, y_hi + 1):
        # views: an index that is a sum might be negative, and numba would check every one
        xs, ys, greys = map_x[y, x_lo:], map_y[y, x_lo:], image[y, x_lo:]
        first = (y - y_lo) * width
        X_row, Y_row, grey_row = pixels[0, first:], pixels[1, first:], pixels[4, first:]
        x_row, y_row = pixels[2, first:], pixels[3, first:]
        for k in range(width):
            w = 1.0 / (w0 * xs[k] + w1 * ys[k] + w2)
            X_row[k] = (X0 * xs[k] + X1 * ys[k] + X2) * w
            Y_row[k] = (Y0 * xs[k] + Y1 * ys[k] + Y2) * w
            x_row[k], y_row[k], grey_row[k] = 0.1 * (x_lo + k - u0), 0.1 * (y - v0), greys[k]
    # is the rim or another dot near enough to affect any pixel?
    reach = unit * outer
    blur = p[ROW.sigma] * steepest * unit
    crowded = math.hypot(expected_x, expected_y) + reach > rim - 2.5 * blur
    for j in range(centres.shape[0]):
        apart = math.hypot(expected_x - centres[j, 0], expected_y - centres[j, 1])
        crowded |= j != own and apart - reach - unit < 3.0 * blur
    g00, g01, g10, g11 = _f(G[0, 0]), _f(G[0, 1]), _f(G[1, 0]), _f(G[1, 1])
    for i in range(n):
        d, slope, nx, ny, inv_g, curvature = _edge_distance(pixels[0, i], pixels[1, i], radius, g00, g01, g10, g11, _0)
        pixels[5, i], pixels[6, i] = d, inv_g
    kept, nearest, farthest = 0, _f(-band - 1.0), _f(band)
    for i in range(n):
        d = pixels[5, i]
        good = nearest < d < farthest  # False also for NaN: a pixel without a ray
        if crowded and good:
            X, Y = expected_x + unit * pixels[0, i], expected_y + unit * pixels[1, i]
            blur = p[ROW.sigma] * unit / pixels[6, i]
            good = math.hypot(X, Y) <= rim - 2.5 * blur
            for j in range(centres.shape[0]):
                good &= j == own or math.hypot(X - centres[j, 0], Y - centres[j, 1]) - unit >= 3.0 * blur
        for row in range(6):
            pixels[ROW.x + row, kept] = pixels[row, i]
        kept += 1 if good else 0
    inside_sum, inside_n, outside_sum, outside_n = 0.0, 0.0, 0.0, 0.0
    well_inside, well_outside = _f(-min(1.2 * p[ROW.sigma], 0.4 * p[ROW.radius] / steepest)), _f(1.2 * p[ROW.sigma])
    for i in range(kept):
        d, grey = pixels[ROW.distance, i], pixels[ROW.grey, i]
        is_in, is_out = _1 if d < well_inside else _0, _1 if d > well_outside else _0
        inside_n += is_in
        outside_n += is_out
        inside_sum += is_in * grey
        outside_sum += is_out * grey
    inside = inside_sum / inside_n if inside_n >= 3 else np.nan
    outside = outside_sum / outside_n if outside_n >= 8 else np.nan
    return kept, inside, outside


@_part
def _lit(pixels, i, covered, level, slope_x, slope_y, contrast, limit):
    """Fill a pixel's residual and its derivatives by the light; `covered`: fraction of the pixel covered by the dot.

    Returns the light, the weight (0 if the squared residual exceeds the limit), the contribution to chi-square, and 1
    if the pixel is clipped.
    """
    x, y = pixels[ROW.offset_x, i], pixels[ROW.offset_y, i]
    light = level + slope_x * x + slope_y * y
    weight = pixels[ROW.weight, i]
    r = weight * (pixels[ROW.grey, i] - light * (_1 - contrast * covered))
    squared = r * r
    fits = _1 if squared <= limit else _0
    weight *= fits
    seen = (_1 - contrast * covered) * weight
    pixels[ROW.level, i], pixels[ROW.slope_x, i], pixels[ROW.slope_y, i] = seen, seen * x, seen * y
    pixels[ROW.contrast, i] = -light * covered * weight
    pixels[ROW.residual, i] = r * fits
    return light, weight, min(squared, limit), _1 - fits


@_part
def _whitened_model(pixels, n, p, G, det, clip):
    """Fill the pixels' rows of d model / d p and of the residual, each over the pixel's sigma.

    model = (level + slopes . offset) * (1 - contrast * S(z)), S the blurred edge: erfc of the distance over sigma.
    Pixels whose squared whitened residual exceeds clip get zeros. Returns chi-square (clipped pixels count as clip),
    and the number of clipped pixels.
    """
    g00, g01, g10, g11, det2 = _f(G[0, 0]), _f(G[0, 1]), _f(G[1, 0]), _f(G[1, 1]), _f(det * det)
    near_x, near_y = _f(G[2, 0]), _f(G[2, 1])
    a, b, radius, contrast = _f(p[ROW.a]), _f(p[ROW.b]), _f(p[ROW.radius]), _f(p[ROW.contrast])
    inv_sigma, sigma, half_sigma = _f(1.0 / p[ROW.sigma]), _f(p[ROW.sigma]), _f(0.5 * p[ROW.sigma])
    level, slope_x, slope_y, limit = _f(p[ROW.level]), _f(p[ROW.slope_x]), _f(p[ROW.slope_y]), _f(clip)
    half_step = _f(0.05)
    chi2, n_clipped = _0, _0
    for i in range(n):
        x, y = pixels[ROW.offset_x, i], pixels[ROW.offset_y, i]
        d, slope, nx, ny, inv_g, curvature = _edge_distance(
            pixels[ROW.x, i] - a, pixels[ROW.y, i] - b, radius, g00, g01, g10, g11, det2
        )
        # the gradient is that at the dot's centre, but perspective changes the scale over the dot: the distance follows
        # from the scale half way between pixel and edge (the scale at the pixel would shift centres by 5e-4 px)
        half = half_step * d * inv_g
        mid_x, mid_y = x - half * (g00 * nx + g10 * ny), y - half * (g01 * nx + g11 * ny)
        d *= _1 + near_x * mid_x + near_y * mid_y
        # blur by sigma shifts a curved edge inwards by sigma^2 / (2 radius of curvature)
        z = d * inv_sigma + half_sigma * curvature
        s, bell = _edge_profile(z)
        light, weight, squared, clipped = _lit(pixels, i, s, level, slope_x, slope_y, contrast, limit)
        chi2 += squared
        n_clipped += clipped
        edge = -light * contrast * bell * inv_sigma * weight  # - d model / d distance
        pixels[ROW.a, i], pixels[ROW.b, i] = edge * nx * slope, edge * ny * slope
        pixels[ROW.radius, i], pixels[ROW.sigma, i] = edge * slope, edge * (z - curvature * sigma)
    return float(chi2), float(n_clipped)


@_part
def _image_centroid(camera, point, R, radius, J):
    """Centroid u, v [px] of the image of a circle about a point (3,), in the plane of the first columns of R.

    Point and R are in camera axes. A quadrature over four points, exact to the third order; J (2, 3) is scratch.
    """
    whole, sum_u, sum_v = 0.0, 0.0, 0.0
    for k in range(4):
        axis, arm = k % 2, math.sqrt(0.5) * (radius if k < 2 else -radius)
        x, y, z = point[0] + arm * R[0, axis], point[1] + arm * R[1, axis], point[2] + arm * R[2, axis]
        u, v = project_point(camera, x, y, z, J)
        a, b, c, d = 0.0, 0.0, 0.0, 0.0
        for i in range(3):
            a, b, c, d = a + J[0, i] * R[i, 0], b + J[0, i] * R[i, 1], c + J[1, i] * R[i, 0], d + J[1, i] * R[i, 1]
        area = a * d - b * c
        whole, sum_u, sum_v = whole + area, sum_u + area * u, sum_v + area * v
    return sum_u / whole, sum_v / whole


@_part
def _whitened_ellipse(pixels, n, p, G, det, centroid, nodes, clip):
    """As `_whitened_model`, with the integral of the Gaussian over the whole ellipse; nodes (3, _NODES) is scratch.

    Along the long axis x = a sin t, for which the trapezoidal rule converges exponentially; across it the error
    function.
    """
    i00, i01, i10, i11 = G[3, 0], G[3, 1], G[4, 0], G[4, 1]  # plane -> pixel
    c00, c01, c11 = i00 * i00 + i01 * i01, i00 * i10 + i01 * i11, i10 * i10 + i11 * i11
    half_difference = 0.5 * (c00 - c11)
    angle = 0.5 * math.atan2(c01, half_difference)
    axis_u, axis_v = math.cos(angle), math.sin(angle)  # unit vector of the long axis in the image
    longer, in_sigma = math.sqrt(0.5 * (c00 + c11) + math.hypot(half_difference, c01)), 1.0 / p[ROW.sigma]
    a, b = p[ROW.radius] * longer * in_sigma, p[ROW.radius] * (1.0 / (abs(det) * longer)) * in_sigma
    n_nodes = min(int(3.2 * a) + 8, _NODES)
    every = math.pi / n_nodes
    for k in range(n_nodes):
        t = (k + 0.5) * every - 0.5 * math.pi
        nodes[0, k], nodes[1, k], nodes[2, k] = a * math.sin(t), b * math.cos(t), a * every * math.cos(t)
    round_edge = _f(a * b * every)
    A_px, B_px = p[ROW.a], p[ROW.b]
    from_x = _f(centroid[0] + i00 * A_px + i01 * B_px)
    from_y = _f(centroid[1] + i10 * A_px + i11 * B_px)
    along_x, along_y = _f(axis_u * in_sigma), _f(axis_v * in_sigma)
    A_along = _f(in_sigma * (axis_u * i00 + axis_v * i10))
    A_across = _f(in_sigma * (axis_u * i10 - axis_v * i00))
    B_along = _f(in_sigma * (axis_u * i01 + axis_v * i11))
    B_across = _f(in_sigma * (axis_u * i11 - axis_v * i01))
    inv_radius, inv_sigma, ten = _f(1.0 / p[ROW.radius]), _f(in_sigma), _f(10.0)
    contrast, level, slope_x, slope_y = _f(p[ROW.contrast]), _f(p[ROW.level]), _f(p[ROW.slope_x]), _f(p[ROW.slope_y])
    limit = _f(clip)
    chi2, n_clipped = _0, _0
    for i in range(n):
        x, y = pixels[ROW.offset_x, i], pixels[ROW.offset_y, i]
        from_u, from_v = ten * x - from_x, ten * y - from_y
        along, across = along_x * from_u + along_y * from_v, along_x * from_v - along_y * from_u
        covered, d_along, d_across, edge = _0, _0, _0, _0
        for k in range(n_nodes):
            z = along - nodes[0, k]
            if z * z > _Z2_MAX:
                continue
            _, bell = _edge_profile(z)
            above, bell_above = _edge_profile(-across - nodes[1, k])
            below, bell_below = _edge_profile(nodes[1, k] - across)
            column = nodes[2, k] * bell
            covered += column * (above - below)
            d_along -= z * column * (above - below)
            d_across += column * (bell_above - bell_below)
            edge += bell * (bell_above + bell_below)
        edge *= round_edge
        light, weight, squared, clipped = _lit(pixels, i, covered, level, slope_x, slope_y, contrast, limit)
        chi2 += squared
        n_clipped += clipped
        dark = light * contrast * weight
        pixels[ROW.a, i] = dark * (d_along * A_along + d_across * A_across)
        pixels[ROW.b, i] = dark * (d_along * B_along + d_across * B_across)
        pixels[ROW.radius, i] = -dark * edge * inv_radius
        pixels[ROW.sigma, i] = dark * (along * d_along + across * d_across + edge) * inv_sigma
    return float(chi2), float(n_clipped)


@_part
def _descend(pixels, n, p, G, det, px_per_unit, clip, work, blurred, centroid, nodes):
    """Gauss-Newton on the eight template parameters; returns converged, chi-square, number of clipped pixels.

    blurred: the model is the whole ellipse, with the expected radius as a prior, instead of single edges.

    On convergence the first matrix of work holds the Cholesky factor of J^T W J at the minimum.
    """
    M, rhs, step = work
    converged, chi2, n_clipped = False, 0.0, 0.0
    before = np.inf  # length of the last step: the ratio of two lengths is the contraction of the iteration
    for _ in range(_MAX_ITERATIONS + 1):
        if blurred:
            chi2, n_clipped = _whitened_ellipse(pixels, n, p, G, det, centroid, nodes, clip)
            chi2 += ((p[ROW.radius] - 1.0) / _RADIUS_PRIOR) ** 2
        else:
            chi2, n_clipped = _whitened_model(pixels, n, p, G, det, clip)
        if converged:
            return True, chi2, n_clipped
        residual = pixels[ROW.residual]
        for j in range(0, 8, 2):  # two rows at a time: each value loaded is used twice
            row, next_row = pixels[j], pixels[j + 1]
            for k in range(0, j + 1, 2):
                column, next_column = pixels[k], pixels[k + 1]
                a, b, c, d = _0, _0, _0, _0
                for i in range(n):
                    a += row[i] * column[i]
                    b += row[i] * next_column[i]
                    c += next_row[i] * column[i]
                    d += next_row[i] * next_column[i]
                M[j, k], M[j, k + 1], M[j + 1, k], M[j + 1, k + 1] = a, b, c, d
            a, b = _0, _0
            for i in range(n):
                a += row[i] * residual[i]
                b += next_row[i] * residual[i]
            rhs[j], rhs[j + 1] = a, b
        if blurred:
            M[ROW.radius, ROW.radius] += _RADIUS_PRIOR**-2
            rhs[ROW.radius] += (1.0 - p[ROW.radius]) * _RADIUS_PRIOR**-2
        for i in range(8):
            step[i] = rhs[i]
        if not solve_in_place(M, step):
            return False, chi2, n_clipped
        length = math.hypot(step[ROW.a], step[ROW.b])
        scale = min(1.0, 0.4 / max(length, 1e-30))
        gain, sigma = 0.0, p[ROW.sigma]
        for i in range(8):
            p[i] += scale * step[i]
            gain += step[i] * rhs[i]
        p[ROW.sigma] = min(max(p[ROW.sigma], 0.4 * sigma, 0.2), 2.0 * sigma)
        if not (0.5 < p[ROW.radius] < 1.6 and p[ROW.sigma] < 20.0):
            return False, chi2, n_clipped
        length *= px_per_unit
        contraction = min(length / before, 1.0) if before < np.inf else 1.0
        if length * contraction < _CONVERGED_PX and length < 0.1:
            if gain <= 0.5:
                return True, chi2, n_clipped
            converged = True  # evaluate once more: the last step changed the sums
        before = length
    return False, chi2, 0.0


@_part
def _fit_dot(image, map_x, map_y, camera, point, R, face, own, sigma, noise, pixels, work, result):
    """Fit the image of one circular dot to the grey values around its edge. Returns a MarkerStatus code.

    image (H, W); map_x, map_y (H, W): normalised coordinates of every pixel; point (3,): expected centre, and R (3, 3):
    body axes, in axes of the camera; face as from `template.face_of`, in which the dot is number `own`: pixels that the
    blur of the rim or of another dot reaches are not used; sigma: initial guess of the blur [px]; noise (3,): variance
    = noise[0] + noise[1] grey, and the grey-value step; pixels and work (matrix, right-hand side, step) are scratch.
    result (a DOT) receives the centre with its covariance in pixels, and the quality of the fit.
    """
    height, width = image.shape
    unit = face[1]  # lengths on the plane are in radii of the dot
    P, G, J, nodes = np.empty((3, 3)), np.empty((5, 2)), np.empty((2, 3)), np.empty((3, _NODES), np.float32)
    p = np.zeros(8)
    p[ROW.radius], p[ROW.sigma] = 1.0, sigma
    n, n_clipped, chi2, light, settled = 0, 0.0, 0.0, 1.0, False
    for selection in range(_MAX_ITERATIONS):
        u0, v0, det = _view_of(camera, point, R, unit, P, G, J)
        if not (2.0 < u0 < width - 3.0 and 2.0 < v0 < height - 3.0):
            return OUTSIDE
        norm2 = G[0, 0] * G[0, 0] + G[0, 1] * G[0, 1] + G[1, 0] * G[1, 0] + G[1, 1] * G[1, 1]
        largest = math.sqrt(0.5 * (norm2 + math.sqrt(max(norm2 * norm2 - 4 * det * det, 0.0))))
        if not abs(det) > 1e-9 * norm2:
            return BLURRED
        blur = max(p[ROW.sigma], 1.0)
        if 1.0 / largest < blur:  # semi-minor axis below the blur: the template of the ellipse fails, too
            return BLURRED
        blurred = 1.0 / largest < _MIN_SEMI_MINOR * blur
        band = 3.0 * p[ROW.sigma] + 1.0
        extent_x, extent_y = math.hypot(G[3, 0], G[3, 1]) + band, math.hypot(G[4, 0], G[4, 1]) + band
        x_lo, x_hi = int(math.floor(u0 - extent_x)), int(math.ceil(u0 + extent_x))
        y_lo, y_hi = int(math.floor(v0 - extent_y)), int(math.ceil(v0 + extent_y))
        if x_lo < 1 or y_lo < 1 or x_hi > width - 2 or y_hi > height - 2:
            return OUTSIDE
        window, room = (x_lo, x_hi, y_lo, y_hi), (x_hi - x_lo + 1) * (y_hi - y_lo + 1) + 1
        if room > pixels.shape[1]:
            pixels = np.empty((16, room), np.float32)
        n, inside, outside = _select_pixels(image, map_x, map_y, P, face, own, window, G, largest, p, u0, v0, pixels)
        if not (n >= 30 and math.isfinite(inside) and math.isfinite(outside)):
            return OCCLUDED
        if selection == 0:
            light = max(inside, outside, 1e-6)  # the unit of grey from here on: no result depends on the file's own
            p[ROW.level], p[ROW.contrast] = outside / light, 1.0 - inside / max(outside, 1e-6)
        dark = p[ROW.level] * (1.0 - p[ROW.contrast])
        read, gain, step2 = noise[0] / (light * light), noise[1] / light, noise[2] * noise[2] / (light * light)
        if abs(p[ROW.level] - dark) < 4.0 * math.sqrt(max(read + gain * max(p[ROW.level], dark), 0.1 * step2)):
            return LOW_CONTRAST
        in_light = 1.0 / light
        read_32, gain_32, floor = _f(read), _f(gain), _f(step2 / 12.0)
        level, step, inv_sigma = _f(p[ROW.level]), _f(dark - p[ROW.level]), _f(1.0 / p[ROW.sigma])
        distance, weight, grey = pixels[ROW.distance], pixels[ROW.weight], pixels[ROW.grey]
        for i in range(n):
            # weights from the expected grey value: weights from the noisy one would bias the fit towards dark pixels
            s, bell = _edge_profile(distance[i] * inv_sigma)
            weight[i] = _1 / math.sqrt(max(read_32 + gain_32 * (level + step * s), floor))
        for i in range(n):
            grey[i] *= in_light  # a product in double precision, rounded once
        u, v = _image_centroid(camera, point, R, unit, J)
        centroid = u - u0, v - v0
        limit = np.inf
        while True:  # once with all pixels, once without outliers
            converged, chi2, n_clipped = _descend(
                pixels, n, p, G, det, largest / abs(det), limit, work, blurred, centroid, nodes
            )
            if not converged:
                return NOT_CONVERGED
            if limit < np.inf:
                chi2 -= n_clipped * limit
                break
            a, b = p[ROW.a], p[ROW.b]
            settled = math.hypot(G[3, 0] * a + G[3, 1] * b, G[4, 0] * a + G[4, 1] * b) < _SETTLED_PX
            if not blurred and 1.0 / largest < _MIN_SEMI_MINOR * p[ROW.sigma]:
                settled = False  # more blurred than expected: fit the ellipse instead
            if not settled and selection < _MAX_ITERATIONS - 1:
                break
            # outliers (hot pixels, specks) are clipped; the limit grows with the rms residual of all pixels
            limit = _CLIP_SIGMA * _CLIP_SIGMA * max(1.0, chi2 / n)
            worst = _0
            for i in range(n):
                worst = max(worst, abs(pixels[ROW.residual, i]))
            if worst * worst <= limit:
                break
        for k in range(3):
            point[k] += unit * (R[k, 0] * p[ROW.a] + R[k, 1] * p[ROW.b])
        p[ROW.a], p[ROW.b] = 0.0, 0.0  # from here on
        if settled:
            break
    # covariance of the shift on the plane: the leading corner of (J^T W J)^-1
    M, x, y = work
    for i in range(8):
        x[i], y[i] = 1.0 if i == ROW.a else 0.0, 1.0 if i == ROW.b else 0.0
    substitute(M, x)
    substitute(M, y)
    a, b, c, d = G[3, 0], G[3, 1], G[4, 0], G[4, 1]
    result.var_u = a * a * x[ROW.a] + 2 * a * b * x[ROW.b] + b * b * y[ROW.b]
    result.var_v = c * c * x[ROW.a] + 2 * c * d * x[ROW.b] + d * d * y[ROW.b]
    result.cov_uv = a * c * x[ROW.a] + (a * d + b * c) * x[ROW.b] + b * d * y[ROW.b]
    result.u, result.v = project_point(camera, point[0], point[1], point[2], J)
    freedom, inside, n_inside = max(n - n_clipped - 8, 1), 0.0, 0.0
    for i in range(n):
        within = _1 if pixels[ROW.distance, i] < _0 else _0
        n_inside += within
        inside += within * pixels[ROW.residual, i] * pixels[ROW.residual, i]
    result.chi_square = chi2 / freedom
    result.inside = inside / max(n_inside, 1.0) * n / freedom
    result.outside = (chi2 - inside) / max(n - n_inside, 1.0) * n / freedom
    result.sigma, result.radius = p[ROW.sigma], unit * p[ROW.radius]
    result.level, result.contrast = light * p[ROW.level], p[ROW.contrast]
    result.clipped, result.n_pixels = n_clipped / n, n
    return MEASURED


@_part
def _judge_dot(result, radius, typical_sigma, noise, limits):
    """Refuse a converged fit that does not match the dot.

    A misfit must be large compared with both the noise and the contrast: small errors of the template must not reject
    the dots of a sensor with very low noise.
    """
    misfit = math.sqrt(max(result.chi_square, 0.0))
    step = abs(result.contrast * result.level)
    middle = result.level * (1.0 - 0.5 * result.contrast)
    share = misfit * math.sqrt(max(noise[0] + noise[1] * middle, 0.0)) / max(step, 1e-12)
    if (misfit > limits.misfit and share > limits.share) or result.clipped > limits.clipped:
        return OCCLUDED
    if abs(result.radius / radius - 1.0) > limits.radius:
        return OCCLUDED
    if result.sigma > limits.blur * typical_sigma + 1.0:
        return BLURRED
    return MEASURED


@_part
def _look(images, readable, maps, cameras, face, sigma, noise, limits, R, t, pixels, work, results, status):
    """Locate and judge the dots in the images (cameras, H, W) of one instant, with the disc near the pose R, t.

    Filled: results (cameras, m) of DOT, status (cameras, m); u, v are the image of the dot's centre, not the centre of
    its elliptical image.
    """
    centres, (intrinsics, R_cw, t_cw) = face[0], cameras
    R_cb, point = np.empty((3, 3)), np.empty(3)
    for c in range(images.shape[0]):
        for i in range(3):
            for j in range(3):
                R_cb[i, j] = R_cw[c, i, 0] * R[0, j] + R_cw[c, i, 1] * R[1, j] + R_cw[c, i, 2] * R[2, j]
        for i in range(centres.shape[0]):
            facing = 0.0
            for k in range(3):
                point[k] = t_cw[c, k]
                for j in range(3):
                    point[k] += R_cw[c, k, j] * t[j] + R_cb[k, j] * centres[i, j]
                facing -= R_cb[k, 2] * point[k]
            if not readable[c]:
                status[c, i] = NOT_LOOKED_FOR
            elif point[2] <= 0.0:
                status[c, i] = OUTSIDE
            elif facing <= 0.0:  # the camera sees the other face
                status[c, i] = OCCLUDED
            else:
                status[c, i] = _fit_dot(images[c], maps[0][c], maps[1][c], intrinsics[c], point, R_cb, face, i,
                                        sigma[c], noise[c], pixels, work, results[c, i])  # fmt: skip
            if status[c, i] == MEASURED:
                status[c, i] = _judge_dot(results[c, i], face[1], sigma[c], noise[c], limits)


@_part
def _predict(R, t):
    """Extrapolate poses R (4, 3, 3), t (4, 3) with constant second differences: D1 D0^T D1 after rotations D0 and D1.

    The error is the third difference of the motion. An extrapolation with constant velocity would err in proportion to
    the acceleration, and bias the centres with it (by the template's band and shape), by 1e-4 px.
    """
    for i in range(3):
        t[3, i] = 3.0 * (t[2, i] - t[1, i]) + t[0, i]
    _copy(R[3], R[2])
    _turn_on(R[2], R[1], R[3])
    _turn_on(R[0], R[1], R[3])
    _turn_on(R[2], R[1], R[3])


@_part
def _turn_on(to, since, R):
    """Apply the rotation from `since` to `to`: R = to since^T R."""
    for j in range(3):
        x, y, z = R[0, j], R[1, j], R[2, j]
        a = since[0, 0] * x + since[1, 0] * y + since[2, 0] * z
        b = since[0, 1] * x + since[1, 1] * y + since[2, 1] * z
        c = since[0, 2] * x + since[1, 2] * y + since[2, 2] * z
        for k in range(3):
            R[k, j] = to[k, 0] * a + to[k, 1] * b + to[k, 2] * c


@_part
def _orthonormalise(R, work):
    """One Newton step, R (3 - R^T R) / 2; without it R R_before^T R would triple the rounding error in every frame."""
    _copy(work, R)
    _turn_on(R, R, work)
    for i in range(3):
        for j in range(3):
            R[i, j] = 1.5 * R[i, j] - 0.5 * work[i, j]


@_part
def _settle(results, status, cameras, centres, R, t, dots, filled):
    """Fit the pose R, t to the dots of one pair; returns the rms residual [px], negative if the fit fails.

    A prediction needs no exact weights: each dot has sigma _FOLLOWED_PX at least, and Huber's weight beyond a pixel.
    """
    observed, covariance, used = dots
    count = 0
    for c in range(2):
        for m in range(centres.shape[0]):
            observed[c, m, 0], observed[c, m, 1] = results[c, m].u, results[c, m].v
            used[c, m] = status[c, m] == MEASURED
            count += used[c, m]
            for axis in range(2):
                covariance[c, m, axis, axis] = results[c, m].var_u + results[c, m].var_v + _FOLLOWED_PX * _FOLLOWED_PX
    if count < 3 or not fit_pose(observed, covariance, used, cameras, centres, 0.1, 1.0, R, t, filled):
        return -1.0
    total = 0.0
    for c in range(2):
        for m in range(centres.shape[0]):
            if used[c, m]:
                du, dv = observed[c, m, 0] - filled[0][c, m, 0], observed[c, m, 1] - filled[0][c, m, 1]
                total += du * du + dv * dv
    return math.sqrt(total / count)


@_entry
def track_frames(images, readable, maps, cameras, face, sigma, noise, limits, results, status, R, t, max_rms):
    """Follow the disc through a block of pairs, each predicted from the three before (`_predict`).

    images (n, 2, H, W); readable (n, 2); maps: x and y (2, H, W) undistorted normalised coordinates of the cameras'
    pixels; cameras as from `pose.stacked`, face as from `template.face_of`; sigma (2,) [px] of the dots' edges in each
    camera; noise (2, 3): variance = noise[0] + noise[1] grey, and the grey-value step. Filled: results (n, 2, m) of
    DOT, status (n, 2, m); R (3 + n, 3, 3), t (3 + n, 3) after the three poses before.
    Returns the number of frames followed; less than n if the disc was lost at that frame.
    """
    pixels, work = np.empty((16, _PIXELS), np.float32), (np.empty((8, 8)), np.empty(8), np.empty(8))
    R_expected, shape = np.empty((3, 3)), (2, face[0].shape[0])
    dots = np.empty((*shape, 2)), np.zeros((*shape, 2, 2)), np.empty(shape, np.bool_)
    filled = np.empty((*shape, 2)), np.empty((*shape, 2)), np.empty((*shape, 2, 6))
    for f in range(images.shape[0]):
        _predict(R[f : f + 4], t[f : f + 4])
        pose = R[f + 3], t[f + 3]
        rms = -1.0
        for _ in range(3):
            _copy(R_expected, pose[0])
            _look(images[f], readable[f], maps, cameras, face, sigma, noise, limits, *pose, pixels, work, results[f],
                  status[f])  # fmt: skip
            rms = _settle(results[f], status[f], cameras, face[0], *pose, dots, filled)
            turned = 0.0
            for i in range(3):
                for j in range(3):
                    turned += (pose[0][i, j] - R_expected[i, j]) * (pose[0][i, j] - R_expected[i, j])
            if rms < 0.0 or turned < 2.0 * _ATTITUDE_TOLERANCE * _ATTITUDE_TOLERANCE:
                break
        if not 0.0 <= rms < max_rms:
            return f
        _orthonormalise(pose[0], R_expected)
    return images.shape[0]
