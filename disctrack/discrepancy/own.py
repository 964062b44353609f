"""Quantities that one block of rows has of its own (a run's initial state), eliminated block by block.

They matter to no other block. Fits, scores and free runs cost as much as there are blocks, not as their third power.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.kit.arrays import Array
from calibration.kit.least_squares import OwnNumbers, eliminate, triangle
from disctrack.discrepancy.system import Quantity, System, Values


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
        rows, rest = system.blocks, np.ones(len(system.weights), bool)
        self.blocks = []
        for number, of_block in own.items():
            here = np.arange(rows[number].start, rows[number].stop)
            rest[here] = False
            self.blocks.append(Block(here, [self.slots.index(q.slot) for q in of_block], tuple(of_block)))
        self.rest = np.flatnonzero(rest)  # rows without own quantities

    def reduced(
        self, residual: Array, derivative: Array, values: Values
    ) -> tuple[Array, Array, tuple[OwnNumbers, ...]]:
        """Least-squares problem (right (m,), matrix (m, k)) of the shared quantities, and the heads of all blocks.

        residual, derivative : (n, w), (n, w, slots + k) of a linearisation by [*slots, *shared names]
        """
        n = len(self.slots)
        stacked = np.concatenate([derivative, residual[..., None]], axis=-1)
        width = stacked.shape[-1] - n
        heads, tails = [], [stacked[self.rest][..., n:].reshape(-1, width)]
        for block in self.blocks:
            p = len(block.columns)
            head, tail = eliminate(np.concatenate([block.parts(stacked, n), block.prior(values, p + width)]), p)
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
