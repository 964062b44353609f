"""The interface of all readers, and which files they read."""

import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol, TypeVar, runtime_checkable

import numpy as np

from calibration.kit.arrays import Array, Image
from disctrack.errors import RecordingError

IMAGE_SUFFIXES = frozenset({".png", ".tif", ".tiff", ".bmp", ".jpg", ".jpeg"})
VIDEO_SUFFIXES = frozenset({".avi", ".mp4", ".mkv", ".mov"})
MRAW_SUFFIXES = frozenset({".cih", ".cihx", ".mraw"})  # Photron
CINE_SUFFIXES = frozenset({".cine", ".cin", ".cci"})  # Phantom
HDF5_SUFFIXES = frozenset({".h5", ".hdf5", ".hdf", ".he5"})
SUFFIXES = IMAGE_SUFFIXES | VIDEO_SUFFIXES | MRAW_SUFFIXES | CINE_SUFFIXES | HDF5_SUFFIXES
NUMBER = "{number}"  # in a pattern: these digits count the frames


@runtime_checkable
class FrameReader(Protocol):
    """Frames of one camera in order. Opening it reads no more than headers; frames are read when asked for.

    `read` raises disctrack.errors.RecordingError naming file, frame, what was found and what to do. It may be called
    from several threads at once.
    """

    image_size: tuple[int, int]  # width, height [px]
    bit_depth: int  # bits that carry grey values: 8 (uint8), or 9 to 16 (uint16)
    timestamps: Array | None  # (n,) [s] by the camera's clock, where the file has them
    frame_rate: float | None  # [Hz] where the file states the camera's own, not that of a player
    notes: tuple[str, ...]  # what the user should know about how the frames were read, one sentence each
    random_access: bool  # False where frames are read fastest in order, by one thread

    def __len__(self) -> int: ...

    def read(self, index: int, out: Image | None = None) -> Image:
        """Frame `index`, (height, width) grey values as the camera wrote them; into `out` if given, and returned."""
        ...

    def describe(self, index: int) -> str:
        """Where frame `index` lies, for messages: a file name, or a file name and an offset."""
        ...

    def content_sha256(self, start: int, stop: int) -> str:
        """SHA-256 (hex) of what frames start..stop-1 were made from; equal if and only if the input is the same."""
        ...


class Frames:
    """What readers have in common (see FrameReader); each says in which file a frame lies, and decodes it."""

    random_access = True
    timestamps: Array | None = None
    frame_rate: float | None = None
    camera: str
    image_size: tuple[int, int]
    dtype: np.dtype
    bit_depth: int

    def _place(self, index: int) -> str:
        raise NotImplementedError

    def _decoded(self, index: int, out: Image | None, where: str) -> Image:
        raise NotImplementedError  # in `out` or anywhere else; RecordingErrors begin with `where`

    def read(self, index: int, out: Image | None = None) -> Image:
        """Frame `index`, (height, width), into `out` if given. Raises RecordingError with file, camera and frame."""
        where = f"{self._place(index)} ({self.camera} camera, frame {index})"
        image = self._decoded(index, out, where)
        if image.shape[::-1] != self.image_size or image.dtype != self.dtype:
            width, height = self.image_size
            raise RecordingError(
                f"{where}: {image.shape[1]} x {image.shape[0]} px of {8 * image.itemsize} bit, but the first frame has "
                f"{width} x {height} px of {8 * self.dtype.itemsize} bit. Export it again."
            )
        if out is None or image is out:
            return image
        out[...] = image
        return out

    def _buffer(self, out: Image | None) -> Image:
        """`out` where a frame can be decoded straight into it; another array of a frame's size and type otherwise."""
        shape = self.image_size[::-1]
        if out is not None and out.shape == shape and out.dtype == self.dtype and out.flags.c_contiguous:
            return out
        return np.empty(shape, self.dtype)


class Changed:
    """Frames of another reader that are changed after they are read; in all else that reader."""

    def __init__(self, reader: FrameReader, by: str) -> None:
        """By : all that tells how they are changed, for the digest of the content."""
        self._reader, self._by = reader, by

    def __len__(self) -> int:
        return len(self._reader)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._reader, name)

    def content_sha256(self, start: int, stop: int) -> str:
        """Of the frames and of how they are changed."""
        return hashlib.sha256(f"{self._reader.content_sha256(start, stop)} {self._by}".encode()).hexdigest()


_T = TypeVar("_T")


def first_readable(n: int, camera: str, decoded: Callable[[int], _T]) -> _T:
    """What `decoded` gives of the first of n frames that it can decode. Raises RecordingError if there is none."""
    problem: RecordingError | None = None
    for index in range(n):
        try:
            return decoded(index)
        except RecordingError as error:
            problem = problem or error
    raise RecordingError(f"none of the {n} {camera} frames can be read; the first: {problem}")


def only_file(files: Sequence[Path], camera: str) -> Path:
    """The one file that a camera's pattern may match, where a file holds all its frames."""
    if len(files) != 1:
        raise RecordingError(f"{files[0]} and {len(files) - 1} more match for the {camera} camera; name one recording.")
    return files[0]


def split_member(pattern: str) -> tuple[str, str]:
    """Pattern of the files and what else a pattern says, "" for most.

    "frames.h5:/left" is ("frames.h5", "/left"), "a/{number}.png" is ("a/*.png", "a/{number}.png").
    """
    if NUMBER in pattern:
        return pattern.replace(NUMBER, "*"), pattern
    file, colon, member = pattern.rpartition(":")
    if colon and Path(file).suffix.lower() in HDF5_SUFFIXES:
        return file, member
    return pattern, ""
