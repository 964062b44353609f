"""The row filters of PNG images, undone in one compiled pass."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calibration.kit.compiled import njit


def prepare() -> None:
    """Compile what undoes the row filters, or load it."""
    undo_filters(np.frombuffer(bytes(2), np.uint8).reshape(1, 2), 1, np.empty((1, 1), np.uint8))


@njit(nogil=True, cache=True)
def undo_filters(rows: NDArray, pixel_bytes: int, out: NDArray) -> bool:  # pragma: no cover (compiled)
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
            for lane in range(pixel_bytes):  # a sum in a register: reading what was just stored costs four times more
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
