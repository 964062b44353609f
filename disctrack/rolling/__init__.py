"""The rolling disc forwards: equations of motion, effects that are added to them, simulation, derivatives.

Public verbs in the order of use: `Model`, `State` (or `steady_precession`, `struck_disc`), `simulate`,
`sensitivities`. Effects are in `CATALOGUE`.
"""

from disctrack.rolling.effects.base import CATALOGUE as CATALOGUE
from disctrack.rolling.effects.base import Effect as Effect
from disctrack.rolling.effects.base import EffectParameter as EffectParameter
from disctrack.rolling.model import Model as Model
from disctrack.rolling.model import effects_from_tables as effects_from_tables
from disctrack.rolling.motion import EndReason as EndReason
from disctrack.rolling.motion import Motion as Motion
from disctrack.rolling.records import Regime as Regime
from disctrack.rolling.simulate import Effort as Effort
from disctrack.rolling.simulate import prepare as prepare
from disctrack.rolling.simulate import sensitivities as sensitivities
from disctrack.rolling.simulate import simulate as simulate
from disctrack.rolling.state import State as State
from disctrack.rolling.state import steady_precession as steady_precession
from disctrack.rolling.state import struck_disc as struck_disc
