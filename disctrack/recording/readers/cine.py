"""Phantom recordings (.cine): uncompressed grey values of 8, 10, 12 or 16 bit, with the time of every frame.

Layout after "The Cine File Format" of Vision Research: file header, bitmap header, camera setup, tagged blocks of
information, a table of where each image lies, images. Every number is little-endian. Lengths and offsets are checked
against the file's size before anything is read or made of that size.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.kit.arrays import Array
from disctrack.errors import RecordingError
from disctrack.recording.readers.base import only_file
from disctrack.recording.readers.camera_frames import (
    PIXELS_PER_GROUP,
    CameraFrames,
    PixelLayout,
    bit_depth_of,
    check_present,
    count_present,
)
from disctrack.recording.readers.camera_header import CameraHeader
from disctrack.recording.readers.raw import RawFile, check_frame_size

_FILE_HEADER = struct.Struct("<2sHHHiIiIIIIII")
_BITMAP_HEADER = struct.Struct("<IiiHHII")
_BLOCK_HEADER = struct.Struct("<IHH")
_TIMES_BLOCK = 1002
_MOST_BLOCKS = 1000  # real files have two or three
_SETUP_MARK = 140  # where the setup's own mark and length stand
# Field of the camera setup: offset and type. Fields beyond the setup's stated length are not in the file.
_SETUP_FIELDS = {
    "Serial": (743, "<I"),
    "bFlipH": (756, "<i"),
    "bFlipV": (760, "<i"),
    "FrameRate": (768, "<I"),
    "Shutter": (772, "<I"),
    "CameraVersion": (792, "<I"),
    "CFA": (808, "<I"),
    "RealBPP": (896, "<I"),
    "FRPSteps": (1048, "<I"),
    "ShutterNs": (1568, "<I"),
    "EDRShutterNs": (1572, "<I"),
}
_SETUP_BYTES = 1576
# Way of packing (biCompression): bits per stored pixel; 0 is none.
_PACKED = {256: 10, 1024: 12}


def open_cine(files: Sequence[Path], camera: str) -> CameraFrames:
    """Frames of one camera. Raises RecordingError if the file is damaged, compressed or of colours."""
    file = RawFile(only_file(files, camera))
    cine = _read_headers(file)
    layout = _layout(cine)
    starts = _image_table(cine, camera)
    check_present(file, camera, layout, len(starts), count_present(file, layout, starts))
    offsets = _pixels(cine, starts, layout)
    times, doubts = _times(cine)
    header = _header(cine, layout, times)
    notes = (header.sentence(), *doubts, *_setup_notes(cine))
    return CameraFrames(file, camera, layout, offsets, header, notes, None if times is None else times - times[0])


@dataclass(frozen=True)
class _Cine:
    """The headers of one file."""

    file: RawFile
    first_image: int  # relative to the trigger
    n_images: int
    table: int  # offset of the table of images
    trigger: tuple[int, int]  # fractions (2**-32 s) and seconds since 1970
    width: int
    height: int
    bottom_up: bool
    bits: int  # per pixel as the bitmap header says
    packing: int
    image_bytes: int
    setup_offset: int
    setup_length: int
    setup: bytes

    @property
    def path(self) -> Path:
        return self.file.path

    def field(self, name: str) -> int | None:
        """A field of the camera setup, or None where the file's setup is older than the field."""
        offset, kind = _SETUP_FIELDS[name]
        if offset + struct.calcsize(kind) > len(self.setup):
            return None
        return int(struct.unpack_from(kind, self.setup, offset)[0])


def _read_headers(file: RawFile) -> _Cine:
    path = file.path
    head = _FILE_HEADER.unpack(file.bytes_at(0, _FILE_HEADER.size, f"{path}: file header"))
    mark, _, compression, version, _, _, first, n, bitmap_at, setup_at, table, fraction, second = head
    if mark != b"CI" or version > 1:
        raise RecordingError(f"{path}: not a cine file of a known version. Export the recording again.")
    if compression == 1:  # 0: as they are; 2: as the sensor has them, which is grey without a colour filter
        raise RecordingError(f"{path}: a compressed cine (JPEG). Save it uncompressed: cine raw.")
    bitmap = _BITMAP_HEADER.unpack(file.bytes_at(bitmap_at, _BITMAP_HEADER.size, f"{path}: bitmap header"))
    _, width, height, _, bits, packing, image_bytes = bitmap
    check_frame_size(width, abs(height), str(path))
    mark_and_length = file.bytes_at(setup_at + _SETUP_MARK, 4, f"{path}: camera setup")
    length = int.from_bytes(mark_and_length[2:], "little")
    if mark_and_length[:2] != b"ST":
        raise RecordingError(f"{path}: no camera setup where the header says. Export the recording again.")
    return _Cine(
        file=file,
        first_image=first,
        n_images=n,
        table=table,
        trigger=(fraction, second),
        width=width,
        height=abs(height),
        bottom_up=height > 0 and packing == 0,  # as in a bitmap; packed images begin with the upper row
        bits=bits,
        packing=packing,
        image_bytes=image_bytes,
        setup_offset=setup_at,
        setup_length=length,
        setup=file.bytes_at(setup_at, min(length, _SETUP_BYTES), f"{path}: camera setup"),
    )


def _layout(cine: _Cine) -> PixelLayout:
    """How the pixels lie. Raises RecordingError for colours, and for what is not an uncompressed grey image."""
    filter_code = (cine.field("CFA") or 0) & 0xFFFFFF  # the highest byte tells of grey heads
    if filter_code or cine.bits not in (8, 16):
        raise RecordingError(
            f"{cine.path}: a colour recording (filter code {filter_code}, {cine.bits} bit per pixel); expected grey "
            "values. A conversion here would mix what the sensor measured: record with a monochrome camera."
        )
    if cine.packing and cine.packing not in _PACKED:
        raise RecordingError(
            f"{cine.path}: images are packed in a way (biCompression {cine.packing}) that is not read. Save them "
            "unpacked with 8 or 16 bit, or packed with 10 or 12 bit."
        )
    stored = _PACKED.get(cine.packing, cine.bits)
    plain = cine.width * cine.height * stored
    if plain % 8 or cine.width * cine.height % PIXELS_PER_GROUP[stored]:
        raise RecordingError(f"{cine.path}: {cine.width} x {cine.height} px of {stored} bit do not fill whole bytes.")
    padding = 0 if cine.packing else _padding(cine, plain // 8)
    if stored == 10:
        return PixelLayout(cine.width, cine.height, 10, 12, table=linear_from_10_bits())
    depth = bit_depth_of(stored, cine.field("RealBPP") or stored)
    return PixelLayout(cine.width, cine.height, stored, depth, padding, cine.bottom_up)


def _padding(cine: _Cine, plain_bytes: int) -> int:
    """Bytes after each row: none, or as in a bitmap up to a multiple of 4, whichever gives the stated size."""
    row = plain_bytes // cine.height
    padding = -row % 4
    return padding if padding and cine.image_bytes == plain_bytes + padding * cine.height else 0


def _image_table(cine: _Cine, camera: str) -> NDArray[np.int64]:
    """(n,) where each image's record begins."""
    if cine.n_images < 1:
        raise RecordingError(f"{cine.path} ({camera} camera): its header tells of no image. Export it again.")
    table = cine.file.bytes_at(cine.table, 8 * cine.n_images, f"{cine.path}: table of {cine.n_images} images")
    return np.frombuffer(table, "<i8").astype(np.int64)


def _pixels(cine: _Cine, starts: NDArray[np.int64], layout: PixelLayout) -> NDArray[np.int64]:
    """(n,) where each image's pixels begin; -1 where there is no image of the right size.

    A record is the length of its note, the note, the size of the image, the pixels. Records that lie as far apart as
    the first is long have notes of the same length.
    """
    first = _pixels_of(cine, int(starts[0]), layout)
    if first < 0:
        raise RecordingError(
            f"{cine.path}: the first image does not have the {layout.frame_bytes} bytes of {layout.width} x "
            f"{layout.height} px with {layout.stored_bits} bit. The file is damaged: export it again."
        )
    if (np.diff(starts) == first - starts[0] + layout.frame_bytes).all():
        return starts + (first - starts[0])
    return np.array([_pixels_of(cine, int(start), layout) for start in starts], np.int64)


def _pixels_of(cine: _Cine, start: int, layout: PixelLayout) -> int:
    """Where the pixels of the record at `start` begin, or -1 if it is damaged or beyond the end of the file."""
    where = f"{cine.path}: image at byte {start}"
    try:
        (note,) = struct.unpack("<I", cine.file.bytes_at(start, 4, where))
        (size,) = struct.unpack("<I", cine.file.bytes_at(start + note - 4, 4, where))
    except RecordingError:
        return -1
    return start + note if note >= 8 and size == layout.frame_bytes else -1


def linear_from_10_bits() -> NDArray[np.uint16]:
    """(1024,) 12-bit grey value of each 10-bit code of a packed cine: black 64, white 4064.

    The codes follow the transfer curve of ITU-R BT.709, code = 63.5 + 950.4 E'(L) with L = (grey - 64) / 4000. Within
    one unit of 4095 of the maker's table; codes above 1014 are saturated, and the lowest two end below the line.
    """
    alpha, beta = 1.09929682680944, 0.018053968510807  # BT.709: slope 4.5 below beta, power 0.45 above
    signal = (np.arange(1024) - 63.5) / 950.375
    above = np.maximum((signal + alpha - 1) / alpha, 0) ** (1 / 0.45)
    grey = np.rint(64 + 4000 * np.where(signal < 4.5 * beta, signal / 4.5, above))
    grey[:2], grey[1015:] = (2, 5), 4095
    return grey.astype(np.uint16)


def _seconds(fractions: NDArray[np.uint32], seconds: NDArray[np.uint32], since: int) -> Array:
    """Times [s] after the whole second `since`; the two lowest bits of the fraction are flags."""
    return (seconds.astype(np.int64) - since) + (fractions & np.uint32(0xFFFFFFFC)) * 2.0**-32


def _times(cine: _Cine) -> tuple[Array | None, list[str]]:
    """(n,) [s] from the trigger to each frame by the camera's clock, or None and why they are not used."""
    block = _find_block(cine, _TIMES_BLOCK)
    if block is None:
        return None, ["the file has no time stamps; frames are taken as evenly spaced"]
    start, size = block
    if size < 8 * cine.n_images:
        return None, [f"the file has {size // 8} time stamps for {cine.n_images} frames; they are not used"]
    raw = np.frombuffer(cine.file.bytes_at(start, 8 * cine.n_images, str(cine.path)), "<u4").reshape(-1, 2)
    fraction, second = cine.trigger
    trigger = (fraction & 0xFFFFFFFC) * 2.0**-32
    times = _seconds(raw[:, 0], raw[:, 1], second) - trigger
    if not _saved_step(cine, times):
        rate = cine.field("FrameRate") or 0
        return None, [f"the time stamps do not belong to a recording with {rate} Hz; they are not used"]
    return times, []


def _saved_step(cine: _Cine, times: Array) -> int:
    """Of how many recorded frames one was saved, by the time stamps (the setup does not tell); 0 if they cannot be."""
    steps = np.diff(times)
    if not len(steps):
        return 1
    periods = float(np.median(steps)) * (cine.field("FrameRate") or 0)
    step = round(periods)
    return step if (steps > 0).all() and step >= 1 and abs(periods / step - 1) < 0.01 else 0


def _find_block(cine: _Cine, wanted: int) -> tuple[int, int] | None:
    """Offset and size of the content of a tagged block between the setup and the table of images."""
    position = cine.setup_offset + cine.setup_length
    for _ in range(_MOST_BLOCKS):
        if position + _BLOCK_HEADER.size > min(cine.table, cine.file.size):
            return None
        content = cine.file.bytes_at(position, _BLOCK_HEADER.size, str(cine.path))
        size, kind, _ = _BLOCK_HEADER.unpack(content)
        if size < _BLOCK_HEADER.size or position + size > cine.file.size:
            return None
        if kind == wanted:
            return position + _BLOCK_HEADER.size, size - _BLOCK_HEADER.size
        position += size
    return None


def _header(cine: _Cine, layout: PixelLayout, times: Array | None) -> CameraHeader:
    rate = cine.field("FrameRate")
    if not rate:
        raise RecordingError(f"{cine.path}: the camera setup states no frame rate. Export the recording again.")
    nanoseconds = cine.field("ShutterNs") or 1000 * (cine.field("Shutter") or 0)
    exposure = nanoseconds / 1e9
    fraction, second = cine.trigger
    trigger_time = second + (fraction & 0xFFFFFFFC) * 2.0**-32
    version, serial = cine.field("CameraVersion"), cine.field("Serial")
    step = 1 if times is None else _saved_step(cine, times)
    return CameraHeader(
        file=str(cine.path),
        device=f"Phantom {version}, serial number {serial}",
        frame_rate=rate / step,
        step=step,
        exposure=exposure if 0 < exposure * rate <= 1.001 else None,
        first_frame=cine.first_image,
        first_time=None if times is None else float(times[0]),
        trigger_time=trigger_time if second else None,
        locked_clock=bool(second) and not fraction & 1,
        recorded=datetime(1970, 1, 1) + timedelta(seconds=second) if second else None,
        saturation=(1 << layout.bit_depth) - 1,
    )


def _setup_notes(cine: _Cine) -> list[str]:
    """What in the setup bears on the grey values or on time."""
    notes = []
    if cine.field("FRPSteps"):
        notes.append("the frame rate was changed during the recording (frame rate profile)")
    if 0 < (cine.field("EDRShutterNs") or 0) < (cine.field("ShutterNs") or 0):
        notes.append("bright pixels are compressed (extreme dynamic range): edges of the dots may be biased")
    if cine.field("bFlipH") or cine.field("bFlipV"):
        notes.append(
            "the setup asks to show the images mirrored; they are used as stored: the calibration views must be, too"
        )
    return notes
