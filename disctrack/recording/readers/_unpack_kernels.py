"""Compiled unpacking of pixels of 10 and 12 bits that lie without a gap, most significant bit first."""

import numpy as np
from numpy.typing import NDArray

from calibration.kit.compiled import njit


@njit(nogil=True, cache=True)
def unpack_12(packed: NDArray, out: NDArray) -> None:  # pragma: no cover (compiled)
    """3 bytes to 2 pixels: packed (3 k,) uint8, out (2 k,) uint16."""
    for i in range(out.size // 2):
        a, b, c = np.uint16(packed[3 * i]), np.uint16(packed[3 * i + 1]), np.uint16(packed[3 * i + 2])
        out[2 * i] = (a << np.uint16(4)) | (b >> np.uint16(4))
        out[2 * i + 1] = ((b & np.uint16(0xF)) << np.uint16(8)) | c


@njit(nogil=True, cache=True)
def unpack_10(packed: NDArray, out: NDArray) -> None:  # pragma: no cover (compiled)
    """5 bytes to 4 pixels: packed (5 k,) uint8, out (4 k,) uint16."""
    for i in range(out.size // 4):
        a, b, c = np.uint16(packed[5 * i]), np.uint16(packed[5 * i + 1]), np.uint16(packed[5 * i + 2])
        d, e = np.uint16(packed[5 * i + 3]), np.uint16(packed[5 * i + 4])
        out[4 * i] = (a << np.uint16(2)) | (b >> np.uint16(6))
        out[4 * i + 1] = ((b & np.uint16(0x3F)) << np.uint16(4)) | (c >> np.uint16(4))
        out[4 * i + 2] = ((c & np.uint16(0xF)) << np.uint16(6)) | (d >> np.uint16(2))
        out[4 * i + 3] = ((d & np.uint16(0x3)) << np.uint16(8)) | e
