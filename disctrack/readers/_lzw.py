"""LZW strips of TIFF files, decoded in compiled code (TIFF 6.0, Adobe 1992, section 13).

libtiff follows a chain of table entries for every string. Here an entry holds the first eight bytes of its string,
which are stored at once, and where in the output the string stands, from where longer ones are copied. A frame of
512 x 512 of 8 bits with noise: 0.42 ms of a core with its differences, OpenCV 1.12 ms.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calibration.compiled import njit

SLACK = 8  # bytes beyond a strip that may be written, and beyond its codes that may be read
_part = njit(nogil=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)  # called by compiled functions only
_CLEAR, _END, _FIRST, _ENTRIES = 256, 257, 258, 4096


def prepare() -> None:
    """Compile the decoder and what undoes differences, or load them."""
    pixels = np.zeros((1, 1 + SLACK), np.uint8)
    decode_lzw(np.zeros(SLACK, np.uint8), np.zeros(2, np.int64), pixels[0], 1, 1)
    for rows in (pixels, np.zeros((1, 1), np.uint16)):
        undo_differences(rows)


@njit(nogil=True, cache=True)
def decode_lzw(codes: NDArray, ends: NDArray, out: NDArray, strip: int, size: int) -> bool:  # pragma: no cover
    """Fill `out` with strips, each but the last of `strip` bytes, `size` in all; False where they hold anything else.

    codes : uint8, the strips' codes and SLACK bytes.   ends : (1 + n_strips,) where in `codes` they begin and end
    out : uint8, size and SLACK bytes, which may be written
    """
    first_bytes, length = np.empty(_ENTRIES, np.uint64), np.empty(_ENTRIES, np.int64)
    place = np.zeros(_ENTRIES, np.int64)
    for i in range(256):
        first_bytes[i], length[i] = i, 1
    for number in range(ends.size - 1):
        start = number * strip
        stop = min(start + strip, size)
        if not _decode_strip(codes, ends[number], ends[number + 1], out, start, stop, first_bytes, length, place):
            return False
    return True


@_part
def _decode_strip(
    codes: NDArray,
    begin: int,
    end: int,
    out: NDArray,
    at: int,
    stop: int,
    first_bytes: NDArray,
    length: NDArray,
    place: NDArray,
) -> bool:  # pragma: no cover (compiled)
    bit, end_bit, width, entries, previous = 8 * begin, 8 * end, 9, _FIRST, -1
    while at < stop:
        if bit + width > end_bit:
            return False
        byte = np.uint64(bit >> 3)
        word = (
            np.uint64(codes[byte]) << np.uint64(24)
            | np.uint64(codes[byte + np.uint64(1)]) << np.uint64(16)
            | np.uint64(codes[byte + np.uint64(2)]) << np.uint64(8)
            | np.uint64(codes[byte + np.uint64(3)])
        )
        code = int(word >> np.uint64(32 - width - (bit & 7))) & ((1 << width) - 1)
        bit += width
        if code == _CLEAR:
            width, entries, previous = 9, _FIRST, -1
            continue
        if code == _END or code > entries:
            return False
        if previous < 0:
            if code > 255:
                return False
        else:
            if entries == _ENTRIES:  # a writer that goes on with a full table
                return False
            known = length[previous]
            # the new string is the previous one and the first byte of this one; this one may be the new one itself
            added = first_bytes[previous if code == entries else code] & np.uint64(255)
            first_bytes[entries] = first_bytes[previous]
            if known < 8:
                first_bytes[entries] |= added << np.uint64(8 * known)
            length[entries], place[entries] = known + 1, at - known
            entries += 1
            if entries > (1 << width) - 2 and width < 12:
                width += 1
        n = length[code]
        if n > stop - at:
            return False
        value, target = first_bytes[code], np.uint64(at)
        for j in range(8):
            out[target + np.uint64(j)] = np.uint8((value >> np.uint64(8 * j)) & np.uint64(255))
        if n > 8:
            origin = np.uint64(place[code])
            for i in range(8, n, 8):  # the string stands eight bytes before its copy, at least
                for j in range(8):
                    k = np.uint64(i + j)
                    out[target + k] = out[origin + k]
        at += n
        previous = code
    return True


@njit(nogil=True, cache=True)
def undo_differences(rows: NDArray) -> None:  # pragma: no cover (compiled)
    """Rows (height, width) of differences to the pixel on the left, to pixels, in place (section 14)."""
    height, width = rows.shape
    for y in range(height):
        total = rows[y, 0]
        for x in range(1, width):
            total = rows.dtype.type(total + rows[y, x])
            rows[y, x] = total
