"""Subsets of the frames: parts for parallel work, runs of frames, evenly spread ones."""

import numpy as np

from calibration.kit.types import Indices, Mask

AT_ONCE = 512  # frames, whose temporary arrays are many times as large as the result, and fit into a core's cache
SHARED_FRAMES = 400  # at most, to estimate what all frames share: more frames repeat it
MIN_FRAMES = 20  # to estimate what frames share, or how they scatter
SURE = 3.0  # sigmas of an estimate of what frames share, below which it is not used
FEW = 4  # consecutive frames that indicate a lasting fault


def parts(n: int) -> list[slice]:
    """Consecutive slices of n frames, each of AT_ONCE at most."""
    return [slice(first, first + AT_ONCE) for first in range(0, n, AT_ONCE)]


def stretches(chosen: Mask, shortest: int = 1) -> Indices:
    """(k, 2) first and one past the last frame of every run of at least `shortest` frames in the mask `chosen` (n,)."""
    edges = np.flatnonzero(np.diff(np.r_[False, chosen, False].astype(int))).reshape(-1, 2)
    return np.asarray(edges[edges[:, 1] - edges[:, 0] >= shortest])


def evenly(rows: Indices, most: int) -> Indices:
    """At most `most` of the rows (k,), evenly spread."""
    return rows[np.linspace(0, len(rows) - 1, min(most, len(rows))).astype(int)]
