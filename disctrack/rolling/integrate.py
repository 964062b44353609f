"""Runge-Kutta method of order 8 with dense output (coefficients: SciPy's DOP853) and events, compiled.

It has never heard of discs: the system and its event margins are C functions by address. Numbers may be complex: an
imaginary part of 1e-30 on a starting value or a parameter is carried along as the exact derivative of the solution. The
step control then looks at the real parts with the tolerances of the real solution, and at the imaginary parts relative
to their own largest size: a law whose amount is zero shows nowhere else.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numba import typeof
from scipy.integrate import DOP853

from calibration.kit.arrays import Array
from calibration.kit.compiled import njit
from disctrack.rolling._addresses import Addresses, call_system
from disctrack.rolling.records import Numbers, Records

Tableau: TypeAlias = tuple[Array, ...]  # A, B, C, E3, E5, D
Box: TypeAlias = tuple[Numbers, Numbers]  # scratch for a state, and for an instant

REACHED_END, EVENT, TOO_MANY_STEPS, NOT_FINITE = range(4)
RTOL_IMAGINARY = 1e-7  # error of fifth order per step; the derivatives then hold to about 1e-9 of their size

_part = njit(error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)  # called by compiled functions only

_N = DOP853.n_stages  # 12; stage 12 is the rate at the end of the step, stages 13 to 15 serve the dense output
_A_ALL = np.zeros((_N + 4, _N + 4))
_A_ALL[:_N, :_N] = DOP853.A[:_N, :_N]
_A_ALL[_N + 1 :] = DOP853.A_EXTRA
_C_ALL = np.concatenate([DOP853.C[:_N], [1.0], DOP853.C_EXTRA])
_TABLEAU = tuple(np.ascontiguousarray(a) for a in (_A_ALL, DOP853.B, _C_ALL, DOP853.E3, DOP853.E5, DOP853.D))


@dataclass(frozen=True)
class CompiledSystem:
    """Addresses of the rates and of the event margins, and the four addresses that both are called with."""

    rates: int
    margins: int
    n_margins: int
    arguments: Addresses  # (4,)


@dataclass(frozen=True)
class SolvedStretch:
    """Solution up to the end of the grid or to the first event; real or complex like its start."""

    status: int
    n_filled: int  # grid points reached
    y: Numbers  # (n_grid, n)
    t_last: complex  # instant of the event, or the last grid point
    y_last: Numbers  # (n,)
    event: int  # number of the margin that ran out, or -1
    n_steps: int


def integrate(
    system: CompiledSystem,
    t0: complex,
    y0: Numbers,
    grid: Array,
    rtol: float,
    atol: Array,
    max_steps: int = 200_000,
) -> SolvedStretch:
    """Solve dy/dt = f(t, y) from (t0, y0) to the grid's points, until a margin that was positive runs out.

    grid : (n_grid,) increasing, none before t0.   atol : (n,)
    """
    passed = _passed(system, t0, y0, grid, rtol, atol, max_steps)
    solution, _, t_last, y_last = passed[-4:]
    status, n_filled, event, n_steps = _dop853(*passed)
    return SolvedStretch(status, n_filled, solution, t_last[0], y_last, event, n_steps)


def prepare(scalar: type) -> None:
    """Compile the integrator for real or complex states, or load it."""
    system = CompiledSystem(0, 0, 1, np.zeros(4, np.int64))
    passed = _passed(system, 0.0, np.zeros(1, scalar), np.zeros(1), RTOL_IMAGINARY, np.zeros(1), 1)
    _dop853.compile(tuple(map(typeof, passed)))
    row, rows = (typeof(np.zeros(shape, scalar)) for shape in (1, (1, 1)))
    _evaluate.compile((typeof(0), typeof(system.arguments), row, rows, rows, row, row, rows, rows))


def _passed(
    system: CompiledSystem, t0: complex, y0: Numbers, grid: Array, rtol: float, atol: Array, max_steps: int
) -> tuple[Any, ...]:
    """What the compiled integrator is called with; the last four are its results and its scratch."""
    kind = y0.dtype
    return (
        system.rates,
        system.margins,
        system.arguments,
        np.array([t0], kind),
        y0,
        grid,
        rtol,
        atol,
        max_steps,
        kind.kind == "c",
        _TABLEAU,
        np.full((len(grid), len(y0)), np.nan, kind),
        np.zeros(system.n_margins, kind),
        np.array([t0], kind),
        y0.copy(),
    )


@_part
def _assign(target: Numbers, values: Numbers) -> None:
    """As target[:] = values, for which numba compiles the text of an error besides: a second."""
    for i in range(target.size):
        target[i] = values[i]


@_part
def _call(function: int, t: complex, y: Numbers, out: Numbers, t_box: Numbers, args: Addresses) -> None:
    t_box[0] = t
    call_system(function, t_box.ctypes.data, y.ctypes.data, out.ctypes.data, args[0], args[1], args[2], args[3])


@_part
def _stages(
    rates: int, args: Addresses, t: complex, y: Numbers, h: complex, first: int, last: int, A: Array, C: Array,
    K: Numbers, box: Box,
) -> None:  # fmt: skip
    """K[i] = f(t + c_i h, y + h sum_j a_ij K_j) for first <= i < last."""
    y_stage, t_box = box
    for i in range(first, last):
        for k in range(y.size):
            total = A[i, 0] * K[0, k]
            for j in range(1, i):
                total += A[i, j] * K[j, k]
            y_stage[k] = y[k] + h * total
        _call(rates, t + C[i] * h, y_stage, K[i], t_box, args)


@_part
def _step(
    rates: int, args: Addresses, t: complex, y: Numbers, h: complex, tableau: Tableau, K: Numbers, box: Box,
    y_new: Numbers,
) -> None:  # fmt: skip
    """y_new = y(t + h) of order 8 from K[0] = f(t, y)."""
    A, B, C, _, _, _ = tableau
    _stages(rates, args, t, y, h, np.int64(1), B.size, A, C, K, box)  # a literal is a type of its own
    for k in range(y.size):
        total = B[0] * K[0, k]
        for i in range(1, B.size):
            total += B[i] * K[i, k]
        y_new[k] = y[k] + h * total


@_part
def _error_norm(y: Numbers, y_new: Numbers, h: float, K: Numbers, tableau: Tableau, rtol: float, atol: Array) -> float:
    """Hairer's combination of the embedded errors of order 5 and 3, in units of the tolerance."""
    _, _, _, E3, E5, _ = tableau
    sum5, sum3 = 0.0, 0.0
    for k in range(y.size):
        e5, e3 = 0.0, 0.0
        for i in range(E5.size):
            e5 += E5[i] * K[i, k].real
            e3 += E3[i] * K[i, k].real
        scale = atol[k] + rtol * max(abs(y[k].real), abs(y_new[k].real))
        e5, e3 = e5 / scale, e3 / scale
        sum5 += e5 * e5
        sum3 += e3 * e3
    if sum5 == 0.0 and sum3 == 0.0:
        return 0.0
    return abs(h) * sum5 / np.sqrt((sum5 + 0.01 * sum3) * y.size)


@_part
def _imaginary_error(y_new: Numbers, h: float, K: Numbers, tableau: Tableau, atol: Array, size: Array) -> float:
    """Embedded error of the imaginary parts in units of its tolerance; `size` (1,) is their largest so far in atol."""
    _, _, _, _, E5, _ = tableau
    worst = 0.0
    for k in range(y_new.size):
        size[0] = max(size[0], abs(y_new[k].imag) / atol[k])
        e5 = 0.0
        for i in range(E5.size):
            e5 += E5[i] * K[i, k].imag
        worst = max(worst, abs(e5) / atol[k])
    return abs(h) * worst / (RTOL_IMAGINARY * size[0]) if size[0] > 0.0 else 0.0


@_part
def _interpolant(y: Numbers, y_new: Numbers, h: complex, K: Numbers, D: Array, F: Numbers) -> None:
    """Coefficients F (7, n) of the polynomial of degree 7 through the step."""
    for k in range(y.size):
        difference = y_new[k] - y[k]
        F[0, k] = difference
        F[1, k] = h * K[0, k] - difference
        F[2, k] = 2.0 * difference - h * (K[12, k] + K[0, k])
        for row in range(D.shape[0]):
            total = D[row, 0] * K[0, k]
            for i in range(1, D.shape[1]):
                total += D[row, i] * K[i, k]
            F[3 + row, k] = h * total


@_part
def _interpolate(y: Numbers, F: Numbers, x: complex, out: Numbers) -> None:
    """Value at the fraction x of the step, by nested factors x, 1 - x, x, ..."""
    for k in range(y.size):
        total = 0.0 * F[0, k]
        for i in range(F.shape[0]):
            total = (total + F[6 - i, k]) * (x if i % 2 == 0 else 1.0 - x)
        out[k] = y[k] + total


@_part
def _fill(
    rates: int, args: Addresses, t: complex, y: Numbers, h: complex, tableau: Tableau, K: Numbers, box: Box,
    y_new: Numbers, F: Numbers, grid: Array, i_grid: int, solution: Numbers,
) -> int:  # fmt: skip
    """Write the grid points from number i_grid up to the end of the step; returns the number of the next one."""
    A, B, C, _, _, D = tableau
    _stages(rates, args, t, y, h, B.size + 1, C.size, A, C, K, box)
    _interpolant(y, y_new, h, K, D, F)
    while i_grid < grid.size and grid[i_grid] <= (t + h).real:
        _interpolate(y, F, (grid[i_grid] - t) / h, solution[i_grid])
        i_grid += 1
    return i_grid


@_part
def _first_step(y: Numbers, f: Numbers, atol: Array) -> float:
    """A hundredth of the time in which the fastest component changes by its own size."""
    fastest = 0.0
    for k in range(y.size):
        fastest = max(fastest, abs(f[k].real) / (atol[k] * 1e6 + abs(y[k].real)))
    return 0.01 / (1.0 + fastest)


@_part
def _ran_out(before: Numbers, after: Numbers) -> int:
    """Number of the first margin that was positive and is no longer, or -1."""
    for e in range(after.size):
        if before[e].real > 0.0 and after[e].real <= 0.0:
            return e
    return -1


@_part
def _locate(
    system: tuple[int, int], args: Addresses, t: complex, y: Numbers, h: float, tableau: Tableau, K: Numbers,
    box: Box, y_new: Numbers, before: Numbers, after: Numbers,
) -> tuple[int, float]:  # fmt: skip
    """Shorten the step to where the first margin has just run out, by bisection; y_new and `after` hold there.

    Returns the number of the margin and the length of the step.
    """
    rates, margins = system
    unit = 0.0 * y[0] + 1.0
    low, high, trial = 0.0, h, 0.5 * h
    while True:
        _step(rates, args, t, y, trial * unit, tableau, K, box, y_new)
        _call(margins, t + trial * unit, y_new, after, box[1], args)
        event = _ran_out(before, after)
        if trial == high:
            return event, high
        if event >= 0:
            high = trial
        else:
            low = trial
        trial = 0.5 * (low + high)
        if not low < trial < high or high - low < 1e-16:
            trial = high


@njit(cache=True, nogil=True, error_model="numpy")
def _dop853(
    rates: int, margins: int, args: Addresses, t0: Numbers, y0: Numbers, grid: Array, rtol: float, atol: Array,
    max_steps: int, is_complex: bool, tableau: Tableau, solution: Numbers, margin: Numbers, t_last: Numbers,
    y_last: Numbers,
) -> tuple[int, np.signedinteger, int, int]:  # fmt: skip
    n, n_stages = y0.size, tableau[1].size
    unit = 0.0 * y0[0] + 1.0  # one, in the kind of number of the state
    K, F = np.zeros((tableau[2].size, n), y0.dtype), np.zeros((7, n), y0.dtype)
    y, y_new, margin_new = y0.copy(), y0.copy(), margin.copy()
    box = (y0.copy(), t0.copy())
    t, size = t0[0], np.zeros(1)
    for k in range(n):
        size[0] = max(size[0], abs(y[k].imag) / atol[k])
    _call(rates, t, y, K[0], box[1], args)
    _call(margins, t, y, margin, box[1], args)
    h_next, i_grid = _first_step(y, K[0], atol), np.int64(0)
    for steps in range(max_steps):
        t_last[0] = t
        _assign(y_last, y)
        if i_grid == grid.size:
            return REACHED_END, i_grid, -1, steps
        room = grid[-1] - t
        h = room if room.real <= h_next else h_next * unit
        if room.real < 1e-15:  # the last points coincide with t up to rounding
            while i_grid < grid.size:
                _assign(solution[i_grid], y)
                i_grid += 1
            continue
        _step(rates, args, t, y, h, tableau, K, box, y_new)
        error = _error_norm(y, y_new, h.real, K, tableau, rtol, atol)
        if is_complex:
            error = max(error, _imaginary_error(y_new, h.real, K, tableau, atol, size))
        if not error <= 1.0:  # also when not a number
            h_next = h.real * (max(0.2, 0.9 * error**-0.125) if np.isfinite(error) else 0.1)
            if h_next < 1e-15:
                return NOT_FINITE, i_grid, -1, steps
            continue
        h_next = h.real * (5.0 if error == 0.0 else min(5.0, 0.9 * error**-0.125))
        _call(margins, t + h, y_new, margin_new, box[1], args)
        event = _ran_out(margin, margin_new)
        if event >= 0:
            event, h_event = _locate((rates, margins), args, t, y, h.real, tableau, K, box, y_new, margin, margin_new)
            h = h_event * unit
        _call(rates, t + h, y_new, K[n_stages], box[1], args)
        if grid[i_grid] <= (t + h).real:
            i_grid = _fill(rates, args, t, y, h, tableau, K, box, y_new, F, grid, i_grid, solution)
        t = t + h
        _assign(y, y_new)
        if event >= 0:
            t_last[0] = t
            _assign(y_last, y)
            return EVENT, i_grid, event, steps
        _assign(K[0], K[n_stages])
        _assign(margin, margin_new)
    return TOO_MANY_STEPS, i_grid, -1, max_steps


@njit(cache=True, error_model="numpy")
def _evaluate(
    function: int,
    args: Addresses,
    t: Numbers,
    Y: Numbers,
    out: Numbers,
    first: Numbers,
    second: Numbers,
    firsts: Numbers,
    seconds: Numbers,
) -> None:
    t_box = t[:1].copy()
    for i in range(len(t)):
        _call(function, t[i], Y[i], out[i], t_box, args)
        _assign(firsts[i], first)
        _assign(seconds[i], second)


def evaluate(
    function: int,
    arguments: Addresses,
    t: Numbers,
    Y: Numbers,
    n_out: int,
    scratch: tuple[Records, Records],
) -> tuple[Numbers, Records, Records]:
    """Call a system function at many states; also returns the two scratch records (1,) as they are after each call.

    t : (n,), Y : (n, n_y) -> (n, n_out), (n,), (n,)
    """
    out = np.zeros((len(t), n_out), Y.dtype)
    first, second = (np.zeros(len(t), s.dtype) for s in scratch)
    numbers = [s.view(Y.dtype) for s in scratch] + [r.view(Y.dtype).reshape(len(t), -1) for r in (first, second)]
    _evaluate(function, arguments, t.astype(Y.dtype), np.ascontiguousarray(Y), out, *numbers)
    return out, first, second
