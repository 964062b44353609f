"""Measured inputs that act late: the same signals on knots of their own, exact for any delay."""

import numpy as np

from calibration.kit.arrays import Array


def with_late(knots: Array, pieces: Array, which: list[int], late: Array) -> tuple[Array, Array]:
    """Inputs, and some of them once more as they were `late` seconds ago, on knots that all of them share.

    knots (m,), pieces (c, 5, m - 1) : as `declared.Samples` has them
    which : index of the input that each late one is;  late : (len(which),) [s]
    Before its first sample an input is what it is there, and after its last one what it is then.
    """
    both = np.concatenate([pieces, pieces[which]])
    if not np.any(late):
        return knots, both
    ends = knots[[0, -1]]
    shared = np.unique(np.concatenate([knots, *(knots + s for s in late)]))
    # knots that agree but for rounding are one: a step between them would be as short
    shared = shared[np.concatenate([[True], np.diff(shared) > 1e-9 * np.median(np.diff(knots))])]
    shared = shared[(shared >= ends[0]) & (shared <= ends[1])]
    shift = np.concatenate([np.zeros(len(pieces)), late])
    found = np.zeros((len(both), 5, len(shared) - 1))
    middle = (shared[1:] + shared[:-1]) / 2
    for c, s in enumerate(shift):
        piece = np.clip(np.searchsorted(knots, middle - s, side="right") - 1, 0, len(knots) - 2)
        a, b, d, e, step = both[c][:, piece]
        x = shared[:-1] - s - knots[piece]
        found[c] = a, 3 * a * x + b, (3 * a * x + 2 * b) * x + d, ((a * x + b) * x + d) * x + e, step
        for beyond, end in ((middle - s < ends[0], 0), (middle - s > ends[1], -1)):
            a, b, d, e, _ = both[c][:, end]
            x = (ends[1] - knots[-2]) if end else 0.0
            found[c][:, beyond] = np.array([0.0, 0.0, 0.0, ((a * x + b) * x + d) * x + e, 0.0])[:, None]
    return shared, found
