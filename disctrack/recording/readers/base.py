"""Common part of all readers; a format defines where a frame is stored, and how its bytes become grey values."""

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import NoReturn, TypeVar

import numpy as np

from calibration.kit.types import AnyArray, Array, Image
from disctrack.errors import RecordingError


@dataclass(frozen=True)
class CameraHeader:
    """Header that a camera wrote for one recording; None, or empty text, for missing entries."""

    file: str  # that contains the header
    device: str  # make, model, number
    frame_rate: float  # [Hz] of the frames in the file
    step: int  # every step-th recorded frame is in the file
    exposure: float | None = None  # [s]
    trigger: str = ""  # trigger mode
    first_frame: int | None = None  # the camera's number of frame 0; its origin depends on the trigger mode
    first_time: float | None = None  # [s] from the trigger to frame 0, by the camera's clock
    trigger_time: float | None = None  # [s] since 1970, UTC, by the camera's clock
    locked_clock: bool = False  # True if the clock follows a common time signal (IRIG)
    recorded: datetime | None = None  # by the clock of the camera or its computer

    @property
    def rate(self) -> str:
        """Rate of the frames in the file, with the recording rate if only some frames were saved."""
        every = f" ({self.step * self.frame_rate:g} Hz, one frame in {self.step} saved)" if self.step > 1 else ""
        return f"{self.frame_rate:g} Hz{every}"

    def sentence(self) -> str:
        """The settings in one line."""
        exposure = "" if self.exposure is None else f"exposure {1e6 * self.exposure:g} µs"
        trigger = f"trigger {self.trigger}" if self.trigger else ""
        first = "" if self.first_frame is None else f"first frame {self.first_frame}"
        recorded = "" if self.recorded is None else f"{self.recorded:%Y-%m-%d %H:%M:%S}"
        return ", ".join(filter(None, (self.device, self.rate, exposure, trigger, first, recorded)))

    def as_dict(self) -> dict[str, object]:
        """Entries of the header in JSON types, without the file's path."""
        entries = asdict(self) | {"recorded": self.recorded.isoformat() if self.recorded else None}
        del entries["file"]
        return entries


@dataclass(eq=False, kw_only=True)
class FrameReader:
    """Frames of one camera in order. Opening reads only headers; frames are read on request.

    `read` may be called from several threads at once.

        >>> reader = open_frames("left/*.png", "clip", "left")
        >>> reader.image_size, reader.read(0).shape
        ((272, 272), (272, 272))
    """

    camera: str = ""  # left or right, as `open_frames` was told
    files: Sequence[object]  # file of each frame, for messages
    image_size: tuple[int, int]  # width, height [px]
    dtype: np.dtype  # of grey values in memory
    # grey values of a frame, in the given array or in another one. RecordingErrors begin with the text
    decoded: Callable[[int, Image | None, str], Image]
    stored: Callable[[int], bytes | memoryview]  # stored bytes of a frame. Raises RecordingError
    coding: str = ""  # of the stored bytes, in addition to size and type
    bit_depth: int = 0  # significant bits of grey values: 8 (uint8), or 9 to 16 (uint16); 0: all bits of the type
    timestamps: Array | None = None  # (n,) [s] by the camera's clock, if in the file
    frame_rate: float | None = None  # [Hz] of the camera, if stated in the file; not that of a player
    header: CameraHeader | None = None  # if the format has one
    numbers: range | None = None  # of the frames, if they are numbered
    notes: tuple[str, ...] = ()  # for the user, on the reading of the frames, one sentence each
    doubts: tuple[str, ...] = ()  # assumptions on the instants of the frames
    random_access: bool = True  # False if reading is fastest in order, by one thread

    def __post_init__(self) -> None:
        self.bit_depth = self.bit_depth or 8 * self.dtype.itemsize

    def __len__(self) -> int:
        return len(self.files)

    def describe(self, index: int) -> str:
        """File and number of frame `index`, for messages."""
        return f"{self.files[index]}, frame {index}"

    def read(self, index: int, out: Image | None = None) -> Image:
        """Frame `index`, (height, width) grey values as the camera wrote them; copied into `out` if given.

        Raises RecordingError with file, camera, frame, problem and remedy.
        """
        where = f"{self.files[index]} ({self.camera} camera, frame {index})"
        image = self.decoded(index, out, where)
        if image.shape[::-1] != self.image_size or image.dtype != self.dtype:
            found = in_words(image.shape[::-1], 8 * image.itemsize)
            first = in_words(self.image_size, 8 * self.dtype.itemsize)
            raise RecordingError(f"{where}: {found}, but the first frame has {first}. Export it again.")
        if out is None or image is out:
            return image
        out[...] = image
        return out

    def content_sha256(self, start: int, stop: int) -> str:
        """SHA-256 (hex) of the stored bytes and the coding of frames start..stop-1: equal only for equal input."""
        total = hashlib.sha256(f"{self.image_size} {self.dtype} {self.bit_depth} {self.coding}".encode())
        for index in range(start, stop):
            try:
                total.update(hashlib.sha256(self.stored(index)).digest())
            except RecordingError:
                total.update(b"unreadable")
        return total.hexdigest()


def changed(reader: FrameReader, change: Callable[[Image], Image], by: str) -> FrameReader:
    """A reader that applies `change` to every frame, with all other properties of `reader`.

    by : identifies the change, for the hash of the content
    """
    coding = f"{reader.coding} {reader.image_size} {reader.bit_depth} {by}"
    return replace(reader, decoded=lambda index, out, where: change(reader.read(index)), coding=coding)


# x, y, width, height [px]: rectangle of a stored image that is the image of a camera, for one sensor with mirrors, or
# for images of two cameras that are stored as one
Part = tuple[int, int, int, int]
Parts = tuple[Part | None, ...]  # of the left and of the right camera


def cut_out(image: AnyArray, part: Part, where: str) -> AnyArray:
    """The part of an image (h, w) or (h, w, channels); an image of the part's size is returned whole.

    Raises RecordingError, which begins with `where`, if the image does not contain the part.
    """
    x, y, width, height = part
    found = image[y : y + height, x : x + width] if image.shape[:2] != (height, width) else image
    if found.shape[:2] != (height, width):
        size = f"{image.shape[1]} x {image.shape[0]} px"
        raise RecordingError(f"{where}: {size} do not hold the part {list(part)} that [cameras] declares.")
    return np.ascontiguousarray(found)


def frames_in_parts(readers: Sequence[FrameReader], parts: Parts, where: str) -> Iterator[FrameReader]:
    """Both readers, cut to the declared parts. Raises RecordingError, which begins with `where`, if one is outside."""
    for reader, part in zip(readers, parts, strict=True):
        if part is None:
            yield reader
            continue
        (x, y, *size), (width, height) = part, reader.image_size
        if x + size[0] > width or y + size[1] > height:
            said = f"{reader.camera}_part is {list(part)}, but {reader.describe(0)} has {width} x {height} px"
            raise RecordingError(f"{where}: [cameras] {said}. It is [x, y, width, height] from the upper left corner.")
        cut = changed(reader, partial(cut_out, part=part, where=where), str(list(part)))
        yield replace(cut, image_size=part[2:])


def in_words(image_size: tuple[int, ...], bit_depth: int) -> str:
    """Size (width, height) and depth of images in words."""
    return f"{image_size[0]} x {image_size[1]} px of {bit_depth} bit"


def room_for(out: AnyArray | None, image_size: tuple[int, int], dtype: np.dtype) -> AnyArray:
    """`out` if an image (width, height) can be decoded directly into it; otherwise a new array."""
    if out is not None and out.shape == image_size[::-1] and out.dtype == dtype and out.flags.c_contiguous:
        return out
    return np.empty(image_size[::-1], dtype)


_T = TypeVar("_T")


def first_readable(n: int, camera: str, decoded: Callable[[int], _T]) -> _T:
    """Result of `decoded` for the first of n frames that can be decoded. Raises RecordingError if there is none."""
    problem: RecordingError | None = None
    for index in range(n):
        try:
            return decoded(index)
        except RecordingError as error:
            problem = problem or error
    raise RecordingError(f"none of the {n} {camera} frames can be read; the first: {problem}")


def refuse_colour(where: str, found: str) -> NoReturn:
    """Raise RecordingError for pixels that are not grey values."""
    remedy = "A conversion here would mix what the sensor measured: export grey values, or use a monochrome camera."
    raise RecordingError(f"{where}: {found}; expected grey values. {remedy}")


def only_file(files: Sequence[Path], camera: str) -> Path:
    """The only file of a camera, for formats with all frames in one file. Raises RecordingError if there are more."""
    if len(files) != 1:
        raise RecordingError(f"{files[0]} and {len(files) - 1} more match for the {camera} camera; name one recording.")
    return files[0]
