"""Dark and flat images of a camera: correction of the frames for offset and gain of each pixel.

    corrected = (frame - dark) m / (flat - dark),   m the median of flat - dark

so that the level of grey values does not change. Corrected frames have 16 bits for any camera: rounding to its grey
values would cause an equal error of a pixel in every frame, which is a fixed pattern again. Clipped pixels stay
clipped. A pixel with a response far below or above its neighbours' is dead, and gets the median of these.
"""

import glob
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from calibration.kit.stuck_pixels import MOST, repair
from calibration.kit.types import Array32, Image, Mask
from disctrack.errors import RecordingError
from disctrack.frames import CAMERAS
from disctrack.recording.readers import open_frames
from disctrack.recording.readers.base import FrameReader, changed, in_words
from disctrack.recording.readers.files import IMAGES, match_files, split_member

ODD = 0.5  # relative difference of a dead pixel's response from its neighbours'; gains differ by 0.05
LEAST_LIGHT = 0.1  # level of a flat over full scale; below, the errors of gains exceed their differences


@dataclass(frozen=True, eq=False)
class FlatField:
    """Correction of one camera's frames."""

    dark: Array32  # (height, width) [grey]
    gain: Array32  # (height, width) factor
    dead: Mask | None  # (height, width)
    bit_depth: int  # of the frames as the camera wrote them
    sha256: str  # (hex) of the dark and flat images
    notes: tuple[str, ...] = ()

    def fits(self, image: Image) -> bool:
        """True for a grey image of the camera's size and depth."""
        return image.shape == self.dark.shape and image.dtype == (np.uint8 if self.bit_depth == 8 else np.uint16)

    def corrected(self, image: Image) -> Image:
        """(height, width) uint16, full scale 65535, corrected for offsets and gains."""
        signal = cv2.subtract(image, self.dark, dtype=cv2.CV_32F)
        scale = 2.0 ** (16 - self.bit_depth)
        found: Image = np.asarray(cv2.multiply(signal, self.gain, scale=scale, dtype=cv2.CV_16U), np.uint16)
        found[image >= 2**self.bit_depth - 1] = np.iinfo(np.uint16).max
        if self.dead is not None:
            repair(found, self.dead)
        return found


FlatFields = tuple[FlatField | None, ...]  # of the left and of the right camera


def flat_fields(folder: Path, patterns: Sequence[tuple[str | None, str | None]]) -> FlatFields:
    """Corrections of the left and of the right camera, None if not declared. Raises RecordingError.

    patterns : flat and dark images of each camera, relative to `folder`: a file, a pattern, or a folder
    """
    return tuple(_flat_field(*images, folder, camera) for images, camera in zip(patterns, CAMERAS, strict=True))


def flat_fielded(readers: Sequence[FrameReader], fields: FlatFields) -> list[FrameReader]:
    """Both cameras' readers with corrected frames; if only one has a field, the other's are converted to 16 bits.

    Raises RecordingError if dark and flat images do not fit the frames.
    """
    if fields == (None, None):
        return list(readers)
    return [_corrected(reader, field) for reader, field in zip(readers, fields, strict=True)]


def _corrected(reader: FrameReader, field: FlatField | None) -> FrameReader:
    if field is None:
        zero = np.zeros(reader.image_size[::-1], np.float32)
        field = FlatField(zero, zero + 1, None, reader.bit_depth, "none")
    frames, images = in_words(reader.image_size, reader.bit_depth), in_words(field.dark.shape[::-1], field.bit_depth)
    if frames != images:
        said = f"{reader.camera} frames are {frames}, but [cameras] {reader.camera}_flat and _dark have {images}"
        remedy = "Take these with the settings of the recording, or leave them out."
        raise RecordingError(f"{reader.describe(0)}: {said}. {remedy}")
    notes = (*reader.notes, *field.notes)
    corrected = changed(reader, field.corrected, field.sha256)
    return replace(corrected, notes=notes, bit_depth=16, dtype=np.dtype(np.uint16))


def _readers(pattern: str | None, folder: Path, camera: str, kind: str) -> list[FrameReader]:
    """Readers of one file, or of each image in a folder or of a pattern; none if not declared."""
    if pattern is None:
        return []
    if (folder / pattern).is_dir():
        pattern = str(Path(pattern) / "*")
    files = match_files(split_member(pattern)[0], folder, f"{camera} camera's {kind}")
    if files[0].suffix.lower() in IMAGES:
        return [open_frames(glob.escape(file.name), file.parent, f"{camera}_{kind}") for file in files]
    return [open_frames(pattern, folder, f"{camera}_{kind}")]


def _flat_field(flat_images: str | None, dark_images: str | None, folder: Path, camera: str) -> FlatField | None:
    flats, darks = _readers(flat_images, folder, camera, "flat"), _readers(dark_images, folder, camera, "dark")
    if not flats + darks:
        return None
    first = (flats + darks)[0]
    for reader in flats + darks:
        found, expected = (in_words(one.image_size, one.bit_depth) for one in (reader, first))
        if found != expected:
            said = f"{reader.describe(0)} is {found}, but {first.describe(0)} is {expected}"
            raise RecordingError(f"[cameras] {reader.camera}: {said}. Take both with the settings of the recording.")
    offset = _mean(darks)[0] if darks else np.zeros(first.image_size[::-1], np.float32)
    gain, dead = np.ones_like(offset), np.zeros(offset.shape, bool)
    notes = []
    if flats:
        gain, dead = _gain(flats, darks, offset)
        n = sum(map(len, flats))
        averaged = f"{camera}_flat is the mean of {n} image{'s' * (n > 1)}"
        notes.append(f"[cameras] {averaged}, whose own noise becomes a pattern of the sensor: of ten it is small")
    if n := int(dead.sum()):
        notes.append(f"{camera} camera: {n} dead pixel{'s' * (n > 1)} by its flat image, replaced by their neighbours")
    digest = hashlib.sha256()
    for reader in flats + darks:
        digest.update(f"{reader.camera} {reader.content_sha256(0, len(reader))}".encode())
    return FlatField(offset, gain, dead if dead.any() else None, first.bit_depth, digest.hexdigest(), tuple(notes))


def _mean(readers: Sequence[FrameReader]) -> tuple[Array32, Mask]:
    """Mean of all frames, and the pixels that are clipped in more than 5 % of them."""
    total, n, full = np.zeros(readers[0].image_size[::-1]), sum(map(len, readers)), 2 ** readers[0].bit_depth - 1
    clipped = np.zeros(total.shape, np.int64)
    for image in (reader.read(index) for reader in readers for index in range(len(reader))):
        total += image
        clipped += image >= full
    return (total / n).astype(np.float32), clipped > 0.05 * n


def _gain(flats: Sequence[FrameReader], darks: Sequence[FrameReader], offset: Array32) -> tuple[Array32, Mask]:
    """Factors for the pixels' signals, and the dead pixels. Raises RecordingError."""
    flat, *dark = (f"{readers[0].describe(0)} ([cameras] {readers[0].camera})" for readers in (flats, darks) if readers)
    mean, clipped = _mean(flats)
    full, saturated = 2 ** flats[0].bit_depth, float(np.mean(clipped))
    response = mean - offset
    level, around = float(np.median(response)), cv2.medianBlur(response, 5)
    dead = np.asarray((np.abs(response - around) > ODD * around) | clipped | (response <= 0.1 * level))
    odd = f"{100 * dead.mean():.2g} % of its pixels hardly answer the light, or far more than their neighbours"
    refusals = (
        (saturated > MOST, f"{100 * saturated:.2g} % of its pixels are saturated. Take it at half of full scale."),
        (level <= 0, f"it is not brighter than {' '.join(dark) or 'black'}: are the two exchanged?"),
        (level < LEAST_LIGHT * full, f"a level of {level:.1f} of {full - 1} is too dark to tell gains; half is good."),
        (dead.mean() > MOST, f"{odd}. Take it out of focus, of an evenly lit white surface without an edge in view."),
    )
    for wrong, said in refusals:
        if wrong:
            raise RecordingError(f"{flat}: {said}")
    gain = np.where(dead, 1.0, level / np.where(dead, 1.0, response)).astype(np.float32)
    return gain, dead
