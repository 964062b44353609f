"""Motion and its sensitivities from one set of equations: Dormand and Prince's method of order 8, dense output of 7.

Steps follow the motion, not the sampling; between them the solution is a polynomial. Coefficients and error estimate:
Hairer, Norsett & Wanner, Solving Ordinary Differential Equations I, sections II.5 and II.6, as SciPy's DOP853 has them.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numba import types
from scipy.integrate import DOP853

from calibration.kit.compiled import njit

_f, _v, _m, _cube = types.float64, types.float64[::1], types.float64[:, ::1], types.float64[:, :, ::1]
# rhs(t, y, p, u, u_rate, f, J, P): f (n,), J = df/dy (n, n), P = df/dp (n, n_p) are filled in
RHS = types.void(_f, _v, _v, _v, _v, _v, _m, _m)
# observe(t, y, p, u, u_rate, h, H_y, H_p): what the sensors see (w,), and its derivatives (w, n), (w, n_p)
OBSERVE = RHS
RHS_TYPE = types.FunctionType(RHS)

DONE, NOT_FINITE, TOO_MANY_STEPS, STIFF_CHANGES = 0, 1, 2, 3
_STABLE = 6.1  # step times the fastest rate, up to which the method is stable (Hairer's code DOP853)
_OFTEN = 15  # steps in a row at that limit, from which on it is the limit and not the error that holds them back

_A = np.ascontiguousarray(DOP853.A)  # (12, 12)
_B, _C = np.ascontiguousarray(DOP853.B), np.ascontiguousarray(DOP853.C)
_E3, _E5 = np.ascontiguousarray(DOP853.E3), np.ascontiguousarray(DOP853.E5)  # (13,)
_D = np.ascontiguousarray(DOP853.D)  # (4, 16)
_A_EXTRA, _C_EXTRA = np.ascontiguousarray(DOP853.A_EXTRA), np.ascontiguousarray(DOP853.C_EXTRA)  # (3, 16), (3,)
_SENSITIVITY_TOLERANCE = 1e-6  # relative to the largest so far: steps of a fit need no more


_RULES: dict[str, Any] = {"error_model": "numpy", "nogil": True}
entry = njit(cache=True, **_RULES)
part = njit(no_cpython_wrapper=True, no_cfunc_wrapper=True, **_RULES)  # called by compiled functions only


@part
def first_after(t, knots):
    """Index of the first knot beyond t: what numpy.searchsorted finds, that compiles for half a second."""
    low, high = 0, len(knots)
    while low < high:
        middle = (low + high) // 2
        if knots[middle] <= t:
            low = middle + 1
        else:
            high = middle
    return low


@part
def _assign(target, values):
    """As target[:] = values, for which numba compiles the text of an error besides."""
    for i in range(len(target)):
        target[i] = values[i]


@part
def piece_at(t, knots):
    """Index of the inputs' piece that holds at t and just after it; beyond the ends the last piece goes on."""
    return min(max(first_after(t, knots) - 1, 0), len(knots) - 2)


@part
def inputs_at(t, i, knots, pieces, u, u_rate):
    """Piecewise cubics (channels, 5, knots - 1), highest power first: the i-th piece at t.

    The fifth number is added to the slope: that of an input that is held, which steps.
    """
    for c in range(len(u)):
        x = t - knots[i]
        a, b, d, e = pieces[c, 0, i], pieces[c, 1, i], pieces[c, 2, i], pieces[c, 3, i]
        u[c] = ((a * x + b) * x + d) * x + e
        u_rate[c] = (3.0 * a * x + 2.0 * b) * x + d + pieces[c, 4, i]


@part
def _slope(rhs, t, piece, z, p, columns, knots, pieces, u, u_rate, f, J, P, out):
    """Z = (y, dy/da_1, dy/da_2, ...) one after the other -> dz/dt, with the inputs of one of their pieces."""
    n, k = len(f), len(columns)
    inputs_at(t, piece, knots, pieces, u, u_rate)
    rhs(t, z[:n], p, u, u_rate, f, J, P)
    for i in range(n):
        out[i] = f[i]
    for c in range(k):
        s = n * (c + 1)
        for i in range(n):
            total = P[i, columns[c]] if columns[c] >= 0 else 0.0
            for j in range(n):
                total += J[i, j] * z[s + j]
            out[s + i] = total


@entry
def integrate(rhs, z, p, columns, span, n, knots, pieces, size, tolerance, max_steps, largest, pointer, samples, out):
    """Fill out (groups, m, len(z)) with the solution at samples (groups, m), each group increasing.

    z : (n (1 + k),) states and their derivatives by k quantities at span[0]
    columns : (k,) index in p of each quantity; -1 for an initial state
    span : (3,) first and last instant, and the step to begin with (0: as the slope says)
    size : (n,) of the states, to which the tolerance is relative
    largest : (k,) size of each derivative so far, 0 at first
    pointer : (groups,) how many samples are filled in
    returns : DONE, or why not; number of steps. Where the equations have become stiff it stops (STIFF_CHANGES), with z,
        span, largest and pointer as they are there: `_stiff_kernel.integrate` goes on from these, and this from its.
        After max_steps (TOO_MANY_STEPS) it may be called again with them, too.
    """
    N, n_p = len(z), len(p)
    k = len(columns)
    groups, m = samples.shape
    K = np.zeros((16, N))
    F = np.zeros((7, N))
    f, J, P = np.zeros(n), np.zeros((n, n)), np.zeros((n, n_p))
    u, u_rate = np.zeros(pieces.shape[0]), np.zeros(pieces.shape[0])
    new, work, last_stage = np.zeros(N), np.zeros(N), np.zeros(n)
    t, end = span[0], span[1]
    piece = piece_at(t, knots)
    _slope(rhs, t, piece, z, p, columns, knots, pieces, u, u_rate, f, J, P, K[0])
    speed = 0.0
    for i in range(n):
        speed = max(speed, abs(K[0, i]) / size[i])
    h = min(end - t, 0.01 / speed) if speed > 0 else 0.01 * (end - t)
    if span[2] > 0.0:
        h = min(end - t, span[2])
    steps, rejected, attempts, at_limit, calm = 0, False, 0, 0, 0
    while True:
        remaining = end - t
        last = remaining <= h * (1.0 + 1e-9)
        step = remaining if last else h
        # inputs are smooth between their knots only: a step across one would be rejected more often than not
        i = first_after(t + 1e-12 * max(abs(t), 1.0), knots)
        arrival = t + step
        if i < len(knots) and arrival > knots[i]:
            arrival = knots[i]  # to the bit: on the other side of it the inputs are others
            step, last = arrival - t, False
        attempts += 1
        if attempts > max_steps or step < 1e-15 * max(abs(t), 1e-3):
            if last and remaining <= 0:
                break
            span[0], span[2] = t, h
            return TOO_MANY_STEPS, steps
        for s in range(1, 12):
            for i in range(N):
                total = 0.0
                for j in range(s):
                    total += _A[s, j] * K[j, i]
                work[i] = z[i] + step * total
            _slope(rhs, t + _C[s] * step, piece, work, p, columns, knots, pieces, u, u_rate, f, J, P, K[s])
        for i in range(n):
            last_stage[i] = work[i]
        for i in range(N):
            total = 0.0
            for j in range(12):
                total += _B[j] * K[j, i]
            new[i] = z[i] + step * total
        # at a knot too the inputs of the piece before it hold for this step
        _slope(rhs, t + step, piece, new, p, columns, knots, pieces, u, u_rate, f, J, P, K[12])
        worst = 0.0
        for c in range(k + 1):
            e5, e3, top = 0.0, 0.0, 0.0
            if c > 0:
                top = largest[c - 1]
                for i in range(n * c, n * (c + 1)):
                    scale = abs(new[i]) / (size[i - n * c] + 1e-300)
                    top = max(top, scale)
                if steps > 0 and largest[c - 1] == 0.0:
                    # what sets in within the step (an overflow, a stop): of a start at a kink no error is small beside
                    # itself, however short the step; it is small beside what such a slope will have brought by the end
                    for s in range(13):
                        for i in range(n * c, n * (c + 1)):
                            top = max(top, (end - span[0]) * abs(K[s, i]) / (size[i - n * c] + 1e-300))
            for i in range(n * c, n * (c + 1)):
                a5, a3 = 0.0, 0.0
                for j in range(13):
                    a5 += _E5[j] * K[j, i]
                    a3 += _E3[j] * K[j, i]
                if c == 0:
                    scale = tolerance * max(size[i], abs(new[i]))
                else:
                    scale = _SENSITIVITY_TOLERANCE * (top * size[i - n * c] + 1e-300)
                e5 += (a5 / scale) ** 2
                e3 += (a3 / scale) ** 2
            if e5 > 0 or e3 > 0:
                worst = max(worst, step * e5 / np.sqrt((e5 + 0.01 * e3) * n))
            if not (np.isfinite(e5) and np.isfinite(e3)):
                worst = np.inf
        if not np.isfinite(worst):
            h = 0.1 * step
            rejected = True
            if h < 1e-10 * (end - span[0]):
                return NOT_FINITE, steps
            continue
        if worst > 1.0:
            h = step * max(0.2, 0.9 * worst**-0.125)
            rejected = True
            continue
        inside = False
        for g in range(groups):
            if pointer[g] < m and (samples[g, pointer[g]] <= t + step or last):
                if abs(samples[g, pointer[g]] - t - step) > 1e-12 * step:
                    inside = True
                else:  # the step ends at the sample, as at every one with an input's knot
                    _assign(out[g, pointer[g]], new)
                    pointer[g] += 1
        if inside:
            for e in range(3):
                for i in range(N):
                    total = 0.0
                    for j in range(13 + e):
                        total += _A_EXTRA[e, j] * K[j, i]
                    work[i] = z[i] + step * total
                _slope(
                    rhs, t + _C_EXTRA[e] * step, piece, work, p, columns, knots, pieces, u, u_rate, f, J, P, K[13 + e]
                )
            for i in range(N):
                delta = new[i] - z[i]
                F[0, i] = delta
                F[1, i] = step * K[0, i] - delta
                F[2, i] = 2.0 * delta - step * (K[12, i] + K[0, i])
                for d in range(4):
                    total = 0.0
                    for j in range(16):
                        total += _D[d, j] * K[j, i]
                    F[3 + d, i] = step * total
            for g in range(groups):
                while pointer[g] < m and (samples[g, pointer[g]] <= t + step or last):
                    x = (samples[g, pointer[g]] - t) / step
                    for i in range(N):
                        total = 0.0
                        for d in range(6, -1, -1):
                            total += F[d, i]
                            total *= x if d % 2 == 0 else 1.0 - x
                        out[g, pointer[g], i] = total + z[i]
                    pointer[g] += 1
        for c in range(k):
            for i in range(n):
                largest[c] = max(largest[c], abs(new[n * (c + 1) + i]) / (size[i] + 1e-300))
        # how fast nearby motions part or meet, from two estimates of the state at the end of the step
        apart, together = 0.0, 0.0
        for i in range(n):
            apart += ((K[12, i] - K[11, i]) / size[i]) ** 2
            together += ((new[i] - last_stage[i]) / size[i]) ** 2
        if together > 0.0 and step * np.sqrt(apart / together) > _STABLE:
            at_limit, calm = at_limit + 1, 0
        else:
            calm += 1
            if calm == 6:
                at_limit = 0
        steps += 1
        t = arrival
        _assign(z, new)
        before, piece = piece, piece_at(t, knots)
        if piece != before:
            _slope(rhs, t, piece, z, p, columns, knots, pieces, u, u_rate, f, J, P, K[0])
        else:
            _assign(K[0], K[12])
        grow = 5.0 if worst == 0.0 else min(5.0, max(0.2, 0.9 * worst**-0.125))
        if rejected:
            grow = min(1.0, grow)
        rejected = False
        h = max(h, step) if step < h else h  # a step cut short at a knot says nothing against the next
        h = h * grow if step >= h * 0.999 else max(h, step * grow)
        if last:
            break
        if at_limit >= _OFTEN:
            span[0], span[2] = t, step
            return STIFF_CHANGES, steps
    return DONE, steps


@entry
def observe_all(observe, times, states, p, knots, pieces, seen, by_state, by_parameter):
    """What the sensors see at instants (m,) in states (m, n): seen (m, w) and derivatives (m, w, n), (m, w, n_p)."""
    u, u_rate = np.zeros(pieces.shape[0]), np.zeros(pieces.shape[0])
    for i in range(len(times)):
        inputs_at(times[i], piece_at(times[i], knots), knots, pieces, u, u_rate)
        observe(times[i], states[i], p, u, u_rate, seen[i], by_state[i], by_parameter[i])


@entry
def rates_all(rhs, times, states, p, knots, pieces, rates, by_parameter):
    """Rates (m, n) and their derivatives by parameters (m, n, n_p) at instants (m,) in states (m, n)."""
    n = states.shape[1]
    u, u_rate, J = np.zeros(pieces.shape[0]), np.zeros(pieces.shape[0]), np.zeros((n, n))
    for i in range(len(times)):
        inputs_at(times[i], piece_at(times[i], knots), knots, pieces, u, u_rate)
        rhs(times[i], states[i], p, u, u_rate, rates[i], J, by_parameter[i])


def compile_for(*wanted: tuple[Any, tuple[Any, ...]]) -> None:
    """Compile functions for these types of arguments, and for no others; or load them."""
    for function, arguments in wanted:
        function.compile(arguments)
        function.disable_compile()


@cache
def prepare() -> None:
    """Compile what Python calls for the arrays that it is called with; or load it."""
    whole = types.int64
    compile_for(
        (integrate, (RHS_TYPE, _v, _v, whole[::1], _v, whole, _v, _cube, _v, _f, whole, _v, whole[::1], _m, _cube)),
        (observe_all, (RHS_TYPE, _v, _m, _v, _v, _cube, _m, _cube, _cube)),
        (rates_all, (RHS_TYPE, _v, _m, _v, _v, _cube, _m, _cube)),
    )
