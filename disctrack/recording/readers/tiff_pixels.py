"""Pixels of a page of a TIFF file without libtiff, where it holds whole-byte grey values in strips."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from disctrack.recording.readers import _lzw
from disctrack.recording.readers._inflate import inflated
from disctrack.recording.readers.tiff_directories import Code, Tag, Tiff

_PLAIN, _LZW, _DEFLATE = (1,), (5,), (8, 32946)
_DIFFERENCES = 2
# What makes a page an ordinary grey image: tag, value.
_GREY = (
    (Code.PHOTOMETRIC, 1), (Code.FILL_ORDER, 1), (Code.ORIENTATION, 1), (Code.SAMPLES, 1), (Code.SAMPLE_FORMAT, 1),
)  # fmt: skip
# A page may claim any size: no more is made than such compression can hold, or this many bytes.
_MOST_PER_BYTE, _SMALL = 1500, 1 << 22


def plain_grey(tiff: Tiff, tags: Mapping[int, Tag], pieces: Sequence[bytes]) -> NDArray | None:
    """Pixels (height, width) uint8 or uint16 of strips that are as they are, by LZW, or by deflate, differences or not.

    None of any other page, and where the strips are not what the page announces: libtiff has the last word on those.
    """
    compression, predictor = tiff.value(tags, Code.COMPRESSION, 1), tiff.value(tags, Code.PREDICTOR, 1)
    if Code.TILE_OFFSETS in tags or any(tiff.value(tags, tag, 1) != value for tag, value in _GREY):
        return None
    if compression not in (*_PLAIN, *_LZW, *_DEFLATE) or predictor not in (1, _DIFFERENCES):
        return None
    width, height = tiff.value(tags, Code.WIDTH), tiff.value(tags, Code.HEIGHT)
    bits, rows = tiff.value(tags, Code.BITS, 1), tiff.value(tags, Code.ROWS_PER_STRIP, height)
    rows, size = min(rows, height), width * height * bits // 8
    if bits not in (8, 16) or rows < 1 or width < 1 or len(pieces) != -(-height // rows):
        return None
    if size > max(_SMALL, _MOST_PER_BYTE * sum(map(len, pieces))):
        return None
    strip = rows * width * bits // 8
    stored = _from_lzw(pieces, strip, size) if compression in _LZW else _joined(pieces, strip, size, compression)
    if stored is None:
        return None
    pixels = stored.view(f"{tiff.order}u{bits // 8}").reshape(height, width)
    if not pixels.dtype.isnative:
        pixels = pixels.byteswap(inplace=True).view(pixels.dtype.newbyteorder())
    if predictor == _DIFFERENCES and compression not in _PLAIN:
        _lzw.undo_differences(pixels)
    return pixels


def _from_lzw(pieces: Sequence[bytes], strip: int, size: int) -> NDArray[np.uint8] | None:
    codes = np.frombuffer(bytearray().join([*pieces, bytes(_lzw.SLACK)]), np.uint8)
    out = np.empty(_lzw.HEAD + size, np.uint8)
    ends = np.cumsum([0, *map(len, pieces)])
    return out[_lzw.HEAD :] if _lzw.decode_lzw(codes, ends, out, strip, size) else None


def _joined(pieces: Sequence[bytes], strip: int, size: int, compression: int) -> NDArray[np.uint8] | None:
    """The strips one after the other, inflated where they are compressed."""
    out = np.empty(size, np.uint8)
    for i, piece in enumerate(pieces):
        place = out[i * strip : (i + 1) * strip]
        content = inflated(piece, len(place)) if compression in _DEFLATE else piece
        if content is None or len(content) != len(place):
            return None
        place[:] = np.frombuffer(content, np.uint8)
    return out
