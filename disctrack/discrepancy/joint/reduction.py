"""One recording of several: its own quantities take their best values, and what is left speaks of the shared ones.

An initial state matters to nobody else. What is left once it is eliminated is the least-squares problem in the shared
quantities alone: a few dozen rows, however long the recording. Its minimum is followed as the shared quantities move.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calibration.kit.arrays import Array
from calibration.kit.least_squares import OwnNumbers, eliminate
from disctrack.discrepancy.fit import prior_rows
from disctrack.discrepancy.nuisances import Projection, is_linear, projection
from disctrack.discrepancy.system import Quantity, System, Values

NEAR = 0.3  # of chi-square, that a further step of the own quantities may promise: what it changes is then a thousandth
STEPS = 12
HALVINGS = 6
ANCHORS = 30  # points that are remembered, to start from the nearest
Eliminated = tuple[OwnNumbers, Array]  # and the rows [shared | residual] that are left


@dataclass(frozen=True)
class _Anchor:
    """Best own values at some values of the shared quantities, and how they move with these."""

    shared: dict[str, float]
    own: Array  # (k,)
    names: tuple[str, ...]  # (s,)
    by_shared: Array  # (k, s)


@dataclass(frozen=True)
class Reduced:
    """Least-squares problem in the shared quantities: residual right - matrix @ step, own values at their best."""

    right: Array  # (m,)
    matrix: Array  # (m, s)


class Reduction:
    """A system in which some quantities of the base always take their best values."""

    def __init__(self, system: System, own: Sequence[Quantity], start: Values, scales: Mapping[str, float]) -> None:
        """Own : they have no bounds.   start : their values at the shared ones that it holds too.

        scales : steps of the shared quantities, by which the nearest known point is chosen
        """
        self.system = system
        self.own = [q for q in own if not is_linear(q)]
        self.linear = [q for q in own if is_linear(q)]
        self._scales = dict(scales)
        names = [q.name for q in self.own]
        shared = {n: v for n, v in start.items() if n in scales}
        first = np.array([start[n] for n in names])
        self._anchors = [_Anchor(shared, first, (), np.zeros((len(names), 0)))]

    @property
    def n_data(self) -> int:
        """Numbers that are left to the shared quantities: the data less what the own ones take."""
        free = sum(not np.isfinite(q.prior_sigma) for q in self.own)
        return int(np.sum(self.system.weights)) - free

    def own_values(self, shared: Values) -> dict[str, float]:
        """Best own values that are known near these shared ones; linear ones are not among them."""
        return dict(zip((q.name for q in self.own), self._guess(shared).tolist(), strict=True))

    def reduce(self, shared: Values, names: Sequence[str]) -> Reduced | None:
        """The problem in the shared quantities `names`, at the values `shared`; None where there is no prediction."""
        own = self._guess(shared)
        common = projection(self.system, self.linear, {**shared, **self._named(own)})
        found = self._eliminated(shared, own, names, common)
        for _ in range(STEPS):
            if found is None:
                break
            numbers = found[0]
            if numbers.gain < NEAR:
                return self._remembered(shared, own, names, found)
            further = self._stepped(shared, own, names, common, found)
            if further is None:  # rounding, or a kink: this is as far as it goes
                return self._remembered(shared, own, names, found) if numbers.gain < 100 * NEAR else None
            found, own = further
        if found is not None or len(self._anchors) == 1:
            return None
        self._anchors = self._anchors[:1]  # the point that was followed led nowhere: from the beginning, once
        return self.reduce(shared, names)

    def _stepped(
        self, shared: Values, own: Array, names: Sequence[str], common: Projection, found: Eliminated
    ) -> tuple[Eliminated, Array] | None:
        """The same further down, and where; None where no step leads down."""
        for halving in range(HALVINGS):
            trial = own + 0.5**halving * found[0].step
            there = self._eliminated(shared, trial, names, common)
            if there is not None and _cost(there) < _cost(found):
                return there, trial
        return None

    def _eliminated(self, shared: Values, own: Array, names: Sequence[str], common: Projection) -> Eliminated | None:
        """Own quantities and the rows [names | residual] that they leave; None where there is no prediction."""
        values = {**shared, **self._named(own)}
        values |= dict(zip(common.names, common.null.tolist(), strict=True))
        all_names = [*(q.name for q in self.own), *names]
        residual, derivative = self.system.linearise(values, all_names)
        stacked = np.column_stack([derivative.reshape(residual.size, -1), residual.reshape(-1)])
        if not np.isfinite(stacked).all():
            return None
        prior, prior_matrix = prior_rows(self.own, values)
        rows = np.zeros((len(prior), stacked.shape[1]))
        rows[:, : len(own)], rows[:, -1] = prior_matrix, prior
        return eliminate(np.concatenate([common.cleared(stacked), rows]), len(own))

    def _named(self, own: Array) -> dict[str, float]:
        return dict(zip((q.name for q in self.own), own.tolist(), strict=True))

    def _guess(self, shared: Values) -> Array:
        anchor = min(self._anchors, key=lambda a: self._distance(a.shared, shared))
        delta = [shared.get(n, 0.0) - anchor.shared.get(n, 0.0) for n in anchor.names]
        return anchor.own + anchor.by_shared @ np.array(delta) if delta else anchor.own

    def _distance(self, a: Values, b: Values) -> float:
        names = {*a, *b} & self._scales.keys()
        return float(sum(((a.get(n, 0.0) - b.get(n, 0.0)) / self._scales[n]) ** 2 for n in sorted(names)))

    def _remembered(self, shared: Values, own: Array, names: Sequence[str], found: Eliminated) -> Reduced:
        numbers, left = found
        if not any(self._distance(a.shared, shared) == 0.0 and set(names) <= set(a.names) for a in self._anchors):
            self._anchors = [*self._anchors[:1], *self._anchors[1:][-ANCHORS:]]
            self._anchors.append(_Anchor(dict(shared), own + numbers.step, tuple(names), numbers.by_shared))
        return Reduced(left[:, -1], left[:, :-1])


def _cost(found: Eliminated) -> float:
    """Chi-square with priors, before the step of the own quantities."""
    return found[0].gain + float(found[1][:, -1] @ found[1][:, -1])
