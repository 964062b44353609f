"""Image files as pixels: container and checksums are verified, and nothing is converted that would be lost."""

import struct
import zlib
from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.kit.arrays import Image
from disctrack.errors import RecordingError
from disctrack.recording.readers._png import PngHeader, decode_plain_grey
from disctrack.recording.readers.raw import MOST_PIXELS, check_frame_size
from disctrack.recording.readers.tiff_directories import Code, Field, Tag, Tiff, TiffContent, assembled
from disctrack.recording.readers.tiff_pixels import plain_grey

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_TIFF_SIGNATURES = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_WHITE_IS_ZERO = 0  # of tag 262
# Compressions that OpenCV's libtiff decodes; of most others it delivers black images without a word.
_BY_LIBTIFF = frozenset((1, 2, 3, 4, 5, 6, 7, 8, 32771, 32773, 32946))
_OTHERS = {
    34712: "JPEG 2000", 34887: "LERC", 34925: "LZMA", 34933: "PNG", 34934: "JPEG XR", 22610: "JPEG XR",
    50000: "Zstandard", 50001: "WebP", 50002: "JPEG XL", 52546: "JPEG XL",
}  # fmt: skip
# A header may claim any size, and decoding must not exhaust the memory. Even a black image does not shrink by more than
# this when compressed (deflate: 1032); small ones are let pass.
_MOST_PER_BYTE, _SMALL_IMAGE = 1500, 1 << 22  # pixels per byte of the file; pixels


def decode(content: bytes, where: str, out: NDArray | None = None) -> NDArray:
    """Pixels of an image file's content as stored: (h, w) or (h, w, channels), any depth; in `out` where it fits.

    Container and checksums are verified first: a decoder may return a torn image without a word.
    Raises RecordingError that begins with `where`.
    """
    try:
        header = _checked_container(content)
        image = _tiff(content, where) if content[:4] in _TIFF_SIGNATURES else None
    except _Damaged as fault:
        raise RecordingError(f"{where}: {fault}. Copy or export this image again.") from fault
    if header is not None and header.is_plain_grey:
        image = decode_plain_grey(content, header, out)
    elif image is None:
        image = _by_opencv(content, where)
    if image is None:
        raise RecordingError(f"{where}: not a readable image, or damaged. Copy or export this image again.")
    return image


def _by_opencv(content: bytes, where: str) -> NDArray | None:
    try:
        image: NDArray | None = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    except (cv2.error, MemoryError) as error:
        raise RecordingError(f"{where}: not a readable image ({error.__class__.__name__}).") from error
    return image


def as_grey(image: NDArray, where: str) -> Image:
    """(h, w) of 8 or 16 bits: equal channels become one. Raises RecordingError where something would be lost."""
    if image.dtype not in (np.uint8, np.uint16):
        raise RecordingError(f"{where}: pixels of type {image.dtype}; expected 8 or 16 bit grey values.")
    if image.ndim == 2:
        return image
    if image.shape[2] in (2, 4) and (image[..., -1] != np.iinfo(image.dtype).max).any():
        raise RecordingError(f"{where}: has transparent pixels; expected grey values. Export it without alpha channel.")
    colours = image[..., : 3 if image.shape[2] >= 3 else 1]
    if (colours != colours[..., :1]).any():
        raise RecordingError(
            f"{where}: a colour image; expected grey values. Export the camera's grey values: a conversion here would "
            "mix what the sensor measured."
        )
    return np.ascontiguousarray(colours[..., 0])


class _Damaged(Exception):
    """The text says what is wrong with the file as a container."""


def _checked_container(content: bytes) -> PngHeader | None:
    """Header of a PNG, None for other formats; only PNG has checksums, the others an end or a length to check."""
    if not content:
        raise _Damaged("the file is empty")
    if content.startswith(_PNG_SIGNATURE):
        return _checked_png(content)
    if content.startswith(b"\xff\xd8"):
        if b"\xff\xd9" not in content[-1024:]:
            raise _Damaged("the JPEG file is truncated (no end marker)")
        _check_size(*_jpeg_size(content), len(content))
    if content.startswith(b"BM") and len(content) >= 26:
        declared = struct.unpack_from("<I", content, 2)[0]
        if declared > len(content):
            raise _Damaged(f"the BMP file ends after {len(content)} of {declared} bytes")
        width, height = struct.unpack_from("<ii", content, 18)
        _check_size(abs(width), abs(height), len(content))
    return None


def _tiff(content: bytes, where: str) -> NDArray | None:
    """Pixels of the first page; None where libtiff must say what it is."""
    try:
        tiff = Tiff(TiffContent(content))
        tags, _ = tiff.directory(tiff.first)
        _check_size(tiff.value(tags, Code.WIDTH), tiff.value(tags, Code.HEIGHT), len(content))
        alone = Code.TILE_OFFSETS not in tags and tiff.value(tags, Code.PHOTOMETRIC, 1) != _WHITE_IS_ZERO
        whole = plain_grey(tiff, tags, tiff.pieces(tags, "")) if alone else None
        unknown = _not_decoded(tiff, tags)
        several = not alone and tiff.value(tags, Code.BITS, 1) >= 8
    except RecordingError:
        return None
    if unknown:
        raise _Damaged(unknown)
    return page_of_tiff(tiff, tiff.first, where) if several else whole


def _not_decoded(tiff: Tiff, tags: Mapping[int, Tag]) -> str:
    """What OpenCV would leave out of a page without a word; "" where it does not."""
    compression = tiff.value(tags, Code.COMPRESSION, 1)
    if compression in _BY_LIBTIFF:
        return ""
    name = _OTHERS.get(compression, "unknown")
    return f"its pixels are compressed by a method ({compression}, {name}) that is not read; LZW and deflate are"


def page_of_tiff(tiff: Tiff, offset: int, where: str) -> NDArray:
    """Pixels of the page with its directory at `offset`, by libtiff unless they are plain grey; tiles one by one.

    Upright, and light is more: orientation and a white that is zero are undone.
    """
    tags, _ = tiff.directory(offset)
    pieces, fields = tiff.pieces(tags, where), tiff.fields(tags, where)
    if unknown := _not_decoded(tiff, tags):
        raise RecordingError(f"{where}: {unknown}. Export this image again.")
    if Code.TILE_OFFSETS in tags:
        pixels = _tiles(tiff, tags, pieces, fields, where)
    else:
        plain = plain_grey(tiff, tags, pieces)
        pixels = decode(assembled(tiff.order, fields, pieces), where) if plain is None else plain
    if tiff.value(tags, Code.PHOTOMETRIC, 1) == _WHITE_IS_ZERO and pixels.dtype.kind == "u":
        pixels = ~pixels
    return np.ascontiguousarray(_upright(pixels, tiff.value(tags, Code.ORIENTATION, 1)))


def _tiles(
    tiff: Tiff, tags: Mapping[int, Tag], pieces: Sequence[bytes], fields: dict[int, Field], where: str
) -> NDArray:
    """Pixels of a page in tiles."""
    width, height = tiff.value(tags, Code.WIDTH), tiff.value(tags, Code.HEIGHT)
    tile_width, tile_height = tiff.value(tags, Code.TILE_WIDTH), tiff.value(tags, Code.TILE_HEIGHT)
    check_frame_size(width, height, where)
    check_frame_size(tile_width, tile_height, where)
    columns, rows = -(-width // tile_width), -(-height // tile_height)
    if len(pieces) != columns * rows or tile_width * tile_height * len(pieces) > 4 * MOST_PIXELS:
        raise RecordingError(
            f"{where}: {len(pieces)} tiles for {columns} x {rows}; the page is damaged. Copy it again."
        )
    fields = fields | {Code.WIDTH: fields[Code.TILE_WIDTH], Code.HEIGHT: fields[Code.TILE_HEIGHT]}
    for tag in (Code.TILE_WIDTH, Code.TILE_HEIGHT, Code.ROWS_PER_STRIP):
        fields.pop(tag, None)
    tiles = [decode(assembled(tiff.order, fields, [piece]), where) for piece in pieces]
    if any(tile.shape[:2] != (tile_height, tile_width) for tile in tiles):
        raise RecordingError(f"{where}: tiles of other sizes than announced; the page is damaged. Copy it again.")
    lines = [np.hstack(tiles[row * columns : (row + 1) * columns]) for row in range(rows)]
    return np.vstack(lines)[:height, :width]


def _upright(pixels: NDArray, orientation: int) -> NDArray:
    """Pixels whose row 0 and column 0 lie at the sides that TIFF 6.0 numbers (section 8), or Exif."""
    if orientation in (5, 6, 7, 8):
        pixels = pixels.swapaxes(0, 1)
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    return pixels[::-1] if orientation in (3, 4, 7, 8) else pixels


def _jpeg_size(content: bytes) -> tuple[int, int]:
    """Width and height by the frame header (ITU-T T.81, B.2.2); 0 where there is none before the scan."""
    position = 2
    while position + 9 <= len(content) and content[position] == 0xFF:
        marker, length = content[position + 1], int.from_bytes(content[position + 2 : position + 4], "big")
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack_from(">HH", content, position + 5)
            return width, height
        if marker == 0xDA:
            break
        position += 2 + length if marker != 0xFF else 1
    return 0, 0


def _checked_png(content: bytes) -> PngHeader:
    position, end, view = 8, len(content), memoryview(content)
    ihdr: tuple[int, ...] = ()
    data: list[tuple[int, int]] = []
    transparent = False
    while position + 12 <= end:
        (length,) = struct.unpack_from(">I", content, position)
        kind = content[position + 4 : position + 8]
        start, stop = position + 8, position + 8 + length
        if stop + 4 > end:
            break
        if zlib.crc32(view[position + 4 : stop]) != struct.unpack_from(">I", content, stop)[0]:
            raise _Damaged(f"the PNG is damaged: wrong checksum of chunk {kind.decode('latin-1')!r} at byte {position}")
        if kind == b"IHDR" and length == 13:
            ihdr = struct.unpack_from(">IIBBBBB", content, start)
            _check_size(ihdr[0], ihdr[1], end)
        elif kind == b"IDAT":
            data.append((start, stop))
        elif kind == b"tRNS":
            transparent = True
        elif kind == b"IEND" and ihdr:
            return PngHeader(ihdr[0], ihdr[1], ihdr[2], ihdr[3], ihdr[6] != 0, transparent, tuple(data))
        position = stop + 4
    raise _Damaged(f"the PNG file is truncated after {end} bytes (no end chunk)")


def _check_size(width: int, height: int, n_bytes: int) -> None:
    """Refuse a size that the file's n_bytes cannot hold."""
    if width * height > min(MOST_PIXELS, max(_SMALL_IMAGE, _MOST_PER_BYTE * n_bytes)):
        raise _Damaged(f"the header claims {width} x {height} px, more than any such camera has or the file can hold")
