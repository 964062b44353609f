"""Phantom recordings (.cine): uncompressed grey values of 8, 10, 12 or 16 bit, with the time of every frame.

Layout after "The Cine File Format" of Vision Research: file header, bitmap header, camera setup, tagged blocks of
information, table of image offsets, images. All numbers are little-endian. Lengths and offsets are checked against the
file's size before memory is allocated or read.
"""

import struct
from collections.abc import Sequence
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.kit.types import Array
from disctrack.errors import RecordingError
from disctrack.recording.readers.base import CameraHeader, FrameReader, in_words, only_file, refuse_colour
from disctrack.recording.readers.raw import PixelLayout, RawFile, bit_depth_of, check_frame_size, raw_frames

_FILE_HEADER = struct.Struct("<2sHHHiIiIIIIII")
_BITMAP_HEADER = struct.Struct("<IiiHHII")
_BLOCK_HEADER = struct.Struct("<IHH")
# Fields (4 bytes) of the camera setup: offsets. Fields beyond the stated length of the setup are not in the file.
_SETUP_FIELDS = {
    "Serial": 743,
    "FrameRate": 768,
    "Shutter": 772,
    "CameraVersion": 792,
    "CFA": 808,
    "RealBPP": 896,
    "ShutterNs": 1568,
    "EDRShutterNs": 1572,
}
_FRACTION = 0xFFFFFFFC  # of a second, in 2**-32 s; the two lowest bits are flags
# Packing (biCompression): bits per stored pixel; 0 means unpacked.
_PACKED = {256: 10, 1024: 12}


def open_cine(files: Sequence[Path], camera: str) -> FrameReader:
    """Frames of one camera. Raises RecordingError if the file is damaged, compressed or in colour."""
    file = RawFile(only_file(files, camera))
    cine = _Cine(file)
    layout, depth = _layout(cine)
    n = cine.n_images
    starts = np.frombuffer(file.bytes_at(cine.table, 8 * n, f"{file}: table of {n} images"), "<i8")
    file.check_announced(camera, layout, n, layout.count_whole(starts, file.size))
    times, step, doubts = _times(cine)
    header = _header(cine, times, step)
    notes = [header.sentence(), *doubts]
    if 0 < cine.field("EDRShutterNs") < cine.field("ShutterNs"):
        notes.append("bright pixels are compressed (extreme dynamic range): edges of the dots may be biased")
    return raw_frames(
        files=[file] * n,
        offsets=_pixels(cine, starts, layout),
        layout=layout,
        bit_depth=depth,
        timestamps=None if times is None else times - times[0],
        frame_rate=header.frame_rate,
        header=header,
        notes=tuple(notes),
    )


class _Cine:
    """The headers of one file."""

    def __init__(self, file: RawFile) -> None:
        self.file = file
        head = _FILE_HEADER.unpack(file.bytes_at(0, _FILE_HEADER.size, f"{file}: file header"))
        mark, _, compression, version, _, _, *rest = head
        self.first_image, self.n_images, bitmap_at, setup_at, self.table, *time = rest
        if mark != b"CI" or version > 1:
            raise RecordingError(f"{file}: not a cine file of a known version. Export the recording again.")
        if compression == 1:  # 0: uncompressed; 2: raw sensor values, which are grey without a colour filter
            raise RecordingError(f"{file}: a compressed cine (JPEG). Save it uncompressed: cine raw.")
        self.clock_is_free, self.trigger_second = bool(time[0] & 1), time[1]  # [s] since 1970
        self.trigger = (time[0] & _FRACTION) * 2.0**-32  # [s] after that
        bitmap = _BITMAP_HEADER.unpack(file.bytes_at(bitmap_at, _BITMAP_HEADER.size, f"{file}: bitmap header"))
        _, self.width, height, _, self.bits, self.packing, self.image_bytes = bitmap
        self.height = abs(height)
        self.bottom_up = height > 0 and self.packing == 0  # as in a bitmap; packed images begin with the upper row
        mark, length = struct.unpack("<2sH", file.bytes_at(setup_at + 140, 4, f"{file}: camera setup"))
        if mark != b"ST":
            raise RecordingError(f"{file}: no camera setup where the header says. Export the recording again.")
        self.setup = file.bytes_at(setup_at, length, f"{file}: camera setup")
        self.blocks = setup_at + length  # where they begin

    def field(self, name: str) -> int:
        """A field of the camera setup; 0 if the file's version of the setup does not have it."""
        offset = _SETUP_FIELDS[name]
        return int.from_bytes(self.setup[offset : offset + 4], "little") if offset + 4 <= len(self.setup) else 0


def _layout(cine: _Cine) -> tuple[PixelLayout, int]:
    """Layout of the pixels, and their significant bits. Raises RecordingError for colour or unknown packing."""
    filter_code = cine.field("CFA") & 0xFFFFFF  # the highest byte describes grey heads
    if filter_code or cine.bits not in (8, 16):
        refuse_colour(str(cine.file), f"a colour recording (filter code {filter_code}, {cine.bits} bit per pixel)")
    if cine.packing and cine.packing not in _PACKED:
        said = f"images are packed in a way (biCompression {cine.packing}) that is not read"
        raise RecordingError(f"{cine.file}: {said}. Save them with 8 or 16 bit, or packed with 10 or 12.")
    packed, w, h = _PACKED.get(cine.packing, 0), cine.width, cine.height
    check_frame_size(w, h, str(cine.file), packed or cine.bits)
    if packed:
        table = linear_from_10_bits() if packed == 10 else None
        depth = 12 if packed == 10 else bit_depth_of(12, cine.field("RealBPP"))
        return PixelLayout(w, h, np.dtype("<u2"), packed, table=table), depth
    row = w * cine.bits // 8
    padding = -row % 4  # to a multiple of 4 as in a bitmap, or none, according to the stated size
    padding = padding if cine.image_bytes == (row + padding) * h else 0
    layout = PixelLayout(w, h, np.dtype(f"<u{cine.bits // 8}"), padding=padding, bottom_up=cine.bottom_up)
    return layout, bit_depth_of(cine.bits, cine.field("RealBPP"))


def _pixels(cine: _Cine, starts: NDArray[np.int64], layout: PixelLayout) -> NDArray[np.int64]:
    """(n,) offsets of each image's pixels; -1 if there is no image of the right size.

    A record is the length of its annotation, the annotation, the size of the image, the pixels. If the distances of all
    records equal the length of the first, all annotations have the same length.
    """
    first = _pixels_of(cine, int(starts[0]), layout)
    if first < 0:
        size = f"{layout.frame_bytes} bytes of {in_words((layout.width, layout.height), layout.stored_bits)}"
        raise RecordingError(f"{cine.file}: the first image does not have the {size}: damaged. Export it again.")
    if (np.diff(starts) == first - starts[0] + layout.frame_bytes).all():
        return starts + (first - starts[0])
    return np.array([_pixels_of(cine, int(start), layout) for start in starts], np.int64)


def _pixels_of(cine: _Cine, start: int, layout: PixelLayout) -> int:
    """Offset of the pixels of the record at `start`; -1 if it is damaged or beyond the end of the file."""
    where = f"{cine.file}: image at byte {start}"
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


def _times(cine: _Cine) -> tuple[Array | None, int, list[str]]:
    """Times (n,) [s] since the trigger by the camera's clock, step of saved frames, and doubts.

    Times are None if they are not usable. The step follows from the times, as the setup does not contain it.
    """
    block, n = _block_of_times(cine), cine.n_images
    if block is None:
        return None, 1, ["the file has no time stamps; frames are taken as evenly spaced"]
    start, size = block
    if size < 8 * n:
        return None, 1, [f"the file has {size // 8} time stamps for {n} frames; they are not used"]
    raw = np.frombuffer(cine.file.bytes_at(start, 8 * n, str(cine.file)), "<u4").reshape(-1, 2)
    fractions = (raw[:, 0] & np.uint32(_FRACTION)) * 2.0**-32
    times = (raw[:, 1].astype(np.int64) - cine.trigger_second) + fractions - cine.trigger
    steps, rate = np.diff(times), cine.field("FrameRate")
    periods = float(np.median(steps)) * rate if len(steps) else 1.0
    step = round(periods)
    if not (steps > 0).all() or step < 1 or abs(periods / step - 1) >= 0.01:
        return None, 1, [f"the time stamps do not belong to a recording with {rate} Hz; they are not used"]
    return times, step, []


def _block_of_times(cine: _Cine) -> tuple[int, int] | None:
    """Offset and size of the content of the tagged block 1002, between the setup and the table of images."""
    position = cine.blocks
    for _ in range(1000):  # real files have two or three
        if position + _BLOCK_HEADER.size > min(cine.table, cine.file.size):
            return None
        size, kind, _ = _BLOCK_HEADER.unpack(cine.file.bytes_at(position, _BLOCK_HEADER.size, str(cine.file)))
        if size < _BLOCK_HEADER.size or position + size > cine.file.size:
            return None
        if kind == 1002:
            return position + _BLOCK_HEADER.size, size - _BLOCK_HEADER.size
        position += size
    return None


def _header(cine: _Cine, times: Array | None, step: int) -> CameraHeader:
    rate = cine.field("FrameRate")
    if not rate:
        raise RecordingError(f"{cine.file}: the camera setup states no frame rate. Export the recording again.")
    exposure = (cine.field("ShutterNs") or 1000 * cine.field("Shutter")) / 1e9
    second = cine.trigger_second
    return CameraHeader(
        file=str(cine.file),
        device=f"Phantom {cine.field('CameraVersion')}, serial number {cine.field('Serial')}",
        frame_rate=rate / step,
        step=step,
        exposure=exposure if 0 < exposure * rate <= 1.001 else None,
        first_frame=cine.first_image,
        first_time=None if times is None else float(times[0]),
        trigger_time=second + cine.trigger if second else None,
        locked_clock=bool(second) and not cine.clock_is_free,
        recorded=datetime(1970, 1, 1) + timedelta(seconds=second) if second else None,
    )
