"""Frames of uncompressed or packed pixels at known offsets in a file, read at the speed of memory.

Positioned reads copy bytes from the system's file cache directly into the caller's array. A memory map would need the
same copy and page faults, and a truncated file or a lost network connection would end the process instead of raising an
error.
"""

import io
import os
import threading
import weakref
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.kit.types import AnyArray, Image
from disctrack.errors import RecordingError, told_as
from disctrack.files.whole import open_regular
from disctrack.recording.readers._pixel_kernels import unpack
from disctrack.recording.readers.base import FrameReader, in_words, room_for

# Of an image: more than any camera of this kind has, and few enough not to exhaust the memory.
MOST_PIXELS = 1 << 27
# Of the frames that a header states, the part that a truncated file must contain: below, the header is taken as wrong,
# since all arrays have the length that it states.
LEAST_PRESENT = 0.5


class RawFile:
    """A file that stays open and is read at any offset, by several threads at once.

    content : of the file, if it was read before
    Raises RecordingError if it cannot be opened.
    """

    def __init__(self, path: Path, content: bytes | None = None) -> None:
        self.path, self._content, self._lock = path, content, threading.Lock()
        with told_as(RecordingError, f"{path}: cannot be read", OSError):
            self._stream = self.stream()
        weakref.finalize(self, self._stream.close)
        self.size = self._stream.seek(0, os.SEEK_END)

    def __str__(self) -> str:
        return str(self.path)

    def stream(self) -> io.FileIO | io.BytesIO:
        """A new stream of the file for a library, which the caller closes."""
        return io.FileIO(open_regular(self.path)) if self._content is None else io.BytesIO(self._content)

    def read_into(self, buffer: NDArray[np.uint8], offset: int, where: str) -> None:
        """Fill `buffer` (n,) with the bytes from `offset` on.

        Raises RecordingError that begins with `where` if the file ends earlier or can no longer be read.
        """
        with self._lock, told_as(RecordingError, f"{where}: cannot be read", OSError, then="Copy the file again."):
            self._stream.seek(offset)
            done = self._stream.readinto(buffer.data)
        if done < len(buffer):
            said = f"ends {len(buffer) - done} bytes before the end of what lies at byte {offset}: it is cut short"
            raise RecordingError(f"{where}: the file {said}. Copy it again from the camera.")

    def bytes_at(self, offset: int, size: int, where: str) -> bytes:
        """`size` bytes from `offset` on; errors as in `read_into`; no memory is allocated if the file is too short."""
        if offset < 0 or size < 0 or offset + size > self.size:
            said = f"{size} bytes at byte {offset} are announced, but the file has {self.size}: cut short or damaged"
            raise RecordingError(f"{where}: {said}. Copy it again from the camera.")
        buffer = np.empty(size, np.uint8)
        self.read_into(buffer, offset, where)
        return buffer.tobytes()

    def check_announced(self, camera: str, layout: "PixelLayout", n: int, present: int) -> None:
        """Raise RecordingError unless n > 0 and `present`, the number of frames in the file, is most of n."""
        if n < 1:
            raise RecordingError(f"{self} ({camera} camera): its header states no frame. Export it again.")
        if present < LEAST_PRESENT * n or present * layout.frame_bytes > self.size:
            each, total = in_words((layout.width, layout.height), layout.stored_bits), n * layout.frame_bytes
            said = f"the header states {n} frames, {each} ({total} bytes), but the file has {self.size}"
            remedy = "It is cut short, or the header is of another file: copy both again."
            raise RecordingError(f"{self} ({camera} camera): {said}. {remedy}")


@dataclass(frozen=True)
class PixelLayout:
    """Layout of the pixels of one frame in the file."""

    width: int  # [px]
    height: int
    dtype: np.dtype  # of a pixel in the file, with its byte order; for packed pixels, of the unpacked ones
    packed_bits: int = 0  # bits per pixel, 10 or 12, if packed, most significant bit first; otherwise 0
    padding: int = 0  # bytes after each row; packed rows have none
    bottom_up: bool = False
    table: NDArray[np.uint16] | None = None  # grey value of each stored value

    @property
    def stored_bits(self) -> int:
        """Bits of a pixel in the file."""
        return self.packed_bits or 8 * self.dtype.itemsize

    @property
    def frame_bytes(self) -> int:
        """Bytes of one frame in the file."""
        return self.width * self.height * self.stored_bits // 8 + self.padding * self.height

    @property
    def is_plain(self) -> bool:
        """True if the bytes of the file are the image, except for the byte order."""
        return not (self.packed_bits or self.padding or self.bottom_up) and self.table is None

    def count_whole(self, offsets: NDArray[np.integer], ends: NDArray[np.integer] | int) -> int:
        """Number of frames at offsets (n,) that are completely within their files."""
        return int(np.sum((offsets >= 0) & (offsets <= np.subtract(ends, self.frame_bytes))))

    def decode(self, stored: NDArray[np.uint8], out: Image) -> None:
        """Bytes of one frame (frame_bytes,) into pixels (height, width), contiguous, native uint8 or uint16."""
        if self.packed_bits:
            unpack[self.packed_bits](stored, out.reshape(-1))
        else:
            rows = stored.reshape(self.height, -1)[:, : self.width * self.dtype.itemsize].view(self.dtype)
            out[...] = rows[::-1] if self.bottom_up else rows
        if self.table is not None:
            np.take(self.table, out, out=out, mode="clip")


def raw_frames(
    files: Sequence[RawFile], offsets: AnyArray, layout: PixelLayout, notes: tuple[str, ...] = (), **others: Any
) -> FrameReader:
    """Frames of equal size at known offsets in one or several files.

    Frame i begins at byte offsets[i] of files[i]; it is lost if that is negative, or if the file ends within the frame.
    others : fields of the reader
    """
    n, image_size, dtype = len(offsets), (layout.width, layout.height), layout.dtype.newbyteorder("=")
    if lost := n - layout.count_whole(offsets, np.array([file.size for file in files])):
        notes = (*notes, f"{files[0]}: lacks {lost} of {n} frames; they are left without an answer")

    def filled(index: int, where: str, buffer: NDArray[np.uint8] | None = None) -> NDArray[np.uint8]:
        if offsets[index] < 0:
            raise RecordingError(f"{where}: there is no image of the right size where the file says. Copy it again.")
        buffer = np.empty(layout.frame_bytes, np.uint8) if buffer is None else buffer
        files[index].read_into(buffer, int(offsets[index]), where)
        return buffer

    def decoded(index: int, out: Image | None, where: str) -> Image:
        image = room_for(out, image_size, dtype)
        if not layout.is_plain:
            layout.decode(filled(index, where), image)
            return image
        filled(index, where, image.reshape(-1).view(np.uint8))
        return image if layout.dtype.isnative else image.byteswap(inplace=True)

    return FrameReader(
        files=files,
        image_size=image_size,
        dtype=dtype,
        decoded=decoded,
        stored=lambda index: filled(index, "").data,
        coding=f"{layout.stored_bits} {layout.dtype.str} {layout.bottom_up} {layout.table is not None}",
        notes=notes,
        **others,
    )


def bit_depth_of(stored_bits: int, effective_bits: int) -> int:
    """Significant bits of grey values: as stated by the header if that is possible, otherwise all stored bits."""
    return effective_bits if 8 < effective_bits <= stored_bits else stored_bits


def check_frame_size(width: int, height: int, where: str, bits: int = 8, n_bytes: int | None = None) -> None:
    """Raise RecordingError, beginning with `where`, unless the image size in a header is possible.

    bits    : of a pixel in the file; those of a frame must fill whole bytes
    n_bytes : size of a compressed image, which limits its number of pixels
    """
    # above the largest compression ratio, that of a black image (deflate: 1032); small images are always accepted
    most = MOST_PIXELS if n_bytes is None else min(MOST_PIXELS, max(1 << 22, 1500 * n_bytes))
    if width <= 0 or height <= 0 or width * height > most:
        said = f"claims images of {width} x {height} px, which no camera of this kind has, or the file cannot hold"
        raise RecordingError(f"{where}: the header {said}: damaged, or of another format. Copy or export it again.")
    if width * height * bits % 8:
        said = in_words((width, height), bits)
        raise RecordingError(f"{where}: {said} do not fill whole bytes. Save them with 16 bit.")
