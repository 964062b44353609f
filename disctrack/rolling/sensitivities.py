"""Exact derivatives of the motion with respect to its initial state and to the parameters of its effects.

Each column is one more run of the same compiled integrator with an imaginary part of 1e-30 on one number (complex-step
derivative): no difference is taken, and the way in which the instants of the switches between rolling, slip and flight
move is included.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from calibration.arrays import Array
from disctrack.rolling._assembly import Assembly
from disctrack.rolling.model import DEFAULT_THETA_END, Model
from disctrack.rolling.motion import EndReason, as_seen
from disctrack.rolling.records import STATE_COMPONENTS
from disctrack.rolling.simulate import MAX_SLIP_STEPS, MAX_SWITCHES, RTOL, _grid, _start, follow
from disctrack.rolling.state import State

_SEED = 1e-30  # imaginary part; its square is far below the smallest rounding


@dataclass(frozen=True)
class Sensitivities:
    """Motion at n times and its derivatives with respect to k numbers; NaN after the end of the motion."""

    time: Array  # (n,)
    q: Array  # (n, 6)
    qdot: Array  # (n, 6)
    names: tuple[str, ...]  # (k,) components of the state, then "effect.parameter"
    dq: Array  # (n, 6, k) in the unit of q per unit of the number
    dqdot: Array  # (n, 6, k)
    slip_steps: int = 0  # of the integrator in slip, over all runs


def sensitivities(
    model: Model,
    state: State,
    times: ArrayLike,
    parameters: Sequence[str] = (),
    components: Sequence[str] | None = None,
    theta_end: float = DEFAULT_THETA_END,
    rtol: float = RTOL,
    max_switches: int = MAX_SWITCHES,
    max_slip_steps: int = MAX_SLIP_STEPS,
) -> Sensitivities:
    """D q(t), d qdot(t) by initial state and parameters.

    parameters : "effect.parameter" names; an effect that is not in the model is taken at its null value.
    components : of records.STATE_COMPONENTS; all that the state has if not given.
    max_switches : between rolling and slip, beyond which the motion counts as over; then there are no derivatives.
    max_slip_steps : of the integrator in slip, of all runs together; beyond them the rest is missing, too
    """
    grid = _grid(None, 0.0, times)
    y0 = _start(state, theta_end)
    enlarged = model.with_values(_missing(model, parameters))
    components = STATE_COMPONENTS[: len(y0)] if components is None else components
    names = (*components, *parameters)
    dq, dqdot = np.full((2, len(grid), 6, len(names)), np.nan)
    q, qdot = np.full((2, len(grid), 6), np.nan)
    path = follow(Assembly(enlarged, theta_end), y0, grid, rtol, max_switches, max_slip_steps)
    spent = path.slip_steps
    n = len(path.samples.time)
    q[:n], qdot[:n] = as_seen(path.samples.kinematics, path.samples.wrench)
    if path.end is EndReason.CHATTER:
        return Sensitivities(grid, q, qdot, names, dq, dqdot, spent)
    for column, name in enumerate(names):
        y, values = y0.astype(complex), {}
        if column < len(components):
            y[STATE_COMPONENTS.index(name)] += 1j * _SEED
        else:
            values = {name: enlarged.values[name] + 1j * _SEED}
        left = max(max_slip_steps - spent, 0)
        path = follow(Assembly(enlarged, theta_end, complex, values), y, grid, rtol, max_slip_steps=left)
        spent += path.slip_steps
        n = len(path.samples.time)
        complex_q, complex_qdot = as_seen(path.samples.kinematics, path.samples.wrench)
        dq[:n, :, column], dqdot[:n, :, column] = complex_q.imag / _SEED, complex_qdot.imag / _SEED
    return Sensitivities(grid, q, qdot, names, dq, dqdot, spent)


def _missing(model: Model, parameters: Sequence[str]) -> dict[str, float]:
    """Null values of parameters whose effect the model lacks."""
    present = {e.name for e in model.effects}
    missing = {}
    for full_name in parameters:
        effect, name = model.split_name(full_name)
        if effect.name not in present:
            missing[full_name] = effect.absent().values[name]
    return missing
