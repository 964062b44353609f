"""A model turned into what the compiled functions are called with."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibration.kit.arrays import Numbers
from disctrack.rolling import integrate
from disctrack.rolling._compiled import compile_law, compile_system
from disctrack.rolling.effects.base import HELPERS
from disctrack.rolling.equations import EVENTS, FILM, FLYING, rates
from disctrack.rolling.model import Model, body_constants, effect_values
from disctrack.rolling.records import BODY, INSTANT, Records, record_dtype


class Assembly:
    """Records, addresses and compiled functions of one model; owns the memory that the addresses point to.

    Not shared between threads: the instant is scratch space.
    """

    def __init__(self, model: Model, theta_end: float, scalar: type = float, values: Mapping[str, Any] | None = None):
        """Values (by full name, complex if `scalar` is) take precedence over the model's."""
        constants = body_constants(model, theta_end, values)
        self.scalar = scalar
        self.body = np.array([tuple(constants[name] for name in BODY)], record_dtype(BODY, scalar))
        self.instant = np.zeros(1, record_dtype(INSTANT, scalar))
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
        self._tables = [self._table(regime, in_air if regime == FLYING else calls) for regime in range(3)]

    def _table(self, regime: int, calls: list[int]) -> NDArray[np.int64]:
        return np.array([regime, len(calls) // 2, self.instant.ctypes.data, *calls], np.int64)

    def system(self, regime: int) -> integrate.CompiledSystem:
        """Rates and margins in this regime."""
        a, b, c = (array.ctypes.data for array in (self._tables[regime], self.body, self.instant))
        return integrate.CompiledSystem(self._rates.address, a, b, c, len(EVENTS))

    def at(self, regime: int, t: ArrayLike, Y: Numbers) -> tuple[Numbers, Numbers, Records]:
        """Rates (N, n), margins (N, 4) and all that is known (N,) at states Y (N, n), or at one (n,)."""
        return integrate.evaluate(self.system(regime), np.atleast_1d(t), np.atleast_2d(Y), self.instant)

    def constant(self, name: str) -> Any:
        """One of records.BODY."""
        return self.body[name][0]

    @property
    def on_a_film(self) -> bool:
        """Does the contact creep so fast that its velocity is a state of its own? Coulomb's friction goes first."""
        return bool(self.constant("creep").real > FILM and self.constant("inverse_friction") == 0.0)
