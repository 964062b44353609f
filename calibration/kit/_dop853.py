"""Runge-Kutta method of order 8 with dense output of order 7, compiled (coefficients: SciPy's DOP853).

Hairer, Norsett & Wanner, Solving Ordinary Differential Equations I, sections II.5 and II.6. This is one step and the
polynomial through it; step size control and events are left to the caller. Numbers are real, or complex if imaginary
parts carry derivatives.
"""

from typing import NamedTuple

import numpy as np
from scipy.integrate import DOP853

from calibration.kit.compiled import exact_part, owning_part
from calibration.kit.types import Numbers

N = DOP853.n_stages  # 12; stage 12 is the rate at the end of the step, stages 13 to 15 are for the dense output
A = np.zeros((N + 4, N + 4))
A[:N, :N] = DOP853.A[:N, :N]
A[N + 1 :] = DOP853.A_EXTRA
C = np.concatenate([DOP853.C[:N], [1.0], DOP853.C_EXTRA])
B, E3, E5, D = (np.ascontiguousarray(a) for a in (DOP853.B, DOP853.E3, DOP853.E5, DOP853.D))


class Step(NamedTuple):
    """Work arrays of a step."""

    K: Numbers  # (16, n or more) rates at the stages
    F: Numbers  # (7, n) coefficients of the polynomial through the step
    stage: Numbers  # (n,) state at the last stage: a second estimate of ...
    end: Numbers  # (n,) ... the state at the end of the step


@owning_part
def room(y: Numbers, width: int) -> Step:
    """Work arrays for states (n,) if the function of rates writes `width` numbers."""
    return Step(np.zeros((N + 4, width), y.dtype), np.zeros((7, y.size), y.dtype), y.copy(), y.copy())


@exact_part
def _moved(y: Numbers, h: complex, weights: Numbers, K: Numbers, out: Numbers) -> None:
    """`out` = y + h times the weighted sum of rates."""
    for k in range(y.size):
        total = weights[0] * K[0, k]
        for j in range(1, weights.size):
            total += weights[j] * K[j, k]
        out[k] = y[k] + h * total


def method(rates):
    """`step(system, own, t, y, h, made)` and `polynomial(...)` for rates(t, y, out, system, own).

    `rates` is a compiled function; it writes the rate of y (n,) into the first n numbers of `out`.
    step : sets K[1] to K[11] of a step from y, whose rate is K[0], and its end
    polynomial : sets F, with the rate at the step's end in K[12]; computes the last stages, and overwrites `stage`
    """

    @exact_part
    def stages(system, own, t, y, h, first, last, made):
        for s in range(first, last):
            _moved(y, h, A[s, :s], made.K, made.stage)
            rates(t + C[s] * h, made.stage, made.K[s], system, own)

    @exact_part
    def step(system, own, t, y, h, made):
        stages(system, own, t, y, h, np.int64(1), np.int64(N), made)  # a literal is a type of its own
        _moved(y, h, B, made.K, made.end)

    @exact_part
    def polynomial(system, own, t, y, h, made):
        stages(system, own, t, y, h, np.int64(N + 1), np.int64(N + 4), made)
        K, F = made.K, made.F
        for k in range(y.size):
            F[0, k] = made.end[k] - y[k]
            F[1, k] = h * K[0, k] - F[0, k]
            F[2, k] = 2.0 * F[0, k] - h * (K[N, k] + K[0, k])
            made.stage[k] = 0.0
        for row in range(4):
            _moved(made.stage, h, D[row], K, F[3 + row])

    return step, polynomial


@exact_part
def along(F: Numbers, y: Numbers, x: complex, out: Numbers) -> None:
    """The step's polynomial at the fraction x of the step, by nested factors x, 1 - x, x, ..."""
    for k in range(y.size):
        total = 0.0 * F[0, k]
        for i in range(7):
            total = (total + F[6 - i, k]) * (x if i % 2 == 0 else 1.0 - x)
        out[k] = y[k] + total
