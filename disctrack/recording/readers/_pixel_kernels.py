"""Compiled loops over stored pixels: row filters of PNG, packed pixels of 10 and 12 bits, and codes of LZW.

The most significant bit comes first.
"""

from collections.abc import Callable

import numpy as np

from calibration.kit.compiled import njit
from calibration.kit.types import AnyArray


def prepare() -> None:
    """Compile `undo_filters`, or load it from the cache."""
    undo_filters(np.frombuffer(bytes(2), np.uint8).reshape(1, 2), 1, np.empty((1, 1), np.uint8))


@njit(nogil=True, cache=True)
def undo_filters(rows: AnyArray, pixel_bytes: int, out: AnyArray) -> bool:  # pragma: no cover (compiled)
    """Rows (height, 1 + stride), filter type first, to pixels (height, stride); False for an unknown filter type.

    PNG specification (ISO/IEC 15948), section 9.2; all sums modulo 256.
    """
    height, stride = out.shape
    for y in range(height):
        kind = rows[y, 0]
        if kind == 0:
            for i in range(stride):
                out[y, i] = rows[y, i + 1]
        elif kind == 1:
            for lane in range(pixel_bytes):  # a sum in a register takes a quarter of the time of a stored one
                total = np.uint8(0)
                for i in range(lane, stride, pixel_bytes):
                    total = np.uint8(total + rows[y, i + 1])
                    out[y, i] = total
        elif kind == 2:
            for i in range(stride):
                out[y, i] = rows[y, i + 1] + (out[y - 1, i] if y > 0 else 0)
        elif kind == 3:
            for i in range(stride):
                left = np.int64(out[y, i - pixel_bytes]) if i >= pixel_bytes else 0
                up = np.int64(out[y - 1, i]) if y > 0 else 0
                out[y, i] = rows[y, i + 1] + ((left + up) >> 1)
        elif kind == 4:
            for i in range(stride):
                left = np.int64(out[y, i - pixel_bytes]) if i >= pixel_bytes else 0
                up = np.int64(out[y - 1, i]) if y > 0 else 0
                corner = np.int64(out[y - 1, i - pixel_bytes]) if i >= pixel_bytes and y > 0 else 0
                to_left, to_up, to_corner = np.abs(up - corner), np.abs(left - corner), np.abs(left + up - 2 * corner)
                if to_left <= to_up and to_left <= to_corner:
                    best = left
                elif to_up <= to_corner:
                    best = up
                else:
                    best = corner
                out[y, i] = rows[y, i + 1] + best
        else:
            return False
    return True


def _unpacker(bits: int) -> Callable[[AnyArray, AnyArray], None]:
    """Function of packed (n k,) uint8 and out (m k,) uint16: n bytes to m pixels, 5 to 4 (10 bits) or 3 to 2 (12).

    A pixel begins in one byte, `spare` bits later than the one before, and ends in the next. The numbers are constants
    of the compiled function, which is ten times as fast as one with arguments.
    """
    spare, surplus = bits - 8, np.uint16(16 - bits)
    pixels = 8 // spare

    @njit(nogil=True, cache=True)
    def unpacked(packed: AnyArray, out: AnyArray) -> None:  # pragma: no cover (compiled)
        for group in range(out.size // pixels):
            for i in range(pixels):
                at = group * (pixels + 1) + i
                both = (np.uint16(packed[at]) << np.uint16(8)) | np.uint16(packed[at + 1])
                out[group * pixels + i] = np.uint16(both << np.uint16(spare * i)) >> surplus

    return unpacked


unpack = {bits: _unpacker(bits) for bits in (10, 12)}


@njit(nogil=True, cache=True)
def lzw_codes_follow(packed: AnyArray) -> bool:  # pragma: no cover (compiled)
    """False if a code (TIFF 6.0, section 13) refers to a string that is not in the table yet.

    imagecodecs does not check this, and would read arbitrary memory.
    """
    follows, width, known, at = False, 9, 258, 0  # known: entries of the table; width: bits of a code
    while at + width <= 8 * packed.size:
        code = 0
        for bit in range(at, at + width):
            code = 2 * code + ((packed[bit // 8] >> (7 - bit % 8)) & 1)
        at += width
        if code == 257:  # end of information
            return True
        if code == 256:  # clear table
            follows, width, known = False, 9, 258
            continue
        if code > known or (code > 255 and not follows):
            return False
        if follows and known < 4096:
            known += 1
        width = 9 + (known > 510) + (known > 1022) + (known > 2046)
        follows = True
    return True
