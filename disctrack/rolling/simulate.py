"""Simulation of a model from an initial state, through pure rolling, slip and flight, and its derivatives.

The derivatives with respect to the initial state and the parameters of the effects are exact. Each column is another
run of the same compiled integrator with an imaginary part of 1e-30 on one number (complex-step derivative). They
include the dependence of the instants of the switches between rolling, slip and flight. Columns that follow from a
symmetry of the model are not integrated: if the model does not depend on the position or direction on the table, or on
the spin angle, a motion with another initial value is the same motion, displaced or rotated.

The derivatives with respect to the state determine first-order responses of a rolling motion to any moment and force.
Let Phi(t) = dy(t)/dy(0) be the fundamental matrix, and B(t) the derivative of the state's rate by moment and force.
Then a small wrench f(t) moves the state by Phi(t) times the integral of Phi(s)^-1 B(s) f(s) ds (variation of
constants). The responses to hundreds of laws thus need no further integration.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import CodeType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.integrate import cumulative_simpson

from calibration.kit.types import Array, FrameRate, Numbers, Seconds, Times, checked
from disctrack.disc import MA_2014
from disctrack.errors import ModelError
from disctrack.files.toml_tree import MOST
from disctrack.frames import COORDINATES
from disctrack.rolling import integrate
from disctrack.rolling._compiled import compile_law, compile_system
from disctrack.rolling.effects.base import CATALOGUE, HELPERS
from disctrack.rolling.effects.learned import effect_from_formulas
from disctrack.rolling.equations import EVENTS, FILM, FLYING, ROLLING, SLIPPING, STICK_SPEED, rates
from disctrack.rolling.model import DEFAULT_THETA_END, Model, body_constants, effect_values
from disctrack.rolling.motion import EndReason, Motion, Path, Switch, columns, coordinates
from disctrack.rolling.records import BODY, INSTANT, ROLLING_COMPONENTS, STATE_COMPONENTS, Records, Regime, record_dtype
from disctrack.rolling.state import State, steady_precession

# m, m, rad, rad, rad, rad/s x 3, m/s x 2, m, m/s: about 1e-12 of the typical values
ATOL = np.array([1e-13, 1e-13, 1e-12, 1e-13, 1e-12, 1e-11, 1e-11, 1e-11, 1e-13, 1e-13, 1e-13, 1e-13])
COMPONENTS = ("M_n", "M_m", "M_z", "X_n", "X_m", "X_z")  # of moment and force in `responses`
_PROBE = effect_from_formulas("probe", {c: f"{c}_given" for c in COMPONENTS})
_SEED = 1e-30  # imaginary part; its square is far below rounding errors
_ASKEW = ("com_1", "com_2", "J_12", "J_13", "J_23")  # nonzero in a body without symmetry about its axis
# Kinematics with which a law depends on a direction of the table.
_OF_DIRECTION = {"x", "y", "psi", *(f"{v}{a}" for v in ("table_", "table_v", "table_a", "field_") for a in "xy")}


class Effort(NamedTuple):
    """How accurately a motion is integrated, and how far."""

    rtol: float = 1e-11  # without dissipation the energy is constant to 1e-11 over 1.5 s
    max_switches: int = 2000  # between slip and rolling; more is chatter: the motion ends, and has no derivatives
    max_steps: int = 1_000_000  # of the integrator, in all regimes and runs; after these derivatives are NaN
    rtol_of_derivatives: float = 1e-11  # with which the motion is followed for these


FULL = Effort()


@checked
def simulate(
    model: Model,
    state: State,
    duration: Seconds | None = None,
    *,
    rate: FrameRate = 1000.0,
    times: Times | None = None,
    theta_end: float = DEFAULT_THETA_END,
) -> Motion:
    """Motion from `state` over `duration` [s] at `rate` [Hz], or at the given `times`.

    The state is that at the first of the times (0 with `duration`). The motion ends early, with the reason in `end`, if
    the nutation falls to `theta_end` [rad], the disc stands up, or it lands after a loss of contact. Then it has only
    the times before its end. Raises ModelError for an invalid state or invalid times.

        >>> disc = read_recording("clip").disc
        >>> simulate(Model(disc), steady_precession(0.1, disc), duration=0.1).q.shape
        (101, 6)
    """
    grid = _grid(duration, rate, times)
    assembly = Assembly(model, theta_end)
    return Motion(model, assembly.body, follow(assembly, _start(state, theta_end), grid))


def _grid(duration: float | None, rate: float, times: ArrayLike | None) -> Array:
    """The times, or the instants i / rate up to the duration, both ends included [s]."""
    if times is None:
        if duration is None:
            raise ModelError("neither a duration nor times are given")
        if duration * rate > MOST:
            instants = f"{duration:g} s at {rate:g} Hz are {duration * rate:.3g} instants"
            raise ModelError(f"{instants}; expected at most {MOST:g}")
        return np.arange(int(np.floor(duration * rate * (1 + 1e-12))) + 1) / rate
    grid = np.ascontiguousarray(times, float)
    if grid.ndim != 1 or len(grid) == 0 or not np.isfinite(grid).all() or (np.diff(grid) <= 0).any():
        raise ModelError("the times must be a list of finite, increasing numbers")
    return grid


def _start(state: State, theta_end: float) -> Array:
    y = state.array
    given = [name for name in ("v_x", "v_y", "z", "v_z") if getattr(state, name) is not None]
    if given not in ([], ["v_x", "v_y"], ["v_x", "v_y", "z", "v_z"]):
        raise ModelError(
            f"of the velocity and height of O, the state has {', '.join(given)}: give none for rolling, v_x and v_y "
            "for slip, v_x, v_y, z and v_z for flight"
        )
    if not theta_end < state.theta <= np.pi / 2:
        raise ModelError(
            f"nutation {np.degrees(state.theta):.4g} deg is outside ({np.degrees(theta_end):.4g}, 90] deg: the motion "
            "would be over at its start"
        )
    if theta_end <= 0:
        raise ModelError(
            "theta_end must be positive: at zero nutation the disc lies flat, psi and phi lose their meaning"
        )
    return y


class Assembly:
    """Records, addresses and compiled functions of one model; owns the memory at these addresses.

    Not thread-safe: `instant` is scratch space.
    """

    def __init__(self, model: Model, theta_end: float, scalar: type = float, values: Mapping[str, Any] = {}):
        """Values (by full name, complex if `scalar` is) take precedence over the model's."""
        constants = body_constants(model, theta_end, values)
        self.scalar = scalar
        self.body = np.array([tuple(constants[name] for name in BODY)], record_dtype(BODY, scalar))
        self.instant: Records = np.zeros(1, record_dtype(INSTANT, scalar))
        self._rates = compile_system(rates, scalar)
        self._laws, calls, in_air = [], [], []
        for effect in model.effects:
            if effect.law is None:
                continue
            own = effect_values(effect, values)
            law = compile_law(type(effect).law, tuple(own), HELPERS, scalar)
            parameters = np.array([tuple(own.values())], record_dtype(tuple(own), scalar))
            self._laws.append((law, parameters))
            calls += [law.address, parameters.ctypes.data]
            in_air += calls[-2:] if effect.airborne else []
        b, c = self.body.ctypes.data, self.instant.ctypes.data
        by_regime = (calls, calls, in_air)
        self._tables = [np.array([i, len(part) // 2, c, *part], np.int64) for i, part in enumerate(by_regime)]
        # rates and margins in each regime
        self.systems = [
            integrate.CompiledSystem(self._rates.address, table.ctypes.data, b, c, len(EVENTS))
            for table in self._tables
        ]

    def at(self, regime: int, t: ArrayLike, Y: Numbers) -> tuple[Numbers, Numbers, Records]:
        """Rates (N, n), margins (N, 4) and records.INSTANT (N,) at states Y (N, n), or at one (n,)."""
        t, Y = np.atleast_1d(t).astype(Y.dtype), np.ascontiguousarray(np.atleast_2d(Y))
        out: Numbers = np.zeros((len(Y), Y.shape[1] + len(EVENTS)), Y.dtype)
        found = np.empty(len(Y), self.instant.dtype)
        rows = found.view(Y.dtype).reshape(len(Y), -1)
        integrate.evaluate(self.systems[regime], t, Y, out, self.instant.view(Y.dtype), rows)
        return out[:, : Y.shape[1]], out[:, Y.shape[1] :], found

    def constant(self, name: str) -> Any:
        """One of records.BODY."""
        return self.body[name][0]


def follow(assembly: Assembly, y: Numbers, grid: Array, effort: Effort = FULL, scale: float = 0.0) -> Path:
    """Integrate through the regimes until the grid or the motion ends; complex if the assembly is.

    scale : as for `integrate.integrate`
    """
    y = np.array(y, assembly.scalar)
    t: complex = grid[0] * y.dtype.type(1.0)
    regime = (len(y) - 8) // 2
    segments, switches = list[tuple[Records, Array]](), list[Switch]()
    end: EndReason | None = None
    i, n_steps = 0, 0
    # whether the contact creeps so fast that its velocity is part of the state; Coulomb friction takes precedence
    on_a_film = assembly.constant("creep").real > FILM and assembly.constant("inverse_friction") == 0.0

    def add(times: Array, Y: Numbers) -> None:
        segments.append((assembly.at(regime, times, Y)[2], np.full(len(times), regime, np.uint8)))

    while end is None:
        if regime == ROLLING and on_a_film:
            regime, y = SLIPPING, np.concatenate([y, assembly.at(ROLLING, t, y)[0][0, :2]])
        event = _event_at_start(assembly, regime, t, y)
        if event < 0:
            system, atol = assembly.systems[regime], ATOL[: len(y)]
            left = effort.max_steps - n_steps
            Y, t, y, event, n = integrate.integrate(system, t, y, grid[i:], effort.rtol, atol, scale, left)
            n_steps += n
            if len(Y):  # empty if the steps are used up before the first instant
                add(grid[i : i + len(Y)], Y)
            i += len(Y)
            if event < 0:
                end = EndReason.TIME if i == len(grid) else EndReason.FAILED
            elif assembly.scalar is complex:
                t, y = _complex_instant(assembly, regime, event, t, y)
        if end is None:
            end, new, y = _switch(assembly, regime, event, t, y)
            if end is None:
                switches.append(Switch(float(np.real(t)), Regime(regime), Regime(new)))
                regime = new
                if len(switches) > effort.max_switches:
                    end = EndReason.CHATTER
    if not segments:  # the motion ends at its start
        add(grid[:1], y[None])
    parts, regimes = zip(*segments, strict=True)
    now = np.concatenate([part.view(y.dtype) for part in parts]).view(parts[0].dtype)  # records are copied slowly
    return Path(now, np.concatenate(regimes), switches, end, t, y, n_steps)


def _event_at_start(assembly: Assembly, regime: int, t: complex, y: Numbers) -> int:
    """Index of an event that has already occurred at the start of a regime, so that the regime is wrong; or -1."""
    margins = assembly.at(regime, t, y)[1][0].real
    if regime == SLIPPING and not margins[EVENTS.index("grip")] > 0:  # at zero slip the direction of friction and
        return EVENTS.index("grip")  # the load are undetermined
    margins[EVENTS.index("upright")] += -1e-12 * np.sign(y[5].real)  # at exactly 90 deg the nutation rate decides
    failed = np.flatnonzero(~(margins > 0))
    return int(failed[0]) if failed.size else -1


def _complex_instant(assembly: Assembly, regime: int, event: int, t: complex, y: Numbers) -> tuple[complex, Numbers]:
    """Complex instant and state of an event, at which the imaginary part of the margin vanishes too.

    The instant depends on the parameters. To first order, which is exact for imaginary parts of 1e-30, the state moves
    along its rates.
    """
    probe = 1e-20  # [s]; its square is far below rounding
    (rates,), (margins,), _ = assembly.at(regime, t, y)
    margin = margins[event].imag
    slope = (assembly.at(regime, t, y + 1j * probe * rates)[1][0, event].imag - margin) / probe
    shift = -margin / slope
    return t + 1j * shift, y + 1j * shift * rates


def _switch(
    assembly: Assembly, regime: int, event: int, t: complex, y: Numbers
) -> tuple[EndReason | None, int, Numbers]:
    """Consequence of an event: (reason to end or None, next regime, its state)."""
    name = EVENTS[event]
    if name == "theta_end":
        return EndReason.NUTATION, regime, y
    if name == "upright":
        return EndReason.UPRIGHT, regime, y
    if name == "load" and regime == FLYING:
        return EndReason.LANDED, regime, y
    if name == "load":
        (q,), (qdot,) = coordinates(assembly.at(regime, t, y)[2])
        return None, FLYING, np.concatenate([y[:8], qdot[:2], [q[2], qdot[2]]])
    _, (margins,), now = assembly.at(ROLLING, t, y[:8])
    if regime == SLIPPING and margins[event].real > 0:
        return None, ROLLING, y[:8]
    # slip begins opposite to the friction force that rolling would need
    F_n, F_m = now["F_n"][0], now["F_m"][0]
    cp, sp = np.cos(y[2]), np.sin(y[2])
    scale = -2 * STICK_SPEED / np.sqrt(F_n * F_n + F_m * F_m)
    v = coordinates(now)[1][0, :2] + scale * np.array([F_n * cp - F_m * sp, F_n * sp + F_m * cp])
    return None, SLIPPING, np.concatenate([y[:8], v])


@dataclass(frozen=True)
class Sensitivities:
    """Motion at n times and its derivatives with respect to k quantities; NaN after the end of the motion."""

    time: Array  # (n,)
    q: Array  # (n, 6)
    qdot: Array  # (n, 6)
    names: tuple[str, ...]  # (k,) components of the state, then "effect.parameter"
    dq: Array  # (n, 6, k) in the unit of q per unit of the quantity
    dqdot: Array  # (n, 6, k)
    dstate: Array  # (n, 8, k) of records.ROLLING_COMPONENTS
    n_steps: int = 0  # of the integrator, over all runs


def sensitivities(
    model: Model,
    state: State,
    times: ArrayLike,
    parameters: Sequence[str] = (),
    components: Sequence[str] | None = None,
    theta_end: float = DEFAULT_THETA_END,
    effort: Effort = FULL,
) -> Sensitivities:
    """Derivatives of q(t) and qdot(t) with respect to initial state and parameters.

    parameters : "effect.parameter" names; an effect that is not in the model has its null value.
    components : of records.STATE_COMPONENTS; by default all that the state has.
    """
    grid = _grid(None, 0.0, times)
    y0 = _start(state, theta_end)
    added = {effect.name: effect for effect, _ in map(model.split_name, parameters) if not model.effect(effect.name)}
    enlarged = model.with_effects(*(effect.absent() for effect in added.values()))
    components = tuple(STATE_COMPONENTS[: len(y0)] if components is None else components)
    names = (*components, *parameters)
    found = np.full((len(grid), 20, 1 + len(names)), np.nan)  # q, qdot and state: the motion, then its derivatives
    assembly = Assembly(enlarged, theta_end)
    path = follow(assembly, y0, grid, effort)
    n_steps = path.n_steps
    found[: len(path.now), :, 0] = _numbers(path)
    if path.end is not EndReason.CHATTER:
        still = Assembly(enlarged, theta_end, complex)
        same = symmetries(enlarged, assembly) - ({"psi"} if len(y0) > 8 else set())  # initial slip has a direction
        for column, name in enumerate(names, start=1):
            if name in same and column <= len(components):
                found[: len(path.now), :, column] = [float(name == n) for n in _NUMBERS]
                if name == "psi":
                    _rotate(found[..., column], found[..., 0])
                continue
            y, moved, scale = y0.astype(complex), still, 0.0
            if column <= len(components):
                y[STATE_COMPONENTS.index(name)] += 1j * _SEED
            else:
                moved = Assembly(enlarged, theta_end, complex, {name: enlarged.values[name] + 1j * _SEED})
                scale = _scale(moved, path, grid)
            left = Effort(effort.rtol_of_derivatives, effort.max_switches, effort.max_steps - n_steps)
            run = follow(moved, y, grid, left, scale)
            n_steps += run.n_steps
            found[: len(run.now), :, column] = _numbers(run).imag / _SEED
    q, qdot, _ = np.split(found[..., 0], [6, 12], axis=1)
    dq, dqdot, dstate = np.split(found[..., 1:], [6, 12], axis=1)
    return Sensitivities(grid, q, qdot, names, dq, dqdot, dstate, n_steps)


def _scale(moved: Assembly, path: Path, grid: Array) -> float:
    """Size that imaginary parts reach by a parameter, in units of ATOL, from their rates along the motion.

    Without it, the tail of a short force would be resolved relative to nothing, from 1e-300 of its height on.
    """
    few = slice(0, len(path.now), 4)  # a force is longer than a few frames, or its scale is smaller
    states = columns(path.now[few], *ROLLING_COMPONENTS).astype(complex)
    rates = np.nan_to_num(moved.at(ROLLING, grid[: len(path.now)][few], states)[0].imag)
    return float(np.max(np.abs(rates) / ATOL[: rates.shape[1]]) * (grid[-1] - grid[0]) / len(grid))


_NUMBERS = (*COORDINATES, *(f"{c}dot" for c in COORDINATES), *ROLLING_COMPONENTS)


def _numbers(path: Path) -> Numbers:
    """(n, 20) q, qdot and state of a path."""
    return np.concatenate([*path.as_seen, columns(path.now, *ROLLING_COMPONENTS)], axis=1)


def _rotate(column: Array, motion: Array) -> None:
    """Set the derivative K x v of a rotation of the motion about the vertical through its initial position."""
    moved = motion[:, :2] - motion[0, :2]
    for first, (x, y) in ((0, moved.T), (6, motion[:, 6:8].T), (12, moved.T)):  # x, y of q, qdot and the state
        column[:, first], column[:, first + 1] = -y, x


def symmetries(model: Model, assembly: Assembly) -> set[str]:
    """Those of the initial x, y, psi, phi that only displace or rotate the motion."""
    if any(assembly.constant(name) != 0.0 for name in ("uneven", "surface_vx", "surface_vy", "surface_turn")):
        return set()
    reads = {name for e in model.effects if e.law is not None for name in _names(type(e).law.__code__)}
    askew = any(assembly.constant(name) != 0.0 for name in _ASKEW)
    if askew or assembly.constant("J_11") != assembly.constant("J_22"):
        reads.add("phi")
    if _OF_DIRECTION & reads or assembly.constant("g_x") != 0.0 or assembly.constant("g_y") != 0.0:
        reads.add("psi")
    return {"x", "y", "psi", "phi"} - reads


def _names(code: CodeType) -> Iterator[str]:
    """All names of attributes and globals in a function, and in functions and comprehensions within it."""
    yield from code.co_names
    for inside in code.co_consts:
        if isinstance(inside, CodeType):
            yield from _names(inside)


def moved_start(time: Array, kernel: Array, wrenches: Array) -> Array:
    """(N, 8, p) displacement of the initial state that is equivalent to wrenches (N, 6, p) up to each instant.

    The state moves by Phi times this displacement, and every prediction by its derivative with respect to the initial
    state times it.   time, kernel : of `responses`
    """
    per_instant = kernel * np.gradient(time)[:, None, None]
    return np.asarray(cumulative_simpson(np.einsum("nkc,ncp->nkp", per_instant, wrenches), axis=0, initial=0.0))


def responses(
    model: Model, state: State, times: Array, theta_end: float = DEFAULT_THETA_END
) -> tuple[Motion, Array] | None:
    """Motion from `state` at times[0], at N (nearly) equally spaced times, and its response to moments and forces.

    The response is Phi^-1 B (N, 8, 6) by COMPONENTS, per N m and per N. None if the disc does not roll at all times.
    """
    motion = simulate(model, state, times=times, theta_end=theta_end)
    if len(motion) < len(times) or np.any(motion.regime != ROLLING):
        return None
    found = sensitivities(model, state, times, (), ROLLING_COMPONENTS, theta_end)
    if not np.isfinite(found.dq).all():
        return None
    return motion, np.asarray(np.linalg.solve(found.dstate, _per_wrench(model, motion.state, times)), float)


def _per_wrench(model: Model, states: Array, times: Array) -> Array:
    """(N, 8, 6) derivative of the state's rate with respect to moment and force, on which it depends linearly."""
    rates = []
    for row in np.vstack([np.zeros(len(COMPONENTS)), np.eye(len(COMPONENTS))]):
        probe = _PROBE(**{f"{c}_given": x for c, x in zip(COMPONENTS, row, strict=True)})
        rates.append(Assembly(model.with_effects(probe), DEFAULT_THETA_END).at(ROLLING, times, states)[0])
    return np.asarray(np.stack(rates[1:], axis=-1) - rates[0][..., None], float)


def prepare() -> None:
    """Compile or load integrator, equations of motion and laws of the catalogue, for real and complex states."""
    for kind in CATALOGUE.values():
        if kind.law is not None:
            for scalar in (float, complex):
                compile_law(kind.law, tuple(p.name for p in kind.parameters), HELPERS, scalar)
    sensitivities(Model(MA_2014), steady_precession(0.1, MA_2014), [0.0, 1e-3], components=["theta"])
