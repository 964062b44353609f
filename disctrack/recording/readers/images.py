"""Image sequences: one PNG, TIFF, BMP or JPEG file per frame."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.kit.arrays import Image
from calibration.kit.grey_levels import full_scale, level_step
from disctrack.errors import RecordingError
from disctrack.recording.readers.base import FrameReader, first_readable
from disctrack.recording.readers.decoding import as_grey, decode
from disctrack.recording.readers.file_numbers import check_continuation, number_files
from disctrack.recording.readers.files import content_of
from disctrack.recording.readers.tiff import is_stack, open_stack


def open_images(files: Sequence[Path], camera: str, pattern: str = "") -> FrameReader:
    """One file per frame, or TIFF files of many pages each. Raises RecordingError if no frame can be read.

    A missing number among the files is a frame that cannot be read. Size and depth are those of the first frame that
    can be read.
    pattern : tells by {number} which digits of the names count the frames; "" where the names alone must
    """
    if files[0].suffix.lower() in (".tif", ".tiff") and (is_stack(files[0]) or is_stack(files[-1])):
        check_continuation(files, camera)
        return open_stack(files, camera)
    slots, numbers, notes, doubts = number_files(files, camera, pattern)

    def decoded(index: int) -> tuple[NDArray, Image]:
        name = str(files[index])
        stored = decode(content_of(files[index], name), name)
        return stored, as_grey(stored, name)

    stored, first = first_readable(len(files), camera, decoded)
    return ImageSequence(
        camera=camera,
        files=[file or f"missing file of {camera} frame {index}" for index, file in enumerate(slots)],
        numbers=numbers,
        image_size=(first.shape[1], first.shape[0]),
        dtype=first.dtype,
        notes=(*notes, *_depth_notes(stored, first)),
        doubts=doubts,
    )


def _depth_notes(stored: NDArray, grey: Image) -> list[str]:
    notes = []
    if stored.ndim == 3:
        notes.append(f"images are stored with {stored.shape[2]} channels of equal value; one is used, without loss")
    if grey.dtype == np.uint16:
        step, top = level_step(grey), full_scale(grey)
        used = f"{(top // step).bit_length()} of them in use, in steps of {step}; first frame: up to {grey.max()}"
        notes.append(f"images have 16 bits per pixel ({used}); used as they are")
    return notes


@dataclass(eq=False, kw_only=True)
class ImageSequence(FrameReader):
    """One file per frame. Files are opened when a frame is read, and never written."""

    files: Sequence[Path | str]  # words where a number is missing

    def describe(self, index: int) -> str:
        """The file's name."""
        return str(self.files[index])

    def _decoded(self, index: int, out: Image | None, where: str) -> Image:
        content = self._stored(index, where)
        self._digests[index] = hashlib.sha256(content).digest()
        return as_grey(decode(content, where, out), where)

    def _stored(self, index: int, where: str = "") -> bytes:
        file = self.files[index]
        if isinstance(file, str):
            raise RecordingError(f"{where}: there is no file with this number. Copy it again from the camera.")
        return content_of(file, where)
