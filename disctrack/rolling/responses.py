"""First-order responses of a rolling motion to any moment and force, from eight runs and no more.

With the fundamental matrix Phi(t) = dy(t)/dy(0) of the state and B(t), what a unit of moment or force adds to its rate,
a small wrench f(t) moves the state by Phi(t) times the integral of Phi(s)^-1 B(s) f(s) ds (variation of constants). So
hundreds of laws can be asked for what each would do, for the price of some sums.
"""

from dataclasses import dataclass

import numpy as np
from scipy.integrate import cumulative_simpson

from calibration.kit.arrays import Array
from disctrack.rolling._assembly import Assembly
from disctrack.rolling.effects import effect_from_formulas
from disctrack.rolling.equations import ROLLING
from disctrack.rolling.model import DEFAULT_THETA_END, Model
from disctrack.rolling.records import ROLLING_COMPONENTS
from disctrack.rolling.sensitivities import sensitivities
from disctrack.rolling.simulate import RTOL, simulate
from disctrack.rolling.state import State

COMPONENTS = ("M_n", "M_m", "M_z", "X_n", "X_m", "X_z")
_PROBE = effect_from_formulas("probe", {c: f"{c}_given" for c in COMPONENTS})


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
