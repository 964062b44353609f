"""Exact derivatives of the motion with respect to its initial state and to the parameters of its effects.

Each column is one more run of the same compiled integrator with an imaginary part of 1e-30 on one number (complex-step
derivative): no difference is taken, and the way in which the instants of the switches between rolling, slip and flight
move is included. Columns that follow from a symmetry of the model are written down: where nothing tells one place or
direction of the table, or one angle of the body from another, a motion that begins elsewhere is the same motion there.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from types import CodeType

import numpy as np
from numpy.typing import ArrayLike

from calibration.kit.arrays import Array
from disctrack.frames import COORDINATES
from disctrack.rolling._assembly import Assembly
from disctrack.rolling.model import DEFAULT_THETA_END, Model
from disctrack.rolling.motion import EndReason, as_seen
from disctrack.rolling.records import STATE_COMPONENTS
from disctrack.rolling.simulate import MAX_SLIP_STEPS, MAX_SWITCHES, RTOL, _grid, _start, follow
from disctrack.rolling.state import State

_SEED = 1e-30  # imaginary part; its square is far below the smallest rounding
_UNEVEN = ("curvature", "slope_x", "slope_y", "oval_c", "oval_s", "lobes_c", "lobes_s", "flat_depth")
_ASKEW = ("com_1", "com_2", "J_12", "J_13", "J_23")  # of a body that is not the same all round its axis
_OF_PLACE = {"x": {"x"}, "y": {"y"}, "phi": {"phi"}}  # kinematics by which a law breaks the symmetry
_OF_DIRECTION = {"x", "y", "psi", *(f"{v}{a}" for v in ("table_", "table_v", "table_a", "field_") for a in "xy")}


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
    components = tuple(STATE_COMPONENTS[: len(y0)] if components is None else components)
    names = (*components, *parameters)
    dq, dqdot = np.full((2, len(grid), 6, len(names)), np.nan)
    q, qdot = np.full((2, len(grid), 6), np.nan)
    assembly = Assembly(enlarged, theta_end)
    path = follow(assembly, y0, grid, rtol, max_switches, max_slip_steps)
    spent = path.slip_steps
    n = len(path.samples.time)
    q[:n], qdot[:n] = as_seen(path.samples.kinematics, path.samples.wrench)
    if path.end is EndReason.CHATTER:
        return Sensitivities(grid, q, qdot, names, dq, dqdot, spent)
    same = symmetries(enlarged, assembly)
    for name in [c for c in components if c in same and c != "psi"]:
        column = components.index(name)
        dq[:n, :, column], dqdot[:n, :, column] = 0.0, 0.0
        dq[:n, COORDINATES.index(name), column] = 1.0
    # a turn of the table's axes moves the direction of a velocity at the start, too
    turns = "psi" in components and "psi" in same and (len(y0) == 8 or {"v_x", "v_y"} <= set(components))
    for column, name in enumerate(names):
        if column < len(components) and name in same and (name != "psi" or turns):
            continue
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
    if turns:
        column = components.index("psi")
        dq[:n, :, column], dqdot[:n, :, column] = _turned(q[:n] - q[0] * [1, 1, 0, 0, 0, 0]), _turned(qdot[:n])
        dq[:n, COORDINATES.index("psi"), column] = 1.0
        for amount, name in zip(_turned(y0[None, 8:10])[0], ("v_x", "v_y"), strict=False):
            dq[..., column] -= amount * dq[..., components.index(name)]
            dqdot[..., column] -= amount * dqdot[..., components.index(name)]
    return Sensitivities(grid, q, qdot, names, dq, dqdot, spent)


def _turned(vectors: Array) -> Array:
    """K x v for vectors whose first two of k components are x and y; the others are left at zero."""
    found = np.zeros_like(vectors)
    if vectors.shape[1]:
        found[:, 0], found[:, 1] = -vectors[:, 1], vectors[:, 0]
    return found


def symmetries(model: Model, assembly: Assembly) -> set[str]:
    """Those of x, y, psi, phi at the start on which nothing depends but where, and which way round, the motion is."""
    reads = {name for e in model.effects if e.law is not None for name in _names(type(e).law.__code__)}
    if any(assembly.constant(name) != 0.0 for name in _UNEVEN):
        return set()
    found = {name for name, breaking in _OF_PLACE.items() if not breaking & reads}
    if any(assembly.constant(name) != 0.0 for name in _ASKEW) or assembly.constant("J_11") != assembly.constant("J_22"):
        found.discard("phi")
    if not _OF_DIRECTION & reads and assembly.constant("g_x") == 0.0 and assembly.constant("g_y") == 0.0:
        found.add("psi")
    return found


def _names(code: CodeType) -> Iterator[str]:
    """All attributes and globals that a function names."""
    yield from code.co_names
    for inside in code.co_consts:
        if isinstance(inside, CodeType):
            yield from _names(inside)


def _missing(model: Model, parameters: Sequence[str]) -> dict[str, float]:
    """Null values of parameters whose effect the model lacks."""
    present = {e.name for e in model.effects}
    missing = {}
    for full_name in parameters:
        effect, name = model.split_name(full_name)
        if effect.name not in present:
            missing[full_name] = effect.absent().values[name]
    return missing
