"""Frames of one camera, whatever file they lie in: one small module per format, one interface."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

Frame = NDArray[np.uint8] | NDArray[np.uint16]


@runtime_checkable
class FrameReader(Protocol):
    """Frames of one camera in order. Opening it reads no more than headers; frames are read when asked for.

    `read` raises disctrack.errors.RecordingError naming file, frame, what was found and what to do. It may be called
    from several threads at once.
    """

    image_size: tuple[int, int]  # width, height [px]
    bit_depth: int  # bits that carry grey values: 8, 10, 12 or 16
    timestamps: NDArray[np.float64] | None  # (n,) [s] where the file has them

    def __len__(self) -> int: ...

    def read(self, index: int) -> Frame:
        """Frame `index`, (height, width) grey values as the camera wrote them."""
        ...

    def describe(self, index: int) -> str:
        """Where frame `index` lies, for messages: a file name, or a file name and an offset."""
        ...
