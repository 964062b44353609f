"""The rolling disc forwards: equations of motion, effects that are added to them, simulation, derivatives.

Public verbs in the order of use: `Model`, `State` (or `steady_precession`), `simulate`, `simulate_batch`,
`sensitivities`. Effects are in `effects.CATALOGUE`.
"""

from disctrack.rolling import effects
from disctrack.rolling.effects import CATALOGUE, Effect, ModelError, Parameter
from disctrack.rolling.model import DEFAULT_THETA_END, Model
from disctrack.rolling.motion import EndReason, Motion, Regime, Switch
from disctrack.rolling.sensitivities import Sensitivities, sensitivities
from disctrack.rolling.simulate import simulate, simulate_batch, time_grid
from disctrack.rolling.state import State
from disctrack.rolling.steady import nutation_frequency, precession_rate, steady_precession

__all__ = [
    "CATALOGUE",
    "DEFAULT_THETA_END",
    "Effect",
    "EndReason",
    "Model",
    "ModelError",
    "Motion",
    "Parameter",
    "Regime",
    "Sensitivities",
    "State",
    "Switch",
    "effects",
    "nutation_frequency",
    "precession_rate",
    "sensitivities",
    "simulate",
    "simulate_batch",
    "steady_precession",
    "time_grid",
]
