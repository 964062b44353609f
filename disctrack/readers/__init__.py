"""Frames of one camera, whatever file they lie in: one small module per format, one interface."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Protocol, runtime_checkable

from calibration.arrays import Array, Image
from disctrack.errors import RecordingError

IMAGE_SUFFIXES = frozenset({".png", ".tif", ".tiff", ".bmp", ".jpg", ".jpeg"})
VIDEO_SUFFIXES = frozenset({".avi", ".mp4", ".mkv", ".mov"})
MRAW_SUFFIXES = frozenset({".cih", ".cihx", ".mraw"})  # Photron
CINE_SUFFIXES = frozenset({".cine", ".cin", ".cci"})  # Phantom
HDF5_SUFFIXES = frozenset({".h5", ".hdf5", ".hdf", ".he5"})

# Suffixes of a format, the module that reads it, and its function (files, camera) -> FrameReader.
FORMATS: tuple[tuple[frozenset[str], str, str], ...] = (
    (IMAGE_SUFFIXES, "images", "open_images"),
    (VIDEO_SUFFIXES, "video", "open_video"),
    (MRAW_SUFFIXES, "mraw", "open_mraw"),
    (CINE_SUFFIXES, "cine", "open_cine"),
    (HDF5_SUFFIXES, "hdf5", "open_hdf5"),
)
NUMBER = "{number}"  # in a pattern: these digits count the frames
SUFFIXES = frozenset[str]().union(*(suffixes for suffixes, _, _ in FORMATS))


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


def open_frames(pattern: str, folder: Path, camera: str) -> FrameReader:
    """Reader of one camera's frames: a file pattern, relative to `folder`.

    pattern : "left/*.png", "left.mkv", "stack.tif", or "frames.h5:/left" for a data set in an HDF5 file;
        "left/*_{number}_a.png" where the names alone do not tell which digits count the frames
    camera  : "left" or "right", for messages
    Raises RecordingError if nothing matches, or if no frame can be read.
    """
    from disctrack.readers.files import match_files

    pattern, member = split_member(pattern)
    files = match_files(pattern, folder, camera)
    suffix = files[0].suffix.lower()
    module, function = next((module, function) for suffixes, module, function in FORMATS if suffix in suffixes)
    if NUMBER in member and suffix not in IMAGE_SUFFIXES:
        raise RecordingError(f"{files[0]}: {NUMBER} in a pattern numbers images of a file each; leave it out here.")
    opener = getattr(import_module(f"disctrack.readers.{module}"), function)
    reader: FrameReader = opener(files, camera, member) if member else opener(files, camera)
    return reader


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
