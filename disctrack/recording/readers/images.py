"""Image sequences: one PNG, TIFF, BMP or JPEG file per frame."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.kit.arrays import Image
from calibration.kit.grey_levels import full_scale, level_step
from disctrack.errors import RecordingError
from disctrack.files.inputs import MOST_IMAGE, read_regular
from disctrack.recording.readers.base import FrameReader, Frames, first_readable
from disctrack.recording.readers.decoding import as_grey, decode
from disctrack.recording.readers.file_numbers import NumberedFiles, check_continuation, number_files
from disctrack.recording.readers.tiff import is_stack, open_stack


def open_images(files: Sequence[Path], camera: str, pattern: str = "") -> FrameReader:
    """One file per frame, or TIFF files of many pages each. Raises RecordingError if no frame can be read.

    pattern : tells by {number} which digits of the names count the frames; "" where the names alone must
    """
    if files[0].suffix.lower() in (".tif", ".tiff") and (is_stack(files[0]) or is_stack(files[-1])):
        check_continuation(files, camera)
        return open_stack(files, camera)
    return open_image_sequence(number_files(files, camera, pattern), camera)


def open_image_sequence(numbered: NumberedFiles, camera: str) -> ImageSequence:
    """Sequence of numbered files; a missing number among them is a frame that cannot be read.

    Size and depth are those of the first frame that can be read. Raises RecordingError if there is none.
    """
    files = [file for file in numbered.slots if file is not None]

    def decoded(index: int) -> tuple[NDArray, Image]:
        file = files[index]
        try:
            stored = decode(read_regular(file, MOST_IMAGE), str(file))
        except OSError as error:
            raise RecordingError(str(error)) from error
        return stored, as_grey(stored, str(file))

    stored, first = first_readable(len(files), camera, decoded)
    notes = [f"{camera} camera: {note}" for note in (*numbered.notes, *_depth_notes(stored, first))]
    size = first.shape[1], first.shape[0]
    return ImageSequence(numbered, camera, size, first.dtype, tuple(notes))


def _depth_notes(stored: NDArray, grey: Image) -> list[str]:
    notes = []
    if stored.ndim == 3:
        notes.append(f"images are stored with {stored.shape[2]} channels of equal value; one is used, without loss")
    if grey.dtype == np.uint16:
        step, top = level_step(grey), full_scale(grey)
        used = f"{(top // step).bit_length()} of them in use, in steps of {step}; first frame: up to {grey.max()}"
        notes.append(f"images have 16 bits per pixel ({used}); used as they are")
    return notes


class ImageSequence(Frames):
    """One file per frame; see FrameReader. Files are opened when a frame is read, and never written."""

    def __init__(
        self,
        numbered: NumberedFiles,
        camera: str,
        image_size: tuple[int, int],
        dtype: np.dtype,
        notes: tuple[str, ...] = (),
    ) -> None:
        self.numbered = numbered
        self.files = list(numbered.slots)
        self.doubts = tuple(f"{camera} camera: {doubt}" for doubt in numbered.doubts)
        self.camera = camera
        self.image_size = image_size
        self.dtype = dtype
        self.bit_depth = dtype.itemsize * 8
        self.notes = notes
        self._digests: list[bytes | None] = [None] * len(self.files)

    def __len__(self) -> int:
        return len(self.files)

    def describe(self, index: int) -> str:
        """The file's name, or that there is none."""
        file = self.files[index]
        return f"missing file of {self.camera} frame {index}" if file is None else str(file)

    _place = describe

    def _decoded(self, index: int, out: Image | None, where: str) -> Image:
        content = self._content(index, where)
        self._digests[index] = hashlib.sha256(content).digest()
        return as_grey(decode(content, where, out), where)

    def _content(self, index: int, where: str) -> bytes:
        file = self.files[index]
        if file is None:
            raise RecordingError(f"{where}: there is no file with this number. Copy it again from the camera.")
        try:
            return read_regular(file, MOST_IMAGE)
        except OSError as error:
            raise RecordingError(f"{where}: cannot be read: {error.strerror}. Copy it again.") from error

    def content_sha256(self, start: int, stop: int) -> str:
        """SHA-256 of the files of frames start..stop-1; those already read are not read again."""
        total = hashlib.sha256()
        for index in range(start, stop):
            digest = self._digests[index]
            if digest is None:
                try:
                    digest = hashlib.sha256(self._content(index, "")).digest()
                except RecordingError:
                    digest = b"unreadable"
            total.update(digest)
        return total.hexdigest()
