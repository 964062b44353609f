"""Some of the frames, and the same function on parts of the frames by several threads."""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

AT_ONCE = 4096  # frames whose derivatives, many times as large, are held together
SHARED_FRAMES = 400  # at most, for what all frames share: it repeats in more of them
MIN_FRAMES = 20  # for what frames share, or how they scatter


def evenly(rows: NDArray[np.intp], most: int) -> NDArray[np.intp]:
    """Of the rows (k,) at most so many, evenly spread."""
    return rows[np.linspace(0, len(rows) - 1, min(most, len(rows))).astype(int)]


def side_by_side(function: Callable[[slice], None], n: int, at_once: int, workers: int) -> None:
    """Call the function with parts of n frames.

    NumPy lets go of the interpreter where arrays are large: parts of some hundred frames are worked on side by side.
    """
    parts: Iterable[slice] = [slice(first, first + at_once) for first in range(0, n, at_once)]
    if workers < 2:
        for part in parts:
            function(part)
        return
    with ThreadPoolExecutor(workers, thread_name_prefix="part") as pool:
        list(pool.map(function, parts))
