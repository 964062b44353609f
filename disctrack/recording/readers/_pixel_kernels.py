"""Compiled loops over stored pixels: row filters of PNG, packed pixels of 10 and 12 bits, and codes of LZW.

The most significant bit comes first.
"""

import numpy as np

from calibration.kit.arrays import AnyArray
from calibration.kit.compiled import njit


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


@njit(nogil=True, cache=True)
def unpack_12(packed: AnyArray, out: AnyArray) -> None:  # pragma: no cover (compiled)
    """3 bytes to 2 pixels: packed (3 k,) uint8, out (2 k,) uint16."""
    for i in range(out.size // 2):
        a, b, c = np.uint16(packed[3 * i]), np.uint16(packed[3 * i + 1]), np.uint16(packed[3 * i + 2])
        out[2 * i] = (a << np.uint16(4)) | (b >> np.uint16(4))
        out[2 * i + 1] = ((b & np.uint16(0xF)) << np.uint16(8)) | c


@njit(nogil=True, cache=True)
def unpack_10(packed: AnyArray, out: AnyArray) -> None:  # pragma: no cover (compiled)
    """5 bytes to 4 pixels: packed (5 k,) uint8, out (4 k,) uint16."""
    for i in range(out.size // 4):
        a, b, c = np.uint16(packed[5 * i]), np.uint16(packed[5 * i + 1]), np.uint16(packed[5 * i + 2])
        d, e = np.uint16(packed[5 * i + 3]), np.uint16(packed[5 * i + 4])
        out[4 * i] = (a << np.uint16(2)) | (b >> np.uint16(6))
        out[4 * i + 1] = ((b & np.uint16(0x3F)) << np.uint16(4)) | (c >> np.uint16(4))
        out[4 * i + 2] = ((c & np.uint16(0xF)) << np.uint16(6)) | (d >> np.uint16(2))
        out[4 * i + 3] = ((d & np.uint16(0x3)) << np.uint16(8)) | e


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
