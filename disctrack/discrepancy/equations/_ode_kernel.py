"""Integration of a motion with its sensitivities: Dormand and Prince's method of order 8, dense output of order 7.

Steps follow the motion, not the sampling; between them the solution is a polynomial. Coefficients and error estimate:
Hairer, Norsett & Wanner, Solving Ordinary Differential Equations I, sections II.5 and II.6, as SciPy's DOP853 has them.
Where the equations are stiff (friction that holds, fast reactions) Radau's method IIA of order 5 takes over, its stages
solved by Newton's method with the exact derivative of all of them, the sensitivities those of the step as it is
computed: Hairer & Wanner, Solving Ordinary Differential Equations II, section IV.8, as SciPy's Radau has it.
"""

from functools import cache
from typing import NamedTuple

import numpy as np
from numba import types
from numpy.typing import NDArray

from calibration.kit import _dop853 as dop853
from calibration.kit.compiled import exact_part, njit, owning_part
from calibration.kit.types import Array

_f, _v, _m, _cube = types.float64, types.float64[::1], types.float64[:, ::1], types.float64[:, :, ::1]
# rhs(t, y, p, u, u_rate, f, J, P): f (n,), J = df/dy (n, n), P = df/dp (n, n_p) are filled in
RHS = types.void(_f, _v, _v, _v, _v, _v, _m, _m)
# observe(t, y, p, u, u_rate, h, H_y, H_p): the same of what the sensors see (w,), (w, n), (w, n_p)
RHS_TYPE = types.FunctionType(RHS)

_STABLE = 6.1  # step times the fastest rate, up to which the method is stable (Hairer's code DOP853)
_OFTEN = 15  # consecutive steps at that limit, from which on stability and not accuracy limits them
_RAN_AWAY = 1e6  # times the size of a state, beyond which a motion has diverged

_SENSITIVITY_TOLERANCE = 1e-6  # relative to the largest so far: enough for the steps of a fit

_RADAU_C = np.array([4.0 - 6.0**0.5, 4.0 + 6.0**0.5, 10.0]) / 10.0  # nodes
# collocation: increments at the nodes -> coefficients of x, x^2, x^3; the slope at the nodes is the rate
_RADAU_Q = np.linalg.inv(_RADAU_C[:, None] ** [1, 2, 3])
_RADAU_A = np.linalg.inv(_RADAU_C[:, None] ** [0, 1, 2] * [1, 2, 3] @ _RADAU_Q)
_RADAU_E = np.array([-13.0 - 7.0 * 6.0**0.5, -13.0 + 7.0 * 6.0**0.5, -1.0]) / 3.0
_REAL = 3.0 + 3.0 ** (2.0 / 3.0) - 3.0 ** (1.0 / 3.0)  # real eigenvalue of A^-1
_NEWTON = 12  # iterations of Newton's method; it converges in two to four or not at all
_STIFF_TOLERANCE = 1e-8  # of a step: the estimate is of third order, far above the error of fifth order
_CLOSE = 1e-3  # of the tolerance, to which Newton's method solves the stages
_MILD = 2.0  # step times the fastest rate, below which the explicit method can take steps of this length


entry = njit(cache=True, error_model="numpy", nogil=True)


class _Drive(NamedTuple):
    """Arguments of the slope other than instant and state, and work arrays."""

    p: Array
    columns: Array
    knots: Array
    pieces: Array
    piece: NDArray[np.int64]  # (1,) index of the current piece of the inputs
    u: Array
    u_rate: Array
    f: Array
    J: Array
    P: Array


@exact_part
def piece_at(t, knots):
    """Index of the piece of the inputs at t and just after it; beyond the ends the last piece is extrapolated."""
    return min(max(np.searchsorted(knots, t, side="right") - 1, 0), len(knots) - 2)


@exact_part
def inputs_at(t, i, knots, pieces, u, u_rate):
    """Piecewise cubics (channels, 5, knots - 1), highest power first: the i-th piece at t.

    The fifth number is added to the slope: that of an input that is held, which steps.
    """
    for c in range(len(u)):
        x = t - knots[i]
        a, b, d, e = pieces[c, 0, i], pieces[c, 1, i], pieces[c, 2, i], pieces[c, 3, i]
        u[c] = ((a * x + b) * x + d) * x + e
        u_rate[c] = (3.0 * a * x + 2.0 * b) * x + d + pieces[c, 4, i]


@exact_part
def _slope(t, z, out, rhs, drive):
    """Z = (y, dy/da_1, dy/da_2, ...) -> dz/dt, with the current piece of the inputs."""
    n, k = len(drive.f), len(drive.columns)
    inputs_at(t, drive.piece[0], drive.knots, drive.pieces, drive.u, drive.u_rate)
    rhs(t, z[:n], drive.p, drive.u, drive.u_rate, drive.f, drive.J, drive.P)
    for i in range(n):
        out[i] = drive.f[i]
    for c in range(k):
        s = n * (c + 1)
        for i in range(n):
            total = drive.P[i, drive.columns[c]] if drive.columns[c] >= 0 else 0.0
            for j in range(n):
                total += drive.J[i, j] * z[s + j]
            out[s + i] = total


_step, _polynomial = dop853.method(_slope)


@exact_part
def _error(step, K, new, size, least, largest, tolerance, duration):
    """Largest error of a step over its tolerance, of the states and of each sensitivity; infinite if not finite.

    duration : [s] of the motion. A sensitivity below the least size until this step (an overflow, a motion from rest)
        has no size yet, to which its error could be relative: its slope times this duration is used
    """
    n, worst = len(size), 0.0
    for c in range(len(new) // n):
        top = 0.0
        if c > 0:
            top = max(largest[c - 1], least[c - 1])
            for i in range(n):
                scale = abs(new[n * c + i])
                if largest[c - 1] <= least[c - 1]:
                    for s in range(13):
                        scale = max(scale, duration * abs(K[s, n * c + i]))
                top = max(top, scale / (size[i] + 1e-300))
        e5, e3 = 0.0, 0.0
        for i in range(n):
            a5, a3 = 0.0, 0.0
            for j in range(13):
                a5 += dop853.E5[j] * K[j, n * c + i]
                a3 += dop853.E3[j] * K[j, n * c + i]
            if c == 0:
                scale = tolerance * max(size[i], abs(new[i]))
            else:
                scale = _SENSITIVITY_TOLERANCE * (top * size[i] + 1e-300)
            e5 += (a5 / scale) ** 2
            e3 += (a3 / scale) ** 2
        if not (np.isfinite(e5) and np.isfinite(e3)):
            return np.inf
        if e5 > 0 or e3 > 0:
            worst = max(worst, step * e5 / np.sqrt((e5 + 0.01 * e3) * n))
    return worst


@owning_part
def _solve(M, b):
    """Replace b (m, k) by M^-1 b; False where M has no inverse."""
    try:
        b[:] = np.linalg.solve(M, b)
    except Exception:  # compiled code knows no LinAlgError
        return False
    return True


@owning_part
def _stages(rhs, t, step, z, Z, drive, F, J, P, M, left):
    """Negative residuals of the stage equations for stages z + Z (3 n, 1), and their Jacobian M (3 n, 3 n)."""
    n = len(drive.f)
    for s in range(3):
        at = t + _RADAU_C[s] * step
        inputs_at(at, drive.piece[0], drive.knots, drive.pieces, drive.u, drive.u_rate)
        rhs(at, z[:n] + Z[s * n : (s + 1) * n, 0], drive.p, drive.u, drive.u_rate, F[s], J[s], P[s])
    M[:] = np.eye(3 * n)
    left[:] = -Z
    for s in range(3):
        rows = slice(s * n, (s + 1) * n)
        for r in range(3):
            weight = step * _RADAU_A[s, r]
            left[rows, 0] += weight * F[r]
            M[rows, r * n : (r + 1) * n] -= weight * J[r]


@owning_part
def _implicit_step(rhs, t, step, z, drive, slope, size, W):
    """Increments of states and sensitivities at the stages, W (3, len(z)), and the error over its tolerance.

    slope : at (t, z), where `drive` holds its derivative by the states
    """
    n, k = len(size), len(drive.columns)
    F, J, P = np.zeros((3, n)), np.zeros((3, n, n)), np.zeros((3, n, len(drive.p)))
    Z, M, change, own = np.zeros((3 * n, 1)), np.zeros((3 * n, 3 * n)), np.zeros((3 * n, 1)), np.zeros((3 * n, k))
    for _ in range(_NEWTON):
        _stages(rhs, t, step, z, Z, drive, F, J, P, M, change)
        if not _solve(M, change):
            return np.inf
        moved = 0.0
        for j in range(3 * n):
            Z[j, 0] += change[j, 0]
            moved = max(moved, abs(change[j, 0]) / (_STIFF_TOLERANCE * max(size[j % n], abs(z[j % n]))))
        if not moved >= _CLOSE:
            break
    if not moved < _CLOSE:
        return np.inf
    _stages(rhs, t, step, z, Z, drive, F, J, P, M, change)
    E, error = _REAL / step * np.eye(n) - drive.J, slope[:n].copy().reshape(n, 1)
    for i in range(n):
        for s in range(3):
            error[i, 0] += _RADAU_E[s] * Z[s * n + i, 0] / step
            W[s, i] = Z[s * n + i, 0]
            for c in range(k):
                rate = P[s, i, drive.columns[c]] if drive.columns[c] >= 0 else 0.0
                for j in range(n):
                    rate += J[s, i, j] * z[n * (c + 1) + j]
                for r in range(3):
                    own[r * n + i, c] += step * _RADAU_A[r, s] * rate
    if not (_solve(E, error) and _solve(M, own)):
        return np.inf
    worst = 0.0
    for i in range(n):
        worst = max(worst, abs(error[i, 0]) / (_STIFF_TOLERANCE * max(size[i], abs(z[i]))))
        for c in range(k):
            for s in range(3):
                W[s, n * (c + 1) + i] = own[s * n + i, c]
    return worst


@owning_part
def _along_stages(W, z, x, out):
    """Collocation polynomial of the implicit step at the fraction x of it."""
    part = x * (_RADAU_Q[0] + x * (_RADAU_Q[1] + x * _RADAU_Q[2]))
    for i in range(len(z)):
        out[i] = z[i] + part[0] * W[0, i] + part[1] * W[1, i] + part[2] * W[2, i]


@entry
def integrate(rhs, z, p, columns, span, n, knots, pieces, size, least, tolerance, max_steps, samples, out):
    """Fill out (m, len(z)) with the solution at samples (m,), which increase; returns the number of steps.

    Its negative where the integration fails.

    z : (n (1 + k),) states and their derivatives by k quantities at span[0]
    columns : (k,) index in p of each quantity; -1 for an initial state
    span : (2,) first and last instant
    size : (n,) of the states, to which the tolerance is relative
    least : (k,) sizes of the sensitivities, in those of the states, below which they are rounding errors
    """
    N, m = len(z), len(samples)
    u, u_rate, piece = np.zeros(len(pieces)), np.zeros(len(pieces)), np.zeros(1, np.int64)
    f, J, P = np.zeros(n), np.zeros((n, n)), np.zeros((n, len(p)))
    drive = _Drive(p, columns, knots, pieces, piece, u, u_rate, f, J, P)
    made, W, largest = dop853.room(z, N), np.zeros((3, N)), np.zeros(len(columns))
    K, new = made.K, made.end
    t, end = span[0], span[1]
    drive.piece[0] = piece_at(t, knots)
    _slope(t, z, K[0], rhs, drive)
    speed, most = 0.0, 0.0
    for i in range(n):
        speed, most = max(speed, abs(K[0, i]) / size[i]), max(most, _RAN_AWAY * size[i])
    h = min(end - t, 0.01 / speed) if speed > 0 else 0.01 * (end - t)
    filled, stiff, rejected, at_limit, calm = 0, False, False, 0, 0
    for taken in range(max_steps):
        remaining = end - t
        last = remaining <= h * (1.0 + 1e-9)
        step = remaining if last else h
        # inputs are smooth between their knots only: a step across a knot would mostly be rejected
        i = np.searchsorted(knots, t + 1e-12 * max(abs(t), 1.0), side="right")
        arrival = t + step
        if i < len(knots) and arrival > knots[i]:
            arrival = knots[i]  # exactly: the inputs change there
            step, last = arrival - t, False
        if step < 1e-15 * max(abs(t), 1e-3):
            return -taken
        if stiff:
            worst, power = _implicit_step(rhs, t, step, z, drive, K[0], size, W), -0.25
            _along_stages(W, z, 1.0, new)
        else:
            _step(rhs, drive, t, z, step, made)
            # a step that ends at a knot uses the piece before it
            _slope(t + step, new, K[12], rhs, drive)
            worst, power = _error(step, K, new, size, least, largest, tolerance, end - span[0]), -0.125
        if not worst <= 1.0:
            h = step * max(0.2, 0.9 * worst**power) if np.isfinite(worst) else 0.1 * step
            rejected = True
            if h < 1e-14 * (end - span[0]):
                return -taken
            continue
        # stiffness: the fastest rate, from two estimates of the state at the end of the step
        apart, together = 0.0, 0.0
        for i in range(n):
            if abs(new[i]) > most:
                return -taken
            apart += ((K[12, i] - K[11, i]) / size[i]) ** 2
            together += ((new[i] - made.stage[i]) / size[i]) ** 2
            for c in range(len(columns)):
                largest[c] = max(largest[c], abs(new[n * (c + 1) + i]) / (size[i] + 1e-300))
        inside = False
        while filled < m and (samples[filled] <= t + step or last):
            x = (samples[filled] - t) / step
            if abs(x - 1.0) <= 1e-12:  # as for every sample at a knot of the inputs
                out[filled] = new
            elif stiff:
                _along_stages(W, z, x, out[filled])
            else:
                if not inside:
                    _polynomial(rhs, drive, t, z, step, made)
                    inside = True
                dop853.along(made.F, z, x, out[filled])
            filled += 1
        t = arrival
        z[:] = new
        before, drive.piece[0] = drive.piece[0], piece_at(t, knots)
        grow = 5.0 if worst == 0.0 else min(5.0, max(0.2, 0.9 * worst**power))
        if rejected:
            grow = min(1.0, grow)
        rejected = False
        # a step shortened at a knot does not limit the next one
        h = h * grow if step >= h * 0.999 else max(h, step * grow)
        if stiff:
            _slope(t, z, K[0], rhs, drive)
            fastest = 0.0
            for i in range(n):
                for j in range(n):
                    fastest = max(fastest, abs(drive.J[i, j]) * size[j] / size[i])
            calm = calm + 1 if h * fastest < _MILD else 0
            stiff = calm < 3
        else:
            calm = 0 if together > 0.0 and step * np.sqrt(apart / together) > _STABLE else calm + 1
            at_limit = at_limit + 1 if calm == 0 else (0 if calm == 6 else at_limit)
            stiff = at_limit >= _OFTEN
            if stiff or drive.piece[0] != before:
                _slope(t, z, K[0], rhs, drive)
            else:
                K[0] = K[12]
            if stiff:
                h, at_limit, calm = step, 0, 0
        if last:
            return taken + 1
    return -max_steps


@entry
def evaluate(function, times, states, p, knots, pieces, values, by_state, by_number):
    """Rates or sensors (m, w) at instants (m,) in states (m, n), with derivatives (m, w, n) and (m, w, n_p)."""
    u, u_rate = np.zeros(len(pieces)), np.zeros(len(pieces))
    for i in range(len(times)):
        inputs_at(times[i], piece_at(times[i], knots), knots, pieces, u, u_rate)
        function(times[i], states[i], p, u, u_rate, values[i], by_state[i], by_number[i])


@cache
def prepare() -> None:
    """Compile the functions called from Python for these types only, or load them from the cache."""
    whole = types.int64
    integrate.compile((RHS_TYPE, _v, _v, whole[::1], _v, whole, _v, _cube, _v, _v, _f, whole, _v, _m))
    evaluate.compile((RHS_TYPE, _v, _m, _v, _v, _cube, _m, _cube, _cube))
    for function in (integrate, evaluate):
        function.disable_compile()
