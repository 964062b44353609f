"""Motion and its sensitivities where equations are stiff: friction that holds, fast reactions, short time constants.

Radau's method IIA of three stages and order 5. The stages are solved by Newton's method with the exact derivative of
all of them, and the sensitivities are those of the step as it is computed. Coefficients and error estimate: Hairer &
Wanner, Solving Ordinary Differential Equations II, section IV.8, as SciPy's Radau has them.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numba import types

from disctrack.discrepancy.equations._ode_kernel import (
    DONE,
    NOT_FINITE,
    RHS_TYPE,
    STIFF_CHANGES,
    TOO_MANY_STEPS,
    compile_for,
    entry,
    first_after,
    inputs_at,
    part,
    piece_at,
)

_S6 = 6.0**0.5
_C = np.array([(4.0 - _S6) / 10.0, (4.0 + _S6) / 10.0, 1.0])
_A = np.array(
    [
        [(88.0 - 7.0 * _S6) / 360.0, (296.0 - 169.0 * _S6) / 1800.0, (-2.0 + 3.0 * _S6) / 225.0],
        [(296.0 + 169.0 * _S6) / 1800.0, (88.0 + 7.0 * _S6) / 360.0, (-2.0 - 3.0 * _S6) / 225.0],
        [(16.0 - _S6) / 36.0, (16.0 + _S6) / 36.0, 1.0 / 9.0],
    ]
)
_E = np.array([-13.0 - 7.0 * _S6, -13.0 + 7.0 * _S6, -1.0]) / 3.0
_REAL = 3.0 + 3.0 ** (2.0 / 3.0) - 3.0 ** (1.0 / 3.0)  # real eigenvalue of A^-1
_NEWTON = 12  # steps of Newton's method; it converges in two to four or not at all
_TOLERANCE = 1e-8  # of a step: the estimate is of third order, and far above the error of fifth
_CLOSE = 1e-3  # of the tolerance, to which Newton's method solves the stages
_MILD = 2.0  # step times the fastest rate, below which an explicit method takes steps as long


@part
def _factorise(M, order):
    """LU with partial pivoting in place; False where the matrix is singular or not finite."""
    n = len(M)
    for i in range(n):
        best = i
        for j in range(i + 1, n):
            if abs(M[j, i]) > abs(M[best, i]):
                best = j
        order[i] = best
        if best != i:
            for j in range(n):
                M[i, j], M[best, j] = M[best, j], M[i, j]
        if M[i, i] == 0.0 or not np.isfinite(M[i, i]):
            return False
        for j in range(i + 1, n):
            M[j, i] /= M[i, i]
            for k in range(i + 1, n):
                M[j, k] -= M[j, i] * M[i, k]
    return True


@part
def _solve(M, order, b):
    """Replace b by the solution, from the factors."""
    n = len(M)
    for i in range(n):
        k = order[i]
        b[i], b[k] = b[k], b[i]
    for i in range(n):
        for j in range(i):
            b[i] -= M[i, j] * b[j]
    for i in range(n - 1, -1, -1):
        for j in range(i + 1, n):
            b[i] -= M[i, j] * b[j]
        b[i] /= M[i, i]


@part
def _stages(rhs, t, h, piece, z, Z, y, p, knots, pieces, u, u_rate, F, J, P, M, residual):
    """Slopes F (3, n) at the stages z + Z with derivatives, Newton's matrix M (3n, 3n), and minus what is left."""
    n = len(y)
    for s in range(3):
        for i in range(n):
            y[i] = z[i] + Z[s * n + i]
        inputs_at(t + _C[s] * h, piece, knots, pieces, u, u_rate)
        rhs(t + _C[s] * h, y, p, u, u_rate, F[s], J[s], P[s])
    for s in range(3):
        for i in range(n):
            total = Z[s * n + i]
            for r in range(3):
                total -= h * _A[s, r] * F[r, i]
                for j in range(n):
                    M[s * n + i, r * n + j] = -h * _A[s, r] * J[r, i, j]
            M[s * n + i, s * n + i] += 1.0
            residual[s * n + i] = -total


@entry
def integrate(rhs, z, p, columns, span, n, knots, pieces, size, max_steps, pointer, samples, out):
    """Go on from span[0] as long as the equations are stiff, as `_ode_kernel.integrate` does while they are not.

    z, span[0] and pointer are left where it stops: DONE at the end, STIFF_CHANGES where an explicit method may go on.
    """
    n_p, k = len(p), len(columns)
    groups, m = samples.shape
    f0, J0, P0 = np.zeros(n), np.zeros((n, n)), np.zeros((n, n_p))
    F, J, P = np.zeros((3, n)), np.zeros((3, n, n)), np.zeros((3, n, n_p))
    M, order, residual = np.zeros((3 * n, 3 * n)), np.zeros(3 * n, np.int64), np.zeros(3 * n)
    E, order_e, error, again = np.zeros((n, n)), np.zeros(n, np.int64), np.zeros(n), np.zeros(n)
    Z, W, y = np.zeros(3 * n), np.zeros((1 + k, 3 * n)), np.zeros(n)
    u, u_rate = np.zeros(pieces.shape[0]), np.zeros(pieces.shape[0])
    t, end, h = span[0], span[1], span[2]
    steps, attempts, mild, rejected = 0, 0, 0, False
    while True:
        remaining = end - t
        if remaining <= 0.0:
            return DONE, steps
        step = min(h, remaining)
        piece = piece_at(t, knots)
        i = first_after(t + 1e-12 * max(abs(t), 1.0), knots)
        arrival = t + step
        if remaining <= h * (1.0 + 1e-9):
            arrival = end
        if i < len(knots) and arrival > knots[i]:
            arrival = knots[i]
        step = arrival - t
        attempts += 1
        if attempts > max_steps or step < 1e-15 * max(abs(t), 1e-3):
            span[0] = t
            return TOO_MANY_STEPS, steps
        inputs_at(t, piece, knots, pieces, u, u_rate)
        rhs(t, z[:n], p, u, u_rate, f0, J0, P0)
        for j in range(3 * n):
            Z[j] = 0.0
        solved = False
        for _ in range(_NEWTON):
            _stages(rhs, t, step, piece, z, Z, y, p, knots, pieces, u, u_rate, F, J, P, M, residual)
            if not _factorise(M, order):
                break
            _solve(M, order, residual)
            moved = 0.0
            for j in range(3 * n):
                Z[j] += residual[j]
                moved = max(moved, abs(residual[j]) / (_TOLERANCE * max(size[j % n], abs(z[j % n]))))
            if not np.isfinite(moved):
                break
            if moved < _CLOSE:
                solved = True
                break
        worst = np.inf
        if solved:
            for a in range(n):
                for b in range(n):
                    E[a, b] = -J0[a, b]
                E[a, a] += _REAL / step
                error[a] = f0[a] + (_E[0] * Z[a] + _E[1] * Z[n + a] + _E[2] * Z[2 * n + a]) / step
            if _factorise(E, order_e):
                _solve(E, order_e, error)
                for attempt in range(2):
                    worst = 0.0
                    for a in range(n):
                        worst = max(worst, abs(error[a]) / (_TOLERANCE * max(size[a], abs(z[a]))))
                    if worst <= 1.0 or attempt == 1:
                        break
                    # where a fast rate makes the estimate too large: the same with the slope there
                    for a in range(n):
                        y[a] = z[a] + error[a]
                    inputs_at(t, piece, knots, pieces, u, u_rate)
                    rhs(t, y, p, u, u_rate, again, J0, P0)
                    for a in range(n):
                        error[a] = again[a] + (_E[0] * Z[a] + _E[1] * Z[n + a] + _E[2] * Z[2 * n + a]) / step
                    _solve(E, order_e, error)
        if not worst <= 1.0:
            h = step * (max(0.2, 0.9 * worst**-0.25) if np.isfinite(worst) else 0.25)
            rejected = True
            if h < 1e-14 * (end - t):
                span[0] = t
                return NOT_FINITE, steps
            continue
        # sensitivities of the step as it was computed: the same matrix, at the stages that solve it
        _stages(rhs, t, step, piece, z, Z, y, p, knots, pieces, u, u_rate, F, J, P, M, residual)
        if not _factorise(M, order):
            span[0] = t
            return NOT_FINITE, steps
        for j in range(3 * n):
            W[0, j] = Z[j]
        for c in range(k):
            first = n * (c + 1)
            for s in range(3):
                for a in range(n):
                    total = 0.0
                    for r in range(3):
                        slope = P[r, a, columns[c]] if columns[c] >= 0 else 0.0
                        for b in range(n):
                            slope += J[r, a, b] * z[first + b]
                        total += _A[s, r] * slope
                    W[c + 1, s * n + a] = step * total
            _solve(M, order, W[c + 1])
        for g in range(groups):
            while pointer[g] < m and (samples[g, pointer[g]] <= arrival or arrival >= end):
                x = (samples[g, pointer[g]] - t) / step
                l1 = x * (x - _C[1]) * (x - 1.0) / (_C[0] * (_C[0] - _C[1]) * (_C[0] - 1.0))
                l2 = x * (x - _C[0]) * (x - 1.0) / (_C[1] * (_C[1] - _C[0]) * (_C[1] - 1.0))
                l3 = x * (x - _C[0]) * (x - _C[1]) / ((1.0 - _C[0]) * (1.0 - _C[1]))
                for c in range(k + 1):
                    for a in range(n):
                        out[g, pointer[g], c * n + a] = (
                            z[c * n + a] + l1 * W[c, a] + l2 * W[c, n + a] + l3 * W[c, 2 * n + a]
                        )
                pointer[g] += 1
        for c in range(k + 1):
            for a in range(n):
                z[c * n + a] += W[c, 2 * n + a]
        steps += 1
        t = arrival
        fastest = 0.0
        for a in range(n):
            total = 0.0
            for b in range(n):
                total += abs(J[2, a, b]) * size[b] / size[a]
            fastest = max(fastest, total)
        grow = 5.0 if worst == 0.0 else min(5.0, max(0.2, 0.9 * worst**-0.25))
        if rejected:
            grow = min(1.0, grow)
        rejected = False
        h = max(h, step * grow) if step < h else step * grow
        mild = mild + 1 if h * fastest < _MILD else 0
        if t < end and mild >= 3:
            span[0], span[2] = t, h
            return STIFF_CHANGES, steps


@cache
def prepare() -> None:
    """Compile what Python calls for the arrays that it is called with; or load it."""
    v, m, whole = types.float64[::1], types.float64[:, ::1], types.int64
    cube = types.float64[:, :, ::1]
    compile_for((integrate, (RHS_TYPE, v, v, whole[::1], v, whole, v, cube, v, whole, whole[::1], m, cube)))
