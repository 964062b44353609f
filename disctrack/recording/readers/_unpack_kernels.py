"""Compiled loops over packed pixels: 10 and 12 bits without a gap, and the codes of LZW; most significant bit first."""

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


@njit(nogil=True, cache=True)
def lzw_codes_follow(packed: NDArray) -> bool:  # pragma: no cover (compiled)
    """False where a code (TIFF 6.0, section 13) stands for a string that no code before it has made.

    imagecodecs takes such a code at its word, and reads whatever lies in memory there.
    """
    follows, width, known, at = False, 9, 258, 0  # of the table: entries, and bits of a code
    while at + width <= 8 * packed.size:
        code = 0
        for bit in range(at, at + width):
            code = 2 * code + ((packed[bit // 8] >> (7 - bit % 8)) & 1)
        at += width
        if code == 257:  # the end
            return True
        if code == 256:  # the table begins anew
            follows, width, known = False, 9, 258
            continue
        if code > known or (code > 255 and not follows):
            return False
        if follows and known < 4096:
            known += 1
        width = 9 + (known > 510) + (known > 1022) + (known > 2046)
        follows = True
    return True
