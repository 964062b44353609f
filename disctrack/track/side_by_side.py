"""Some of the frames."""

import numpy as np
from numpy.typing import NDArray

from calibration.kit.arrays import Mask

AT_ONCE = 512  # frames: what their poses need beside the result is many times as large, and stays in a core's cache
SHARED_FRAMES = 400  # at most, for what all frames share: it repeats in more of them
MIN_FRAMES = 20  # for what frames share, or how they scatter
FEW = 4  # frames: as many as one after the other tell of a fault that lasts


def parts(n: int) -> list[slice]:
    """Of n frames, some at a time."""
    return [slice(first, first + AT_ONCE) for first in range(0, n, AT_ONCE)]


def stretches(chosen: Mask, shortest: int = 1) -> NDArray[np.intp]:
    """(k, 2) first and one past the last of every run of so many of the frames chosen (n,), or more."""
    edges = np.flatnonzero(np.diff(np.r_[False, chosen, False].astype(int))).reshape(-1, 2)
    return np.asarray(edges[edges[:, 1] - edges[:, 0] >= shortest])


def evenly(rows: NDArray[np.intp], most: int) -> NDArray[np.intp]:
    """Of the rows (k,) at most so many, evenly spread."""
    return rows[np.linspace(0, len(rows) - 1, min(most, len(rows))).astype(int)]
