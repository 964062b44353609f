"""From a model and a state to the motion: pure rolling, slip and flight, with the switches between them found."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from calibration.kit.arguments import FrameRate, Seconds, Times, checked
from calibration.kit.arrays import Array
from disctrack.rolling import integrate
from disctrack.rolling._assembly import Assembly
from disctrack.rolling.effects import ModelError
from disctrack.rolling.equations import EVENTS, FLYING, ROLLING, SLIPPING, STICK_SPEED
from disctrack.rolling.model import DEFAULT_THETA_END, Model
from disctrack.rolling.motion import EndReason, Motion, MotionSamples, Regime, Switch, coordinates, motion_from_samples
from disctrack.rolling.records import Numbers, Records
from disctrack.rolling.state import State

RTOL = 1e-11  # of the integrator; keeps the energy without losses to 1e-11 over 1.5 s
# m, m, rad, rad, rad, rad/s x 3, m/s x 2, m, m/s: about 1e-12 of what moves
ATOL = np.array([1e-13, 1e-13, 1e-12, 1e-13, 1e-12, 1e-11, 1e-11, 1e-11, 1e-13, 1e-13, 1e-13, 1e-13])
_N_STATE = {ROLLING: 8, SLIPPING: 10, FLYING: 12}
MAX_SWITCHES = 2000  # of slip and rolling: more is chatter
MAX_SLIP_STEPS = 10**9  # of the integrator in slip, over all stretches, and ...
MAX_STEPS = 200_000  # ... in each
MOST_INSTANTS = 1e8  # of a motion in memory


def time_grid(duration: float, rate: float = 1000.0) -> Array:
    """Instants i / rate up to the duration, both ends included [s]."""
    if not (duration > 0 and rate > 0 and duration * rate < MOST_INSTANTS):
        raise ModelError(
            f"duration {duration:g} s and rate {rate:g} Hz; expected positive numbers, and at most {MOST_INSTANTS:g} "
            "instants"
        )
    return np.arange(int(np.floor(duration * rate * (1 + 1e-12))) + 1) / rate


@checked
def simulate(
    model: Model,
    state: State,
    duration: Seconds | None = None,
    *,
    rate: FrameRate = 1000.0,
    times: Times | None = None,
    theta_end: float = DEFAULT_THETA_END,
    rtol: float = RTOL,
) -> Motion:
    """Motion from `state` over `duration` [s] at `rate` [Hz], or at the given `times`.

    The state holds at the first of the times (0 with `duration`). The motion ends early, with the reason in `end`,
    where the nutation falls to `theta_end` [rad], the disc stands up, or it lands after a loss of contact; then only
    the times before are there. Raises ModelError for a state or times that make no sense.

        >>> disc = read_recording("clip").disc
        >>> simulate(Model(disc), steady_precession(0.1, disc), duration=0.1).q.shape
        (101, 6)
    """
    grid = _grid(duration, rate, times)
    assembly = Assembly(model, theta_end)
    path = follow(assembly, _start(state, theta_end), grid, rtol)
    return motion_from_samples(
        model, assembly.body, path.samples, path.switches, path.end, path.end_time.real, path.end_state.real
    )


def _grid(duration: float | None, rate: float, times: ArrayLike | None) -> Array:
    if times is None:
        if duration is None:
            raise ModelError("neither a duration nor times are given")
        return time_grid(duration, rate)
    grid = np.ascontiguousarray(times, float)
    if grid.ndim != 1 or len(grid) == 0 or not np.isfinite(grid).all() or (np.diff(grid) <= 0).any():
        raise ModelError("the times must be a list of finite, increasing numbers")
    return grid


def _start(state: State, theta_end: float) -> Array:
    y = state.array
    if not np.isfinite(y).all():
        raise ModelError(f"the state has numbers that are not finite: {state}")
    given = [name for name in ("v_x", "v_y", "z", "v_z") if getattr(state, name) is not None]
    if len(given) != len(y) - 8:
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


@dataclass(frozen=True)
class Path:
    """Solution over all regimes."""

    samples: MotionSamples
    switches: list[Switch]
    end: EndReason
    end_time: complex
    end_state: Numbers
    slip_steps: int = 0  # of the integrator in slip, which is stiff where it creeps


def follow(
    assembly: Assembly,
    y: Numbers,
    grid: Array,
    rtol: float,
    max_switches: int = MAX_SWITCHES,
    max_slip_steps: int = MAX_SLIP_STEPS,
) -> Path:
    """Integrate through the regimes until the grid or the motion ends; complex if the assembly is."""
    y = np.array(y, assembly.scalar)
    t: complex = grid[0] * y.dtype.type(1.0)
    regime = {n: r for r, n in _N_STATE.items()}[len(y)]
    pieces: list[MotionSamples] = []
    switches: list[Switch] = []
    end: EndReason | None = None
    i, slip_steps = 0, 0
    while end is None:
        if regime == ROLLING and assembly.on_a_film:
            regime, y = SLIPPING, np.concatenate([y, _rates(assembly, ROLLING, t, y)[0][:2]])
        event = _event_at_start(assembly, regime, t, y)
        if event is None:
            system, atol = assembly.system(regime), ATOL[: len(y)]
            if regime == SLIPPING:
                left = min(max(max_slip_steps - slip_steps, 0), MAX_STEPS)
                stretch = integrate.integrate(system, t, y, grid[i:], rtol, atol, left)
                slip_steps += stretch.n_steps
            else:
                stretch = integrate.integrate(system, t, y, grid[i:], rtol, atol)
            if stretch.n_filled:  # none where the steps are used up before the first instant
                pieces.append(_sample(assembly, regime, grid[i : i + stretch.n_filled], stretch.y[: stretch.n_filled]))
            i += stretch.n_filled
            t, y = stretch.t_last, stretch.y_last
            if stretch.status == integrate.REACHED_END:
                end = EndReason.TIME
            elif stretch.status != integrate.EVENT:
                end = EndReason.FAILED
            else:
                event = stretch.event
                if assembly.scalar is complex:
                    t, y = _complex_instant(assembly, regime, event, t, y)
        if event is not None:
            end, new, y = _switch(assembly, regime, event, t, y)
            if end is None:
                switches.append(Switch(float(np.real(t)), Regime(regime), Regime(new)))
                regime = new
                if len(switches) > max_switches:
                    end = EndReason.CHATTER
    if not pieces:  # over at its start
        pieces.append(_sample(assembly, regime, grid[:1], y[None]))
    return Path(_join(pieces), switches, end, t, y, slip_steps)


def _join(pieces: list[MotionSamples]) -> MotionSamples:
    return MotionSamples(
        *(np.concatenate([getattr(p, name) for p in pieces]) for name in MotionSamples.__dataclass_fields__)
    )


def _sample(assembly: Assembly, regime: int, time: Array, Y: Numbers) -> MotionSamples:
    system = assembly.system(regime)
    n = Y.shape[1]
    rates, kinematics, wrench = integrate.evaluate(
        system.rates, system.arguments, time, Y, n, (assembly.kinematics, assembly.wrench)
    )
    return MotionSamples(time, kinematics, wrench, rates[:, :8], np.full(len(time), regime, np.uint8))


def _rates(assembly: Assembly, regime: int, t: complex, y: Numbers) -> tuple[Numbers, Records, Records]:
    """Rates (n,), kinematics (1,) and wrench (1,) at one state."""
    system = assembly.system(regime)
    scratch = (assembly.kinematics, assembly.wrench)
    rates, k, w = integrate.evaluate(system.rates, system.arguments, np.array([t]), y[None], len(y), scratch)
    return rates[0], k, w


def _margins(assembly: Assembly, regime: int, t: complex, y: Numbers) -> Numbers:
    system = assembly.system(regime)
    scratch = (assembly.kinematics, assembly.wrench)
    return integrate.evaluate(system.margins, system.arguments, np.array([t]), y[None], system.n_margins, scratch)[0][0]


def _event_at_start(assembly: Assembly, regime: int, t: complex, y: Numbers) -> int | None:
    """An event that holds already where a stretch starts: the regime asked for is not the one that physics allows."""
    margins = _margins(assembly, regime, t, y).real
    if regime == SLIPPING and not margins[EVENTS.index("grip")] > 0:  # without slip the direction of friction is open,
        return EVENTS.index("grip")  # and the load with it
    margins[EVENTS.index("upright")] += -1e-12 * np.sign(y[5].real)  # at exactly 90 deg the direction decides
    failed = np.flatnonzero(~(margins > 0))
    return int(failed[0]) if failed.size else None


def _complex_instant(assembly: Assembly, regime: int, event: int, t: complex, y: Numbers) -> tuple[complex, Numbers]:
    """Event moved in imaginary time to where the margin's imaginary part vanishes too.

    The instant depends on the parameters; to first order, which is all that imaginary parts of 1e-30 know, the state
    moves along its rates.
    """
    probe = 1e-20  # [s]; its square is far below rounding
    rates = _rates(assembly, regime, t, y)[0]
    margin = _margins(assembly, regime, t, y)[event].imag
    slope = (_margins(assembly, regime, t, y + 1j * probe * rates)[event].imag - margin) / probe
    shift = -margin / slope
    return t + 1j * shift, y + 1j * shift * rates


def _switch(
    assembly: Assembly, regime: int, event: int, t: complex, y: Numbers
) -> tuple[EndReason | None, int, Numbers]:
    """What follows an event: (reason to end or None, next regime, its state)."""
    name = EVENTS[event]
    if name == "theta_end":
        return EndReason.NUTATION, regime, y
    if name == "upright":
        return EndReason.UPRIGHT, regime, y
    if name == "load" and regime == FLYING:
        return EndReason.LANDED, regime, y
    if name == "load":
        return None, FLYING, _full_state(assembly, regime, t, y)
    _, _, wrench = _rates(assembly, ROLLING, t, y[:8])
    F_n, F_m = (wrench[f"F_{axis}"][0] for axis in "nm")
    holds = (wrench["N"][0] - assembly.constant("inverse_friction") * wrench["F_t"][0]).real > 0
    if regime == SLIPPING and holds:
        return None, ROLLING, y[:8]
    return None, SLIPPING, _slipping_state(assembly, t, y[:8], F_n, F_m)


def _full_state(assembly: Assembly, regime: int, t: complex, y: Numbers) -> Numbers:
    """All twelve components of a state in contact."""
    _, k, _ = _rates(assembly, regime, t, y)
    q, qdot = coordinates(k)
    return np.concatenate([y[:8], qdot[0, :2], [q[0, 2], qdot[0, 2]]])


def _slipping_state(assembly: Assembly, t: complex, y: Numbers, F_n: complex, F_m: complex) -> Numbers:
    """Rolling state that has just begun to slip, against the friction force that rolling would have needed."""
    _, k, _ = _rates(assembly, ROLLING, t, y)
    v = coordinates(k)[1][0, :2]
    scale = -2 * STICK_SPEED / np.sqrt(F_n * F_n + F_m * F_m)
    cp, sp = np.cos(y[2]), np.sin(y[2])
    return np.concatenate([y, v + scale * np.array([F_n * cp - F_m * sp, F_n * sp + F_m * cp])])
