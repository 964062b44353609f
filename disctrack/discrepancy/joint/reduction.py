"""One recording of several: its own quantities take their best values, and what is left speaks of the shared ones.

An initial state matters to nobody else. Of a linearisation, [own | shared | residual] = Q R, the lower right block of R
is the least-squares problem in the shared quantities alone, at the best own values (Schur's complement of the normal
equations, without squaring the condition): a few dozen rows, however long the recording. Its minimum is followed as
the shared quantities move.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from calibration.kit.arrays import Array
from disctrack.discrepancy.fit import prior_rows, triangle
from disctrack.discrepancy.nuisances import Projection, is_linear, projection
from disctrack.discrepancy.system import Quantity, System, Values

NEAR = 0.3  # of chi-square, that a further step of the own quantities may promise: what it changes is then a thousandth
STEPS = 12
HALVINGS = 6
ANCHORS = 30  # points that are remembered, to start from the nearest


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
        R = self._triangle(shared, own, names, common)
        for _ in range(STEPS):
            if R is None:
                break
            k = len(own)
            head, gain = R[:k, :k], float(R[:k, -1] @ R[:k, -1])
            if gain < NEAR:
                return self._remembered(shared, own, names, R)
            step = _solved(head, R[:k, -1])
            R, own, moved = self._stepped(shared, own, step, names, common, float(R[:, -1] @ R[:, -1]))
            if not moved:  # rounding, or a kink: this is as far as it goes
                return self._remembered(shared, own, names, R) if R is not None and gain < 100 * NEAR else None
        if R is not None or len(self._anchors) == 1:
            return None
        self._anchors = self._anchors[:1]  # the point that was followed led nowhere: from the beginning, once
        return self.reduce(shared, names)

    def _stepped(
        self, shared: Values, own: Array, step: Array, names: Sequence[str], common: Projection, cost: float
    ) -> tuple[Array | None, Array, bool]:
        before = None
        for halving in range(HALVINGS):
            trial = own + 0.5**halving * step
            R = self._triangle(shared, trial, names, common)
            if R is not None and float(R[:, -1] @ R[:, -1]) < cost:
                return R, trial, True
            before = before if R is None else R
        return self._triangle(shared, own, names, common), own, False

    def _triangle(self, shared: Values, own: Array, names: Sequence[str], common: Projection) -> Array | None:
        """R of [own | names | residual], with rows of priors; its last column is as long as chi-square is large."""
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
        whole = np.concatenate([common.cleared(stacked), rows])
        width = whole.shape[1]
        if len(whole) < width:
            whole = np.concatenate([whole, np.zeros((width - len(whole), width))])
        return triangle(whole)

    def _named(self, own: Array) -> dict[str, float]:
        return dict(zip((q.name for q in self.own), own.tolist(), strict=True))

    def _guess(self, shared: Values) -> Array:
        anchor = min(self._anchors, key=lambda a: self._distance(a.shared, shared))
        delta = [shared.get(n, 0.0) - anchor.shared.get(n, 0.0) for n in anchor.names]
        return anchor.own + anchor.by_shared @ np.array(delta) if delta else anchor.own

    def _distance(self, a: Values, b: Values) -> float:
        names = {*a, *b} & self._scales.keys()
        return float(sum(((a.get(n, 0.0) - b.get(n, 0.0)) / self._scales[n]) ** 2 for n in sorted(names)))

    def _remembered(self, shared: Values, own: Array, names: Sequence[str], R: Array) -> Reduced:
        k = len(own)
        best = own + _solved(R[:k, :k], R[:k, -1])
        by_shared = -_solved(R[:k, :k], R[:k, k:-1])
        if not any(self._distance(a.shared, shared) == 0.0 and set(names) <= set(a.names) for a in self._anchors):
            self._anchors = [*self._anchors[:1], *self._anchors[1:][-ANCHORS:]]
            self._anchors.append(_Anchor(dict(shared), best, tuple(names), by_shared))
        return Reduced(R[k:, -1], R[k:, k:-1])


def _solved(head: Array, right: Array) -> Array:
    """Solution of the triangular system, zero in directions that the data do not determine."""
    size = np.abs(np.diag(head))
    if size.size and size.min() > 1e-13 * size.max():
        return np.asarray(solve_triangular(head, right), float)
    return np.asarray(np.linalg.lstsq(head, right, rcond=1e-13)[0], float)
