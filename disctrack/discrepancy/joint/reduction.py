"""One recording of several: its own quantities take their best values, and what is left speaks of the shared ones.

An initial state matters to nobody else. What is left once it is eliminated is the least-squares problem in the shared
quantities alone: a few dozen rows, however long the recording. Its minimum is followed as the shared quantities move.
"""

from collections.abc import Sequence

import numpy as np

from calibration.kit.arrays import Array
from calibration.kit.least_squares import eliminate
from disctrack.discrepancy.elimination import is_linear, prior_rows, projection
from disctrack.discrepancy.fit import fit
from disctrack.discrepancy.system import Quantity, System, Values

Reduced = tuple[Array, Array]  # right side (m,) and matrix (m, s) of the problem in the shared quantities


class Reduction:
    """A system in which some quantities of the base always take their best values."""

    def __init__(self, system: System, own: Sequence[Quantity], start: Values) -> None:
        """Own : quantities that have no bounds.   start : their values, from which their first fit begins."""
        self.system, self.own = system, tuple(own)
        self.moved = [q for q in own if not is_linear(q)]
        self._first = self.own_values = {q.name: start.get(q.name, q.null) for q in self.moved}

    def reduce(self, shared: Values, names: Sequence[str]) -> Reduced | None:
        """The problem in the shared quantities `names`, at the values `shared`; None where there is no prediction."""
        for start in (self.own_values, self._first):  # where the point that was followed leads nowhere, from the first
            found = fit(self.system, self.own, {**shared, **start})
            if found.converged:
                self.own_values = {name: found.values[name] for name in start}
                return self._eliminated(shared, names)
        return None

    def _eliminated(self, shared: Values, names: Sequence[str]) -> Reduced | None:
        values = {**shared, **self.own_values}
        common = projection(self.system, self.own, values)
        values |= dict(zip(common.names, common.null.tolist(), strict=True))
        residual, derivative = self.system.linearise(values, [*self.own_values, *names])
        stacked = np.column_stack([derivative.reshape(residual.size, -1), residual.reshape(-1)])
        if not np.isfinite(stacked).all():
            return None
        prior, matrix = prior_rows(self.moved, values)
        known = np.column_stack([matrix, np.zeros((len(prior), len(names))), prior])
        _, left = eliminate(np.concatenate([common.cleared(stacked), known]), len(self.moved))
        return left[:, -1], left[:, :-1]
