"""Frames of one camera, whatever file they lie in: one small module per format, one interface."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

Frame = NDArray[np.uint8] | NDArray[np.uint16]

VIDEO_SUFFIXES = frozenset({".avi", ".mp4", ".mkv", ".mov"})


@runtime_checkable
class FrameReader(Protocol):
    """Frames of one camera in order. Opening it reads no more than headers; frames are read when asked for.

    `read` raises disctrack.errors.RecordingError naming file, frame, what was found and what to do. It may be called
    from several threads at once.
    """

    image_size: tuple[int, int]  # width, height [px]
    bit_depth: int  # bits that carry grey values: 8, 10, 12 or 16
    timestamps: NDArray[np.float64] | None  # (n,) [s] where the file has them
    notes: tuple[str, ...]  # what the user should know about how the frames were read, one sentence each
    random_access: bool  # False where frames are read fastest in order, by one thread

    def __len__(self) -> int: ...

    def read(self, index: int, out: Frame | None = None) -> Frame:
        """Frame `index`, (height, width) grey values as the camera wrote them; into `out` if given, and returned."""
        ...

    def describe(self, index: int) -> str:
        """Where frame `index` lies, for messages: a file name, or a file name and an offset."""
        ...

    def content_sha256(self, start: int, stop: int) -> str:
        """SHA-256 (hex) of what frames start..stop-1 were made from; equal if and only if the input is the same."""
        ...


def open_frames(pattern: str, folder: Path, camera: str) -> FrameReader:
    """Reader of one camera's frames: a file pattern or one video, relative to `folder`.

    camera : "left" or "right", for messages
    Raises RecordingError if nothing matches, or if no frame can be read.
    """
    from disctrack.readers.files import match_files

    files = match_files(pattern, folder, camera)
    if files[0].suffix.lower() in VIDEO_SUFFIXES:
        from disctrack.readers.video import open_video

        return open_video(files, camera)
    from disctrack.readers.images import open_image_sequence

    return open_image_sequence(files, camera)
