"""One camera's frames in a video file (AVI, MP4, MKV, MOV), read through PyAV; needs the extra `disctrack[video]`."""

import ctypes
import hashlib
import threading
import zlib
from collections.abc import Generator, Iterator, Sequence
from contextlib import suppress
from pathlib import Path

import av
import numpy as np
from av.container import InputContainer
from av.video.plane import VideoPlane
from numpy.typing import NDArray

from calibration.kit.brief import ranges
from calibration.kit.types import Image
from disctrack.errors import RecordingError, told_as
from disctrack.recording.readers.base import FrameReader, first_readable, only_file
from disctrack.recording.readers.decoding import as_grey
from disctrack.recording.readers.raw import MOST_PIXELS, check_frame_size

# Only containers of frames: a play list named like a video could make the library open other files.
_CONTAINERS = {"format_whitelist": "avi,matroska,webm,mov,mp4,m4a,3gp,3g2,mj2", "protocol_whitelist": "file"}
_LOSSLESS = frozenset({"ffv1", "rawvideo", "huffyuv", "ffvhuff", "utvideo", "magicyuv", "png", "tiff", "v210", "qtrle"})
_DECODED_ON = 8  # frames to be skipped by decoding, which is faster than reopening the file and seeking

_Decoded = tuple[int, av.VideoFrame | None]  # index of a frame, the frame; None after the last one


def open_video(files: Sequence[Path], camera: str) -> FrameReader:
    """Reader of one video. Raises RecordingError if the file is not a video.

    Grey values are the stored luma plane, not stretched from limited to full range. There are no time stamps: those of
    the container are for a player, not from the camera.
    """
    file = only_file(files, camera)
    video = _Video(file, camera)

    def looked_at(index: int) -> tuple[av.VideoFrame, Image]:
        where = f"{file}, frame {index}"
        frame = video.frame(index, where)
        return frame, _luma(frame, where)

    frame, first = first_readable(len(video.times), camera, looked_at)
    lossy = f"{video.codec} may compress with loss, which costs accuracy; ffv1 is free of loss"
    return FrameReader(
        files=[file] * len(video.times),
        image_size=(first.shape[1], first.shape[0]),
        dtype=first.dtype,
        decoded=video.decoded,
        stored=video.stored,
        bit_depth=_depth(frame),
        notes=(*_format_notes(frame), *((lossy,) if video.codec not in _LOSSLESS else ())),
        doubts=tuple(_gap_doubts(video.times)),
        random_access=False,
    )


class _Video:
    """Frames of a video in order of presentation. Reading is fastest forwards, by one thread.

    Frames are identified by their time in the container; reading backwards starts at the preceding key frame.
    """

    def __init__(self, file: Path, camera: str) -> None:
        self.file, self.camera = file, camera
        self._lock = threading.Lock()
        self._frames: Generator[_Decoded, None, None] | None = None
        self._next = 0  # lower limit of the index of the decoder's next frame
        self._held: _Decoded = (-1, None)
        self._content = b""
        with _opened(file, camera) as container:
            codec = container.streams.video[0].codec_context
            check_frame_size(codec.width, codec.height, str(file))
            self.codec = str(codec.name)
            # in order of presentation, in units of the container; frame numbers if the times are not usable
            self.times, self._keys, self._timed, self._checked = _index(container, file)

    def decoded(self, index: int, out: Image | None, where: str) -> Image:
        """Grey values of a frame, in the decoder's memory if `out` is given. Raises RecordingError."""
        with self._lock:
            image = _luma(self.frame(index, where), where)
            return image.copy() if out is None else image

    def stored(self, index: int) -> bytes:
        """SHA-256 of the file, and the index: compressed frames cannot be distinguished without decoding."""
        if not self._content:
            with told_as(RecordingError, f"{self.file}: cannot be read", OSError), self.file.open("rb") as stream:
                self._content = hashlib.file_digest(stream, "sha256").digest()
        return self._content + str(index).encode()

    def frame(self, index: int, where: str) -> av.VideoFrame:
        """The decoded frame. Raises RecordingError."""
        key = int(self._keys[np.searchsorted(self._keys, index, side="right") - 1])
        if self._frames is None or not min(key, index - _DECODED_ON) <= self._next <= index:
            self._frames, self._held = self._from(key), (-1, None)
        self._next = index + 1
        try:
            while self._held[0] < index:
                self._held = next(self._frames, (len(self.times), None))
        except RecordingError as error:  # the next call reopens the file
            self._frames = None
            raise RecordingError(f"{where}: {error}") from error
        position, frame = self._held
        if position > index or frame is None:
            raise RecordingError(f"{where}: the video does not hold this frame, or it is damaged there. Copy it again.")
        return frame

    def _from(self, count: int) -> Generator[_Decoded, None, None]:
        """All undamaged frames in order, from a key frame on, or from the beginning if seeking fails.

        After damage, frames up to the next key frame are omitted. Raises RecordingError if the file no longer exists.
        """
        container = _opened(self.file, self.camera)
        stream, sound = container.streams.video[0], True
        # frames after a fault of the container cannot be found
        with container, suppress(av.FFmpegError, OSError, ValueError):
            with suppress(OSError, ValueError):  # if seeking fails, decode from the beginning
                if count:
                    container.seek(int(self.times[count]), stream=stream, backward=True)
            for packet in container.demux(stream):
                if packet.size:
                    sound = sound or bool(packet.is_keyframe)
                    sound = sound and (not self._checked or checksums_hold(bytes(packet)))
                frames: list[av.VideoFrame] = []
                try:
                    frames = packet.decode()
                except (av.FFmpegError, OSError, ValueError):
                    sound, count = False, count + bool(packet.size)
                for frame in frames:
                    if self._timed and frame.pts is not None:  # otherwise frames are counted
                        count = int(np.searchsorted(self.times, frame.pts))
                    if sound and not frame.is_corrupt:
                        yield count, frame
                    count += 1


def _index(container: InputContainer, file: Path) -> tuple[NDArray[np.int64], NDArray[np.int64], bool, bool]:
    """Times of all packets, and the indices at which decoding can begin, including 0; then two flags.

    The first is True if the times are the container's, False if they are frame numbers. The second is True if packets
    have checksums that the decoder does not enforce. Raises RecordingError.
    """
    stamps: list[tuple[int | None, int | None, bool]] = []  # of presentation, of decoding; key frame
    checked, stream = False, container.streams.video[0]
    with suppress(av.FFmpegError, OSError):  # the file is cut short or damaged there
        for packet in container.demux(stream):
            if packet.size:
                checked = checked or (stream.codec_context.name == "ffv1" and checksums_hold(bytes(packet)))
                stamps.append((packet.pts, packet.dts, bool(packet.is_keyframe)))
    if not stamps:
        raise RecordingError(f"{file}: a video without frames, or damaged. Copy or export it again.")
    *both, keys = zip(*stamps, strict=True)
    times = next((times for times in both if None not in times and len(set(times)) == len(times)), None)
    if times is None:
        return np.arange(len(stamps)), np.zeros(1, np.int64), False, checked
    presented = np.argsort(times, kind="stable")
    first_of_all = np.union1d(np.flatnonzero(np.array(keys)[presented]), [0])
    return np.array(times, np.int64)[presented], first_of_all, True, checked


# zlib computes the CRC of FFV1 from bytes with reversed bits
_REVERSED = np.packbits(np.unpackbits(np.arange(256, dtype=np.uint8)[:, None], axis=1)[:, ::-1], axis=1).ravel()
_FOOTER = 8


def checksums_hold(packet: bytes) -> bool:
    """True if a packet of FFV1 is a chain of slices with correct checksums.

    The decoder only logs a wrong one, and returns the damaged frame. RFC 9043, section 4.9: each slice ends with its
    size (24 bits), and with error detection also an error status (8 bits) and a parity that makes the CRC of the whole
    slice zero (polynomial 0x04C11DB7, start 0, most significant bit first).
    """
    content, stop = np.frombuffer(packet, np.uint8), len(packet)
    while stop:
        if stop < _FOOTER:
            return False
        start = stop - _FOOTER - int.from_bytes(packet[stop - _FOOTER : stop - _FOOTER + 3], "big")
        if start < 0 or packet[stop - 5] or zlib.crc32(_REVERSED[content[start:stop]].data, 0xFFFFFFFF) != 0xFFFFFFFF:
            return False
        stop = start
    return True


def _opened(file: Path, camera: str) -> InputContainer:
    with told_as(RecordingError, f"{file}: not a readable video for the {camera} camera", Exception):
        container = av.open(str(file), options=_CONTAINERS)
        codec = container.streams.video[0].codec_context
        if codec is None:
            raise ValueError("no decoder for it")
        codec.thread_type = "NONE"  # the other camera's file is decoded in parallel
        codec.options = {"err_detect": "explode", "max_pixels": str(MOST_PIXELS)}
        return container


def _gap_doubts(times: NDArray[np.int64]) -> Iterator[str]:
    """A doubt if the container's clock skips, because the recorder lost frames."""
    steps = np.diff(times)
    if len(steps) < 3:
        return
    typical = float(np.median(steps))
    gaps = np.flatnonzero(steps > 1.5 * typical + 1)
    if 0 < len(gaps) <= 0.1 * len(steps):
        where, n = ranges(gaps), int(np.rint(steps[gaps] / typical - 1).sum())
        yield f"the video's clock skips after frame {where}: {n} frame{'s' * (n > 1)} lost, and time shifts there"


def _depth(frame: av.VideoFrame) -> int:
    """Significant bits of the grey values."""
    return int(frame.format.components[0].bits)


def _format_notes(frame: av.VideoFrame) -> Iterator[str]:
    """Notes for the user on the pixel format."""
    name = frame.format.name
    if name.startswith("yuvj") or (name.startswith("yuv") and frame.color_range == 2):
        yield f"luma of {name} (full range) is used as it is"
    elif name.startswith(("yuv", "nv", "p0", "uyvy", "yuyv")):
        yield f"luma of {name} is used as it is, not stretched: limited range has black at 16 and white at 235"
    chroma = frame.planes[1:3] if name.startswith(("yuv4", "yuvj4")) and _depth(frame) == 8 else ()
    if any(np.ptp(_rows(plane, plane.height)[:, : plane.width]) for plane in chroma):
        yield "the video has colour: its luma is a mixture of what the sensor measured"


def _rows(plane: VideoPlane, height: int) -> NDArray[np.uint8]:
    """Bytes of a plane's rows (height, bytes), the upper first; a view of its memory if it is stored in this order."""
    size = abs(plane.line_size)
    if plane.line_size >= 0:
        return np.frombuffer(memoryview(plane), np.uint8)[: size * height].reshape(height, size)
    first = plane.buffer_ptr + (height - 1) * plane.line_size  # bottom up: the plane's pointer is to the upper row
    return np.frombuffer(ctypes.string_at(first, size * height), np.uint8).reshape(height, size)[::-1]


# Pixel formats whose first plane contains the grey values
_FIRST_PLANE = ("gray", "yuv", "yuyv", "nv12", "nv16", "nv21", "nv24", "p0", "uyvy")


def _luma(frame: av.VideoFrame, where: str) -> Image:
    """Grey values (h, w) of a decoded frame without conversion; a view of its memory where possible."""
    name, bits = frame.format.name, _depth(frame)
    if name.startswith(_FIRST_PLANE) and not name.endswith(("be", "32")) and bits in (8, 9, 10, 12, 14, 16):
        step, first = {"yuyv422": (2, 0), "uyvy422": (2, 1)}.get(name, (1, 0))
        rows = _rows(frame.planes[0], frame.height).view(np.uint8 if bits == 8 else np.dtype("<u2"))
        return np.asarray(rows[:, first : step * frame.width : step])
    if name in ("gray10be", "gray12be", "gray14be", "gray16be"):
        return np.asarray(frame.to_ndarray(format=name)).astype(np.uint16)
    if name == "pal8":
        colours = np.frombuffer(memoryview(frame.planes[1]), np.uint8)[:1024].reshape(256, 4)[:, :3]
        if (colours == colours[0]).all():  # grey values without a palette: all would be black
            return _rows(frame.planes[0], frame.height)[:, : frame.width]
    if name in ("rgb24", "bgr24", "bgr0", "rgba", "bgra", "argb", "gbrp", "pal8"):
        return as_grey(np.asarray(frame.to_ndarray(format="rgb24")), where)
    raise RecordingError(f"{where}: pixel format {name} is not read. Export as grey of 8, 10, 12 or 16 bit (ffv1).")
