"""Compiled fit of one inner corner of a chessboard to the grey values around it.

The image of a corner is sign(u) sign(v), u and v the signed distances from its two edges, seen through a Gaussian blur:
with h = u / sigma, k = v / sigma and rho the cosine between the edges' normals,

    S(h, k; rho) = E[sign(h + n1) sign(k + n2)] = 4 Phi2(h, k; rho) - 2 Phi(h) - 2 Phi(k) + 1,

exact for any angle between the edges (a product of two error functions is exact only at 90 degrees). sigma^2 contains
the variance 1/12 of the square pixel; an Edgeworth term adds its fourth cumulant, which a Gaussian lacks. Perspective
maps lines to lines, so the intersection of the edges is an unbiased corner; the curvature of the edges by lens
distortion is known. A gradient of the illumination multiplies both levels, and is fitted. Added light (glare, lens
flare) raises the dark level by the larger fraction, so that the contrast changes over the window. If neglected, a
gradient of 0.1 grey values per px shifts the corner by 0.004 px; it is known from the other corners.

Compiled with numba: one view takes some 10^6 evaluations of this model, 0.05 s.
"""

import math

import numpy as np

from calibration.kit._cholesky import solve_in_place
from calibration.kit.compiled import njit, part

# x, y [px], two edge angles [rad], blur sigma [px], mean grey, half contrast, relative light gradient [1/px]
N_CORNER = 9
FLAT = 0.995  # |S| above which a pixel lies inside a square, where the residual is the image noise
MIN_BLUR = 0.3  # px, just above that of the square pixel: sharpened edges may be sharper than any lens makes them
_FAR = 5.0  # sigmas from an edge, beyond which S is constant to 6e-7
_X, _W = np.polynomial.legendre.leggauss(8)
_N_NODES = len(_X)
_SQRT_HALF = math.sqrt(0.5)

# Compile time: functions that only compiled code calls have no Python wrapper, which would double it. Loops replace
# assignments of slices, as numba's error message for unequal shapes takes longer to compile than a loop. Literals are
# passed as NumPy scalars: numba compiles a function for every literal, but once for a type.


@part
def nodes(rho):  # type: ignore[no-untyped-def]
    """Quadrature over the angle 0..asin(rho): weight, sine and 1 / (2 cos^2) at each node."""
    table = np.zeros((_N_NODES, 3))
    half = 0.5 * math.asin(rho)
    for n in range(_N_NODES):
        sine = math.sin(half * (1.0 + _X[n]))
        table[n, 0] = _W[n] * half * 2.0 / math.pi
        table[n, 1] = sine
        table[n, 2] = 0.5 / (1.0 - sine * sine)
    return table


@part
def blurred_saddle(h, k, rho, table, out):  # type: ignore[no-untyped-def]
    """S and its derivatives with respect to h, k and rho, into out (4,); table from `nodes(rho)`."""
    near_h, near_k = abs(h) < _FAR, abs(k) < _FAR
    erf_h = math.erf(h * _SQRT_HALF) if near_h else (1.0 if h > 0 else -1.0)
    erf_k = math.erf(k * _SQRT_HALF) if near_k else (1.0 if k > 0 else -1.0)
    S = erf_h * erf_k
    S_h = S_k = S_rho = 0.0
    s = math.sqrt(1.0 - rho * rho)
    if near_h:
        S_h = 0.7978845608028654 * math.exp(-0.5 * h * h) * math.erf((k - rho * h) / s * _SQRT_HALF)
    if near_k:
        S_k = 0.7978845608028654 * math.exp(-0.5 * k * k) * math.erf((h - rho * k) / s * _SQRT_HALF)
    square = h * h + k * k
    if square - 2.0 * abs(rho * h * k) < 30.0:  # otherwise the integrand is below exp(-15)
        S_rho = 2.0 / (math.pi * s) * math.exp(-0.5 * (square - 2.0 * rho * h * k) / (s * s))
        for n in range(_N_NODES):
            S += table[n, 0] * math.exp(-(square - 2.0 * h * k * table[n, 1]) * table[n, 2])
    out[0], out[1], out[2], out[3] = S, S_h, S_k, S_rho


@part
def normal_equations(image, window, p, known, noise, weights, first_pass, H, g):  # type: ignore[no-untyped-def]
    """Normal equations of one corner, written to H (9, 9) and g (9,). Returns chi-square and sums over pixels.

    weights : of the window's pixels; set in the first pass from the noise at the model's grey values, then constant, so
    that chi-square is a fixed function of p, which Gauss-Newton steps decrease

    known (4,): curvatures of the two edges [1/px]; relative gradient of contrast minus that of illumination [1/px]
    window (14,): x0, x1, y0, y1 [px, inclusive]; centre x, y; inverse of the local axes, row by row; half widths along
    i and j [squares]; largest step [px]; distance from both edges [squares] beyond which the light squares contain
    a marker, positive if the light squares have i j > 0, negative if i j < 0.
    """
    gradient, S4 = np.zeros(N_CORNER), np.zeros(4)
    H[:] = 0.0
    g[:] = 0.0
    sums = np.zeros(9)  # chi2, n; dark: r2, grey, n; light: r2, grey, n; edge chi2
    c1, s1, c2, s2 = math.cos(p[2]), math.sin(p[2]), math.cos(p[3]), math.sin(p[3])
    bend1, bend2 = known[0], known[1]
    rho, turn, inverse_sigma = math.cos(p[3] - p[2]), math.sin(p[3] - p[2]), 1.0 / p[4]
    table = nodes(rho)
    # Edgeworth: kappa4 of a unit box along the normal is -(nx^4 + ny^4) / 120
    box1 = (s1**4 + c1**4) / (120.0 * 12.0 * p[4] ** 4)
    box2 = (s2**4 + c2**4) / (120.0 * 12.0 * p[4] ** 4)
    x0, x1, y0, y1 = int(window[0]), int(window[1]), int(window[2]), int(window[3])
    for y in range(y0, y1 + 1):
        for x in range(x0, x1 + 1):
            wx, wy = x - window[4], y - window[5]
            wi, wj = window[6] * wx + window[7] * wy, window[8] * wx + window[9] * wy
            if abs(wi) > window[10] or abs(wj) > window[11]:
                continue
            if window[13] * wi * wj > 0.0 and min(abs(wi), abs(wj)) > abs(window[13]):
                continue
            dx, dy = x - p[0], y - p[1]
            along1, across1 = c1 * dx + s1 * dy, -s1 * dx + c1 * dy
            along2, across2 = c2 * dx + s2 * dy, -s2 * dx + c2 * dy
            h = (across1 - bend1 * along1 * along1) * inverse_sigma
            k = (across2 - bend2 * along2 * along2) * inverse_sigma
            light = 1.0 + p[7] * dx + p[8] * dy
            half = p[6] * (1.0 + known[2] * wx + known[3] * wy)
            first = 0
            if abs(h) > _FAR and abs(k) > _FAR:
                S = 1.0 if h * k > 0 else -1.0
                base = p[5] + half * S
                first = 5  # a constant level does not depend on the edges
            else:
                blurred_saddle(h, k, rho, table, S4)
                S, S_h, S_k = S4[0], S4[1], S4[2]
                if abs(h) < _FAR:
                    e = 0.3989422804014327 * math.exp(-0.5 * h * h) * (1.0 if k > 0 else -1.0) * min(abs(k), 1.0)
                    S += box1 * (h * h * h - 3.0 * h) * e
                    S_h += box1 * (6.0 * h * h - h**4 - 3.0) * e
                if abs(k) < _FAR:
                    e = 0.3989422804014327 * math.exp(-0.5 * k * k) * (1.0 if h > 0 else -1.0) * min(abs(h), 1.0)
                    S += box2 * (k * k * k - 3.0 * k) * e
                    S_k += box2 * (6.0 * k * k - k**4 - 3.0) * e
                base = p[5] + half * S
                slope = half * light
                a, b = slope * S_h * inverse_sigma, slope * S_k * inverse_sigma
                gradient[0] = a * (s1 + 2 * bend1 * along1 * c1) + b * (s2 + 2 * bend2 * along2 * c2) - base * p[7]
                gradient[1] = a * (-c1 + 2 * bend1 * along1 * s1) + b * (-c2 + 2 * bend2 * along2 * s2) - base * p[8]
                gradient[2] = -a * along1 * (1 + 2 * bend1 * across1) + slope * S4[3] * turn
                gradient[3] = -b * along2 * (1 + 2 * bend2 * across2) - slope * S4[3] * turn
                gradient[4] = -(a * h + b * k)
            gradient[5], gradient[7], gradient[8] = light, base * dx, base * dy
            gradient[6] = light * S * (1.0 + known[2] * wx + known[3] * wy)
            model = base * light
            residual = image[y, x] - model
            if first_pass:
                weights[y - y0, x - x0] = 1.0 / (noise[0] + noise[1] * max(model, 0.0))
            weight = weights[y - y0, x - x0]
            for i in range(first, N_CORNER):
                gi = gradient[i] * weight
                g[i] += gi * residual
                for j in range(first, i + 1):
                    H[i, j] += gi * gradient[j]
            chi2 = residual * residual * weight
            sums[0] += chi2
            sums[1] += 1.0
            if abs(S) > FLAT:
                at = 5 if (S > 0.0) == (p[6] > 0.0) else 2  # sums of light squares, or of dark ones
                sums[at] += residual * residual
                sums[at + 1] += model
                sums[at + 2] += 1.0
            else:
                sums[8] += chi2
    return sums


@part
def solve_damped(H, damping, rhs, L):  # type: ignore[no-untyped-def]
    """Solve (H + damping diag H) x = rhs in place, H given by its lower triangle; False if not positive definite."""
    for i in range(H.shape[0]):
        for j in range(i):
            L[i, j] = H[i, j]
        L[i, i] = H[i, i] * (1.0 + damping)
    return solve_in_place(L, rhs)


@njit(cache=True, nogil=True)
def fit_corners(image, windows, starts, known, noise, iterations, tolerance):  # type: ignore[no-untyped-def]
    """Levenberg-Marquardt fits of all corners of one image.

    Returns parameters (n, 9), covariances (n, 2, 2) of x and y, sums (n, 9) of `normal_equations`, converged (n,).
    """
    n, found = starts.shape[0], starts.copy()
    covariance, all_sums, converged = np.zeros((n, 2, 2)), np.zeros((n, N_CORNER)), np.zeros(n, np.bool_)
    H, H_new, L = np.zeros((N_CORNER, N_CORNER)), np.zeros((N_CORNER, N_CORNER)), np.zeros((N_CORNER, N_CORNER))
    g, g_new, step, trial = np.zeros(N_CORNER), np.zeros(N_CORNER), np.zeros(N_CORNER), np.zeros(N_CORNER)
    for c in range(n):
        window, p, sums = windows[c], found[c], all_sums[c]
        weights = np.zeros((max(int(window[3] - window[2]) + 1, 1), max(int(window[1] - window[0]) + 1, 1)))
        damping, done, possible, enough, blur = 1e-2, False, True, True, p[4]
        for i in range(N_CORNER):
            trial[i] = p[i]
        for k in range(iterations + 1):
            accepted = possible
            if possible:
                new = normal_equations(image, window, trial, known[c], noise, weights, k == 0, H_new, g_new)
                accepted = k == 0 or new[0] <= sums[0] * (1 + 1e-12)
            if accepted:
                blur = p[4]
                for i in range(N_CORNER):
                    p[i], sums[i] = trial[i], new[i]
                H, H_new = H_new, H
                g, g_new = g_new, g
                damping = max(damping * 0.1, 1e-9)
                # change of the clamped blur: edges sharper than the pixel keep it at its lower bound
                done = k > 0 and abs(step[0]) < tolerance and abs(step[1]) < tolerance
                done = done and abs(p[4] - blur) < 10 * tolerance
            else:
                damping *= 10.0
            enough = sums[1] >= 4 * N_CORNER
            if done or damping > 1e8 or not enough:
                break
            if p[4] <= MIN_BLUR and g[4] < 0.0:  # fixed at its bound, so that the others reach their minimum
                H[4, :4], H[5:, 4], H[4, 4], g[4] = 0.0, 0.0, 1.0, 0.0
            for i in range(N_CORNER):
                step[i] = g[i]
            possible = solve_damped(H, damping, step, L)
            for i in range(N_CORNER):
                trial[i] = p[i] + step[i]
            trial[4] = min(max(trial[4], 0.5 * p[4], MIN_BLUR), 2.0 * p[4])
            reach = math.hypot(trial[0] - window[4], trial[1] - window[5])
            possible &= reach < window[12] and abs(math.cos(trial[3] - trial[2])) < 0.985
        for axis in range(2):  # columns x and y of the inverse
            for i in range(N_CORNER):
                step[i] = 1.0 if i == axis else 0.0
            enough &= solve_damped(H, 0.0, step, L)
            covariance[c, 0, axis], covariance[c, 1, axis] = step[0], step[1]
        converged[c] = enough and done
    return found, covariance, all_sums, converged
