"""Compiled fit of poses to their dots (numba): Levenberg-Marquardt, one frame after the other; see `pose`."""

import math

import numpy as np

from calibration.cameras._projection import project_point
from calibration.kit._cholesky import solve_in_place
from calibration.kit.compiled import RULES, njit
from calibration.kit.compiled import part as _part

_entry = njit(cache=True, **RULES)  # called from Python

_MAX_ITERATIONS = 60


@_part
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


@_part
def _dot_by_pose(camera, R_cw, t_cw, centre, R, t, J, rows):
    """Image u, v of a dot at `centre` (3,) on the disc, NaN behind the camera; fills J (2, 3), rows (2, 6).

    The rows are d (u, v) / d pose, a translation and a rotation vector in world axes.
    """
    a0 = R[0, 0] * centre[0] + R[0, 1] * centre[1] + R[0, 2] * centre[2]
    a1 = R[1, 0] * centre[0] + R[1, 1] * centre[1] + R[1, 2] * centre[2]
    a2 = R[2, 0] * centre[0] + R[2, 1] * centre[1] + R[2, 2] * centre[2]
    x, y, z = a0 + t[0], a1 + t[1], a2 + t[2]
    p0 = t_cw[0] + R_cw[0, 0] * x + R_cw[0, 1] * y + R_cw[0, 2] * z
    p1 = t_cw[1] + R_cw[1, 0] * x + R_cw[1, 1] * y + R_cw[1, 2] * z
    depth = t_cw[2] + R_cw[2, 0] * x + R_cw[2, 1] * y + R_cw[2, 2] * z
    u, v = project_point(camera, p0, p1, depth if depth > 0.0 else np.nan, J)
    for axis in range(2):
        row = rows[axis]
        for i in range(3):
            row[i] = J[axis, 0] * R_cw[0, i] + J[axis, 1] * R_cw[1, i] + J[axis, 2] * R_cw[2, i]
        row[3] = a1 * row[2] - a2 * row[1]
        row[4] = a2 * row[0] - a0 * row[2]
        row[5] = a0 * row[1] - a1 * row[0]
    return u, v


@_part
def _copy(out, values):
    """Copy a matrix."""
    for i in range(values.shape[0]):
        for j in range(values.shape[1]):
            out[i, j] = values[i, j]


@_part
def _evaluate(observed, covariance, used, cameras, centres, reach, R, t, filled, sums):
    """Fill pixels (2, m, 2), whitened residuals and Jacobian (2, m, 2, 6), zeros for dots not used; returns the cost.

    sums (7, 6): J^T J, and J^T r as the last row. A dot with a residual above `reach` [px] has Huber's weight.
    """
    (pixels, residual, jacobian), (intrinsics, R_cw, t_cw) = filled, cameras
    J, row = np.empty((2, 3)), np.empty((2, 6))
    residual[:], jacobian[:], sums[:] = 0.0, 0.0, 0.0
    cost = 0.0
    for c in range(2):
        for m in range(centres.shape[0]):
            u, v = _dot_by_pose(intrinsics[c], R_cw[c], t_cw[c], centres[m], R, t, J, row)
            pixels[c, m, 0], pixels[c, m, 1] = u, v
            # W with W C W^T = 1, as in `pose.whitening`; zero weight if C is not a covariance
            a, b = covariance[c, m, 0, 0], covariance[c, m, 0, 1]
            remaining = covariance[c, m, 1, 1] - b * b / a
            if not (used[c, m] and a > 0.0 and 0.0 < remaining < np.inf):
                continue
            du, dv = observed[c, m, 0] - u, observed[c, m, 1] - v
            weight = 1.0 / max(1.0, math.hypot(du, dv) / reach)
            w00, w11 = math.sqrt(weight / a), math.sqrt(weight / remaining)
            w10 = -b / a * w11
            residual[c, m, 0], residual[c, m, 1] = w00 * du, w10 * du + w11 * dv
            for i in range(6):
                jacobian[c, m, 0, i], jacobian[c, m, 1, i] = w00 * row[0, i], w10 * row[0, i] + w11 * row[1, i]
            for axis in range(2):
                r = residual[c, m, axis]
                cost += (2.0 - weight) * r * r
                for i in range(6):
                    slope = jacobian[c, m, axis, i]
                    sums[6, i] += slope * r
                    for j in range(i + 1):
                        sums[i, j] += slope * jacobian[c, m, axis, j]
    return cost


@_part
def fit_pose(observed, covariance, used, cameras, centres, tolerance, reach, R, t, filled):
    """As `fit`, for one frame; returns whether it converged. Beyond `reach` [px] the cost is linear (Huber)."""
    sums, trial_sums, damped, step = np.empty((7, 6)), np.empty((7, 6)), np.empty((6, 6)), np.zeros(6)
    R_trial, t_trial = np.empty((3, 3)), np.empty(3)
    cost, damping, solved, small = np.inf, 1e-7, True, False
    for k in range(_MAX_ITERATIONS + 1):
        _rotate_from_left(step[3:6], R, R_trial)
        for i in range(3):
            t_trial[i] = t[i] + step[i]
        new = _evaluate(observed, covariance, used, cameras, centres, reach, R_trial, t_trial, filled, trial_sums)
        if k == 0 or (solved and (new < cost or (small and new <= cost * (1.0 + 1e-9) + 1e-12))):
            cost, damping = new, max(0.1 * damping, 1e-10)
            _copy(R, R_trial)
            _copy(sums, trial_sums)
            for i in range(3):
                t[i] = t_trial[i]
        else:
            damping = max(30.0 * damping, 1e-4)
        if small:
            return True
        _copy(damped, sums[:6])
        for i in range(6):
            step[i] = sums[6, i]
            damped[i, i] += damping * damped[i, i]
            if damped[i, i] <= 1e-300:  # a parameter that no dot depends on is kept
                damped[i, i] = 1.0
        solved = solve_in_place(damped, step)
        length2 = 0.0
        for i in range(6):
            length2 += sums[i, i] * step[i] * step[i]
            for j in range(i):
                length2 += 2.0 * sums[i, j] * step[i] * step[j]
        small = solved and length2 < tolerance * tolerance and damping < 1e-2
    return False


@_entry
def fit(rows, observed, covariance, used, cameras, centres, tolerance, R, t, converged, filled):
    """Fit the poses of some rows (k,) of n frames; R (n, 3, 3), t (n, 3) are the initial guess, and are updated.

    observed (n, 2, m, 2), covariance (n, 2, m, 2, 2), used (n, 2, m); cameras as from `pose.stacked`. Marquardt 1963,
    with Nielsen-like damping. A pose has converged when its Gauss-Newton step is shorter than `tolerance` standard
    deviations of its parameters, sqrt(step^T J^T J step).
    Filled: converged (n,), and for the last pose tried (the solution if converged) pixels (n, 2, m, 2) of all dots, NaN
    behind a camera; residuals (n, 2, m, 2), observed - pixels, and jacobian (n, 2, m, 2, 6), both whitened, with zeros
    for dots that are not used.
    """
    pixels, residuals, jacobian = filled
    for f in rows:
        converged[f] = fit_pose(observed[f], covariance[f], used[f], cameras, centres, tolerance, np.inf, R[f], t[f],
                                (pixels[f], residuals[f], jacobian[f]))  # fmt: skip
