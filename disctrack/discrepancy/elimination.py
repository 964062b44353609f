"""Quantities that are taken out of a least-squares problem, so that a fit steps the others alone.

Linear ones with priors: errors of lenses, dots and calibration enter the prediction with derivatives that no step of a
fit changes. There may be hundreds of them; every fit needs only what they cannot absorb (variable projection). And
those that one block of rows has of its own (a run's initial state), eliminated block by block: fits, scores and free
runs cost as much as there are blocks, not as their third power.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from calibration.kit.arrays import Array
from calibration.kit.least_squares import OwnNumbers, eliminate, triangle
from disctrack.discrepancy.system import Quantity, System, Values

_KNOWN: WeakKeyDictionary[System, dict[tuple[object, ...], Projection]] = WeakKeyDictionary()


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
    """What a set of linear quantities (k) with priors can absorb of m whitened numbers."""

    names: tuple[str, ...]
    null: Array  # (k,)
    scale: Array  # (k,) prior standard deviations
    root: Array  # (k, k) L of L L^T = N^T N + 1, N: columns times prior standard deviations
    rows: Array  # (m, k) orthonormal together with `prior_rows`
    prior_rows: Array  # (k, k)

    def cleared(self, columns: Array) -> Array:
        """(m + k, p): columns (m, p) without what the quantities absorb, and below what their priors then lack."""
        if not self.names:
            return columns
        taken = self.rows.T @ columns
        return np.concatenate([columns - self.rows @ taken, -self.prior_rows @ taken])

    def absorbed(self, columns: Array) -> Array:
        """(k, p) values of the quantities, less their nulls, that fit columns (m, p) best."""
        return self.scale[:, None] * solve_triangular(self.root, self.rows.T @ columns, lower=True, trans=1)

    @property
    def covariance(self) -> Array:
        """(k, k) of the quantities if nothing else is unknown."""
        inverse = self.scale[:, None] * solve_triangular(self.root, np.eye(len(self.names)), lower=True, trans=1)
        return np.asarray(inverse @ inverse.T, float)


def is_linear(q: Quantity) -> bool:
    """Is the quantity taken out beforehand? One without a prior never is."""
    return q.linear and bool(np.isfinite(q.prior_sigma))


def projection(system: System, quantities: Sequence[Quantity], values: Values) -> Projection:
    """Of the linear ones among the quantities; `values` of the others only have to lie where there is a prediction."""
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
        if not np.isfinite(columns).all():  # no prediction here: the fit says so
            return Projection(names, null, scale, np.eye(len(names)), np.zeros_like(columns), np.eye(len(names)))
        root = np.linalg.cholesky(columns.T @ columns + np.eye(len(names)))
        rows = solve_triangular(root, columns.T, lower=True).T
        prior = solve_triangular(root, np.eye(len(names)), lower=True).T
        known[key] = Projection(names, null, scale, root, rows, prior)
    return known[key]


@dataclass(frozen=True, eq=False)
class Block:
    """Rows with their own quantities."""

    rows: NDArray[np.intp]
    columns: list[int]  # slots
    quantities: tuple[Quantity, ...]


class Own:
    """All blocks of a system with those of the given quantities that are their own."""

    def __init__(self, system: System, quantities: Sequence[Quantity]) -> None:
        """Those with a slot."""
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
        """Least-squares problem (right (m,), matrix (m, k)) of the shared quantities, and the heads of all blocks.

        It is compressed (m = k + 1 at most): the Q of all rows is dropped, and norms and angles of all combinations of
        columns stay, once what linear quantities absorb is taken off.

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
        """(n, w, k) by the shared quantities, the own ones moving along; derivative (n, w, slots + k)."""
        n = len(self.slots)
        found = derivative[..., n:].copy() if n else derivative
        for block, head in zip(self.blocks, heads, strict=True):
            found[block.rows] += derivative[block.rows][..., block.columns] @ head.by_shared
        return found

    def moved(self, heads: Sequence[OwnNumbers], step: Array) -> dict[str, float]:
        """Steps of all own quantities beside a step (k,) of the shared ones."""
        found: dict[str, float] = {}
        for block, head in zip(self.blocks, heads, strict=True):
            own = head.step + head.by_shared @ step
            found |= dict(zip((q.name for q in block.quantities), own.tolist(), strict=True))
        return found

    def known(self, heads: Sequence[OwnNumbers]) -> dict[str, tuple[Array, Array]]:
        """Rows of root and of by_shared, by quantity; none of a fit that never began."""
        return {
            q.name: (root, by_shared)
            for block, head in zip(self.blocks, heads, strict=bool(heads))
            for q, root, by_shared in zip(block.quantities, head.root, head.by_shared, strict=True)
        }
