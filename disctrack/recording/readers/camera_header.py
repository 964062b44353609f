"""What a camera wrote beside its frames, and whether two cameras can have recorded the same motion with it."""

import dataclasses
from dataclasses import dataclass
from datetime import datetime

from disctrack.errors import RecordingError
from disctrack.recording.readers.base import FrameReader

RATE_ROUNDING_HZ = 0.5  # headers give the rate in whole Hz
CLOCK_TOLERANCE = 1e-3  # relative: cameras whose frames are stamped may run off the nominal rate; the stamps count
SAME_EXPOSURE = 0.01  # relative; the two cameras' clocks round to different ticks
SAME_TAKE_S = 600.0  # computers' clocks, and the time that saving one camera after the other takes


@dataclass(frozen=True)
class CameraHeader:
    """Settings of one camera for one recording; None, or an empty text, where the file does not tell."""

    file: str  # that holds the header
    device: str  # make, model, number
    frame_rate: float  # [Hz] of the frames in the file
    step: int  # one frame in so many of those recorded is in the file
    saturation: int  # largest grey value that a pixel can have
    exposure: float | None = None  # [s]
    trigger: str = ""  # trigger mode
    first_frame: int | None = None  # the camera's own number of frame 0; trigger modes differ in what is counted from
    first_time: float | None = None  # [s] from the trigger to frame 0, by the camera's clock
    trigger_time: float | None = None  # [s] since 1970, UTC, by the camera's clock
    locked_clock: bool = False  # to a common time signal (IRIG)
    recorded: datetime | None = None  # by the clock of the camera or its computer

    @property
    def rate(self) -> str:
        """Rate of the frames in the file, and how it came about."""
        every = f" ({self.step * self.frame_rate:g} Hz, one frame in {self.step} saved)" if self.step > 1 else ""
        return f"{self.frame_rate:g} Hz{every}"

    def sentence(self) -> str:
        """The settings in one line."""
        parts = [self.device, self.rate]
        if self.exposure is not None:
            parts.append(f"exposure {1e6 * self.exposure:g} µs")
        if self.trigger:
            parts.append(f"trigger {self.trigger}")
        if self.first_frame is not None:
            parts.append(f"first frame {self.first_frame}")
        if self.recorded is not None:
            parts.append(f"{self.recorded:%Y-%m-%d %H:%M:%S}")
        return ", ".join(part for part in parts if part)

    def as_dict(self) -> dict[str, object]:
        """What the header says, of JSON's types, without the file's place."""
        fields = dataclasses.asdict(self)
        del fields["file"]
        return {**fields, "recorded": self.recorded.isoformat() if self.recorded else None}


def check_headers(
    left: FrameReader, right: FrameReader, frame_rate: float, exposure: float | None, declared_in: str
) -> tuple[str, ...]:
    """Compare the cameras' headers with each other, and with the declared frame rate [Hz] and exposure [s].

    Returns warnings. Raises RecordingError where frame i of both cannot belong together, or cannot have been taken at
    the declared rate. Formats without a header pass, with a warning where they state another rate: it may be that of a
    player.
    """
    warnings = []
    for reader in (left, right):
        header, camera, rate = reader.header, reader.camera, reader.frame_rate
        declared = f"{declared_in}: [cameras] frame_rate_hz is {frame_rate:g}"
        if header is None:
            if rate is not None and abs(rate - frame_rate) > RATE_ROUNDING_HZ:
                warnings.append(f"{declared}, the {camera} file states {rate:g} Hz")
            continue
        stamped = 0.0 if header.first_time is None else CLOCK_TOLERANCE * header.frame_rate
        if abs(header.frame_rate - frame_rate) > max(RATE_ROUNDING_HZ, stamped):
            raise RecordingError(
                f"{declared}, but the {camera} camera's frames were recorded with {header.rate}, says {header.file}. "
                "Every velocity would be wrong by their ratio: correct that."
            )
        if exposure is not None and header.exposure is not None and _differ(header.exposure, exposure):
            warnings.append(
                f"{declared_in}: [cameras] exposure_us is {1e6 * exposure:g}, the {camera} camera's header says "
                f"{1e6 * header.exposure:g} µs ({header.file}); the declared one is used"
            )
    if left.header is not None and right.header is not None:
        _check_instants(left.header, right.header)
        warnings += _doubtful(left.header, right.header)
    return tuple(warnings)


def _check_instants(left: CameraHeader, right: CameraHeader) -> None:
    """Raise RecordingError where frame i of both does not show the same instant."""
    if abs(left.frame_rate - right.frame_rate) > 1e-6 * left.frame_rate:
        raise RecordingError(
            f"the left camera's frames were recorded with {left.rate} ({left.file}), the right one's with {right.rate} "
            f"({right.file}): frame i of both does not show the same instant. Record with one rate, or export with the "
            "same step."
        )
    numbers = left.first_frame, right.first_frame
    if left.trigger == right.trigger and None not in numbers and numbers[0] != numbers[1]:
        raise RecordingError(
            f"the left file begins with the camera's frame {numbers[0]} ({left.file}), the right one with frame "
            f"{numbers[1]} ({right.file}), at the same trigger mode: frame i of both does not show the same instant. "
            "Export the same range of frames from both cameras."
        )
    offset, period = start_offset(left, right), 1.0 / left.frame_rate
    if offset is not None and abs(offset[0]) > 0.5 * period:
        raise RecordingError(
            f"by the time stamps, counted from {offset[1]}, the first frame of the right camera ({right.file}) was "
            f"taken {offset[0]:.4g} s after that of the left one ({left.file}); a frame lasts {period:.4g} s. "
            "Export the frames of the same instants, of the same take."
        )


def _doubtful(left: CameraHeader, right: CameraHeader) -> list[str]:
    found = []
    if left.trigger != right.trigger:  # equal modes count from the same event; of unequal ones nothing is known
        found.append(
            f"the cameras were triggered in different modes: left {left.trigger or 'unknown'}, right "
            f"{right.trigger or 'unknown'}. The headers do not say whether frame i of both shows the same instant"
        )
    if left.exposure is not None and right.exposure is not None and _differ(left.exposure, right.exposure):
        found.append(
            f"the cameras exposed for different times: left {1e6 * left.exposure:g} µs, right "
            f"{1e6 * right.exposure:g} µs. The middles of the exposures lie "
            f"{0.5e6 * abs(left.exposure - right.exposure):g} µs apart if both begin together"
        )
    if left.recorded is not None and right.recorded is not None:
        apart = abs((left.recorded - right.recorded).total_seconds())
        if apart > SAME_TAKE_S:
            found.append(
                f"the headers' dates lie {apart / 60:.0f} minutes apart: left {left.recorded:%Y-%m-%d %H:%M:%S}, right "
                f"{right.recorded:%Y-%m-%d %H:%M:%S}. Are both files of the same take?"
            )
    return found


def _differ(one: float, other: float) -> bool:
    return abs(one - other) > SAME_EXPOSURE * max(one, other)


def start_offset(left: CameraHeader, right: CameraHeader) -> tuple[float, str] | None:
    """How much later [s] the right camera took its frame 0, and since when that is counted; None if not told.

    Absolute where both clocks follow a common time signal, otherwise from each camera's own trigger.
    """
    if left.first_time is None or right.first_time is None:
        return None
    later = right.first_time - left.first_time
    if left.locked_clock and right.locked_clock and left.trigger_time and right.trigger_time:
        return later + (right.trigger_time - left.trigger_time), "the common clock's zero"
    return later, "the trigger"
