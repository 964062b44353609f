"""Array types of both packages."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
AnyArray = NDArray  # of another type: grey values, records, variables of a file
Indices = NDArray[np.intp]
Codes = NDArray[np.uint8]  # members of an IntEnum
Numbers = NDArray[np.inexact[Any]]  # real, or complex if imaginary parts carry derivatives
Array32 = NDArray[np.float32]
Image = NDArray[np.uint8] | NDArray[np.uint16]  # one image or a stack, as a camera records it


def robust_sigma(values: NDArray[np.floating]) -> float:
    """Standard deviation from the median absolute deviation, robust against outliers."""
    return 1.4826 * float(np.median(np.abs(values - np.median(values))))


def evenly(n: int, most: int) -> list[int]:
    """Indices of at most `most` of n items, evenly spaced."""
    return sorted({round(i) for i in np.linspace(0, n - 1, min(n, most))})
