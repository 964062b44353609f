"""First-order responses of a rolling motion to any moment and force, from eight runs and no more.

With the fundamental matrix Phi(t) = dy(t)/dy(0) of the state and B(t), what a unit of moment or force adds to its rate,
a small wrench f(t) moves the state by Phi(t) times the integral of Phi(s)^-1 B(s) f(s) ds (variation of constants). So
hundreds of laws can be asked for what each would do, for the price of some sums.
"""

from dataclasses import dataclass

import numpy as np

from calibration.kit.arrays import Array
from disctrack.rolling import integrate
from disctrack.rolling._assembly import Assembly
from disctrack.rolling.effects import effect_class
from disctrack.rolling.equations import ROLLING
from disctrack.rolling.model import DEFAULT_THETA_END, Model
from disctrack.rolling.records import ROLLING_COMPONENTS
from disctrack.rolling.sensitivities import sensitivities
from disctrack.rolling.simulate import RTOL, simulate
from disctrack.rolling.state import State

COMPONENTS = ("M_n", "M_m", "M_z", "X_n", "X_m", "X_z")
_SEED = 1e-30
_FOREVER = 1e9  # [s] width of a probe that is a constant


@dataclass(frozen=True)
class Responses:
    """Of a motion that rolls all the time; N instants."""

    time: Array  # (N,) [s]
    q: Array  # (N, 6)
    qdot: Array  # (N, 6)
    kernel: Array  # (N, 8, 6) Phi^-1 B by COMPONENTS, per N m and per N

    def of(self, courses: Array) -> Array:
        """(N, 8, p) displacement of the initial state that stands for what wrenches (N, 6, p) have done up to then.

        The state itself has moved by Phi times this; so has every prediction by its derivative by the initial state.
        """
        integrand = np.einsum("nkc,ncp->nkp", self.kernel, courses)
        return _integral(integrand, self.time)


def responses(model: Model, state: State, times: Array, theta_end: float = DEFAULT_THETA_END) -> Responses | None:
    """Responses along the motion from `state` at times[0]; None where it does not roll over all of the times."""
    motion = simulate(model, state, times=times, theta_end=theta_end, rtol=RTOL)
    if len(motion) < len(times) or np.any(motion.regime != ROLLING):
        return None
    found = sensitivities(model, state, times, (), ROLLING_COMPONENTS, theta_end)
    if not np.isfinite(found.dq).all():
        return None
    s, c = np.sin(found.q[:, 3 + 1]), np.cos(found.q[:, 3 + 1])
    psidot = found.qdot[:, 3]
    d_theta, d_psidot = found.dq[:, 4], found.dqdot[:, 3]
    by_start = np.concatenate(
        [
            found.dq[:, [0, 1, 3, 4, 5]],
            found.dqdot[:, 4:5],
            (d_psidot * s[:, None] + (psidot * c)[:, None] * d_theta)[:, None],
            (d_psidot * c[:, None] - (psidot * s)[:, None] * d_theta + found.dqdot[:, 5])[:, None],
        ],
        axis=1,
    )
    return Responses(times, found.q, found.qdot, np.linalg.solve(by_start, _per_wrench(model, motion.state, times)))


def _per_wrench(model: Model, states: Array, times: Array) -> Array:
    """(N, 8, 6) derivative of the state's rate by moment and force."""
    probe = effect_class("wrench_probe")
    probed = model.with_effects(probe(**{c: 0.0 for c in COMPONENTS}, t_0=0.0, width=_FOREVER))
    found = np.empty((len(times), len(ROLLING_COMPONENTS), len(COMPONENTS)))
    for i, name in enumerate(COMPONENTS):
        assembly = Assembly(probed, DEFAULT_THETA_END, complex, {f"wrench_probe.{name}": 1j * _SEED})
        system = assembly.system(ROLLING)
        scratch = (assembly.kinematics, assembly.wrench)
        rates, _, _ = integrate.evaluate(
            system.rates, system.arguments, times, states.astype(complex), len(ROLLING_COMPONENTS), scratch
        )
        found[:, :, i] = rates.imag / _SEED
    return found


def _integral(f: Array, time: Array) -> Array:
    """Integral of f (N, ...) from time[0] on, N > 3 instants (nearly) equally far apart: cubics, of order 4."""
    first, last = 3 * (f[:1] - f[1:2]) + f[2:3], 3 * (f[-1:] - f[-2:-1]) + f[-3:-2]
    longer = np.concatenate([first, f, last])
    pieces = 13.0 * (f[:-1] + f[1:])
    pieces -= longer[:-3]
    pieces -= longer[3:]
    pieces *= (np.diff(time) / 24.0).reshape(-1, *[1] * (f.ndim - 1))
    found = np.zeros_like(f)
    np.cumsum(pieces, axis=0, out=found[1:])
    return found
