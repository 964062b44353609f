"""Pages of TIFF files: tifffile reads their directories, imagecodecs decodes their strips and tiles.

Neither validates a file. Here sizes and offsets are checked against the file before anything is read or allocated, and
a damaged file raises an error that names it.
"""

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count

import numpy as np
import tifffile

from calibration.kit.types import AnyArray
from disctrack.errors import RecordingError, told_as
from disctrack.recording.readers._pixel_kernels import lzw_codes_follow
from disctrack.recording.readers.raw import MOST_PIXELS, PixelLayout, RawFile, check_frame_size

logging.getLogger("tifffile").addHandler(logging.NullHandler())  # it logs faults of a file; here they are errors

_LZW = tifffile.COMPRESSION.LZW
_READ = {tifffile.COMPRESSION[name] for name in ("NONE", "LZW", "JPEG", "ADOBE_DEFLATE", "PACKBITS", "DEFLATE")}
# Tags that determine the decoding of the pixels.
_CODING = (256, 257, 258, 259, 262, 266, 274, 277, 278, 284, 317, 320, 322, 323, 338, 339, 347)


@dataclass(frozen=True)
class Page:
    """One page: offsets and coding of its strips or tiles."""

    source: RawFile
    places: tuple[int, ...]  # byte offsets of strips or tiles
    sizes: tuple[int, ...]  # [bytes]
    coding: str  # all tags that determine the decoding of the pixels
    like: tifffile.TiffPage  # the first page of the file with this coding, used for its coding only
    description: str

    @property
    def plain(self) -> PixelLayout:
        """Layout of the pixels if they are uncompressed and contiguous."""
        dtype = np.dtype(self.like.dtype).newbyteorder(self.like.parent.byteorder)
        return PixelLayout(int(self.like.imagewidth), int(self.like.imagelength), dtype)

    @property
    def plain_offset(self) -> int:
        """Offset of the pixels if they are upright, uncompressed, contiguous grey values of whole bytes; else -1."""
        page, plain = self.like, self.plain
        grey = page.photometric == tifffile.PHOTOMETRIC.MINISBLACK and page.samplesperpixel == 1 and page.fillorder == 1
        whole = page.bitspersample in (8, 16) and plain.dtype.kind == "u"
        if not (grey and whole) or page.compression != 1 or page.is_tiled or _orientation(page) != 1:
            return -1
        follow = all(a + n == b for a, n, b in zip(self.places, self.sizes, self.places[1:], strict=False))
        one = len(self.places) == 1
        return self.places[0] if one or (follow and sum(self.sizes) == plain.frame_bytes) else -1

    def pieces(self, where: str) -> list[bytes]:
        """Stored bytes of the strips or tiles. Raises RecordingError."""
        return [self.source.bytes_at(a, n, where) for a, n in zip(self.places, self.sizes, strict=True)]


def pages_of(source: RawFile) -> Iterator[Page]:
    """The pages of a file without thumbnails. Raises RecordingError if their chain is broken, or if there is none."""
    first: dict[str, tifffile.TiffPage] = {}  # first page of each coding
    seen, frames = set[int](), 0
    said = f"{source}: not a readable TIFF file, or damaged"
    with told_as(RecordingError, said, Exception), source.stream() as stream:
        tiff = tifffile.TiffFile(stream, name=str(source))
        for index in count():
            try:
                page = tiff.pages[index]
            except IndexError:
                break
            if page.offset in seen:
                raise RecordingError(f"{source}: the chain of pages turns back to byte {page.offset}.")
            if not isinstance(page, tifffile.TiffPage):  # lightweight pages, which tifffile makes on request only
                raise TypeError("no page of its own")
            seen.add(page.offset)
            found = _page(source, page, first)
            if not page.subfiletype & tifffile.FILETYPE.REDUCEDIMAGE:
                frames += 1
                yield found
        if not frames:
            raise ValueError("it holds no page")
        link = source.bytes_at(tiff.pages.next_page_offset or 0, tiff.tiff.offsetsize, str(source))
        if any(link):
            raise RecordingError(f"{source}: the chain of pages breaks off, it is damaged. Copy it again.")


def _page(source: RawFile, page: tifffile.TiffPage, first: dict[str, tifffile.TiffPage]) -> Page:
    if int(page.imagewidth) < 0 or int(page.imagelength) < 0 or len(page.dataoffsets) != len(page.databytecounts):
        raise ValueError(f"the directory at byte {page.offset}")
    coding = page.parent.byteorder + repr([page.tags.valueof(code) for code in _CODING])
    places, sizes = (tuple(map(int, numbers)) for numbers in (page.dataoffsets, page.databytecounts))
    return Page(source, places, sizes, coding, first.setdefault(coding, page), page.description)


def _orientation(page: tifffile.TiffPage) -> int:
    return int(page.tags.valueof(274, default=1))


def page_pixels(page: Page, where: str) -> AnyArray:
    """Pixels of a page, (height, width) or (height, width, channels), upright, with black as 0 and palettes applied.

    Raises RecordingError that begins with `where`.
    """
    with told_as(RecordingError, f"{where}: the page is damaged", Exception, then="Copy or export it again."):
        _check(page, where)
        return np.ascontiguousarray(_decoded(page.like, page.pieces(where)))


def _check(page: Page, where: str) -> None:
    """Raise RecordingError unless a page's sizes are consistent and its compression is known."""
    like, width, height = page.like, page.plain.width, page.plain.height
    check_frame_size(width, height, where, n_bytes=sum(page.sizes))
    if like.compression not in _READ:
        method = f"{int(like.compression)}, {getattr(like.compression, 'name', 'unknown')}"
        said = f"its pixels are compressed by a method ({method}) that is not read; LZW and deflate are"
        raise RecordingError(f"{where}: {said}. Export this image again.")
    tile = int(like.tilewidth) * int(like.tilelength) * int(like.tiledepth) if like.is_tiled else 0
    n = int(np.prod(like.chunked, dtype=float)) if like.dtype is not None and like.shaped[1] == 1 else -1
    if n != len(page.places) or like.samplesperpixel > 4 or max(tile * n, sum(page.sizes)) > 4 * MOST_PIXELS:
        pieces = f"{len(page.places)} pieces of {sum(page.sizes)} bytes in all"
        raise RecordingError(f"{where}: {pieces} do not make up its {width} x {height} px: damaged. Copy it again.")


def _decoded(page: tifffile.TiffPage, pieces: list[bytes]) -> AnyArray:
    pixels: AnyArray = np.empty(page.shaped, page.dtype)  # separate samples, 1, height, width, samples
    for index, piece in enumerate(pieces):
        if page.compression == _LZW and not lzw_codes_follow(np.frombuffer(piece, np.uint8)):
            raise ValueError(f"a code of LZW in piece {index} that nothing explains")
        part, (sample, _, y, x, _), _ = page.decode(piece, index, jpegtables=page.jpegtables)
        if part is None:
            raise ValueError(f"nothing in piece {index}")
        room = pixels[sample, 0, y : y + part.shape[1], x : x + part.shape[2]]
        room[...] = part[0, : room.shape[0], : room.shape[1]]
    image = pixels[0, 0] if len(pixels) == 1 else np.moveaxis(pixels[:, 0, :, :, 0], 0, -1)
    image = image[..., 0] if image.shape[-1] == 1 else image
    if page.photometric == tifffile.PHOTOMETRIC.MINISWHITE and image.dtype.kind == "u":
        image = (2**page.bitspersample - 1) - image
    if page.photometric == tifffile.PHOTOMETRIC.PALETTE:
        image = (np.asarray(page.colormap) >> 8).astype(np.uint8).T[image]
    orientation = _orientation(page)
    if orientation in (5, 6, 7, 8):  # the sides at which row 0 and column 0 lie (TIFF 6.0, section 8)
        image = image.swapaxes(0, 1)
    if orientation in (2, 3, 6, 7):
        image = image[:, ::-1]
    return image[::-1] if orientation in (3, 4, 7, 8) else image
