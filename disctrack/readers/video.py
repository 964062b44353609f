"""One camera's frames in a video file (AVI, MP4, MKV), read through PyAV; needs the extra `disctrack[video]`."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from disctrack.errors import RecordingError
from disctrack.readers import Frame
from disctrack.readers.images import as_grey


def open_video(files: Sequence[Path], camera: str) -> VideoFile:
    """Reader of one video. Raises RecordingError if PyAV is not installed or the file is no video."""
    if len(files) != 1:
        raise RecordingError(f"{files[0]} and {len(files) - 1} more match for the {camera} camera; name one video.")
    return VideoFile(files[0], camera)


class VideoFile:
    """Frames of a video in order of presentation; see FrameReader. Best read forwards, by one thread.

    Grey values are the luma plane as it is stored, not stretched from limited to full range.
    """

    timestamps: NDArray[np.float64] | None = None  # a player's clock, not the camera's
    frame_rate: float | None = None
    random_access = False

    def __init__(self, file: Path, camera: str) -> None:
        self.file, self.camera = file, camera
        self._lock = threading.Lock()
        self._next = 0
        self._frames: Iterator[Any] = iter(())
        self._length = self._count_packets()
        if self._length == 0:
            raise RecordingError(f"{file}: a video without frames. Export it again.")
        first = self._decoded(0, self.describe(0))
        self.image_size = first.shape[1], first.shape[0]
        self.bit_depth = 8 * first.itemsize
        self.notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return self._length

    def describe(self, index: int) -> str:
        """File and frame."""
        return f"{self.file}, frame {index}"

    def read(self, index: int, out: Frame | None = None) -> Frame:
        """Frame `index`, (height, width); decoding starts again from the beginning when going back."""
        where = f"{self.file} ({self.camera} camera, frame {index})"
        with self._lock:
            image = self._decoded(index, where)
        if image.shape[::-1] != self.image_size:
            raise RecordingError(f"{where}: the size changes to {image.shape[1]} x {image.shape[0]} px.")
        if out is None:
            return image
        out[...] = image
        return out

    def content_sha256(self, start: int, stop: int) -> str:
        """SHA-256 of the file and the range: compressed frames cannot be told apart without decoding them."""
        with self.file.open("rb") as stream:
            digest = hashlib.file_digest(stream, "sha256")
        digest.update(f"{start}:{stop}".encode())
        return digest.hexdigest()

    def _open(self) -> Any:
        try:
            import av
        except ImportError as error:
            raise RecordingError(f"{self.file}: videos need PyAV. Install it: pip install disctrack[video]") from error
        try:
            container = av.open(str(self.file))
            container.streams.video[0].thread_type = "NONE"  # the other camera's file is decoded beside this one
            return container
        except (av.FFmpegError, IndexError, OSError, ValueError) as error:
            raise RecordingError(
                f"{self.file}: not a readable video for the {self.camera} camera ({error})."
            ) from error

    def _count_packets(self) -> int:
        with self._open() as container:
            try:
                return sum(packet.size > 0 for packet in container.demux(container.streams.video[0]))
            except OSError as error:  # every error of FFmpeg is one, too
                raise RecordingError(f"{self.file}: damaged video ({error}). Copy it again.") from error

    def _decoded(self, index: int, where: str) -> Frame:
        if index < self._next or self._next == 0:
            self._frames, self._next = self._decode_from_start(), 0
        try:
            for frame in self._frames:
                self._next += 1
                if self._next > index:
                    return _luma(frame, where)
        except (OSError, ValueError) as error:
            self._next = 0
            raise RecordingError(f"{where}: cannot be decoded ({error}). Copy or export the video again.") from error
        self._next = 0
        raise RecordingError(f"{where}: the video ends before this frame. Copy or export it again.")

    def _decode_from_start(self) -> Iterator[Any]:
        with self._open() as container:
            yield from container.decode(container.streams.video[0])


def _luma(frame: Any, where: str) -> Frame:
    """Grey values (h, w) of a decoded frame without conversion."""
    if frame.format.name.startswith(("gray", "yuv", "nv12", "nv21")) and frame.format.components[0].bits == 8:
        plane = frame.planes[0]
        rows = np.frombuffer(plane, np.uint8)[: plane.line_size * frame.height].reshape(frame.height, plane.line_size)
        return rows[:, : frame.width].copy()
    if frame.format.name.startswith("gray16"):
        return np.asarray(frame.to_ndarray(format="gray16le"), np.uint16)
    if frame.format.name in ("rgb24", "bgr24", "bgr0", "rgba", "bgra", "argb", "gbrp", "pal8"):
        return as_grey(np.asarray(frame.to_ndarray(format="rgb24")), where)
    raise RecordingError(f"{where}: pixel format {frame.format.name} is not read. Export as grey 8 bit.")
