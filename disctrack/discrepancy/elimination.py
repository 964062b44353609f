"""Elimination of nuisance parameters from a least-squares problem, so that a fit steps the others alone.

Linear parameters with priors (errors of lenses, dots and calibration) have derivatives that do not change in a fit.
There may be hundreds of them; they are projected out once (variable projection). Parameters of a single block of rows
(a run's initial state) are eliminated block by block, so that the cost grows linearly with the number of blocks.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
from scipy.linalg import solve_triangular

from calibration.kit.least_squares import OwnNumbers, eliminate, triangle
from calibration.kit.types import Array, Indices
from disctrack.discrepancy.system import Quantity, System, Values

_KNOWN: "WeakKeyDictionary[System, dict[tuple[object, ...], Projection]]" = WeakKeyDictionary()


def prior_rows(quantities: Sequence[Quantity], values: Values) -> tuple[Array, Array]:
    """Rows that priors add to a least-squares problem: (right side (p,), matrix (p, k))."""
    known = [i for i, q in enumerate(quantities) if np.isfinite(q.prior_sigma)]
    sigma = np.array([quantities[i].prior_sigma for i in known])
    away = np.array([quantities[i].null - values[quantities[i].name] for i in known])
    matrix = np.zeros((len(known), len(quantities)))
    matrix[np.arange(len(known)), known] = 1.0 / sigma
    return away / sigma, matrix


@dataclass(frozen=True)
class Projection:
    """Projection of m whitened numbers onto what a set of linear quantities (k) with priors can absorb."""

    names: tuple[str, ...]
    null: Array  # (k,)
    scale: Array  # (k,) prior standard deviations
    root: Array  # (k, k) L of L L^T = N^T N + 1, N: columns times prior standard deviations
    rows: Array  # (m, k) orthonormal together with `prior_rows`
    prior_rows: Array  # (k, k)

    def cleared(self, columns: Array) -> Array:
        """(m + k, p): columns (m, p) without what the quantities absorb, and the residuals of their priors."""
        if not self.names:
            return columns
        taken = self.rows.T @ columns
        return np.concatenate([columns - self.rows @ taken, -self.prior_rows @ taken])

    def absorbed(self, columns: Array) -> Array:
        """(k, p) best-fit values of the quantities minus their nulls, for columns (m, p)."""
        return self.scale[:, None] * solve_triangular(self.root, self.rows.T @ columns, lower=True, trans=1)

    @property
    def covariance(self) -> Array:
        """(k, k) of the quantities if all others are known."""
        inverse = self.scale[:, None] * solve_triangular(self.root, np.eye(len(self.names)), lower=True, trans=1)
        return np.asarray(inverse @ inverse.T, float)


def is_linear(q: Quantity) -> bool:
    """Is the quantity projected out? It needs a prior."""
    return q.linear and bool(np.isfinite(q.prior_sigma))


def projection(system: System, quantities: Sequence[Quantity], values: Values) -> Projection:
    """Projection of the linear ones among the quantities; at `values` there has to be a prediction."""
    linear = [q for q in quantities if is_linear(q)]
    names = tuple(q.name for q in linear)
    null, scale = np.array([q.null for q in linear]), np.array([q.prior_sigma for q in linear])
    if not linear:
        return Projection((), null, scale, *np.zeros((3, 0, 0)))
    whole, part = system.known_as
    known = _KNOWN.setdefault(whole, {})
    key = (part, names, scale.tobytes())
    if key not in known:
        _, derivative = system.linearise(values, names)
        columns = derivative.reshape(-1, len(names)) * scale
        if not np.isfinite(columns).all():  # no prediction: the fit will report it
            return Projection(names, null, scale, np.eye(len(names)), np.zeros_like(columns), np.eye(len(names)))
        root = np.linalg.cholesky(columns.T @ columns + np.eye(len(names)))
        rows = solve_triangular(root, columns.T, lower=True).T
        prior = solve_triangular(root, np.eye(len(names)), lower=True).T
        known[key] = Projection(names, null, scale, root, rows, prior)
    return known[key]


@dataclass(frozen=True, eq=False)
class Block:
    """Rows with quantities of their own."""

    rows: Indices
    columns: list[int]  # slots
    quantities: tuple[Quantity, ...]


class Own:
    """All blocks of a system with the given quantities that belong to single blocks."""

    def __init__(self, system: System, quantities: Sequence[Quantity]) -> None:
        """Quantities with a slot belong to single blocks."""
        own: dict[int, list[Quantity]] = {}
        for q in quantities:
            if q.slot:
                own.setdefault(q.block, []).append(q)
        self.slots = tuple(dict.fromkeys(q.slot for block in own.values() for q in block))
        rows, rest = system.blocks, np.ones(len(system.weights), bool)
        self.blocks = []
        for number, of_block in own.items():
            here = np.arange(rows[number].start, rows[number].stop)
            rest[here] = False
            self.blocks.append(Block(here, [self.slots.index(q.slot) for q in of_block], tuple(of_block)))
        self.rest = np.flatnonzero(rest)  # rows without own quantities

    def reduced(
        self, residual: Array, derivative: Array, values: Values, common: Projection
    ) -> tuple[Array, Array, tuple[OwnNumbers, ...]]:
        """Least-squares problem (right (m,), matrix (m, k)) of the shared quantities, and each block's elimination.

        It is the triangular factor of a QR decomposition (m = k + 1 at most) of what linear quantities do not absorb:
        norms and inner products of all combinations of columns are kept.

        residual, derivative : (n, w), (n, w, slots + k) of a linearisation by [*slots, *shared names]
        common : linear quantities, of a system without blocks
        """
        n = len(self.slots)
        stacked = np.concatenate([derivative, residual[..., None]], axis=-1)
        width = stacked.shape[-1] - n
        heads, tails = [], [common.cleared(stacked[self.rest][..., n:].reshape(-1, width))]
        for block in self.blocks:
            p = len(block.columns)
            here = stacked[block.rows]
            rows = np.concatenate([here[..., block.columns], here[..., n:]], axis=-1).reshape(-1, p + width)
            right, matrix = prior_rows(block.quantities, values)
            prior = np.column_stack([matrix, np.zeros((len(right), width - 1)), right])
            head, tail = eliminate(np.concatenate([rows, prior]), p)
            heads.append(head)
            tails.append(tail)
        R = triangle(np.concatenate(tails))
        return R[:, -1], R[:, :-1], tuple(heads)

    def cleared(self, derivative: Array, heads: Sequence[OwnNumbers]) -> Array:
        """(n, w, k) total derivative by the shared quantities; derivative (n, w, slots + k) with the own ones held."""
        n = len(self.slots)
        found = derivative[..., n:].copy() if n else derivative
        for block, head in zip(self.blocks, heads, strict=True):
            found[block.rows] += derivative[block.rows][..., block.columns] @ head.by_shared
        return found

    def moved(self, heads: Sequence[OwnNumbers], step: Array) -> dict[str, float]:
        """Steps of all own quantities that belong to a step (k,) of the shared ones."""
        found: dict[str, float] = {}
        for block, head in zip(self.blocks, heads, strict=True):
            own = head.step + head.by_shared @ step
            found |= dict(zip((q.name for q in block.quantities), own.tolist(), strict=True))
        return found

    def known(self, heads: Sequence[OwnNumbers]) -> dict[str, tuple[Array, Array]]:
        """Rows of root and of by_shared, by quantity; none of a fit that could not start."""
        return {
            q.name: (root, by_shared)
            for block, head in zip(self.blocks, heads, strict=bool(heads))
            for q, root, by_shared in zip(block.quantities, head.root, head.by_shared, strict=True)
        }
