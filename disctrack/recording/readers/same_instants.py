"""Checks that frame i of both cameras shows the same instant.

Headers, numbers in the file names, and time stamps of both cameras are compared. A contradiction is an error; a doubt
is a warning with the numbers of the frames, and frames are assumed to be evenly spaced.
"""

from collections.abc import Iterator
from functools import partial

import numpy as np

from calibration.kit.brief import ranges
from calibration.kit.types import Array
from disctrack.errors import RecordingError
from disctrack.findings import Finding, Kind, Severity
from disctrack.recording.readers.base import CameraHeader, FrameReader

RATE_ROUNDING_HZ = 0.5  # headers give the rate in whole Hz
CLOCK_TOLERANCE = 1e-3  # relative deviation from the nominal rate for cameras with time stamps, which are used instead
SAME_TAKE_S = 600.0  # between the headers' dates: differences of clocks, and saving one camera after the other
ALIKE = 0.01  # relative tolerance of rates and exposures; clock errors are 1000 times smaller, wrong units far larger
SAME_INSTANT = 0.01  # tolerance in periods: at 60 rad/s and 1000 Hz the disc turns by 0.6 mrad in this time


def check_headers(
    left: FrameReader, right: FrameReader, frame_rate: float, exposure: float | None, declared_in: str
) -> Iterator[str]:
    """Compare the cameras' headers with each other, and with the declared frame rate [Hz] and exposure [s].

    Yields warnings. Raises RecordingError if frame i of both cannot be of the same instant, or if the rate is not the
    declared one. For formats without a header, another rate is only a warning: it may be that of a player.
    """
    for reader in (left, right):
        header, camera, rate = reader.header, reader.camera, reader.frame_rate
        declared = f"{declared_in}: [cameras] frame_rate_hz is {frame_rate:g}"
        if header is None:
            if rate is not None and abs(rate - frame_rate) > RATE_ROUNDING_HZ:
                yield f"{declared}, the {camera} file states {rate:g} Hz"
            continue
        stamped = 0.0 if header.first_time is None else CLOCK_TOLERANCE * header.frame_rate
        if abs(header.frame_rate - frame_rate) > max(RATE_ROUNDING_HZ, stamped):
            said = f"the {camera} camera's frames were recorded with {header.rate}, says {header.file}"
            raise RecordingError(f"{declared}, but {said}. Every velocity would be wrong by their ratio: correct that.")
        if exposure is not None and header.exposure is not None and _differ(header.exposure, exposure):
            said = f"the {camera} camera's header says {1e6 * header.exposure:g} µs ({header.file})"
            yield f"{declared_in}: [cameras] exposure_us is {1e6 * exposure:g}, {said}; the declared one is used"
    if left.header is not None and right.header is not None:
        yield from _compared(left.header, right.header)


def _compared(left: CameraHeader, right: CameraHeader) -> Iterator[str]:
    """Yields warnings. Raises RecordingError if frame i of both does not show the same instant."""
    if abs(left.frame_rate - right.frame_rate) > 1e-6 * left.frame_rate:
        rates = f"{left.rate} ({left.file}), the right one's with {right.rate} ({right.file})"
        said = f"the left camera's frames were recorded with {rates}: frame i of both does not show the same instant"
        raise RecordingError(f"{said}. Record with one rate, or export with the same step.")
    numbers = left.first_frame, right.first_frame
    if left.trigger == right.trigger and None not in numbers and numbers[0] != numbers[1]:
        first = f"frame {numbers[0]} ({left.file}), the right one with frame {numbers[1]} ({right.file})"
        said = f"the left file begins with the camera's {first}: frame i of both does not show the same instant"
        raise RecordingError(f"{said}. Export the same range of frames from both cameras.")
    offset, period = start_offset(left, right), 1.0 / left.frame_rate
    if offset is not None and abs(offset[0]) > 0.5 * period:
        later = f"taken {offset[0]:.4g} s after that of the left one ({left.file}); a frame lasts {period:.4g} s"
        said = f"by the time stamps, counted from {offset[1]}, the first frame of the right camera ({right.file}) was"
        raise RecordingError(f"{said} {later}. Export the frames of the same instants, of the same take.")
    if left.trigger != right.trigger:  # equal modes count from the same event, different ones may not
        modes = f"left {left.trigger or 'unknown'}, right {right.trigger or 'unknown'}"
        yield f"the cameras were triggered in different modes: {modes}. Frame i of both may show different instants"
    if left.exposure is not None and right.exposure is not None and _differ(left.exposure, right.exposure):
        times = f"left {1e6 * left.exposure:g} µs, right {1e6 * right.exposure:g} µs"
        apart = f"{0.5e6 * abs(left.exposure - right.exposure):g} µs apart if both begin together"
        yield f"the cameras exposed for different times: {times}. The middles of the exposures lie {apart}"
    if left.recorded is not None and right.recorded is not None:
        seconds = abs((left.recorded - right.recorded).total_seconds())
        if seconds > SAME_TAKE_S:
            dates = f"left {left.recorded:%Y-%m-%d %H:%M:%S}, right {right.recorded:%Y-%m-%d %H:%M:%S}"
            yield f"the headers' dates lie {seconds / 60:.0f} minutes apart: {dates}. Are both files of the same take?"


def _differ(one: float, other: float) -> bool:
    return abs(one - other) > ALIKE * max(one, other)


def start_offset(left: CameraHeader | None, right: CameraHeader | None) -> tuple[float, str] | None:
    """Delay [s] of the right camera's frame 0, and the origin of its times; None if unknown.

    Absolute if both clocks follow a common time signal, otherwise relative to each camera's own trigger.
    """
    if left is None or right is None or left.first_time is None or right.first_time is None:
        return None
    later = right.first_time - left.first_time
    if left.locked_clock and right.locked_clock and left.trigger_time and right.trigger_time:
        return later + (right.trigger_time - left.trigger_time), "the common clock's zero"
    return later, "the trigger"


def check_same_numbers(left: FrameReader, right: FrameReader) -> Iterator[str]:
    """Yields warnings about pairing two sequences by their order; frame i of both must be the same instant.

    Raises RecordingError if the ranges of numbers overlap but begin differently, or if the steps differ.
    """
    ours, theirs = left.numbers, right.numbers
    if ours is None or theirs is None or (ours[0], ours.step) == (theirs[0], theirs.step):
        return
    one, other = (f"{numbers[0]} to {numbers[-1]} in steps of {numbers.step}" for numbers in (ours, theirs))
    spans = f"left files are numbered {one}, right ones {other}"
    if ours.step != theirs.step or not (ours[-1] < theirs[0] or theirs[-1] < ours[0]):
        said = f"{left.describe(0)}, {right.describe(0)}: {spans}, but equal numbers must be the same instant"
        raise RecordingError(f"{said}. Copy what is missing, or number the frames of both cameras alike.")
    yield f"{spans}: they are taken as pairs in their order, number {ours[0]} with {theirs[0]}"


def usable_times(reader: FrameReader, frame_rate: float) -> Array | None:
    """Time stamps (n,) [s] of a reader; None if there are none, or if they do not fit the declared frame rate [Hz]."""
    times = reader.timestamps
    return None if times is None or _fault(times, frame_rate) else times


def check_time_stamps(left: FrameReader, right: FrameReader, frame_rate: float) -> Iterator[Finding]:
    """Yields doubts (unused stamps with the reason, frames lost by one camera only) and warnings.

    The warnings are on lost frames of each camera, and on cameras that are not synchronised. frame_rate [Hz] as
    declared. If the files have headers, times count from frame 0, and the headers give the delay between the cameras.
    """
    doubt, warning = (partial(Finding, Kind.TIME_STAMPS, how) for how in (Severity.DOUBT, Severity.WARNING))
    usable: list[Array] = []
    for reader in (left, right):
        if reader.timestamps is None:
            continue
        if fault := _fault(reader.timestamps, frame_rate):
            said = "time stamps are not used, frames are taken as evenly spaced"
            yield doubt(f"{reader.camera} camera: {said}: {fault}")
        else:
            usable.append(reader.timestamps)
            yield from map(warning, _lost_frames(reader.camera, reader.timestamps, frame_rate))
    offset, headers = start_offset(left.header, right.header), {left.header is None, right.header is None}
    if len(usable) == 2 and len(usable[0]) == len(usable[1]) and len(headers) == 1:
        theirs_shifted = usable[1] + (0.0 if offset is None else offset[0])
        slips = [*_slips(usable[0], theirs_shifted, 1.0 / frame_rate)]
        yield from map(doubt, slips)
        yield from [] if slips else map(warning, _between_cameras(usable[0], theirs_shifted, 1.0 / frame_rate))


def _fault(times: Array, frame_rate: float) -> str:
    """Why time stamps cannot be used; "" if they can."""
    bad = np.flatnonzero(~np.isfinite(times))
    if len(bad):
        return f"that of frame {bad[0]} is not a number"
    steps = np.diff(times)
    back = np.flatnonzero(steps <= 0)
    if len(back):
        return f"they do not increase from frame {back[0]} to {back[0] + 1}"
    if len(steps) and abs(float(np.median(steps)) * frame_rate - 1.0) > ALIKE:
        rate = 1.0 / float(np.median(steps))
        return f"they give {rate:.6g} frames/s, frame_rate_hz of {frame_rate:.6g} (are they in seconds?)"
    return ""


def _lost_frames(camera: str, times: Array, frame_rate: float) -> Iterator[str]:
    missing = np.rint(np.diff(times) * frame_rate).astype(int) - 1
    gaps = np.flatnonzero(missing > 0)
    if lost := int(missing[gaps].sum()):
        yield f"{camera} camera: by its time stamps {lost} frame{'s' * (lost > 1)} missing, after frame {ranges(gaps)}"


def _slips(left: Array, right: Array, period: float) -> Iterator[str]:
    """Message with the frame from which frame i of both cameras is not the same instant, if there is one."""
    later = right - left
    # relative to the first frames: the clocks may have different zeros, which is a constant
    slips = np.rint((later - later[0]) / period).astype(int)
    changes = np.flatnonzero(np.diff(slips)) + 1
    if len(changes):
        yield (
            f"by the time stamps frame i of both cameras does not show the same instant from frame {changes[0]} on: "
            f"one camera lost frames that the other has (the offset changes at frame {ranges(changes)}). Poses from "
            "there on are wrong: take that frame from the other camera, too, or measure up to it with --frames"
        )


def _between_cameras(left: Array, right: Array, period: float) -> Iterator[str]:
    """Messages on differences between the cameras' times: a constant, a drift, jitter."""
    later = right - left
    index = np.arange(len(later)) - 0.5 * (len(later) - 1)
    offset = float(np.median(later))
    drift = float(index @ later / max(float(index @ index), 1.0)) / period
    rest = later - later.mean() - drift * period * index
    worst = int(np.argmax(np.abs(rest)))
    later_by = f"{1e6 * offset:.4g} µs after the left one's, {abs(offset) / period:.2g} of a frame"
    jitter = f"{1e6 * float(rest.std()):.3g} µs (rms), most at frame {worst}: {1e6 * float(rest[worst]):+.3g} µs"
    for part, said in (
        (offset / period, f"right camera's frames are taken {later_by}: not synchronised, or clocks of other zeros"),
        (drift * len(later), f"cameras' clocks drift apart by {1e6 * drift:+.3g} µs per second: each has its own"),
        (rest[worst] / period, f"instants of the two cameras jitter by {jitter}"),
    ):
        if abs(part) > SAME_INSTANT:
            yield f"by the time stamps the {said}"
