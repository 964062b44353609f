"""A model turned into what the compiled functions are called with."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from disctrack.rolling import equations, integrate
from disctrack.rolling._compiled import compile_law, compile_system
from disctrack.rolling.effects.base import HELPERS, catalogue
from disctrack.rolling.model import Model, body_constants, effect_values
from disctrack.rolling.records import BODY, KINEMATICS, WRENCH, record_dtype


def prepare() -> None:
    """Compile integrator, equations of motion and the catalogue's laws for real and complex states, or load them."""
    for scalar in (float, complex):
        integrate.prepare(scalar)
        for function in (equations.rates, equations.event_margins):
            compile_system(function, scalar)
        for kind in catalogue():
            if kind.law is not None:
                compile_law(kind.law, tuple(p.name for p in kind.parameters), HELPERS, scalar)


class Assembly:
    """Records, addresses and compiled functions of one model; owns the memory that the addresses point to.

    Not shared between threads: the kinematics and the wrench are scratch space.
    """

    def __init__(self, model: Model, theta_end: float, scalar: type = float, values: Mapping[str, Any] | None = None):
        """Values (by full name, complex if `scalar` is) take precedence over the model's."""
        constants = body_constants(model, theta_end, values)
        self.scalar = scalar
        self.body = np.array([tuple(constants[name] for name in BODY)], record_dtype(BODY, scalar))
        self.kinematics = np.zeros(1, record_dtype(KINEMATICS, scalar))
        self.wrench = np.zeros(1, record_dtype(WRENCH, scalar))
        self._rates = compile_system(equations.rates, scalar)
        self._margins = compile_system(equations.event_margins, scalar)
        self._laws, self._parameters = [], []
        airborne = []
        for effect in model.effects:
            if effect.law is None:
                continue
            own = effect_values(effect, values)
            names = tuple(own)
            self._laws.append(compile_law(type(effect).law, names, HELPERS, scalar))
            self._parameters.append(np.array([tuple(own.values())], record_dtype(names, scalar)))
            airborne.append(effect.airborne)
        calls = [(law.address, p.ctypes.data) for law, p in zip(self._laws, self._parameters, strict=True)]
        in_air = [call for call, flies in zip(calls, airborne, strict=True) if flies]
        self._tables = [self._table(regime, in_air if regime == equations.FLYING else calls) for regime in range(3)]

    def _table(self, regime: int, calls: list[tuple[int, int]]) -> NDArray[np.int64]:
        header = [regime, len(calls), self.kinematics.ctypes.data, self.wrench.ctypes.data]
        return np.array(header + [address for call in calls for address in call], np.int64)

    def system(self, regime: int) -> integrate.CompiledSystem:
        """Rates and margins in this regime."""
        pointers = [a.ctypes.data for a in (self._tables[regime], self.body, self.kinematics, self.wrench)]
        return integrate.CompiledSystem(
            self._rates.address, self._margins.address, equations.N_EVENTS, np.array(pointers, np.int64)
        )

    def constant(self, name: str) -> Any:
        """One of records.BODY."""
        return self.body[name][0]

    @property
    def on_a_film(self) -> bool:
        """Does the contact creep so fast that its velocity is a state of its own? Coulomb's friction goes first."""
        return bool(self.constant("creep").real > equations.FILM and self.constant("inverse_friction") == 0.0)
