"""LZW strips of TIFF files, decoded in compiled code (TIFF 6.0, Adobe 1992, section 13).

libtiff follows a chain of table entries for every string. Here an entry tells where in the output its string stands,
from where eight bytes are copied at once. A code of a frame with noise costs 1.5 ns; a frame of 512 x 512, 0.15 ms with
8 bits and 0.6 with 16 (imagecodecs 1.4 and 3.5 ms, OpenCV's libtiff 1.1 and 2.4).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calibration.compiled import njit

SLACK = 8  # bytes beyond the codes that may be read
HEAD = 264  # bytes before the first strip: those that single codes stand for, and some more that are read with the last
_part = njit(nogil=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)  # called by compiled functions only
_CLEAR, _END, _FIRST, _ENTRIES = 256, 257, 258, 4096
_u = np.uint64
_PLACE, _LENGTH = _u(16), _u(0xFFFF)


def prepare() -> None:
    """Compile the decoder and what undoes differences, or load them."""
    pixels = np.zeros((1, HEAD + 1), np.uint8)
    decode_lzw(np.zeros(SLACK, np.uint8), np.zeros(2, np.int64), pixels[0], 1, 1)
    for rows in (pixels, np.zeros((1, 1), np.uint16)):
        undo_differences(rows)


@njit(nogil=True, cache=True)
def decode_lzw(codes: NDArray, ends: NDArray, out: NDArray, strip: int, size: int) -> bool:  # pragma: no cover
    """Fill `out` with strips, each but the last of `strip` bytes, `size` in all; False where they hold anything else.

    codes : uint8, the strips' codes and SLACK bytes.   ends : (1 + n_strips,) where in `codes` they begin and end
    out : uint8, the bytes of single codes (HEAD, filled here) and, after them, the `size` bytes of the strips
    """
    strings = np.zeros(_ENTRIES + 1, np.uint64)
    for value in range(256):
        out[value], strings[value] = value, _u(value) << _PLACE | _u(1)
    for number in range(ends.size - 1):
        start = HEAD + number * strip
        stop = min(start + strip, HEAD + size)
        if not _decode_strip(codes, _u(8 * ends[number]), _u(8 * ends[number + 1]), out, _u(start), _u(stop), strings):
            return False
    return True


@_part
def _eight(values: NDArray, at: np.uint64) -> np.uint64:  # pragma: no cover (compiled)
    """Eight bytes as one number, the first is the highest."""
    number = _u(0)
    for k in range(8):
        number |= _u(values[at + _u(k)]) << _u(56 - 8 * k)
    return number


@_part
def _forget(strings: NDArray) -> None:  # pragma: no cover (compiled)
    for entry in range(_FIRST, _ENTRIES + 1):
        strings[entry] = _u(0)


@_part
def _decode_strip(
    codes: NDArray, bit: np.uint64, end_bit: np.uint64, out: NDArray, at: np.uint64, stop: np.uint64, strings: NDArray
) -> bool:  # pragma: no cover (compiled)
    """All unsigned: an index that might be negative is looked at one by one. strings: place << 16 | length; 0 for none.

    A string of the table stands in the output already: the one before the present one, and a byte more. So an entry is
    made before that byte is known.
    """
    width, entries, previous = _u(9), _u(_FIRST), _u(0)
    begins = True
    _forget(strings)
    while at < stop:
        if not begins:
            # as many codes as can change neither the width nor leave room for less than eight bytes; they are judged by
            # one comparison, as CLEAR, END and what nobody entered have no length
            room = (_u(1) << width) - _u(1) if width < _u(12) else _u(_ENTRIES)
            count = min(room - entries, (stop - at) >> _u(3), (end_bit - bit) // width)
            unused = _u(64) - width
            for _ in range(count):
                code = _eight(codes, bit >> _u(3)) << (bit & _u(7)) >> unused
                strings[entries] = previous + _u(1)
                string = strings[code]
                length = string & _LENGTH
                if length - _u(1) >= _u(8) or code == entries:  # no length is the longest
                    strings[entries] = _u(0)
                    break
                first = _eight(out, string >> _PLACE)
                for k in range(8):
                    out[at + _u(k)] = np.uint8(first >> _u(56 - 8 * k))
                previous = at << _PLACE | length
                bit += width
                entries += _u(1)
                at += length
            if entries == room and width < _u(12):
                width += _u(1)
            if at == stop:
                break
        if bit + width > end_bit:
            return False
        code = _eight(codes, bit >> _u(3)) << (bit & _u(7)) >> (_u(64) - width)
        bit += width
        if code == _u(_CLEAR):
            width, entries, begins = _u(9), _u(_FIRST), True
            _forget(strings)
            continue
        if begins:
            if code > _u(255):
                return False
            begins = False
        else:
            if code == _u(_END) or code > entries or entries == _u(_ENTRIES):  # a writer goes on with a full table
                return False
            strings[entries] = previous + _u(1)
            entries += _u(1)
            if entries == (_u(1) << width) - _u(1) and width < _u(12):
                width += _u(1)
        string = strings[code]
        place, length = string >> _PLACE, string & _LENGTH
        if length > stop - at:
            return False
        for k in range(length):  # one after the other: the new string may be the present one, and end with its first
            out[at + _u(k)] = out[place + _u(k)]
        previous = at << _PLACE | length
        at += length
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
