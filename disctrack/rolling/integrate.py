"""Runge-Kutta method of order 8 with dense output and events, compiled.

It is independent of the disc: the system is the address of a C function that computes rates and event margins. Numbers
may be complex: an imaginary part of 1e-30 of an initial value or a parameter becomes the exact derivative of the
solution. The step control then applies the tolerances of the real solution to the real parts, and a tolerance relative
to their maximum to the imaginary parts: a law whose amount is zero changes only these.
"""

from typing import NamedTuple

import numpy as np

from calibration.kit import _dop853 as dop853
from calibration.kit.compiled import exact_part, njit
from calibration.kit.types import Array, Numbers
from disctrack.rolling._compiled import call

RTOL_IMAGINARY = 1e-7  # fifth-order error per step; the relative error of the derivatives is then about 1e-9


class CompiledSystem(NamedTuple):
    """Address of f(t, y, out, a, b, c), which writes rates and then margins, and the addresses a, b, c."""

    function: int
    a: int
    b: int
    c: int
    n_margins: int


@exact_part
def _assign(target: Numbers, values: Numbers) -> None:
    """Same as target[:] = values, for which numba also compiles an error message, which takes a second."""
    for i in range(target.size):
        target[i] = values[i]


@exact_part
def _rates(t: complex, y: Numbers, out: Numbers, system: CompiledSystem, t_box: Numbers) -> None:
    t_box[0] = t
    call(system.function, (t_box.ctypes.data, y.ctypes.data, out.ctypes.data, system.a, system.b, system.c))


_step, _polynomial = dop853.method(_rates)


@njit(cache=True, error_model="numpy")
def evaluate(system: CompiledSystem, t: Numbers, Y: Numbers, out: Numbers, instant: Numbers, found: Numbers) -> None:
    """Rates and margins `out` of states Y (N, n) at t (N,); `found` are copies of the record that each call fills."""
    t_box = t[:1].copy()
    for i in range(len(t)):
        _rates(t[i], Y[i], out[i], system, t_box)
        _assign(found[i], instant)


@exact_part
def _error(y: Numbers, h: float, rtol: float, atol: Array, size: Array, made: dop853.Step) -> float:
    """Hairer's combination of the embedded errors of order 5 and 3, in units of the tolerance.

    Or, if larger, the error of order 5 of the imaginary parts; `size` (1,) is their maximum so far, in units of atol.
    """
    sum5, sum3, worst = 0.0, 0.0, 0.0
    for k in range(y.size):
        e5, e3 = 0.0 * y[k], 0.0 * y[k]
        for i in range(dop853.E5.size):
            e5 += dop853.E5[i] * made.K[i, k]
            e3 += dop853.E3[i] * made.K[i, k]
        new = made.end[k]
        scale = atol[k] + rtol * max(abs(y[k].real), abs(new.real))
        sum5 += (e5.real / scale) ** 2
        sum3 += (e3.real / scale) ** 2
        size[0] = max(size[0], abs(y[k].imag) / atol[k], abs(new.imag) / atol[k])
        worst = max(worst, abs(e5.imag) / atol[k])
    error, imaginary = 0.0, 0.0
    if sum5 != 0.0 or sum3 != 0.0:
        error = abs(h) * sum5 / np.sqrt((sum5 + 0.01 * sum3) * y.size)
    if size[0] > 0.0:
        imaginary = abs(h) * worst / (RTOL_IMAGINARY * size[0])
    if imaginary > error or not np.isfinite(imaginary):
        error = imaginary
    return error


@exact_part
def _first_step(y: Numbers, f: Numbers, atol: Array) -> float:
    """A hundredth of the shortest time in which a component changes by its own magnitude."""
    fastest = 0.0
    for k in range(y.size):
        fastest = max(fastest, abs(f[k].real) / (atol[k] * 1e6 + abs(y[k].real)))
    return 0.01 / (1.0 + fastest)


@exact_part
def _first_event(K: Numbers, n: int) -> int:
    """Index of the first margin that is positive at the start of the step but not at its end, or -1."""
    for e in range(n, K.shape[1]):
        if K[0, e].real > 0.0 and K[dop853.N, e].real <= 0.0:
            return e - n
    return -1


@exact_part
def _locate(
    system: CompiledSystem, t_box: Numbers, t: complex, y: Numbers, h: complex, event: int, made: dop853.Step
) -> tuple[int, float]:
    """The first event within a step and the fraction of the step, by bisection with the interpolating polynomial.

    event : index of the first margin that is not positive at the end of the step
    """
    low, high = 0.0, 1.0
    for _ in range(50):  # to rounding error
        trial = 0.5 * (low + high)
        dop853.along(made.F, y, trial, made.stage)
        _rates(t + trial * h, made.stage, made.K[dop853.N], system, t_box)
        found = _first_event(made.K, y.size)
        if found < 0:
            low = trial
        else:
            high, event = trial, found
    return event, high


@njit(cache=True, nogil=True, error_model="numpy")
def integrate(
    system: CompiledSystem, t0: complex, y0: Numbers, grid: Array, rtol: float, atol: Array, scale: float,
    max_steps: int,
) -> tuple[Numbers, complex, Numbers, int, int]:  # fmt: skip
    """Solve dy/dt = f(t, y) from (t0, y0) to the grid's points, until a positive margin falls to zero.

    grid : (n_grid,) increasing, none before t0.   atol : (n,)
    scale : size that imaginary parts reach, in units of atol, if it is known; else they are resolved from zero on
    Returns y at the grid points that were reached (n_filled, n), instant and state of the event or at the last grid
    point, the index of the margin of the event or -1, and the number of steps. If neither an event nor the last grid
    point is reached, the step became too small, a number is not finite, or the steps were too many.
    """
    y, n, unit = y0.copy(), y0.size, 0.0 * y0[0] + 1.0  # one, in the number type of the state
    solution = np.empty((grid.size, n), y0.dtype)
    t_box, made = np.empty(1, y0.dtype), dop853.room(y, n + system.n_margins)
    K = made.K
    size, t, i_grid, event, steps = np.full(1, scale), t0 * unit, np.int64(0), -1, 0
    _rates(t, y, K[0], system, t_box)
    h_next = _first_step(y, K[0], atol)
    while event < 0 and i_grid < grid.size and steps < max_steps and h_next >= 1e-15:
        steps += 1
        room = grid[-1] - t
        h = room if room.real <= h_next else h_next * unit
        if room.real < 1e-15:  # the last points coincide with t up to rounding
            while i_grid < grid.size:
                _assign(solution[i_grid], y)
                i_grid += 1
            continue
        _step(system, t_box, t, y, h, made)
        error = _error(y, h.real, rtol, atol, size, made)
        if not error <= 1.0:  # also if NaN
            h_next = h.real * (max(0.2, 0.9 * error**-0.125) if np.isfinite(error) else 0.1)
            continue
        h_next = h.real * (5.0 if error == 0.0 else min(5.0, 0.9 * error**-0.125))
        _rates(t + h, made.end, K[dop853.N], system, t_box)
        event = _first_event(K, n)
        if event >= 0:
            _polynomial(system, t_box, t, y, h, made)
            event, part = _locate(system, t_box, t, y, h, event, made)
            h = part * h
            _step(system, t_box, t, y, h, made)
            _rates(t + h, made.end, K[dop853.N], system, t_box)
        if grid[i_grid] <= (t + h).real:
            _polynomial(system, t_box, t, y, h, made)
            while i_grid < grid.size and grid[i_grid] <= (t + h).real:
                dop853.along(made.F, y, (grid[i_grid] - t) / h, solution[i_grid])
                i_grid += 1
        t = t + h
        _assign(y, made.end)
        _assign(K[0], K[dop853.N])
    return solution[:i_grid], t, y, event, steps
