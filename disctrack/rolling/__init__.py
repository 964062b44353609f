"""The rolling disc forwards: equations of motion, effects that are added to them, simulation, derivatives.

Public verbs in the order of use: `Model`, `State` (or `steady_precession`, `struck_disc`), `simulate`,
`sensitivities`. Effects are in `CATALOGUE`.
"""

from disctrack.rolling.effects.base import CATALOGUE, Effect, EffectParameter
from disctrack.rolling.model import Model, effects_from_tables
from disctrack.rolling.motion import EndReason, Motion
from disctrack.rolling.records import Regime
from disctrack.rolling.sensitivities import prepare, sensitivities
from disctrack.rolling.simulate import simulate
from disctrack.rolling.state import State, steady_precession, struck_disc

__all__ = [
    "CATALOGUE",
    "Effect",
    "EffectParameter",
    "EndReason",
    "Model",
    "Motion",
    "Regime",
    "State",
    "effects_from_tables",
    "prepare",
    "sensitivities",
    "simulate",
    "steady_precession",
    "struck_disc",
]
