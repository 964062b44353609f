"""Compiled inner loops of marker location and tracking (numba); their meaning is told in `dots` and `tracking`.

They are compiled because a recording needs about 12 fits of 500 pixels per pair at the camera's own rate of 1000
pairs/s: the same sums written with numpy calls per dot are some fifty times slower.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from scipy.special import erfc

# No NaN is ever tested inside the sums, so the fast floating-point rules change the last digit only.
_compiled = njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "arcp", "nsz", "reassoc"})

# Status codes: the values of trajectory.MarkerStatus, which a test keeps equal.
MEASURED, OUTSIDE, LOW_CONTRAST, OCCLUDED, NOT_CONVERGED, BLURRED = 0, 1, 2, 3, 4, 5
NOT_LOOKED_FOR = 7

# Template parameters, in the order of every array of eight below.
A, B, RADIUS, SIGMA, LEVEL, SLOPE_X, SLOPE_Y, CONTRAST = range(8)

# Columns of a dot's result: pixel centre, its covariance, and what is needed to judge the fit.
U, V, VAR_U, VAR_V, COV_UV, CHI_SQUARE, FIT_SIGMA, FIT_RADIUS, FIT_LEVEL, FIT_CONTRAST, CLIPPED, N_PIXELS = range(12)
N_RESULT = 12
SCRATCH_ROWS = 15

# Edge profile and its slope, tabulated: linear interpolation errs by 1.2e-7, and costs a tenth of erfc and exp.
_Z_MAX, _PER_UNIT = 6.0, 512
_z_nodes = np.arange(-_Z_MAX, _Z_MAX + 2.0 / _PER_UNIT, 1.0 / _PER_UNIT)
_EDGE = 0.5 * erfc(_z_nodes / math.sqrt(2.0))
_BELL = np.exp(-0.5 * _z_nodes**2) / math.sqrt(2.0 * math.pi)
_MAX_SELECTIONS = 4
_MAX_ITERATIONS = 20
_CONVERGED_PX = 2e-4  # length of the step that would come next: a twentieth of the noise of the best dots
_CLIP_SIGMA = 5.0
# Semi-minor axis in blurs: below, the two long edges melt into one another and the centre errs by more than its sigma.
_MIN_SEMI_MINOR = 3.7
_MIN_SEMI_MINOR_PX = 3.5  # in fewer pixels the edge distance itself is too coarse, however sharp the image
_ATTITUDE_TOLERANCE = 1.5e-3  # [rad] farther from the expected attitude a pair is looked at once more


@_compiled
def project_point(camera, X, Y, Z):
    """Pixel (u, v) of one point in camera axes; camera = the nine INTRINSIC_PARAMETERS. Twin of camera.project."""
    a, b = X / Z, Y / Z
    r2 = a * a + b * b
    radial = 1.0 + r2 * (camera[4] + r2 * (camera[5] + r2 * camera[8]))
    xd = a * radial + 2 * camera[6] * a * b + camera[7] * (r2 + 2 * a * a)
    yd = b * radial + camera[6] * (r2 + 2 * b * b) + 2 * camera[7] * a * b
    return camera[0] * xd + camera[2], camera[1] * yd + camera[3]


@_compiled
def project_point_jacobian(camera, X, Y, Z, J):
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


@_compiled
def _substitute(L, x, n):
    """Replace x by the solution of L L^T x = x for a Cholesky factor L (lower triangle)."""
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


@_compiled
def solve_in_place(M, x, n):
    """Solve the symmetric positive definite M[:n, :n] x = x by Cholesky; False where M is not positive definite."""
    for i in range(n):
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
    _substitute(M, x, n)
    return True


@_compiled
def _plane_point(P, xn, yn):
    """Coordinates on the target plane of the normalised image point; P (3, 3) maps image to plane homogeneously."""
    w = 1.0 / (P[2, 0] * xn + P[2, 1] * yn + P[2, 2])
    return (P[0, 0] * xn + P[0, 1] * yn + P[0, 2]) * w, (P[1, 0] * xn + P[1, 1] * yn + P[1, 2]) * w


@_compiled
def _plane_gradient(map_x, map_y, P, iu, iv, G):
    """Derivatives of the exact map at the pixel (iu, iv) by central differences; returns the determinant.

    G (3, 2): rows 0 and 1 are d plane point / d pixel; row 2 is the relative change per 10 px of the length that a
    pixel spans along the direction moved: -2 d log w, w the denominator of the projective map.
    """
    x1, y1 = _plane_point(P, map_x[iv, iu + 1], map_y[iv, iu + 1])
    x0, y0 = _plane_point(P, map_x[iv, iu - 1], map_y[iv, iu - 1])
    G[0, 0], G[1, 0] = 0.5 * (x1 - x0), 0.5 * (y1 - y0)
    x1, y1 = _plane_point(P, map_x[iv + 1, iu], map_y[iv + 1, iu])
    x0, y0 = _plane_point(P, map_x[iv - 1, iu], map_y[iv - 1, iu])
    G[0, 1], G[1, 1] = 0.5 * (x1 - x0), 0.5 * (y1 - y0)
    xn, yn = map_x[iv, iu], map_y[iv, iu]
    w = P[2, 0] * xn + P[2, 1] * yn + P[2, 2]
    G[2, 0] = (
        10.0
        * (P[2, 0] * (map_x[iv, iu + 1] - map_x[iv, iu - 1]) + P[2, 1] * (map_y[iv, iu + 1] - map_y[iv, iu - 1]))
        / w
    )
    G[2, 1] = (
        10.0
        * (P[2, 0] * (map_x[iv + 1, iu] - map_x[iv - 1, iu]) + P[2, 1] * (map_y[iv + 1, iu] - map_y[iv - 1, iu]))
        / w
    )
    return G[0, 0] * G[1, 1] - G[0, 1] * G[1, 0]


@_compiled
def _edge_distance(dx, dy, radius, G, det):
    """Signed distance [px] of a pixel from the dot's edge (positive outside), with what its derivatives need.

    rho = |(dx, dy)| on the plane, F = rho - radius, g = |grad_u F|. To second order the foot point lies at
    d = F/g (1 + t), t = h F/(2 g^2); inside, 1/(1 - t) has the same order and keeps its sign in slender ellipses.
    Returns d, dd/drho, the unit radius (nx, ny), g and the curvature of the level line in the image, det^2/(rho g^3).
    """
    rho = math.sqrt(dx * dx + dy * dy) + 1e-15
    inv_rho = 1.0 / rho
    nx, ny = dx * inv_rho, dy * inv_rho
    gx, gy = G[0, 0] * nx + G[1, 0] * ny, G[0, 1] * nx + G[1, 1] * ny
    g2 = gx * gx + gy * gy
    g = math.sqrt(g2)
    inv_g = 1.0 / g
    inv_g2 = inv_g * inv_g
    # h = (m . G ghat)^2 / rho with m perpendicular to n
    along = -ny * (G[0, 0] * gx + G[0, 1] * gy) + nx * (G[1, 0] * gx + G[1, 1] * gy)
    F = rho - radius
    bend = 0.5 * along * along * F * inv_rho * inv_g2 * inv_g2
    curvature = det * det * inv_rho * inv_g2 * inv_g
    if F > 0.0:
        return F * inv_g * (1.0 + bend), (1.0 + 2.0 * bend) * inv_g, nx, ny, g, curvature
    shrink = 1.0 / (1.0 - max(bend, -0.3))  # the expansion ends well before the dot's own centre, where rho = 0
    return F * inv_g * shrink, inv_g * shrink * shrink, nx, ny, g, curvature


@_compiled
def _select_pixels(image, map_x, map_y, P, start, window, rim, neighbours, G, det, steepest, p, u0, v0, scratch):
    """Fill scratch with the pixels in a band round the edge; return their number and the mean grey in and outside."""
    x_lo, x_hi, y_lo, y_hi = window
    band = 3.0 * p[SIGMA] + 1.0
    n = 0
    inside_sum, inside_n, outside_sum, outside_n = 0.0, 0, 0.0, 0
    # bounds on the distance from the centre that need no square root: most pixels of the window are decided by them
    outer = p[RADIUS] + band * steepest
    inner = max(p[RADIUS] - 1.4 * (band + 1.0) * steepest, 0.0)
    for y in range(y_lo, y_hi + 1):
        for x in range(x_lo, x_hi + 1):
            X, Y = _plane_point(P, map_x[y, x], map_y[y, x])
            dx, dy = X - start[0] - p[A], Y - start[1] - p[B]
            rho2 = dx * dx + dy * dy
            if not inner * inner < rho2 < outer * outer:  # also NaN: a pixel without a ray
                continue
            d, slope, nx, ny, g, curvature = _edge_distance(dx, dy, p[RADIUS], G, det)
            if not -band - 1.0 < d < band or n >= scratch.shape[1]:
                continue
            near = math.hypot(X, Y) > rim - 2.5 * p[SIGMA] * g
            for k in range(neighbours.shape[0]):
                if math.hypot(X - neighbours[k, 0], Y - neighbours[k, 1]) - start[2] < 3.0 * p[SIGMA] * g:
                    near = True
            if near:
                continue
            grey = float(image[y, x])
            scratch[0, n], scratch[1, n], scratch[2, n] = X - start[0], Y - start[1], grey
            scratch[3, n], scratch[4, n], scratch[5, n] = 0.1 * (x - u0), 0.1 * (y - v0), d
            n += 1
            if d < -1.2 * p[SIGMA]:
                inside_sum += grey
                inside_n += 1
            elif d > 1.2 * p[SIGMA]:
                outside_sum += grey
                outside_n += 1
    inside = inside_sum / inside_n if inside_n >= 3 else np.nan
    outside = outside_sum / outside_n if outside_n >= 8 else np.nan
    return n, inside, outside


@_compiled
def _edge_profile(z):
    """Fraction of the dot seen z sigmas outside its edge, and the bell that is minus its slope."""
    if z >= _Z_MAX:
        return 0.0, 0.0
    if z <= -_Z_MAX:
        return 1.0, 0.0
    place = (z + _Z_MAX) * _PER_UNIT
    i = int(place)
    f = place - i
    return _EDGE[i] + f * (_EDGE[i + 1] - _EDGE[i]), _BELL[i] + f * (_BELL[i + 1] - _BELL[i])


@_compiled
def _whitened_model(scratch, n, p, G, det, clip):
    """Fill scratch rows 6-13 with d model / d p and row 14 with the residual, each over the pixel's sigma.

    model = (level + slopes . offset) * (1 - contrast * S(z)), S the blurred edge: erfc of the distance over sigma.
    Pixels whose squared whitened residual exceeds clip get zeros. Returns chi-square (clipped pixels count as clip),
    their number and the largest squared residual.
    """
    chi2, n_clipped, largest = 0.0, 0, 0.0
    sigma, inv_sigma, contrast = p[SIGMA], 1.0 / p[SIGMA], p[CONTRAST]
    near_x, near_y = G[2, 0], G[2, 1]
    for i in range(n):
        d, slope, nx, ny, g, curvature = _edge_distance(scratch[0, i] - p[A], scratch[1, i] - p[B], p[RADIUS], G, det)
        # the gradient was taken at the dot's centre: perspective changes the scale over the dot, and what counts is the
        # scale half way between the pixel and the edge (at the pixel itself it would shift centres by 5e-4 px)
        half = 0.05 * d / g
        mid_x = scratch[3, i] - half * (G[0, 0] * nx + G[1, 0] * ny)
        mid_y = scratch[4, i] - half * (G[0, 1] * nx + G[1, 1] * ny)
        d *= 1.0 + near_x * mid_x + near_y * mid_y
        # a curved edge blurred by sigma looks shifted inwards by sigma^2 / (2 radius of curvature)
        z = d * inv_sigma + 0.5 * curvature * sigma
        s, bell = _edge_profile(z)
        light = p[LEVEL] + p[SLOPE_X] * scratch[3, i] + p[SLOPE_Y] * scratch[4, i]
        weight = scratch[5, i]
        seen = (1.0 - contrast * s) * weight
        r = scratch[2, i] * weight - light * seen
        squared = r * r
        largest = max(largest, squared)
        if squared > clip:
            n_clipped += 1
            chi2 += clip
            for row in range(6, 15):
                scratch[row, i] = 0.0
            continue
        chi2 += squared
        edge = -light * contrast * bell * inv_sigma * weight  # - d model / d distance
        scratch[6, i], scratch[7, i], scratch[8, i] = edge * nx * slope, edge * ny * slope, edge * slope
        scratch[9, i] = edge * (z - curvature * sigma)
        scratch[10, i], scratch[11, i], scratch[12, i] = seen, seen * scratch[3, i], seen * scratch[4, i]
        scratch[13, i] = -light * s * weight
        scratch[14, i] = r
    return chi2, n_clipped, largest


@_compiled
def _normal_equations(scratch, n, p, G, det, clip, M, rhs):
    """Fill M = J^T W J (lower triangle) and rhs = J^T W r; returns as `_whitened_model`."""
    chi2, n_clipped, largest = _whitened_model(scratch, n, p, G, det, clip)
    for j in range(8):
        for k in range(j + 1):
            total = 0.0
            for i in range(n):  # contiguous: the compiler makes vector code of it
                total += scratch[6 + j, i] * scratch[6 + k, i]
            M[j, k] = total
        total = 0.0
        for i in range(n):
            total += scratch[6 + j, i] * scratch[14, i]
        rhs[j] = total
    return chi2, n_clipped, largest


@_compiled
def _descend(scratch, n, p, G, det, px_per_unit, radius, clip, M, rhs):
    """Levenberg-Marquardt on the eight template parameters; returns converged, chi-square, clipped, largest residual.

    On convergence M holds the Cholesky factor of J^T W J at the minimum.
    """
    previous, step = p.copy(), np.empty(8)
    damping, last, rejected = 1e-7, np.inf, False
    before = np.inf  # length of the last step: the ratio of two tells how fast the iteration contracts
    for _ in range(_MAX_ITERATIONS):
        chi2, n_clipped, largest = _normal_equations(scratch, n, p, G, det, clip, M, rhs)
        # the Jacobian leaves out how the curvature moves, so chi-square may creep by a trifle at the minimum
        if chi2 > 1.001 * last + 0.01 and not rejected:
            p[:] = previous
            damping, rejected = max(1e-2, damping * 30.0), True
            if damping > 1e6:
                return False, chi2, n_clipped, largest
            continue
        if not rejected:
            damping = max(0.03 * damping, 1e-9)
        last, rejected = chi2, False
        previous[:] = p
        for i in range(8):
            step[i] = rhs[i]
            M[i, i] *= 1.0 + damping
        if not solve_in_place(M, step, 8):
            return False, chi2, n_clipped, largest
        length = math.hypot(step[A], step[B])
        scale = min(1.0, 0.4 * radius / max(length, 1e-30))
        for i in range(8):
            p[i] += scale * step[i]
        p[SIGMA] = min(max(p[SIGMA], 0.4 * previous[SIGMA], 0.2), 2.0 * previous[SIGMA])
        if not (0.5 * radius < p[RADIUS] < 1.6 * radius and p[SIGMA] < 20.0):
            return False, chi2, n_clipped, largest
        length *= px_per_unit
        contraction = min(length / before, 1.0) if before < np.inf else 1.0
        if length * contraction < _CONVERGED_PX and damping < 1e-3 and length < 0.1:
            gain = 0.0
            for i in range(8):
                gain += step[i] * rhs[i]
            if gain > 0.5:  # the sums were taken before a step that mattered to them
                chi2, n_clipped, largest = _whitened_model(scratch, n, p, G, det, clip)
            return True, chi2, n_clipped, largest
        before = length
    return False, last, 0, np.inf


@_compiled
def _inverse_corner(L, n, out):
    """Leading 2 x 2 block of (L L^T)^-1 for a Cholesky factor L (n, n)."""
    x = np.empty(n)
    for column in range(2):
        for i in range(n):
            x[i] = 1.0 if i == column else 0.0
        _substitute(L, x, n)
        out[0, column], out[1, column] = x[0], x[1]


@_compiled
def fit_dot(image, map_x, map_y, P, start, sigma, noise, rim, neighbours, scratch, p, result):
    """Fit the image of one circular dot to the grey values round its edge. Returns a MarkerStatus code.

    image (H, W); map_x, map_y (H, W): normalised coordinates of every pixel; P (3, 3): normalised image -> target
    plane; start (5,): expected centre and radius on the plane, pixel of that centre; sigma: blur to start from [px];
    noise (3,): variance = noise[0] + noise[1] grey, and the square of the grey values' step; rim: radius of an edge
    about the plane's origin whose blur must not reach the pixels used, nor that of `neighbours` (k, 2), the other dots'
    centres; scratch (SCRATCH_ROWS, N).
    p (8,) receives the template's parameters (A, B: shift on the plane from the expected centre), result (12,) the
    judgement of the fit and the centre's covariance in pixels. The caller projects the centre itself (U, V).
    """
    height, width = image.shape
    G, plane_covariance = np.empty((3, 2)), np.empty((2, 2))
    M, rhs = np.zeros((8, 8)), np.empty(8)
    u0, v0, radius = start[3], start[4], start[2]
    p[A], p[B], p[RADIUS], p[SIGMA] = 0.0, 0.0, radius, sigma
    n, n_clipped, det, chi2, worst = 0, 0, 0.0, 0.0, 0.0
    for selection in range(_MAX_SELECTIONS):
        if not (2.0 < u0 < width - 3.0 and 2.0 < v0 < height - 3.0):
            return OUTSIDE
        det = _plane_gradient(map_x, map_y, P, int(round(u0)), int(round(v0)), G)
        norm2 = G[0, 0] ** 2 + G[0, 1] ** 2 + G[1, 0] ** 2 + G[1, 1] ** 2
        largest = math.sqrt(0.5 * (norm2 + math.sqrt(max(norm2 * norm2 - 4 * det * det, 0.0))))
        if not abs(det) > 1e-9 * norm2:
            return BLURRED
        if radius / largest < max(_MIN_SEMI_MINOR * p[SIGMA], _MIN_SEMI_MINOR_PX):
            return BLURRED
        band = 3.0 * p[SIGMA] + 1.0
        extent_x = radius * math.hypot(G[0, 1], G[1, 1]) / abs(det) + band
        extent_y = radius * math.hypot(G[0, 0], G[1, 0]) / abs(det) + band
        window = (
            int(math.floor(u0 - extent_x)),
            int(math.ceil(u0 + extent_x)),
            int(math.floor(v0 - extent_y)),
            int(math.ceil(v0 + extent_y)),
        )
        if window[0] < 1 or window[2] < 1 or window[1] > width - 2 or window[3] > height - 2:
            return OUTSIDE
        n, inside, outside = _select_pixels(
            image, map_x, map_y, P, start, window, rim, neighbours, G, det, largest, p, u0, v0, scratch
        )
        if not (n >= 30 and math.isfinite(inside) and math.isfinite(outside)):
            return OCCLUDED
        if selection == 0:
            p[LEVEL], p[SLOPE_X], p[SLOPE_Y] = outside, 0.0, 0.0
            p[CONTRAST] = 1.0 - inside / max(outside, 1e-6)
        dark = p[LEVEL] * (1.0 - p[CONTRAST])
        if abs(p[LEVEL] - dark) < 4.0 * math.sqrt(max(noise[0] + noise[1] * max(p[LEVEL], dark), 0.1 * noise[2])):
            return LOW_CONTRAST
        for i in range(n):
            # weights from the expected grey value: the noisy one would pull the fit towards dark pixels
            s, bell = _edge_profile(scratch[5, i] / p[SIGMA])
            expected = p[LEVEL] + (dark - p[LEVEL]) * s
            scratch[5, i] = 1.0 / math.sqrt(max(noise[0] + noise[1] * expected, noise[2] / 12.0))
        px_per_unit = largest / abs(det)
        converged, chi2, n_clipped, worst = _descend(scratch, n, p, G, det, px_per_unit, radius, np.inf, M, rhs)
        if not converged:
            return NOT_CONVERGED
        moved_u = start[3] + (G[1, 1] * p[A] - G[0, 1] * p[B]) / det - u0
        moved_v = start[4] + (G[0, 0] * p[B] - G[1, 0] * p[A]) / det - v0
        u0 += moved_u
        v0 += moved_v
        if math.hypot(moved_u, moved_v) < 0.7:
            break
    # robust end: hot pixels and specks leave the sum; where the model misfits everywhere the limit follows
    limit = _CLIP_SIGMA**2 * max(1.0, chi2 / n)
    if worst > limit:
        converged, chi2, n_clipped, worst = _descend(scratch, n, p, G, det, largest / abs(det), radius, limit, M, rhs)
        if not converged:
            return NOT_CONVERGED
        chi2 -= n_clipped * limit
    _inverse_corner(M, 8, plane_covariance)
    a, b, c, d = G[1, 1] / det, -G[0, 1] / det, -G[1, 0] / det, G[0, 0] / det
    Q = plane_covariance
    result[VAR_U] = a * a * Q[0, 0] + 2 * a * b * Q[0, 1] + b * b * Q[1, 1]
    result[VAR_V] = c * c * Q[0, 0] + 2 * c * d * Q[0, 1] + d * d * Q[1, 1]
    result[COV_UV] = a * c * Q[0, 0] + (a * d + b * c) * Q[0, 1] + b * d * Q[1, 1]
    result[CHI_SQUARE] = chi2 / max(n - n_clipped - 8, 1)
    result[FIT_SIGMA], result[FIT_RADIUS] = p[SIGMA], p[RADIUS]
    result[FIT_LEVEL], result[FIT_CONTRAST] = p[LEVEL], p[CONTRAST]
    result[CLIPPED], result[N_PIXELS] = n_clipped / n, n
    return MEASURED


@_compiled
def _invert3(M, out):
    """Inverse of a 3 x 3 matrix by cofactors."""
    for i in range(3):
        for j in range(3):
            a, b, c, d = (j + 1) % 3, (j + 2) % 3, (i + 1) % 3, (i + 2) % 3
            out[i, j] = M[a, c] * M[b, d] - M[a, d] * M[b, c]
    det = M[0, 0] * out[0, 0] + M[0, 1] * out[1, 0] + M[0, 2] * out[2, 0]
    for i in range(3):
        for j in range(3):
            out[i, j] /= det


@_compiled
def locate_dots(
    image,
    map_x,
    map_y,
    camera,
    R_camera_body,
    t_camera_body,
    centres,
    radius,
    rim,
    sigma,
    noise,
    scratch,
    results,
    status,
):
    """Fit every dot of the disc in one image, the disc's pose being known to a few pixels.

    centres (m, 3) on the body; results (m, 12) and status (m,) are filled; U, V are the image of the dot's own centre,
    not the centre of its elliptical image.
    """
    m = centres.shape[0]
    M, P, start, p = np.empty((3, 3)), np.empty((3, 3)), np.empty(5), np.empty(8)
    R, t = R_camera_body, t_camera_body
    neighbours = np.empty((max(m - 1, 0), 2))
    for i in range(m):
        results[i, :] = np.nan
        x, y, z = centres[i, 0], centres[i, 1], centres[i, 2]
        point = np.empty(3)
        for k in range(3):
            M[k, 0], M[k, 1], M[k, 2] = R[k, 0], R[k, 1], R[k, 2] * z + t[k]
            point[k] = R[k, 0] * x + R[k, 1] * y + R[k, 2] * z + t[k]
        facing = -(R[0, 2] * point[0] + R[1, 2] * point[1] + R[2, 2] * point[2])
        if point[2] <= 0.0:
            status[i] = OUTSIDE
            continue
        if facing <= 0.0:  # the camera sees the other face
            status[i] = OCCLUDED
            continue
        _invert3(M, P)
        start[0], start[1], start[2] = x, y, radius
        start[3], start[4] = project_point(camera, point[0], point[1], point[2])
        count = 0
        for k in range(m):
            if k != i:
                neighbours[count, 0], neighbours[count, 1] = centres[k, 0], centres[k, 1]
                count += 1
        status[i] = fit_dot(image, map_x, map_y, P, start, sigma, noise, rim, neighbours, scratch, p, results[i])
        if status[i] == MEASURED:
            for k in range(3):
                point[k] += R[k, 0] * p[A] + R[k, 1] * p[B]
            results[i, U], results[i, V] = project_point(camera, point[0], point[1], point[2])


@_compiled
def judge_dot(result, radius, typical_sigma, noise, limits):
    """Refuse a converged fit that does not look like the dot: limits = misfit, share, clipped, radius, blur.

    A misfit counts when it is large beside the noise and beside the contrast: the template's own small errors must not
    condemn the dots of a sensor that hardly has any noise.
    """
    misfit = math.sqrt(max(result[CHI_SQUARE], 0.0))
    step = abs(result[FIT_CONTRAST] * result[FIT_LEVEL])
    middle = result[FIT_LEVEL] * (1.0 - 0.5 * result[FIT_CONTRAST])
    share = misfit * math.sqrt(max(noise[0] + noise[1] * middle, 0.0)) / max(step, 1e-12)
    if (misfit > limits[0] and share > limits[1]) or result[CLIPPED] > limits[2]:
        return OCCLUDED
    if abs(result[FIT_RADIUS] / radius - 1.0) > limits[3]:
        return OCCLUDED
    if result[FIT_SIGMA] > limits[4] * typical_sigma + 1.0:
        return BLURRED
    return MEASURED


@_compiled
def _rotate_from_left(v, R, out):
    """Out = exp([v]x) R by Rodrigues' formula."""
    angle2 = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
    angle = math.sqrt(angle2)
    if angle < 1e-6:
        a, b = 1.0, 0.5
    else:
        a, b = math.sin(angle) / angle, (1.0 - math.cos(angle)) / angle2
    for j in range(3):
        x, y, z = R[0, j], R[1, j], R[2, j]
        cx, cy, cz = v[1] * z - v[2] * y, v[2] * x - v[0] * z, v[0] * y - v[1] * x
        out[0, j] = x + a * cx + b * (v[1] * cz - v[2] * cy)
        out[1, j] = y + a * cy + b * (v[2] * cx - v[0] * cz)
        out[2, j] = z + a * cz + b * (v[0] * cy - v[1] * cx)


@_compiled
def _orthonormalise(R):
    """Gram-Schmidt on the rows; without it R R_before^T R would treble any departure in every frame."""
    for i in range(2):
        for k in range(i):
            dot = R[i, 0] * R[k, 0] + R[i, 1] * R[k, 1] + R[i, 2] * R[k, 2]
            for j in range(3):
                R[i, j] -= dot * R[k, j]
        length = math.sqrt(R[i, 0] ** 2 + R[i, 1] ** 2 + R[i, 2] ** 2)
        for j in range(3):
            R[i, j] /= length
    R[2, 0] = R[0, 1] * R[1, 2] - R[0, 2] * R[1, 1]
    R[2, 1] = R[0, 2] * R[1, 0] - R[0, 0] * R[1, 2]
    R[2, 2] = R[0, 0] * R[1, 1] - R[0, 1] * R[1, 0]


@_compiled
def _pose_step(results, status, cameras, R_cw, t_cw, centres, R, t, step):
    """One Gauss-Newton step (translation, world rotation vector) of the disc's pose from the dots of one pair.

    Huber weights keep one wrong dot from pulling the prediction away. Returns the rms residual before the step [px],
    or -1 where fewer than three dots or a singular system leave nothing to solve.
    """
    M, J = np.zeros((6, 6)), np.empty((2, 3))
    row = np.empty(6)
    arm, point = np.empty(3), np.empty(3)
    for i in range(6):
        step[i] = 0.0
    total, count = 0.0, 0
    for c in range(2):
        for m in range(centres.shape[0]):
            if status[c, m] != MEASURED:
                continue
            for i in range(3):
                arm[i] = R[i, 0] * centres[m, 0] + R[i, 1] * centres[m, 1] + R[i, 2] * centres[m, 2]
            for i in range(3):
                point[i] = t_cw[c, i]
                for j in range(3):
                    point[i] += R_cw[c, i, j] * (arm[j] + t[j])
            if point[2] <= 0.0:
                return -1.0
            u, v = project_point_jacobian(cameras[c], point[0], point[1], point[2], J)
            du, dv = results[c, m, U] - u, results[c, m, V] - v
            distance = math.hypot(du, dv)
            total += distance * distance
            count += 1
            # 0.05 px is added: a prediction need not follow the noise of the best dots
            w = 1.0 / (results[c, m, VAR_U] + results[c, m, VAR_V] + 0.0025)
            if distance > 1.0:
                w /= distance
            for axis in range(2):
                r = du if axis == 0 else dv
                for i in range(3):
                    row[i] = 0.0
                    for j in range(3):
                        row[i] += J[axis, j] * R_cw[c, j, i]
                row[3] = arm[1] * row[2] - arm[2] * row[1]
                row[4] = arm[2] * row[0] - arm[0] * row[2]
                row[5] = arm[0] * row[1] - arm[1] * row[0]
                for i in range(6):
                    step[i] += w * row[i] * r
                    for j in range(i + 1):
                        M[i, j] += w * row[i] * row[j]
    if count < 3 or not solve_in_place(M, step, 6):
        return -1.0
    return math.sqrt(total / count)


@_compiled
def _predict(R_last, t_last, R_before, t_before, R, t):
    """The next pose if the last turn and the last shift are made once more: R = (R_last R_before^T) R_last."""
    for i in range(3):
        t[i] = 2.0 * t_last[i] - t_before[i]
        for j in range(3):
            R[i, j] = 0.0
            for k in range(3):
                turn = 0.0
                for q in range(3):
                    turn += R_last[i, q] * R_before[k, q]
                R[i, j] += turn * R_last[k, j]


@_compiled
def _look(images, readable, map_x, map_y, cameras, R_cw, t_cw, centres, radius, rim, sigma, noise, limits, R, t,
          scratch, results, status):  # fmt: skip
    """Locate and judge the dots of one pair (2, H, W), the disc being near the pose R, t."""
    R_cb, t_cb = np.empty((3, 3)), np.empty(3)
    for c in range(2):
        if not readable[c]:
            results[c, :, :] = np.nan
            status[c, :] = NOT_LOOKED_FOR
            continue
        for i in range(3):
            t_cb[i] = t_cw[c, i]
            for j in range(3):
                t_cb[i] += R_cw[c, i, j] * t[j]
                R_cb[i, j] = 0.0
                for k in range(3):
                    R_cb[i, j] += R_cw[c, i, k] * R[k, j]
        locate_dots(images[c], map_x[c], map_y[c], cameras[c], R_cb, t_cb, centres, radius, rim, sigma[c], noise[c],
                    scratch, results[c], status[c])  # fmt: skip
        for i in range(centres.shape[0]):
            if status[c, i] == MEASURED:
                status[c, i] = judge_dot(results[c, i], radius, sigma[c], noise[c], limits)


@_compiled
def _settle(results, status, cameras, R_cw, t_cw, centres, R, t):
    """Move the pose R, t onto the dots of one pair; returns the rms residual [px], negative without an answer."""
    step, R_new = np.empty(6), np.empty((3, 3))
    rms = -1.0
    for _ in range(5):
        rms = _pose_step(results, status, cameras, R_cw, t_cw, centres, R, t, step)
        if rms < 0.0:
            return rms
        for i in range(3):
            t[i] += step[i]
        _rotate_from_left(step[3:], R, R_new)
        R[:] = R_new
        if (
            math.fabs(step[0]) + math.fabs(step[1]) + math.fabs(step[2]) < 1e-6
        ):  # a micrometre: a prediction needs no more
            break
    _orthonormalise(R)
    return rms


@_compiled
def track_frames(images, readable, map_x, map_y, cameras, R_cw, t_cw, centres, radius, rim, sigma, noise, limits,
                 R_last, t_last, R_before, t_before, results, status, R_out, t_out, max_rms):  # fmt: skip
    """Follow the disc through a block of pairs, each predicted from the two before by constant velocity and turn.

    images (n, 2, H, W); readable (n, 2); map_x, map_y (2, H, W); cameras (2, 9); sigma (2,), noise (2, 3), limits (5,)
    for `judge_dot`. R_last ... t_before hold the last two poses and are updated. Filled: results (n, 2, m, 12), status
    (n, 2, m), R_out (n, 3, 3), t_out (n, 3). Returns the number of frames followed; less than n where the disc was
    lost at that frame.
    """
    scratch = np.empty((SCRATCH_ROWS, 40000))
    R, t, R_expected = np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    for f in range(images.shape[0]):
        _predict(R_last, t_last, R_before, t_before, R, t)
        rms = -1.0
        for _ in range(3):
            R_expected[:] = R
            _look(images[f], readable[f], map_x, map_y, cameras, R_cw, t_cw, centres, radius, rim, sigma, noise, limits,
                  R, t, scratch, results[f], status[f])  # fmt: skip
            rms = _settle(results[f], status[f], cameras, R_cw, t_cw, centres, R, t)
            # the template's shape follows the expected attitude: an error of 3 mrad moves centres by 1e-3 px
            if rms < 0.0 or np.sum((R - R_expected) ** 2) < 2.0 * _ATTITUDE_TOLERANCE**2:
                break
        if not 0.0 <= rms < max_rms:
            return f
        R_out[f], t_out[f] = R, t
        R_before[:], t_before[:] = R_last, t_last
        R_last[:], t_last[:] = R, t
    return images.shape[0]
