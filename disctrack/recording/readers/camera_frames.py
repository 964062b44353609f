"""Frames in a camera's own file, whose header says how the pixels lie: packed, upside down, coded by a table."""

import hashlib
import threading
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.kit.arrays import Array, Image
from disctrack.errors import RecordingError
from disctrack.recording.readers._unpack_kernels import look_up, unpack_10, unpack_12
from disctrack.recording.readers.camera_header import CameraHeader
from disctrack.recording.readers.raw import RawFile, RawFrames

# A file that was cut short is worth measuring while most of it is there; a header that promises far more than the file
# holds is not believed: all that follows is sized by it.
LEAST_PRESENT = 0.5
PIXELS_PER_GROUP = {8: 1, 10: 4, 12: 2, 16: 1}  # the fewest that fill whole bytes


@dataclass(frozen=True)
class PixelLayout:
    """How the pixels of one frame lie in the file."""

    width: int  # [px]
    height: int
    stored_bits: int  # per pixel: 8, 16 (little-endian), 10 or 12 (packed, most significant bit first)
    bit_depth: int  # bits that carry grey values
    padding: int = 0  # bytes after each row; packed rows have none
    bottom_up: bool = False
    table: NDArray[np.uint16] | None = None  # (2**stored_bits,) grey value of each stored one

    @property
    def frame_bytes(self) -> int:
        """Bytes of one frame."""
        return self.width * self.height * self.stored_bits // 8 + self.padding * self.height

    @property
    def dtype(self) -> np.dtype:
        """Type of one pixel in the file, or of what packed ones become."""
        return np.dtype("u1" if self.stored_bits == 8 else "<u2")

    @property
    def is_plain(self) -> bool:
        """True where the bytes of the file are the image."""
        return self.stored_bits in (8, 16) and not (self.padding or self.bottom_up) and self.table is None

    def decode(self, stored: NDArray[np.uint8], out: Image) -> None:
        """Bytes of one frame (frame_bytes,) into pixels (height, width), contiguous, native uint8 or uint16."""
        if self.stored_bits in (10, 12):
            (unpack_10 if self.stored_bits == 10 else unpack_12)(stored, out.reshape(-1))
        else:
            rows = stored.reshape(self.height, -1)[:, : self.width * self.dtype.itemsize].view(self.dtype)
            out[...] = rows[::-1] if self.bottom_up else rows
        if self.table is not None:
            look_up(self.table, out.reshape(-1))


class CameraFrames(RawFrames):
    """Frames at given places of one file, with the camera's header; see FrameReader."""

    def __init__(
        self,
        file: RawFile,
        camera: str,
        layout: PixelLayout,
        offsets: NDArray[np.int64],
        header: CameraHeader,
        notes: tuple[str, ...] = (),
        timestamps: Array | None = None,
        doubts: tuple[str, ...] = (),
    ) -> None:
        """Frames whose pixels begin at offsets (n,), below 0 where the file holds none; beyond its end they are lost.

        What n is must have passed `check_present`.
        """
        lost = len(offsets) - count_present(file, layout, offsets)
        cut = (f"{file.path}: lacks {lost} of {len(offsets)} frames; they are left without an answer",)
        super().__init__(
            [file],
            np.broadcast_to(np.uint8(0), len(offsets)),
            offsets,
            (layout.width, layout.height),
            layout.dtype,
            camera,
            bit_depth=layout.bit_depth,
            notes=tuple(f"{camera} camera: {note}" for note in (*notes, *(cut if lost else ()))),
            timestamps=timestamps,
            frame_rate=header.frame_rate,
        )
        self.layout, self.header = layout, header
        self.doubts = tuple(f"{camera} camera: {doubt}" for doubt in doubts)
        self.frame_bytes = layout.frame_bytes
        self._scratch = threading.local()

    def _decoded(self, index: int, out: Image | None, where: str) -> Image:
        if self.offsets[index] < 0:
            raise RecordingError(f"{where}: there is no image of the right size where the file says. Copy it again.")
        if self.layout.is_plain:
            return super()._decoded(index, out, where)
        stored = getattr(self._scratch, "stored", None)
        if stored is None:
            stored = self._scratch.stored = np.empty(self.frame_bytes, np.uint8)
        self.files[0].read_into(stored, int(self.offsets[index]), where)
        image = self._buffer(out)
        self.layout.decode(stored, image)
        return image

    def content_sha256(self, start: int, stop: int) -> str:
        """SHA-256 of how the pixels lie and of the bytes of frames start..stop-1."""
        layout = f"{self.layout.stored_bits} {self.layout.bottom_up} {self.layout.table is not None}"
        return hashlib.sha256(f"{layout} {super().content_sha256(start, stop)}".encode()).hexdigest()


def count_present(file: RawFile, layout: PixelLayout, offsets: NDArray[np.int64]) -> int:
    """How many of the frames at offsets (n,) lie wholly within the file."""
    return int(np.sum((offsets >= 0) & (offsets <= file.size - layout.frame_bytes)))


def check_present(file: RawFile, camera: str, layout: PixelLayout, n: int, present: int) -> None:
    """Raise RecordingError unless there are frames, and `present` of the n promised, most of them, are in the file."""
    if n < 1:
        raise RecordingError(f"{file.path} ({camera} camera): its header tells of no frame. Export it again.")
    if present < LEAST_PRESENT * n or present * layout.frame_bytes > file.size:
        raise RecordingError(
            f"{file.path} ({camera} camera): the header tells of {n} frames of {layout.width} x {layout.height} px, "
            f"{layout.stored_bits} bit, which need {n * layout.frame_bytes} bytes, but the file has {file.size}: it is "
            "cut short, or the header is of another file. Copy both again."
        )


def bit_depth_of(stored_bits: int, effective_bits: int) -> int:
    """Bits that carry grey values: as the header says where that is possible, else as stored."""
    return effective_bits if 8 < effective_bits <= stored_bits else stored_bits
