"""TIFF files of many pages: one file per camera, or several that continue one another.

The directories of the pages are read here (TIFF 6.0, Adobe 1992, section 2; BigTIFF with 64-bit offsets), because a
frame needs little of them: where its pixels lie. Pages without compression are then read at the speed of memory; any
other page goes to libtiff as a file of its own, made of the page's directory and its compressed bytes.
"""

from __future__ import annotations

import hashlib
import math
import re
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from calibration.arrays import Array, Image
from disctrack.errors import RecordingError
from disctrack.readers import FrameReader
from disctrack.readers.images import as_grey, decode
from disctrack.readers.raw import MOST_PIXELS, RawFile, RawFrames, check_frame_size

_SUBFILE, _WIDTH, _HEIGHT, _BITS, _COMPRESSION, _PHOTOMETRIC, _FILL_ORDER = 254, 256, 257, 258, 259, 262, 266
_DESCRIPTION, _STRIP_OFFSETS, _SAMPLES, _STRIP_COUNTS = 270, 273, 277, 279
_ROWS_PER_STRIP, _TILE_WIDTH, _TILE_HEIGHT, _TILE_OFFSETS, _TILE_COUNTS, _SAMPLE_FORMAT = 278, 322, 323, 324, 325, 339
_Field = tuple[int, int, bytes]  # type, number of values, the values
_TYPES = {1: "B", 2: "B", 3: "H", 4: "I", 6: "b", 7: "B", 8: "h", 9: "i", 13: "I", 16: "Q", 17: "q", 18: "Q"}
_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4, 16: 8, 17: 8, 18: 8}
# What libtiff needs to know of a page: layout, compression with its tables, and nothing that points elsewhere.
_COPIED = (256, 257, 258, 259, 262, 266, 277, 278, 292, 317, 322, 323, 338, 339, 347)
_MOST_TAGS = 1 << 12
_REDUCED_IMAGE = 1  # bit of tag 254: a thumbnail of another page


def is_stack(file: Path) -> bool:
    """True for a TIFF file that holds more than one frame; False also for what is no TIFF file at all."""
    try:
        tiff = _Tiff(RawFile(file))
        first, following = tiff.directory(tiff.first)
        if not following:
            return _imagej_pages(tiff.description(first)) > 1
    except RecordingError:
        return False
    try:  # a thumbnail may follow, which is no frame
        return any(not tiff.value(tags, _SUBFILE, 0) & _REDUCED_IMAGE for _, tags in islice(_chain(tiff), 1, None))
    except RecordingError:
        return True  # cut short after the first page


def size_of_first_page(content: bytes) -> tuple[int, int]:
    """Width and height that the first page of a TIFF file's content claims; 0 where none can be read."""
    try:
        tiff = _Tiff(_Bytes(content))
        tags, _ = tiff.directory(tiff.first)
        return tiff.value(tags, _WIDTH), tiff.value(tags, _HEIGHT)
    except RecordingError:
        return 0, 0


class _Bytes:
    """A file's content that was read already, with the part of RawFile that directories need."""

    def __init__(self, content: bytes) -> None:
        self._content, self.size, self.path = content, len(content), Path("TIFF content")

    def bytes_at(self, offset: int, size: int, where: str) -> bytes:
        if offset < 0 or size < 0 or offset + size > self.size:
            raise RecordingError(f"{where}: {size} bytes at byte {offset} are announced, but there are {self.size}.")
        return self._content[offset : offset + size]


def open_stack(files: Sequence[Path], camera: str) -> FrameReader:
    """Frames of all pages of the files, in order. Raises RecordingError if no page can be read.

    The frame rate is taken from the notes of ImageJ or OME in the first page, time stamps from those of OME.
    """
    raw_files = [RawFile(file) for file in files]
    tiffs = [_Tiff(file) for file in raw_files]
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


class TiffPages:
    """Pages that are compressed, or otherwise not plain; see FrameReader."""

    random_access = True

    def __init__(
        self,
        tiffs: Sequence[_Tiff],
        pages: Sequence[_Page],
        camera: str,
        notes: tuple[str, ...],
        timestamps: Array | None,
        frame_rate: float | None,
    ) -> None:
        self._tiffs, self._pages, self.camera = list(tiffs), list(pages), camera
        self.timestamps, self.frame_rate, self.notes = timestamps, frame_rate, notes
        first = self._first_readable()
        self.image_size, self.dtype = first.shape[::-1], first.dtype
        self.bit_depth = 8 * first.itemsize

    def __len__(self) -> int:
        return len(self._pages)

    def describe(self, index: int) -> str:
        """File and page."""
        page = self._pages[index]
        return f"{self._tiffs[page.file].file.path}, frame {index} (directory at byte {page.directory})"

    def read(self, index: int, out: Image | None = None) -> Image:
        """Frame `index`, (height, width), into `out` if given. Raises RecordingError with file, camera and frame."""
        where = f"{self._where(index)} ({self.camera} camera, frame {index})"
        image = self._decoded(index, where)
        if image.shape[::-1] != self.image_size or image.dtype != self.dtype:
            width, height = self.image_size
            raise RecordingError(
                f"{where}: {image.shape[1]} x {image.shape[0]} px of {8 * image.itemsize} bit, but the file began with "
                f"{width} x {height} px of {self.bit_depth} bit. Export it again."
            )
        if out is None:
            return image
        out[...] = image
        return out

    def content_sha256(self, start: int, stop: int) -> str:
        """SHA-256 of the pages of frames start..stop-1, as they are stored."""
        total = hashlib.sha256()
        for index in range(start, stop):
            tiff = self._tiffs[self._pages[index].file]
            try:
                tags, _ = tiff.directory(self._pages[index].directory)
                content = _assembled(tiff.order, tiff.fields(tags, ""), tiff.pieces(tags, ""))
                total.update(hashlib.sha256(content).digest())
            except RecordingError:
                total.update(b"unreadable")
        return total.hexdigest()

    def _where(self, index: int) -> str:
        return str(self._tiffs[self._pages[index].file].file.path)

    def _decoded(self, index: int, where: str) -> Image:
        page = self._pages[index]
        check_frame_size(page.width, page.height, where)
        try:
            return as_grey(_decoded_page(self._tiffs[page.file], page.directory, where), where)
        except RecordingError as error:
            text = str(error)
            raise RecordingError(text if text.startswith(where) else f"{where}: {text}") from error

    def _first_readable(self) -> Image:
        problem: RecordingError | None = None
        for index in range(len(self._pages)):
            try:
                return self._decoded(index, self._where(index))
            except RecordingError as error:
                problem = problem or error
        raise RecordingError(f"none of the {len(self._pages)} {self.camera} frames can be read; the first: {problem}")


@dataclass(frozen=True)
class _Tag:
    """One entry of a directory: its type, number of values, and where they lie."""

    kind: int
    count: int
    offset: int

    @property
    def size(self) -> int:
        return _SIZES.get(self.kind, 1) * self.count


class _Tiff:
    """The directories of one file. Raises RecordingError if it is no TIFF file."""

    def __init__(self, file: RawFile | _Bytes) -> None:
        self.file, self._where = file, str(file.path)
        head = file.bytes_at(0, min(16, file.size), self._where)
        magic = {b"II*\0": ("<", False), b"MM\0*": (">", False), b"II+\0": ("<", True), b"MM\0+": (">", True)}
        if head[:4] not in magic or len(head) < 8:
            raise RecordingError(f"{file.path}: not a TIFF file, or cut short. Copy it again from the camera.")
        self.order, self.big = magic[head[:4]]
        if self.big and (len(head) < 16 or struct.unpack(self.order + "HH", head[4:8]) != (8, 0)):
            raise RecordingError(f"{file.path}: a BigTIFF file with a damaged header. Copy it again from the camera.")
        self.first = int(struct.unpack_from(self.order + ("Q" if self.big else "I"), head, 8 if self.big else 4)[0])

    def directory(self, offset: int) -> tuple[dict[int, _Tag], int]:
        """Tags of the directory at a byte offset, and the offset of the next one, 0 after the last."""
        word, entry, count_size = ("Q", 20, 8) if self.big else ("I", 12, 2)
        where = f"{self._where}: directory of a page"
        count = self._number("Q" if self.big else "H", offset, where)
        if count > _MOST_TAGS:
            raise RecordingError(
                f"{self._where}: the directory at byte {offset} is damaged ({count} tags). Copy it again."
            )
        width = struct.calcsize(word)
        start = offset + count_size
        content = self.file.bytes_at(start, count * entry + width, where)
        tags: dict[int, _Tag] = {}
        for i in range(count):
            tag, kind, values = struct.unpack_from(f"{self.order}HH{word}", content, i * entry)
            found = _Tag(kind, values, start + i * entry + 4 + width)
            if found.size > width:
                found = _Tag(kind, values, struct.unpack_from(self.order + word, content, i * entry + 4 + width)[0])
            tags.setdefault(tag, found)
        return tags, int(struct.unpack_from(self.order + word, content, count * entry)[0])

    def values(self, tags: Mapping[int, _Tag], tag: int, default: int | None = None) -> list[int]:
        """All values of a tag of whole numbers; [default] where the directory has none."""
        if tag not in tags:
            if default is None:
                raise RecordingError(f"{self._where}: a page without tag {tag}. It is damaged: copy it again.")
            return [default]
        found = tags[tag]
        if found.kind not in _TYPES or found.count == 0:
            raise RecordingError(f"{self._where}: tag {tag} has type {found.kind}. It is damaged: copy it again.")
        content = self.file.bytes_at(found.offset, found.size, f"{self._where}: tag {tag}")
        return list(struct.unpack(f"{self.order}{found.count}{_TYPES[found.kind]}", content))

    def value(self, tags: Mapping[int, _Tag], tag: int, default: int | None = None) -> int:
        """The first value of a tag."""
        return self.values(tags, tag, default)[0]

    def description(self, tags: Mapping[int, _Tag]) -> str:
        """Text of tag 270, "" without one."""
        if _DESCRIPTION not in tags or tags[_DESCRIPTION].kind not in (1, 2, 7):
            return ""
        content = self.file.bytes_at(tags[_DESCRIPTION].offset, tags[_DESCRIPTION].size, f"{self._where}: description")
        return content.rstrip(b"\0").decode("utf-8", "replace")

    def pieces(self, tags: Mapping[int, _Tag], where: str) -> list[bytes]:
        """Compressed bytes of the strips or tiles of a page, in order."""
        tiled = _TILE_OFFSETS in tags
        places = self.values(tags, _TILE_OFFSETS if tiled else _STRIP_OFFSETS)
        counts = self.values(tags, _TILE_COUNTS if tiled else _STRIP_COUNTS)
        if len(places) != len(counts) or sum(counts) > self.file.size:
            raise RecordingError(f"{where}: {len(places)} pieces of {sum(counts)} bytes in all; the page is damaged.")
        return [self.file.bytes_at(a, n, where) for a, n in zip(places, counts, strict=True)]

    def fields(self, tags: Mapping[int, _Tag], where: str) -> dict[int, _Field]:
        """What a decoder must know of a page."""
        found = {tag: tags[tag] for tag in _COPIED if tag in tags and tags[tag].kind in _SIZES}
        fields = {tag: (t.kind, t.count, self.file.bytes_at(t.offset, t.size, where)) for tag, t in found.items()}
        if self.value(tags, _PHOTOMETRIC, 1) == 0:  # white is zero: libtiff would invert some depths and not others
            fields[_PHOTOMETRIC] = (3, 1, struct.pack(self.order + "H", 1))
        return fields

    def _number(self, code: str, offset: int, where: str) -> int:
        content = self.file.bytes_at(offset, struct.calcsize(code), where)
        return int(struct.unpack(self.order + code, content)[0])


def _decoded_page(tiff: _Tiff, offset: int, where: str) -> NDArray:
    """Pixels of the page whose directory lies at `offset`, by libtiff; tiles one by one."""
    tags, _ = tiff.directory(offset)
    pieces, fields = tiff.pieces(tags, where), tiff.fields(tags, where)
    if _TILE_OFFSETS not in tags:
        return decode(_assembled(tiff.order, fields, pieces), where)
    width, height = tiff.value(tags, _WIDTH), tiff.value(tags, _HEIGHT)
    tile_width, tile_height = tiff.value(tags, _TILE_WIDTH), tiff.value(tags, _TILE_HEIGHT)
    check_frame_size(width, height, where)
    check_frame_size(tile_width, tile_height, where)
    columns, rows = -(-width // tile_width), -(-height // tile_height)
    if len(pieces) != columns * rows or tile_width * tile_height * len(pieces) > 4 * MOST_PIXELS:
        raise RecordingError(
            f"{where}: {len(pieces)} tiles for {columns} x {rows}; the page is damaged. Copy it again."
        )
    fields |= {_WIDTH: fields.pop(_TILE_WIDTH), _HEIGHT: fields.pop(_TILE_HEIGHT)}
    fields.pop(_ROWS_PER_STRIP, None)
    tiles = [decode(_assembled(tiff.order, fields, [piece]), where) for piece in pieces]
    if any(tile.shape[:2] != (tile_height, tile_width) for tile in tiles):
        raise RecordingError(f"{where}: tiles of other sizes than announced; the page is damaged. Copy it again.")
    lines = [np.hstack(tiles[row * columns : (row + 1) * columns]) for row in range(rows)]
    return np.ascontiguousarray(np.vstack(lines)[:height, :width])


def _assembled(order: str, fields: Mapping[int, _Field], pieces: Sequence[bytes]) -> bytes:
    """A small TIFF file: header, one directory with the fields and the places of the strips, values, strips."""
    n = len(pieces)
    sizes = struct.pack(f"{order}{n}I", *map(len, pieces))
    whole = {**fields, _STRIP_OFFSETS: (4, n, bytes(4 * n)), _STRIP_COUNTS: (4, n, sizes)}
    values_at = 8 + 2 + 12 * len(whole) + 4
    data_at = values_at + sum(len(content) for *_, content in whole.values() if len(content) > 4)
    starts = np.cumsum([data_at, *map(len, pieces)])[:-1]
    whole[_STRIP_OFFSETS] = (4, n, struct.pack(f"{order}{n}I", *starts.tolist()))
    entries, values = b"", b""
    for tag, (kind, count, content) in sorted(whole.items()):
        if len(content) > 4:
            entries += struct.pack(f"{order}HHII", tag, kind, count, values_at + len(values))
            values += content
        else:
            entries += struct.pack(f"{order}HHI", tag, kind, count) + content.ljust(4, b"\0")
    head = {"<": b"II*\0", ">": b"MM\0*"}[order] + struct.pack(f"{order}IH", 8, len(whole))
    return b"".join([head, entries, bytes(4), values, *pieces])


def _pages(tiff: _Tiff, number: int) -> tuple[list[_Page], str | None]:
    """Frames of one file, and a note where the chain of directories breaks off."""
    pages: list[_Page] = []
    note = None
    try:
        for offset, tags in _chain(tiff):
            if not tiff.value(tags, _SUBFILE, 0) & _REDUCED_IMAGE:
                pages.append(_page(tiff, number, offset, tags))
    except RecordingError as error:
        if not pages:
            raise
        note = f"only {len(pages)} pages are whole ({error})"
    if len(pages) == 1 and pages[0].raw_offset >= 0:
        pages = _without_directories(tiff, pages[0])
    return pages, note


def _chain(tiff: _Tiff) -> Iterator[tuple[int, dict[int, _Tag]]]:
    """Offset and tags of every directory of the file."""
    seen: set[int] = set()
    offset = tiff.first
    while offset:
        if offset in seen:
            raise RecordingError(f"{tiff.file.path}: the chain of pages turns back to byte {offset}. Copy it again.")
        seen.add(offset)
        tags, following = tiff.directory(offset)
        yield offset, tags
        offset = following


def _page(tiff: _Tiff, number: int, offset: int, tags: Mapping[int, _Tag]) -> _Page:
    width, height = tiff.value(tags, _WIDTH), tiff.value(tags, _HEIGHT)
    bits = tiff.value(tags, _BITS, 1)
    return _Page(number, offset, width, height, bits, tiff.order, _raw_offset(tiff, tags, width * height * bits // 8))


def _raw_offset(tiff: _Tiff, tags: Mapping[int, _Tag], size: int) -> int:
    """Where the pixels lie, one after the other and as they are; -1 if they do not."""
    plain = {_COMPRESSION: (1,), _PHOTOMETRIC: (0, 1), _FILL_ORDER: (1,), _SAMPLES: (1,), _SAMPLE_FORMAT: (1,)}
    if _TILE_OFFSETS in tags or tiff.value(tags, _BITS, 1) not in (8, 16):
        return -1
    if any(tiff.value(tags, tag, 1) not in allowed for tag, allowed in plain.items()):
        return -1
    places = [min(place, tiff.file.size) for place in tiff.values(tags, _STRIP_OFFSETS)]  # beyond it nothing lies
    if len(places) == 1:
        return places[0]
    counts = tiff.values(tags, _STRIP_COUNTS)
    follow = len(places) == len(counts) and all(a + n == b for a, n, b in zip(places, counts, places[1:], strict=False))
    return places[0] if follow and sum(counts) == size else -1


def _without_directories(tiff: _Tiff, first: _Page) -> list[_Page]:
    """All frames of a file with one directory, as ImageJ writes stacks: the others follow the first without a gap."""
    tags, _ = tiff.directory(first.directory)
    n = _imagej_pages(tiff.description(tags))
    size = first.width * first.height * first.bits // 8
    if n < 2 or size == 0:
        return [first]
    most = max(1, -(-tiff.file.size // size))  # of a file cut short the frames that begin in it; the next is the end
    return [
        _Page(
            first.file, first.directory, first.width, first.height, first.bits, first.order, first.raw_offset + i * size
        )
        for i in range(min(n, most))
    ]


def _imagej_pages(description: str) -> int:
    found = re.search(r"^images=([0-9]{1,12})\s*$", description, re.MULTILINE)
    return int(found.group(1)) if description.startswith("ImageJ=") and found else 0


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
