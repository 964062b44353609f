"""Image files as pixels: container and checksums are verified, and nothing is converted that would be lost."""

import struct
import zlib

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.kit.arrays import Image
from disctrack.errors import RecordingError
from disctrack.recording.readers._png import PngHeader, decode_plain_grey
from disctrack.recording.readers.raw import check_claim
from disctrack.recording.readers.tiff_pages import TiffContent, page_pixels, pages_of

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_TIFF_SIGNATURES = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")


def decode(content: bytes, where: str, out: NDArray | None = None) -> NDArray:
    """Pixels of an image file's content as stored: (h, w) or (h, w, channels), any depth; in `out` where it fits.

    Container and checksums are verified first: a decoder may return a torn image without a word.
    Raises RecordingError that begins with `where`.
    """
    try:
        header = _checked_container(content, where)
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


def _checked_container(content: bytes, where: str) -> PngHeader | None:
    """Header of a PNG, None for other formats; only PNG has checksums, the others an end or a length to check."""
    if not content:
        raise _Damaged("the file is empty")
    if content.startswith(_PNG_SIGNATURE):
        return _checked_png(content, where)
    if content.startswith(b"\xff\xd8"):
        if b"\xff\xd9" not in content[-1024:]:
            raise _Damaged("the JPEG file is truncated (no end marker)")
        check_claim(*_jpeg_size(content), len(content), where)
    if content.startswith(b"BM") and len(content) >= 26:
        declared = struct.unpack_from("<I", content, 2)[0]
        if declared > len(content):
            raise _Damaged(f"the BMP file ends after {len(content)} of {declared} bytes")
        width, height = struct.unpack_from("<ii", content, 18)
        check_claim(abs(width), abs(height), len(content), where)
    return None


def _tiff(content: bytes, where: str) -> NDArray:
    """Pixels of the first page."""
    source = TiffContent(content)
    try:
        page = next(pages_of(source))
    except (RecordingError, StopIteration) as error:
        raise _Damaged(f"not a readable image, or damaged ({error})") from error
    return page_pixels(source, page, where)


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


def _checked_png(content: bytes, where: str) -> PngHeader:
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
            check_claim(ihdr[0], ihdr[1], end, where)
        elif kind == b"IDAT":
            data.append((start, stop))
        elif kind == b"tRNS":
            transparent = True
        elif kind == b"IEND" and ihdr:
            return PngHeader(ihdr[0], ihdr[1], ihdr[2], ihdr[3], ihdr[6] != 0, transparent, tuple(data))
        position = stop + 4
    raise _Damaged(f"the PNG file is truncated after {end} bytes (no end chunk)")
