"""Directories of TIFF files: which pages there are, and where the pixels of each lie.

TIFF 6.0, Adobe 1992, section 2; BigTIFF with 64-bit offsets. No more is read than a directory announces and a file can
hold, whatever its numbers say.
"""

import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path

import numpy as np

from disctrack.errors import RecordingError
from disctrack.recording.readers.raw import RawFile

Field = tuple[int, int, bytes]  # type, number of values, the values
_TYPES = {1: "B", 2: "B", 3: "H", 4: "I", 6: "b", 7: "B", 8: "h", 9: "i", 13: "I", 16: "Q", 17: "q", 18: "Q"}
_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4, 16: 8, 17: 8, 18: 8}
# What libtiff needs to know of a page: layout, compression with its tables, and nothing that points elsewhere.
_COPIED = (256, 257, 258, 259, 262, 266, 277, 278, 292, 317, 320, 322, 323, 338, 339, 347)
_MOST_TAGS = 1 << 12


class Code(IntEnum):
    """Numbers of the tags that are looked at."""

    SUBFILE = 254
    WIDTH = 256
    HEIGHT = 257
    BITS = 258
    COMPRESSION = 259
    PHOTOMETRIC = 262
    FILL_ORDER = 266
    DESCRIPTION = 270
    STRIP_OFFSETS = 273
    ORIENTATION = 274
    SAMPLES = 277
    ROWS_PER_STRIP = 278
    STRIP_COUNTS = 279
    PREDICTOR = 317
    TILE_WIDTH = 322
    TILE_HEIGHT = 323
    TILE_OFFSETS = 324
    TILE_COUNTS = 325
    SAMPLE_FORMAT = 339


class TiffContent:
    """A file's content that was read already, with the part of RawFile that directories need."""

    def __init__(self, content: bytes) -> None:
        self._content, self.size, self.path = content, len(content), Path("TIFF content")

    def bytes_at(self, offset: int, size: int, where: str) -> bytes:
        """Bytes from an offset on. Raises RecordingError where there are fewer."""
        if offset < 0 or size < 0 or offset + size > self.size:
            raise RecordingError(f"{where}: {size} bytes at byte {offset} are announced, but there are {self.size}.")
        return self._content[offset : offset + size]


@dataclass(frozen=True)
class Tag:
    """One entry of a directory: its type, number of values, and where they lie."""

    kind: int
    count: int
    offset: int

    @property
    def size(self) -> int:
        """Bytes of the values."""
        return _SIZES.get(self.kind, 1) * self.count


class Tiff:
    """The directories of one file. Raises RecordingError if it is no TIFF file."""

    def __init__(self, file: RawFile | TiffContent) -> None:
        self.file, self._where = file, str(file.path)
        head = file.bytes_at(0, min(16, file.size), self._where)
        magic = {b"II*\0": ("<", False), b"MM\0*": (">", False), b"II+\0": ("<", True), b"MM\0+": (">", True)}
        if head[:4] not in magic or len(head) < 8:
            raise RecordingError(f"{file.path}: not a TIFF file, or cut short. Copy it again from the camera.")
        self.order, self.big = magic[head[:4]]
        if self.big and (len(head) < 16 or struct.unpack(self.order + "HH", head[4:8]) != (8, 0)):
            raise RecordingError(f"{file.path}: a BigTIFF file with a damaged header. Copy it again from the camera.")
        self.first = int(struct.unpack_from(self.order + ("Q" if self.big else "I"), head, 8 if self.big else 4)[0])

    def directory(self, offset: int) -> tuple[dict[int, Tag], int]:
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
        tags: dict[int, Tag] = {}
        for i in range(count):
            tag, kind, values = struct.unpack_from(f"{self.order}HH{word}", content, i * entry)
            found = Tag(kind, values, start + i * entry + 4 + width)
            if found.size > width:
                found = Tag(kind, values, struct.unpack_from(self.order + word, content, i * entry + 4 + width)[0])
            tags.setdefault(tag, found)
        return tags, int(struct.unpack_from(self.order + word, content, count * entry)[0])

    def values(self, tags: Mapping[int, Tag], tag: int, default: int | None = None) -> list[int]:
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

    def value(self, tags: Mapping[int, Tag], tag: int, default: int | None = None) -> int:
        """The first value of a tag."""
        return self.values(tags, tag, default)[0]

    def description(self, tags: Mapping[int, Tag]) -> str:
        """Text of tag 270, "" without one."""
        if Code.DESCRIPTION not in tags or tags[Code.DESCRIPTION].kind not in (1, 2, 7):
            return ""
        content = self.file.bytes_at(
            tags[Code.DESCRIPTION].offset, tags[Code.DESCRIPTION].size, f"{self._where}: description"
        )
        return content.rstrip(b"\0").decode("utf-8", "replace")

    def pieces(self, tags: Mapping[int, Tag], where: str) -> list[bytes]:
        """Compressed bytes of the strips or tiles of a page, in order."""
        tiled = Code.TILE_OFFSETS in tags
        places = self.values(tags, Code.TILE_OFFSETS if tiled else Code.STRIP_OFFSETS)
        counts = self.values(tags, Code.TILE_COUNTS if tiled else Code.STRIP_COUNTS)
        if len(places) != len(counts) or sum(counts) > self.file.size:
            raise RecordingError(f"{where}: {len(places)} pieces of {sum(counts)} bytes in all; the page is damaged.")
        return [self.file.bytes_at(a, n, where) for a, n in zip(places, counts, strict=True)]

    def fields(self, tags: Mapping[int, Tag], where: str) -> dict[int, Field]:
        """What a decoder must know of a page."""
        found = {tag: tags[tag] for tag in _COPIED if tag in tags and tags[tag].kind in _SIZES}
        fields = {tag: (t.kind, t.count, self.file.bytes_at(t.offset, t.size, where)) for tag, t in found.items()}
        if self.value(tags, Code.PHOTOMETRIC, 1) == 0:  # white is zero: libtiff would invert some depths and not others
            fields[Code.PHOTOMETRIC] = (3, 1, struct.pack(self.order + "H", 1))
        return fields

    def _number(self, code: str, offset: int, where: str) -> int:
        content = self.file.bytes_at(offset, struct.calcsize(code), where)
        return int(struct.unpack(self.order + code, content)[0])


def chain(tiff: Tiff) -> Iterator[tuple[int, dict[int, Tag]]]:
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


def assembled(order: str, fields: Mapping[int, Field], pieces: Sequence[bytes | bytearray]) -> bytes:
    """A small TIFF file: header, one directory with the fields and the places of the strips, values, strips."""
    n = len(pieces)
    sizes = struct.pack(f"{order}{n}I", *map(len, pieces))
    whole = {**fields, Code.STRIP_OFFSETS: (4, n, bytes(4 * n)), Code.STRIP_COUNTS: (4, n, sizes)}
    values_at = 8 + 2 + 12 * len(whole) + 4
    data_at = values_at + sum(len(content) for *_, content in whole.values() if len(content) > 4)
    starts = np.cumsum([data_at, *map(len, pieces)])[:-1]
    whole[Code.STRIP_OFFSETS] = (4, n, struct.pack(f"{order}{n}I", *starts.tolist()))
    entries, values = b"", b""
    for tag, (kind, count, content) in sorted(whole.items()):
        if len(content) > 4:
            entries += struct.pack(f"{order}HHII", tag, kind, count, values_at + len(values))
            values += content
        else:
            entries += struct.pack(f"{order}HHI", tag, kind, count) + content.ljust(4, b"\0")
    head = {"<": b"II*\0", ">": b"MM\0*"}[order] + struct.pack(f"{order}IH", 8, len(whole))
    return b"".join([head, entries, bytes(4), values, *pieces])
