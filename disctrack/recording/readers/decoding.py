"""Decoding of image files: container and checksums are verified, and there is no lossy conversion.

Grey PNG files are decoded directly into the caller's memory. libpng inflates row by row; here the whole image is
inflated at once and the row filters are undone in one compiled pass, in half the time. Other kinds of PNG (palette,
colour, interlaced, fewer than 8 bits) are decoded by OpenCV.
"""

import struct
import zlib
from pathlib import Path

import cv2
import imagecodecs
import numpy as np

from calibration.kit.types import AnyArray, Image
from disctrack.errors import RecordingError, told_as
from disctrack.recording.readers._pixel_kernels import undo_filters
from disctrack.recording.readers.base import refuse_colour, room_for
from disctrack.recording.readers.raw import RawFile, check_frame_size
from disctrack.recording.readers.tiff_pages import page_pixels, pages_of

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_TIFF_SIGNATURES = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_AGAIN = "Copy or export this image again."


def decode(content: bytes, where: str, out: AnyArray | None = None) -> AnyArray:
    """Pixels of an image file's content as stored: (h, w) or (h, w, channels), any depth; in `out` if it fits.

    Container and checksums are verified first: a decoder may return an incomplete image without an error.
    Raises RecordingError that begins with `where`.
    """
    if not content:
        raise RecordingError(f"{where}: the file is empty. {_AGAIN}")
    if content.startswith(_PNG_SIGNATURE):
        return _png(content, where, out)
    if content[:4] in _TIFF_SIGNATURES:
        return page_pixels(next(pages_of(RawFile(Path(where), content))), where)
    _check_length(content, where)
    return _by_opencv(content, where)


def _by_opencv(content: bytes, where: str) -> AnyArray:
    with told_as(RecordingError, f"{where}: not a readable image", cv2.error, MemoryError):
        image: AnyArray | None = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise RecordingError(f"{where}: not a readable image, or damaged. {_AGAIN}")
    return image


def as_grey(image: AnyArray, where: str) -> Image:
    """(h, w) of 8 or 16 bits: equal channels become one. Raises RecordingError if information would be lost."""
    if image.dtype not in (np.uint8, np.uint16):
        raise RecordingError(f"{where}: pixels of type {image.dtype}; expected 8 or 16 bit grey values.")
    if image.ndim == 2:
        return image
    if image.shape[2] in (2, 4) and (image[..., -1] != np.iinfo(image.dtype).max).any():
        raise RecordingError(f"{where}: has transparent pixels; expected grey values. Export it without alpha channel.")
    colours = image[..., : 3 if image.shape[2] >= 3 else 1]
    if (colours != colours[..., :1]).any():
        refuse_colour(where, "a colour image")
    return np.ascontiguousarray(colours[..., 0])


def _check_length(content: bytes, where: str) -> None:
    """Check end marker or length of formats without checksums. Raises RecordingError."""
    if content.startswith(b"\xff\xd8"):
        if b"\xff\xd9" not in content[-1024:]:
            raise RecordingError(f"{where}: the JPEG file is truncated (no end marker). {_AGAIN}")
        check_frame_size(*_jpeg_size(content), where, n_bytes=len(content))
    if content.startswith(b"BM") and len(content) >= 26:
        declared = struct.unpack_from("<I", content, 2)[0]
        if declared > len(content):
            raise RecordingError(f"{where}: the BMP file ends after {len(content)} of {declared} bytes. {_AGAIN}")
        width, height = struct.unpack_from("<ii", content, 18)
        check_frame_size(abs(width), abs(height), where, n_bytes=len(content))


def _jpeg_size(content: bytes) -> tuple[int, int]:
    """Width and height from the frame header (ITU-T T.81, B.2.2); 0 if there is none before the scan."""
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


def _png(content: bytes, where: str, out: AnyArray | None) -> AnyArray:
    position, end, view = 8, len(content), memoryview(content)
    chunks: dict[bytes, list[memoryview]] = {}
    while position + 12 <= end and b"IEND" not in chunks:
        kind, stop = content[position + 4 : position + 8], position + 8 + _number_at(content, position)
        if stop + 4 > end:
            break
        if zlib.crc32(view[position + 4 : stop]) != _number_at(content, stop):
            raise RecordingError(f"{where}: damaged: wrong checksum of chunk {kind!r} at byte {position}. {_AGAIN}")
        chunks.setdefault(kind, []).append(view[position + 8 : stop])
        position = stop + 4
    if b"IEND" not in chunks or [len(header) for header in chunks.get(b"IHDR", ())] != [13]:
        raise RecordingError(f"{where}: the PNG file is truncated after {end} bytes (no end chunk). {_AGAIN}")
    width, height, depth, colour, _, _, interlaced = struct.unpack(">IIBBBBB", *chunks[b"IHDR"])
    check_frame_size(width, height, where, n_bytes=end)
    if colour or interlaced or b"tRNS" in chunks or depth not in (8, 16):
        return _by_opencv(content, where)
    stride = width * depth // 8
    raw = inflated(b"".join(chunks.get(b"IDAT", ())), (stride + 1) * height)
    out = room_for(out, (width, height), np.dtype(f"u{depth // 8}"))
    if raw is None or not undo_filters(
        np.frombuffer(raw, np.uint8).reshape(height, stride + 1), depth // 8, out.view(np.uint8)
    ):
        raise RecordingError(f"{where}: not a readable image, or damaged. {_AGAIN}")
    if depth == 16 and np.little_endian:
        out.byteswap(inplace=True)
    return out


def _number_at(content: bytes, position: int) -> int:
    return int.from_bytes(content[position : position + 4], "big")


def inflated(stream: bytes, size: int) -> bytes | bytearray | None:
    """The `size` bytes of a zlib stream; None if it is damaged, or has another number of bytes."""
    try:
        whole: bytes | bytearray = imagecodecs.deflate_decode(stream, out=size)
    except imagecodecs.DeflateError:
        return None
    return whole if len(whole) == size else None
