"""Quantities that one block of rows has of its own (a run's initial state), eliminated block by block.

They matter to no other block. Of a block's linearisation, [own | shared | residual] = Q R, the lower right of R is what
the block says of the shared quantities at its best own ones (Schur's complement of the normal equations, without
squaring the condition). Fits, scores and free runs then cost as much as there are blocks, not as their third power.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.kit.arrays import Array
from disctrack.discrepancy.system import Quantity, System, Values, blocks

UNDETERMINED = 1e-12  # singular value over the largest, below which a direction of the own quantities is not determined


@dataclass(frozen=True)
class Head:
    """The own quantities (p) of one block, at the shared ones (k)."""

    root: Array  # (p, r): root @ root.T is their covariance at given shared ones
    open: Array  # (p, p - r) directions that nothing determines: no step goes along them
    by_shared: Array  # (p, k) how their best values move with the shared ones
    step: Array  # (p,) to their best values ...
    gain: float  # ... by which chi-square falls


@dataclass(frozen=True, eq=False)
class Block:
    """Rows with their own quantities."""

    rows: NDArray[np.intp]
    columns: list[int]  # slots
    quantities: tuple[Quantity, ...]

    def parts(self, stacked: Array, n_slots: int) -> Array:
        """(rows * w, p + rest) own columns, then the others, of (n, w, n_slots + rest)."""
        here = stacked[self.rows]
        own = here[..., self.columns]
        return np.concatenate([own, here[..., n_slots:]], axis=-1).reshape(-1, own.shape[-1] + here.shape[-1] - n_slots)

    def prior(self, values: Values, width: int) -> Array:
        """(q, width) rows of the priors: own columns first, residual last."""
        known = [(i, q) for i, q in enumerate(self.quantities) if np.isfinite(q.prior_sigma)]
        rows = np.zeros((len(known), width))
        for row, (i, q) in zip(rows, known, strict=True):
            row[i], row[-1] = 1.0 / q.prior_sigma, (q.null - values[q.name]) / q.prior_sigma
        return rows


class Own:
    """All blocks of a system with those of the given quantities that are their own."""

    def __init__(self, system: System, quantities: Sequence[Quantity]) -> None:
        """Those with a slot."""
        own: dict[int, list[Quantity]] = {}
        for q in quantities:
            if q.slot:
                own.setdefault(q.block, []).append(q)
        self.slots = tuple(dict.fromkeys(q.slot for block in own.values() for q in block))
        rows, rest = blocks(system), np.ones(len(system.weights), bool)
        self.blocks = []
        for number, of_block in own.items():
            here = np.arange(rows[number].start, rows[number].stop)
            rest[here] = False
            self.blocks.append(Block(here, [self.slots.index(q.slot) for q in of_block], tuple(of_block)))
        self.rest = np.flatnonzero(rest)  # rows without own quantities

    def reduced(self, residual: Array, derivative: Array, values: Values) -> tuple[Array, Array, tuple[Head, ...]]:
        """Least-squares problem (right (m,), matrix (m, k)) of the shared quantities, and the heads of all blocks.

        residual, derivative : (n, w), (n, w, slots + k) of a linearisation by [*slots, *shared names]
        """
        n = len(self.slots)
        stacked = np.concatenate([derivative, residual[..., None]], axis=-1)
        width = stacked.shape[-1] - n
        heads, tails = [], [stacked[self.rest][..., n:].reshape(-1, width)]
        for block in self.blocks:
            p = len(block.columns)
            R = _triangle(np.concatenate([block.parts(stacked, n), block.prior(values, p + width)]))
            head, tail = _split(R, p)
            heads.append(head)
            tails.append(tail)
        R = _triangle(np.concatenate(tails))
        return R[:, -1], R[:, :-1], tuple(heads)

    def cleared(self, derivative: Array, heads: Sequence[Head]) -> Array:
        """(n, w, k) by the shared quantities, the own ones moving along; derivative (n, w, slots + k)."""
        n = len(self.slots)
        found = derivative[..., n:].copy() if n else derivative
        for block, head in zip(self.blocks, heads, strict=True):
            found[block.rows] += derivative[block.rows][..., block.columns] @ head.by_shared
        return found

    def moved(self, heads: Sequence[Head], step: Array) -> dict[str, float]:
        """Steps of all own quantities beside a step (k,) of the shared ones."""
        found: dict[str, float] = {}
        for block, head in zip(self.blocks, heads, strict=True):
            own = head.step + head.by_shared @ step
            found |= dict(zip((q.name for q in block.quantities), own.tolist(), strict=True))
        return found

    def known(self, heads: Sequence[Head]) -> dict[str, tuple[Array, Array]]:
        """Rows of root and of by_shared, by quantity; none of a fit that never began."""
        return {
            q.name: (root, by_shared)
            for block, head in zip(self.blocks, heads, strict=bool(heads))
            for q, root, by_shared in zip(block.quantities, head.root, head.by_shared, strict=True)
        }


def _split(R: Array, p: int) -> tuple[Head, Array]:
    """Head of p own columns, and what these leave of the others, [shared | residual]."""
    length = np.linalg.norm(R[:, :p], axis=0)
    length = np.where(length > 0, length, 1.0)
    U, singular, V = np.linalg.svd(R[:, :p] / length)
    r = int(np.sum(singular > UNDETERMINED * singular[0]))
    U, directions = U[:, :r], V.T / length[:, None]
    root, taken = directions[:, :r] / singular[:r], U.T @ R[:, p:]
    along = taken[:, -1]
    head = Head(root, directions[:, r:], -root @ taken[:, :-1], root @ along, float(along @ along))
    return head, R[:, p:] - U @ taken


def _triangle(matrix: Array) -> Array:
    return np.asarray(np.linalg.qr(matrix, mode="r"), float)
