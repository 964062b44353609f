"""Compiled fit of many poses to their dots (numba): Levenberg-Marquardt, one frame after the other; see `pose`."""

from __future__ import annotations

import math

import numpy as np

from calibration.kit._cholesky import solve_in_place
from disctrack.track.dots._kernels import _copy, _dot_by_pose, _entry, _part, _rotate_from_left

MAX_DAMPING = 1e10
_MAX_ITERATIONS = 60


@_part
def _evaluate(observed, covariance, used, cameras, R_cw, t_cw, centres, R, t, pixels, residual, jacobian, sums):
    """Fill pixels (2, m, 2), whitened residuals and Jacobian (2, m, 2, 6), zeros for dots not used; returns their cost.

    sums (7, 6): J^T J, and J^T r as the last row.
    """
    J, row = np.empty((2, 3)), np.empty((2, 6))
    sums[:] = 0.0
    cost = 0.0
    for c in range(2):
        for m in range(centres.shape[0]):
            u, v, _ = _dot_by_pose(cameras[c], R_cw[c], t_cw[c], centres[m], R, t, J, row)
            pixels[c, m, 0], pixels[c, m, 1] = u, v
            # W with W C W^T = 1, as `pose.whitening` has it; no weight where C is not a covariance
            a, b = covariance[c, m, 0, 0], covariance[c, m, 0, 1]
            remaining = covariance[c, m, 1, 1] - b * b / a
            good = used[c, m] and a > 0.0 and 0.0 < remaining < np.inf
            if not good:
                for axis in range(2):
                    residual[c, m, axis] = 0.0
                    for i in range(6):
                        jacobian[c, m, axis, i] = 0.0
                continue
            w00, w11 = 1.0 / math.sqrt(a), 1.0 / math.sqrt(remaining)
            w10 = -b / a * w11
            du, dv = observed[c, m, 0] - u, observed[c, m, 1] - v
            residual[c, m, 0], residual[c, m, 1] = w00 * du, w10 * du + w11 * dv
            for i in range(6):
                jacobian[c, m, 0, i], jacobian[c, m, 1, i] = w00 * row[0, i], w10 * row[0, i] + w11 * row[1, i]
            for axis in range(2):
                r = residual[c, m, axis]
                cost += r * r
                for i in range(6):
                    slope = jacobian[c, m, axis, i]
                    sums[6, i] += slope * r
                    for j in range(i + 1):
                        sums[i, j] += slope * jacobian[c, m, axis, j]
    return cost


@_entry
def fit(rows, observed, covariance, used, cameras, R_cw, t_cw, centres, tolerance, R, t, converged, pixels, residuals,
        jacobian):  # fmt: skip
    """Fit the poses of some rows (k,) of n frames, from R (n, 3, 3), t (n, 3) on, which are moved to the minimum.

    observed (n, 2, m, 2), covariance (n, 2, m, 2, 2), used (n, 2, m); cameras (2, 9). Marquardt 1963, with Nielsen-like
    damping; a pose has converged when its Gauss-Newton step is shorter than `tolerance` standard deviations of its own
    parameters, sqrt(step^T J^T J step); a negative tolerance leaves it where it is. Filled: converged (n,), pixels
    (n, 2, m, 2) of all dots, NaN behind a camera; residuals (n, 2, m, 2), observed - pixels, and jacobian
    (n, 2, m, 2, 6), both whitened, with zeros for dots that are not used.
    """
    shape = residuals.shape[1:]
    trial_pixels, trial_residuals, trial_jacobian = np.empty(shape), np.empty(shape), np.empty((*shape, 6))
    sums, trial_sums, damped, step = np.empty((7, 6)), np.empty((7, 6)), np.empty((6, 6)), np.empty(6)
    R_trial, t_trial = np.empty((3, 3)), np.empty(3)
    for f in rows:
        cost, damping, converged[f], solved, small = np.inf, 1e-7, False, True, False
        _copy(R_trial, R[f])
        for i in range(3):
            t_trial[i] = t[f, i]
        for k in range(_MAX_ITERATIONS + 1 if tolerance >= 0.0 else 1):
            new = _evaluate(observed[f], covariance[f], used[f], cameras, R_cw, t_cw, centres, R_trial, t_trial,
                            trial_pixels, trial_residuals, trial_jacobian, trial_sums)  # fmt: skip
            if k == 0 or (solved and (new < cost or (small and new <= cost * (1.0 + 1e-9) + 1e-12))):
                cost, damping = new, max(0.1 * damping, 1e-10)
                _copy(R[f], R_trial)
                _copy(sums, trial_sums)
                for i in range(3):
                    t[f, i] = t_trial[i]
                for c in range(2):
                    _copy(pixels[f, c], trial_pixels[c])
                    _copy(residuals[f, c], trial_residuals[c])
                    for m in range(shape[1]):
                        _copy(jacobian[f, c, m], trial_jacobian[c, m])
            else:
                damping = max(30.0 * damping, 1e-4)
            if small or damping > MAX_DAMPING:
                converged[f] = small
                break
            _copy(damped, sums[:6])
            for i in range(6):
                step[i] = sums[6, i]
                damped[i, i] += damping * damped[i, i]
                if damped[i, i] <= 1e-300:  # a parameter that no datum sees stays where it is
                    damped[i, i] = 1.0
            solved = solve_in_place(damped, step)
            length2 = 0.0
            for i in range(6):
                length2 += sums[i, i] * step[i] * step[i]
                for j in range(i):
                    length2 += 2.0 * sums[i, j] * step[i] * step[j]
            small = solved and length2 < tolerance * tolerance and damping < 1e-2
            _rotate_from_left(step[3:6], R[f], R_trial)
            for i in range(3):
                t_trial[i] = t[f, i] + step[i]
