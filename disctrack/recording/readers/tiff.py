"""TIFF files of many pages: one file per camera, or several that continue one another.

Pages without compression are read at the speed of memory.
"""

import hashlib
import json
import math
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import islice
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from calibration.kit.arrays import Array, Image
from disctrack.errors import RecordingError
from disctrack.recording.readers.base import FrameReader, Frames, first_readable
from disctrack.recording.readers.decoding import as_grey
from disctrack.recording.readers.raw import RawFile, RawFrames, check_frame_size
from disctrack.recording.readers.tiff_pages import Page, page_pixels, pages_of


def is_stack(file: Path) -> bool:
    """True for a TIFF file that holds more than one frame; False also for what is no TIFF file at all."""
    found = 0
    try:
        for page in islice(pages_of(RawFile(file)), 2):
            found += max(_pages_announced(page.description), 1)
    except RecordingError:
        return found > 0  # cut short after the first page
    return found > 1


def open_stack(files: Sequence[Path], camera: str) -> FrameReader:
    """Frames of all pages of the files, in order. Raises RecordingError if no page can be read.

    The frame rate is taken from the notes of ImageJ or OME in the first page, time stamps from those of OME.
    """
    raw_files = [RawFile(file) for file in files]
    pages, notes = [], []
    for number, file in enumerate(raw_files):
        found, note = _pages(file)
        pages += [(number, page) for page in found]
        notes += [f"{camera} camera: {note}"] if note else []
    if not pages:
        raise RecordingError(f"{files[0]}: a TIFF file without a page that can be read. Export it again.")
    first = pages[0][1]
    rate, stamps = _times(first.description, len(pages))
    check_frame_size(first.width, first.height, str(files[0]))
    offsets = np.array([page.plain_offset for _, page in pages], np.int64)
    if (offsets >= 0).all() and all(page.layout == first.layout for _, page in pages):
        return RawFrames(
            raw_files,
            np.array([number for number, _ in pages]),
            offsets,
            (first.width, first.height),
            first.dtype,
            camera,
            notes=tuple(notes),
            timestamps=stamps,
            frame_rate=rate,
        )
    return TiffPages(raw_files, pages, camera, tuple(notes), stamps, rate)


class TiffPages(Frames):
    """Pages that are compressed, or otherwise not plain; see FrameReader."""

    def __init__(
        self,
        files: Sequence[RawFile],
        pages: Sequence[tuple[int, Page]],
        camera: str,
        notes: tuple[str, ...],
        timestamps: Array | None,
        frame_rate: float | None,
    ) -> None:
        """Frames from pages, each with the number of its file."""
        self._files, self._pages, self.camera = list(files), list(pages), camera
        self.timestamps, self.frame_rate, self.notes = timestamps, frame_rate, notes
        first = first_readable(len(pages), camera, lambda index: self._decoded(index, None, self._place(index)))
        self.image_size, self.dtype = first.shape[::-1], first.dtype
        self.bit_depth = 8 * first.itemsize

    def __len__(self) -> int:
        return len(self._pages)

    def describe(self, index: int) -> str:
        """File and page."""
        return f"{self._place(index)}, frame {index} (directory at byte {self._pages[index][1].directory})"

    def content_sha256(self, start: int, stop: int) -> str:
        """SHA-256 of the pages of frames start..stop-1, as they are stored."""
        total = hashlib.sha256()
        for number, page in self._pages[start:stop]:
            total.update(hashlib.sha256(page.layout.encode()).digest())
            for place, size in zip(page.places, page.sizes, strict=True):
                self._files[number].update_digest(total, place, size)
        return total.hexdigest()

    def _place(self, index: int) -> str:
        return str(self._files[self._pages[index][0]].path)

    def _decoded(self, index: int, out: Image | None, where: str) -> Image:
        number, page = self._pages[index]
        return as_grey(page_pixels(self._files[number], page, where), where)


def _pages(file: RawFile) -> tuple[list[Page], str | None]:
    """Frames of one file, and a note where the chain of directories breaks off."""
    pages: list[Page] = []
    note = None
    try:
        for page in pages_of(file):
            pages.append(page)
    except RecordingError as error:
        if not pages:
            raise
        note = f"only {len(pages)} pages are whole ({error})"
    if len(pages) == 1:
        pages = _without_directories(file, pages[0])
    return pages, note


def _without_directories(file: RawFile, first: Page) -> list[Page]:
    """All frames of a file with one directory, as ImageJ writes stacks: the others follow the first without a gap."""
    n, size = _pages_announced(first.description), first.width * first.height * first.dtype.itemsize
    if n < 2 or size == 0:
        return [first]
    if first.plain_offset < 0:
        raise RecordingError(
            f"{file.path}: announces {n} frames in one directory, whose pixels are not plain (white is zero, rows "
            "from another corner, compressed, or no grey values of 8 or 16 bit). Export it again, black as zero."
        )
    most = max(1, -(-file.size // size))  # of a file cut short the frames that begin in it; the next is the end
    start = first.plain_offset
    return [replace(first, places=(start + i * size,), sizes=(size,)) for i in range(min(n, most))]


def _pages_announced(description: str) -> int:
    """Frames behind one directory by ImageJ's note, or by that of tifffile where it left out the others."""
    if description.startswith("ImageJ="):
        found = re.search(r"^images=([0-9]{1,12})\s*$", description, re.MULTILINE)
        return int(found.group(1)) if found else 0
    if description.startswith("{") and '"truncated"' in description:
        with suppress(ValueError, TypeError, KeyError, OverflowError, RecursionError):  # no note of that kind
            *several, _, _ = json.loads(description)["shape"]
            return math.prod(map(int, several))
    return 0


_TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "\u00b5s": 1e-6, "\u03bcs": 1e-6, "ns": 1e-9, "min": 60.0}


def _times(description: str, n: int) -> tuple[float | None, Array | None]:
    """Frame rate [Hz] and time stamps [s] by ImageJ's or OME's notes, None where they say nothing."""
    if description.startswith("ImageJ="):
        for key, invert in (("finterval", True), ("fps", False)):
            found = re.search(rf"^{key}=(\S+)\s*$", description, re.MULTILINE)
            value = _positive(found.group(1)) if found else None
            if value is not None:
                return (1.0 / value if invert else value), None
    if "<OME" in description[:1000]:
        return _ome_times(description, n)
    return None, None


def _ome_times(description: str, n: int) -> tuple[float | None, Array | None]:
    """OME schema 2016-06: Pixels/@TimeIncrement, Pixels/Plane/@DeltaT, each with its unit (default s)."""
    try:
        root = ElementTree.fromstring(description)
    except (ElementTree.ParseError, ValueError):
        return None, None
    pixels = next((item for item in root.iter() if item.tag.endswith("Pixels")), None)
    if pixels is None:
        return None, None
    increment = _positive(pixels.get("TimeIncrement", ""))
    unit = _TIME_UNITS.get(pixels.get("TimeIncrementUnit", "s"))
    stamps = []
    for plane in (item for item in pixels if item.tag.endswith("Plane")):
        seconds, scale = _finite(plane.get("DeltaT", "")), _TIME_UNITS.get(plane.get("DeltaTUnit", "s"))
        if seconds is not None and scale is not None:
            stamps.append(seconds * scale)
    rate = 1.0 / (increment * unit) if increment and unit else None
    return rate, np.array(stamps) if len(stamps) == n else None


def _finite(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def _positive(text: str) -> float | None:
    value = _finite(text)
    return value if value is not None and value > 0 and math.isfinite(1.0 / value) else None
