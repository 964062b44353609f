"""Image files: one PNG, TIFF, BMP or JPEG file per frame, or a sequence of TIFF files with many pages each.

Uncompressed pages are read at the speed of memory.
"""

import json
import math
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from calibration.kit.types import AnyArray, Array, Image
from disctrack.errors import RecordingError
from disctrack.recording.readers.base import FrameReader, first_readable
from disctrack.recording.readers.decoding import as_grey, decode
from disctrack.recording.readers.files import check_continuation, content_of, number_files
from disctrack.recording.readers.raw import RawFile, check_frame_size, raw_frames
from disctrack.recording.readers.tiff_pages import Page, page_pixels, pages_of


def open_images(files: Sequence[Path], camera: str, pattern: str = "") -> FrameReader:
    """One file per frame, or TIFF files of many pages each. Raises RecordingError if no frame can be read.

    A missing number among the files is a frame that cannot be read. Size and depth are those of the first readable
    frame.
    pattern : {number} in it marks the digits that count the frames; "" to find them from the names
    """
    if files[0].suffix.lower() in (".tif", ".tiff") and (_is_stack(files[0]) or _is_stack(files[-1])):
        check_continuation(files, camera)
        return _open_stack(files, camera)
    slots, numbers, notes, doubts = number_files(files, camera, pattern)

    def stored(index: int, where: str = "") -> bytes:
        file = slots[index]
        if file is None:
            raise RecordingError(f"{where}: there is no file with this number. Copy it again from the camera.")
        return content_of(file, where)

    def looked_at(index: int) -> tuple[AnyArray, Image]:
        name = str(files[index])
        image = decode(content_of(files[index], name), name)
        return image, as_grey(image, name)

    whole, first = first_readable(len(files), camera, looked_at)
    alike = f"images are stored with {whole.shape[-1]} channels of equal value; one is used, without loss"
    return FrameReader(
        files=[file or f"missing file of {camera} frame {index}" for index, file in enumerate(slots)],
        numbers=numbers,
        image_size=(first.shape[1], first.shape[0]),
        dtype=first.dtype,
        decoded=lambda index, out, where: as_grey(decode(stored(index, where), where, out), where),
        stored=stored,
        notes=(*notes, *([alike] if whole.ndim == 3 else [])),
        doubts=doubts,
    )


def _is_stack(file: Path) -> bool:
    """True for a TIFF file with more than one frame; False also for a file that is not TIFF."""
    found = 0
    try:
        for page in islice(pages_of(RawFile(file)), 2):
            found += max(_pages_announced(page.description), 1)
    except RecordingError:
        return found > 0  # cut short after the first page
    return found > 1


def _open_stack(files: Sequence[Path], camera: str) -> FrameReader:
    """Frames of all pages of the files, in order. Raises RecordingError if no page can be read.

    The frame rate is taken from the description by ImageJ or OME in the first page, time stamps from that by OME.
    """
    stacks = [_pages(RawFile(file)) for file in files]
    pages = [page for found, _ in stacks for page in found]
    first = pages[0]
    rate, stamps = _times(first.description, len(pages))
    check_frame_size(first.plain.width, first.plain.height, str(files[0]))
    common: dict[str, Any] = {"files": [page.source for page in pages]}
    common |= {"timestamps": stamps, "frame_rate": rate, "notes": tuple(note for _, note in stacks if note)}
    beyond = 2**62  # the end of any file: offsets in a damaged directory may exceed 64 bits
    offsets = np.array([min(page.plain_offset, beyond) for page in pages], np.int64)
    if (offsets >= 0).all() and all(page.coding == first.coding for page in pages):
        return raw_frames(offsets=offsets, layout=first.plain, **common)

    def pixels(index: int, out: Image | None, where: str) -> Image:
        return as_grey(page_pixels(pages[index], where), where)

    image = first_readable(len(pages), camera, lambda index: pixels(index, None, str(pages[index].source)))
    return FrameReader(
        image_size=(image.shape[1], image.shape[0]),
        dtype=image.dtype,
        decoded=pixels,
        stored=lambda index: pages[index].coding.encode() + b"".join(pages[index].pieces("")),
        **common,
    )


def _pages(file: RawFile) -> tuple[list[Page], str | None]:
    """Frames of one file, and a note if the chain of directories is broken."""
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
        pages = _without_directories(pages[0])
    return pages, note


def _without_directories(first: Page) -> list[Page]:
    """All frames of a file with one directory, as in stacks by ImageJ: they follow the first without a gap."""
    n, size = _pages_announced(first.description), first.plain.frame_bytes
    if n < 2 or size == 0:
        return [first]
    if first.plain_offset < 0:
        plain = "grey values of 8 or 16 bit, black as zero, upright, not compressed"
        said = f"announces {n} frames in one directory, whose pixels are not plain; expected {plain}"
        raise RecordingError(f"{first.source}: {said}. Export it again.")
    most = max(1, -(-first.source.size // size))  # a truncated file has the frames that begin in it
    start = first.plain_offset
    return [replace(first, places=(start + i * size,), sizes=(size,)) for i in range(min(n, most))]


def _pages_announced(description: str) -> int:
    """Number of frames of one directory by the description of ImageJ, or of tifffile if truncated; otherwise 0."""
    with suppress(ValueError, TypeError, KeyError, OverflowError, RecursionError):  # another description
        if description.startswith("ImageJ="):
            return int(_imagej(description)["images"])
        *several, _, _ = json.loads(description)["shape"]
        return math.prod(map(int, several)) if '"truncated"' in description else 0
    return 0


def _imagej(description: str) -> dict[str, str]:
    return dict(re.findall(r"^(\w+)=(\S+)\s*$", description, re.MULTILINE))


_TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "\u00b5s": 1e-6, "\u03bcs": 1e-6, "ns": 1e-9, "min": 60.0}


def _times(description: str, n: int) -> tuple[float | None, Array | None]:
    """Frame rate [Hz] and time stamps [s] from the description by ImageJ or OME, None if they are missing.

    OME schema 2016-06: Pixels/@TimeIncrement, Pixels/Plane/@DeltaT, each with its unit.
    """
    if description.startswith("ImageJ="):
        entries = _imagej(description)
        interval, rate = _seconds(entries, "finterval"), _seconds(entries, "fps")
        return 1.0 / interval if interval > 0 else rate if rate > 0 else None, None
    try:
        pixels = next(ElementTree.fromstring(description).iterfind(".//{*}Pixels"))
    except (ElementTree.ParseError, ValueError, StopIteration):  # none, or by another program
        return None, None
    stamps = np.array([_seconds(plane.attrib, "DeltaT") for plane in pixels.iterfind("{*}Plane")])
    stamps, interval = stamps[np.isfinite(stamps)], _seconds(pixels.attrib, "TimeIncrement")
    return 1.0 / interval if interval > 0 else None, stamps if len(stamps) == n else None


def _seconds(entries: Mapping[str, str], key: str) -> float:
    """A time in the unit of the entry `keyUnit`, by default s; NaN if it is missing."""
    with suppress(KeyError, ValueError):
        return float(entries[key]) * _TIME_UNITS[entries.get(f"{key}Unit", "s")]
    return math.nan
