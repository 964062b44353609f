"""Some of the frames."""

import numpy as np
from numpy.typing import NDArray

AT_ONCE = 4096  # frames whose derivatives, many times as large, are held together
SHARED_FRAMES = 400  # at most, for what all frames share: it repeats in more of them
MIN_FRAMES = 20  # for what frames share, or how they scatter


def evenly(rows: NDArray[np.intp], most: int) -> NDArray[np.intp]:
    """Of the rows (k,) at most so many, evenly spread."""
    return rows[np.linspace(0, len(rows) - 1, min(most, len(rows))).astype(int)]
