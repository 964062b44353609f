"""Exact derivatives of the motion with respect to its initial state and to the parameters of its effects.

Each column is one more run of the same compiled integrator with an imaginary part of 1e-30 on one number (complex-step
derivative): no difference is taken, and the way in which the instants of the switches between rolling, slip and flight
move is included. Columns that follow from a symmetry of the model are written down: where nothing tells one place or
direction of the table, or one angle of the body from another, a motion that begins elsewhere is the same motion there.

From those by the state follow first-order responses of a rolling motion to any moment and force, without another run:
with the fundamental matrix Phi(t) = dy(t)/dy(0) of the state and B(t), what a unit of moment or force adds to its rate,
a small wrench f(t) moves the state by Phi(t) times the integral of Phi(s)^-1 B(s) f(s) ds (variation of constants). So
hundreds of laws can be asked for what each would do, for the price of some sums.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.integrate import cumulative_simpson

from calibration.kit.arrays import Array, Numbers
from disctrack.disc import MA_2014
from disctrack.frames import COORDINATES
from disctrack.rolling._compiled import compile_law
from disctrack.rolling.effects.base import CATALOGUE, HELPERS
from disctrack.rolling.effects.learned import effect_from_formulas
from disctrack.rolling.equations import ROLLING
from disctrack.rolling.model import DEFAULT_THETA_END, Model
from disctrack.rolling.motion import EndReason, Path, columns
from disctrack.rolling.records import ROLLING_COMPONENTS, STATE_COMPONENTS
from disctrack.rolling.simulate import MAX_SWITCHES, MOST_STEPS, RTOL, Assembly, _grid, _start, follow, simulate
from disctrack.rolling.state import State, steady_precession

COMPONENTS = ("M_n", "M_m", "M_z", "X_n", "X_m", "X_z")  # of a moment and a force that responses are asked for
_PROBE = effect_from_formulas("probe", {c: f"{c}_given" for c in COMPONENTS})
_SEED = 1e-30  # imaginary part; its square is far below the smallest rounding
_ASKEW = ("com_1", "com_2", "J_12", "J_13", "J_23")  # of a body that is not the same all round its axis
# What a law reads that tells one direction of the table from another.
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
    dstate: Array  # (n, 8, k) of records.ROLLING_COMPONENTS
    slip_steps: int = 0  # of the integrator in slip, over all runs
    n_steps: int = 0  # of it in all


def sensitivities(
    model: Model,
    state: State,
    times: ArrayLike,
    parameters: Sequence[str] = (),
    components: Sequence[str] | None = None,
    theta_end: float = DEFAULT_THETA_END,
    rtol: float = RTOL,
    max_switches: int = MAX_SWITCHES,
    max_steps: int = MOST_STEPS,
) -> Sensitivities:
    """D q(t), d qdot(t) by initial state and parameters.

    parameters : "effect.parameter" names; an effect that is not in the model is taken at its null value.
    components : of records.STATE_COMPONENTS; all that the state has if not given.
    max_switches : between rolling and slip, beyond which the motion counts as over; then there are no derivatives.
    max_steps : of the integrator, of all runs together; beyond them the rest is missing, too
    """
    grid = _grid(None, 0.0, times)
    y0 = _start(state, theta_end)
    lacking = {effect.name: effect for effect, _ in map(model.split_name, parameters) if not model.effect(effect.name)}
    enlarged = model.with_effects(*(effect.absent() for effect in lacking.values()))
    components = tuple(STATE_COMPONENTS[: len(y0)] if components is None else components)
    names = (*components, *parameters)
    found = np.full((len(grid), 20, 1 + len(names)), np.nan)  # q, qdot and state: the motion, then its derivatives
    assembly = Assembly(enlarged, theta_end)
    path = follow(assembly, y0, grid, rtol, max_switches, max_steps)
    spent, n_steps = path.slip_steps, path.n_steps
    found[: len(path.now), :, 0] = _numbers(path)
    if path.end is not EndReason.CHATTER:
        same = symmetries(enlarged, assembly) - ({"psi"} if len(y0) > 8 else set())  # a slip at the start turns, too
        for column, name in enumerate(names, start=1):
            if name in same and column <= len(components):
                found[: len(path.now), :, column] = [float(name == n) for n in _NUMBERS]
                if name == "psi":
                    _turn(found[..., column], found[..., 0])
                continue
            y, values = y0.astype(complex), {}
            if column <= len(components):
                y[STATE_COMPONENTS.index(name)] += 1j * _SEED
            else:
                values = {name: enlarged.values[name] + 1j * _SEED}
            moved = Assembly(enlarged, theta_end, complex, values)
            run = follow(moved, y, grid, rtol, max_steps=max_steps - n_steps)
            spent, n_steps = spent + run.slip_steps, n_steps + run.n_steps
            found[: len(run.now), :, column] = _numbers(run).imag / _SEED
    q, qdot, _ = np.split(found[..., 0], [6, 12], axis=1)
    dq, dqdot, dstate = np.split(found[..., 1:], [6, 12], axis=1)
    return Sensitivities(grid, q, qdot, names, dq, dqdot, dstate, spent, n_steps)


_NUMBERS = (*COORDINATES, *(f"{c}dot" for c in COORDINATES), *ROLLING_COMPONENTS)


def _numbers(path: Path) -> Numbers:
    """(n, 20) of a path."""
    return np.concatenate([*path.as_seen, columns(path.now, *ROLLING_COMPONENTS)], axis=1)


def _turn(column: Array, motion: Array) -> None:
    """Add to a column what a turn of the motion about the vertical through where it begins moves: K x v."""
    moved = motion[:, :2] - motion[0, :2]
    for first, (x, y) in ((0, moved.T), (6, motion[:, 6:8].T), (12, moved.T)):  # place, velocity, place in the state
        column[:, first], column[:, first + 1] = -y, x


def symmetries(model: Model, assembly: Assembly) -> set[str]:
    """Those of x, y, psi, phi at the start on which nothing depends but where, and which way round, the motion is.

    What a law reads stands in its code: it holds no function of its own.
    """
    if any(assembly.constant(name) != 0.0 for name in ("uneven", "surface_vx", "surface_vy", "surface_turn")):
        return set()
    reads = {name for e in model.effects if e.law is not None for name in type(e).law.__code__.co_names}
    askew = any(assembly.constant(name) != 0.0 for name in _ASKEW)
    if askew or assembly.constant("J_11") != assembly.constant("J_22"):
        reads.add("phi")
    if _OF_DIRECTION & reads or assembly.constant("g_x") != 0.0 or assembly.constant("g_y") != 0.0:
        reads.add("psi")
    return {"x", "y", "psi", "phi"} - reads


@dataclass(frozen=True)
class Responses:
    """Of a motion that rolls all the time; N instants, (nearly) equally far apart."""

    time: Array  # (N,) [s]
    q: Array  # (N, 6)
    qdot: Array  # (N, 6)
    kernel: Array  # (N, 8, 6) Phi^-1 B by COMPONENTS, per N m and per N

    def of(self, courses: Array) -> Array:
        """(N, 8, p) displacement of the initial state that stands for what wrenches (N, 6, p) have done up to then.

        The state itself has moved by Phi times this; so has every prediction by its derivative by the initial state.
        """
        per_instant = self.kernel * np.gradient(self.time)[:, None, None]
        return np.asarray(cumulative_simpson(np.einsum("nkc,ncp->nkp", per_instant, courses), axis=0, initial=0.0))


def responses(model: Model, state: State, times: Array, theta_end: float = DEFAULT_THETA_END) -> Responses | None:
    """Responses along the motion from `state` at times[0]; None where it does not roll over all of the times."""
    motion = simulate(model, state, times=times, theta_end=theta_end, rtol=RTOL)
    if len(motion) < len(times) or np.any(motion.regime != ROLLING):
        return None
    found = sensitivities(model, state, times, (), ROLLING_COMPONENTS, theta_end)
    if not np.isfinite(found.dq).all():
        return None
    kernel = np.asarray(np.linalg.solve(found.dstate, _per_wrench(model, motion.state, times)), float)
    return Responses(times, found.q, found.qdot, kernel)


def _per_wrench(model: Model, states: Array, times: Array) -> Array:
    """(N, 8, 6) derivative of the state's rate by moment and force, on which it depends linearly."""
    rates = []
    for row in np.vstack([np.zeros(len(COMPONENTS)), np.eye(len(COMPONENTS))]):
        probe = _PROBE(**{f"{c}_given": x for c, x in zip(COMPONENTS, row, strict=True)})
        rates.append(Assembly(model.with_effects(probe), DEFAULT_THETA_END).at(ROLLING, times, states)[0])
    return np.asarray(np.stack(rates[1:], axis=-1) - rates[0][..., None], float)


def prepare() -> None:
    """Compile integrator, equations of motion and the catalogue's laws for real and complex states, or load them."""
    for kind in CATALOGUE.values():
        if kind.law is not None:
            for scalar in (float, complex):
                compile_law(kind.law, tuple(p.name for p in kind.parameters), HELPERS, scalar)
    sensitivities(Model(MA_2014), steady_precession(0.1, MA_2014), [0.0, 1e-3], components=["theta"])
