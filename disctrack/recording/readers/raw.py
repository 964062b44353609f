"""Frames that lie uncompressed in a file, read at the speed of memory.

Bytes go from the system's file cache straight into the caller's array by positioned reads. A memory map would need the
same copy and its page faults, and a file that is cut short or a network that goes away would end the process instead of
raising an error.
"""

from __future__ import annotations

import hashlib
import os
import threading
import weakref
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import DTypeLike, NDArray

from calibration.kit.arrays import Array, Image
from disctrack.errors import RecordingError
from disctrack.files.inputs import open_regular
from disctrack.recording.readers.base import Frames

# A header may claim any size; no camera of this kind has more pixels, and reading one must not exhaust the memory.
MOST_PIXELS = 1 << 27
# Even a black image does not shrink by more than this when compressed (deflate: 1032); small ones are let pass.
_MOST_PER_BYTE, _SMALL_IMAGE = 1500, 1 << 22  # pixels per byte of the file; pixels
_PIECE = 1 << 20  # bytes hashed at a time


class RawFile:
    """A file that stays open and is read at any offset, by several threads at once.

    Raises RecordingError if it cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._lock = threading.Lock()  # for systems without positioned reads
        try:
            self._descriptor = open_regular(path)
            weakref.finalize(self, os.close, self._descriptor)
            self.size = os.fstat(self._descriptor).st_size
        except OSError as error:
            raise RecordingError(f"{path}: cannot be read: {error.strerror}.") from error

    def read_into(self, buffer: NDArray[np.uint8], offset: int, where: str) -> None:
        """Fill `buffer` (n,) with the bytes from `offset` on.

        Raises RecordingError that begins with `where` if the file ends before, or cannot be read any more.
        """
        view, done = buffer.data, 0
        while done < len(view):
            try:
                n = self._read_some(view[done:], offset + done)
            except OSError as error:
                raise RecordingError(f"{where}: cannot be read: {error.strerror}. Copy the file again.") from error
            if n == 0:
                raise RecordingError(
                    f"{where}: the file ends {len(view) - done} bytes before the end of what lies at byte {offset}. "
                    "It is cut short: copy it again from the camera."
                )
            done += n

    def bytes_at(self, offset: int, size: int, where: str) -> bytes:
        """`size` bytes from `offset` on; errors as in `read_into`, and none is read if the file is too short."""
        if offset < 0 or size < 0 or offset + size > self.size:
            raise RecordingError(
                f"{where}: {size} bytes at byte {offset} are announced, but the file has {self.size}. "
                "It is cut short or damaged: copy it again from the camera."
            )
        buffer = np.empty(size, np.uint8)
        self.read_into(buffer, offset, where)
        return buffer.tobytes()

    def _read_some(self, view: memoryview, offset: int) -> int:
        if hasattr(os, "preadv"):
            return os.preadv(self._descriptor, [view], offset)
        with self._lock:
            os.lseek(self._descriptor, offset, os.SEEK_SET)
            piece = os.read(self._descriptor, len(view))
            view[: len(piece)] = piece
            return len(piece)

    def update_digest(self, digest: hashlib._Hash, offset: int, size: int) -> None:
        """Add `size` bytes from `offset` on to a digest; those that cannot be read count as missing."""
        buffer = np.empty(min(_PIECE, max(size, 1)), np.uint8)
        for start in range(offset, offset + size, _PIECE):
            piece = buffer[: min(_PIECE, offset + size - start)]
            try:
                self.read_into(piece, start, "")
            except RecordingError:
                digest.update(b"unreadable")
                return
            digest.update(piece.data)


class RawFrames(Frames):
    """Frames of equal size at known places in one or several files; see FrameReader."""

    def __init__(
        self,
        files: Sequence[RawFile],
        file_of_frame: NDArray[np.integer],
        offsets: NDArray[np.integer],
        image_size: tuple[int, int],
        dtype: DTypeLike,
        camera: str,
        *,
        bit_depth: int | None = None,
        notes: tuple[str, ...] = (),
        timestamps: Array | None = None,
        frame_rate: float | None = None,
    ) -> None:
        """Frame i begins at byte offsets[i] of files[file_of_frame[i]]; dtype is that of the file, with byte order."""
        self.files, self.camera, self.image_size = list(files), camera, image_size
        self.file_of_frame, self.offsets = np.asarray(file_of_frame), np.asarray(offsets)
        self.stored = np.dtype(dtype)
        self.dtype = self.stored.newbyteorder("=")
        self.bit_depth = bit_depth or 8 * self.stored.itemsize
        self.notes, self.timestamps, self.frame_rate = notes, timestamps, frame_rate
        self.frame_bytes = image_size[0] * image_size[1] * self.stored.itemsize

    def __len__(self) -> int:
        return len(self.offsets)

    def describe(self, index: int) -> str:
        """File, frame and the byte where it begins."""
        return f"{self._place(index)}, frame {index} at byte {self.offsets[index]}"

    def _place(self, index: int) -> str:
        return str(self.files[self.file_of_frame[index]].path)

    def _decoded(self, index: int, out: Image | None, where: str) -> Image:
        image, file = self._buffer(out), self.files[self.file_of_frame[index]]
        file.read_into(image.reshape(-1).view(np.uint8), int(self.offsets[index]), where)
        if self.stored != self.dtype:
            image.byteswap(inplace=True)
        return image

    def content_sha256(self, start: int, stop: int) -> str:
        """SHA-256 of size, type and bytes of frames start..stop-1."""
        digest = hashlib.sha256(f"{self.image_size} {self.stored.str}".encode())
        for index in range(start, stop):
            file = self.files[self.file_of_frame[index]]
            file.update_digest(digest, int(self.offsets[index]), self.frame_bytes)
        return digest.hexdigest()


def check_frame_size(width: int, height: int, where: str) -> None:
    """Raise RecordingError, beginning with `where`, unless a header's image size is one that a camera can have."""
    if not (0 < width <= MOST_PIXELS and 0 < height <= MOST_PIXELS and width * height <= MOST_PIXELS):
        raise RecordingError(
            f"{where}: the header claims images of {width} x {height} px, which no camera of this kind has. "
            "The header is damaged, or not of this format: copy the file again."
        )


def check_claim(width: int, height: int, n_bytes: int, where: str) -> None:
    """Raise RecordingError, beginning with `where`, for a size that n_bytes cannot hold, however compressed."""
    if width * height > min(MOST_PIXELS, max(_SMALL_IMAGE, _MOST_PER_BYTE * n_bytes)):
        raise RecordingError(
            f"{where}: the header claims {width} x {height} px, more than any such camera has or the file can hold. "
            "Copy or export this image again."
        )
