"""TIFF files of many pages: one file per camera, or several that continue one another.

Pages without compression are read at the speed of memory, grey strips by LZW or deflate are decoded here; any other
page goes to libtiff as a file of its own, made of the page's directory and its compressed bytes.
"""

import hashlib
import json
import math
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from calibration.kit.arrays import Array, Image
from disctrack.errors import RecordingError
from disctrack.recording.readers.base import FrameReader, Frames, first_readable
from disctrack.recording.readers.decoding import as_grey, page_of_tiff
from disctrack.recording.readers.raw import RawFile, RawFrames, check_frame_size
from disctrack.recording.readers.tiff_directories import Code, Tag, Tiff, assembled, chain

_REDUCED_IMAGE = 1  # bit of tag 254: a thumbnail of another page


def is_stack(file: Path) -> bool:
    """True for a TIFF file that holds more than one frame; False also for what is no TIFF file at all."""
    try:
        tiff = Tiff(RawFile(file))
        first, following = tiff.directory(tiff.first)
        if not following:
            return _pages_announced(tiff.description(first)) > 1
    except RecordingError:
        return False
    try:  # a thumbnail may follow, which is no frame
        return any(not tiff.value(tags, Code.SUBFILE, 0) & _REDUCED_IMAGE for _, tags in islice(chain(tiff), 1, None))
    except RecordingError:
        return True  # cut short after the first page


def open_stack(files: Sequence[Path], camera: str) -> FrameReader:
    """Frames of all pages of the files, in order. Raises RecordingError if no page can be read.

    The frame rate is taken from the notes of ImageJ or OME in the first page, time stamps from those of OME.
    """
    raw_files = [RawFile(file) for file in files]
    tiffs = [Tiff(file) for file in raw_files]
    pages, notes = [], []
    for number, tiff in enumerate(tiffs):
        found, note = _pages(tiff, number)
        pages += found
        notes += [f"{camera} camera: {note}"] if note else []
    if not pages:
        raise RecordingError(f"{files[0]}: a TIFF file without a page that can be read. Export it again.")
    rate, stamps = _times(tiffs[0].description(tiffs[0].directory(tiffs[0].first)[0]), len(pages))
    first = pages[0]
    check_frame_size(first.width, first.height, str(files[0]))
    if all(page.raw_offset >= 0 and page.layout == first.layout for page in pages):
        return RawFrames(
            raw_files,
            np.array([page.file for page in pages]),
            np.array([page.raw_offset for page in pages], np.int64),
            (first.width, first.height),
            np.dtype(f"{tiffs[0].order}u{first.bits // 8}"),
            camera,
            notes=tuple(notes),
            timestamps=stamps,
            frame_rate=rate,
        )
    return TiffPages(tiffs, pages, camera, tuple(notes), stamps, rate)


@dataclass(frozen=True)
class _Page:
    """One frame: where its directory and, if it is stored plainly, its pixels lie."""

    file: int
    directory: int  # byte offset
    width: int
    height: int
    bits: int
    order: str  # "<" or ">"
    raw_offset: int  # -1: compressed, tiled, colour, or in pieces

    @property
    def layout(self) -> tuple[int, int, int, str]:
        return self.width, self.height, self.bits, self.order


class TiffPages(Frames):
    """Pages that are compressed, or otherwise not plain; see FrameReader."""

    def __init__(
        self,
        tiffs: Sequence[Tiff],
        pages: Sequence[_Page],
        camera: str,
        notes: tuple[str, ...],
        timestamps: Array | None,
        frame_rate: float | None,
    ) -> None:
        self._tiffs, self._pages, self.camera = list(tiffs), list(pages), camera
        self.timestamps, self.frame_rate, self.notes = timestamps, frame_rate, notes
        first = first_readable(len(pages), camera, lambda index: self._decoded(index, None, self._place(index)))
        self.image_size, self.dtype = first.shape[::-1], first.dtype
        self.bit_depth = 8 * first.itemsize

    def __len__(self) -> int:
        return len(self._pages)

    def describe(self, index: int) -> str:
        """File and page."""
        return f"{self._place(index)}, frame {index} (directory at byte {self._pages[index].directory})"

    def content_sha256(self, start: int, stop: int) -> str:
        """SHA-256 of the pages of frames start..stop-1, as they are stored."""
        total = hashlib.sha256()
        for index in range(start, stop):
            tiff = self._tiffs[self._pages[index].file]
            try:
                tags, _ = tiff.directory(self._pages[index].directory)
                content = assembled(tiff.order, tiff.fields(tags, ""), tiff.pieces(tags, ""))
                total.update(hashlib.sha256(content).digest())
            except RecordingError:
                total.update(b"unreadable")
        return total.hexdigest()

    def _place(self, index: int) -> str:
        return str(self._tiffs[self._pages[index].file].file.path)

    def _decoded(self, index: int, out: Image | None, where: str) -> Image:
        page = self._pages[index]
        check_frame_size(page.width, page.height, where)
        try:
            return as_grey(page_of_tiff(self._tiffs[page.file], page.directory, where), where)
        except RecordingError as error:
            text = str(error)
            raise RecordingError(text if text.startswith(where) else f"{where}: {text}") from error


def _pages(tiff: Tiff, number: int) -> tuple[list[_Page], str | None]:
    """Frames of one file, and a note where the chain of directories breaks off."""
    pages: list[_Page] = []
    note = None
    try:
        for offset, tags in chain(tiff):
            if not tiff.value(tags, Code.SUBFILE, 0) & _REDUCED_IMAGE:
                pages.append(_page(tiff, number, offset, tags))
    except RecordingError as error:
        if not pages:
            raise
        note = f"only {len(pages)} pages are whole ({error})"
    if len(pages) == 1:
        pages = _without_directories(tiff, pages[0])
    return pages, note


def _page(tiff: Tiff, number: int, offset: int, tags: Mapping[int, Tag]) -> _Page:
    width, height = tiff.value(tags, Code.WIDTH), tiff.value(tags, Code.HEIGHT)
    bits = tiff.value(tags, Code.BITS, 1)
    return _Page(number, offset, width, height, bits, tiff.order, _raw_offset(tiff, tags, width * height * bits // 8))


def _raw_offset(tiff: Tiff, tags: Mapping[int, Tag], size: int) -> int:
    """Where the pixels lie, one after the other and as they are; -1 if they do not."""
    plain = {
        Code.COMPRESSION: (1,),
        Code.PHOTOMETRIC: (1,),
        Code.ORIENTATION: (1,),
        Code.FILL_ORDER: (1,),
        Code.SAMPLES: (1,),
        Code.SAMPLE_FORMAT: (1,),
    }
    if Code.TILE_OFFSETS in tags or tiff.value(tags, Code.BITS, 1) not in (8, 16):
        return -1
    if any(tiff.value(tags, tag, 1) not in allowed for tag, allowed in plain.items()):
        return -1
    places = [min(place, tiff.file.size) for place in tiff.values(tags, Code.STRIP_OFFSETS)]  # beyond it nothing lies
    if len(places) == 1:
        return places[0]
    counts = tiff.values(tags, Code.STRIP_COUNTS)
    follow = len(places) == len(counts) and all(a + n == b for a, n, b in zip(places, counts, places[1:], strict=False))
    return places[0] if follow and sum(counts) == size else -1


def _without_directories(tiff: Tiff, first: _Page) -> list[_Page]:
    """All frames of a file with one directory, as ImageJ writes stacks: the others follow the first without a gap."""
    tags, _ = tiff.directory(first.directory)
    n = _pages_announced(tiff.description(tags))
    size = first.width * first.height * first.bits // 8
    if n < 2 or size == 0:
        return [first]
    if first.raw_offset < 0:
        raise RecordingError(
            f"{tiff.file.path}: announces {n} frames in one directory, whose pixels are not plain (white is zero, rows "
            "from another corner, compressed, or no grey values of 8 or 16 bit). Export it again, black as zero."
        )
    most = max(1, -(-tiff.file.size // size))  # of a file cut short the frames that begin in it; the next is the end
    return [
        _Page(
            first.file, first.directory, first.width, first.height, first.bits, first.order, first.raw_offset + i * size
        )
        for i in range(min(n, most))
    ]


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
