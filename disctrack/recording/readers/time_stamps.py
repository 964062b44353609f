"""Time stamps that a file keeps for its frames: can they be used, and do both cameras tell the same times?

Doubt leads to a warning, with the frames' numbers, and to evenly spaced frames.
"""

import numpy as np

from calibration.kit.arrays import Array
from calibration.kit.brief import ranges
from disctrack.frames import CAMERAS
from disctrack.recording.readers.base import FrameReader
from disctrack.recording.readers.camera_header import start_offset

RATE_TOLERANCE = 0.01  # of the declared rate; a clock's error is a thousandth of that, a wrong unit far more
LOST = 1.5  # periods between two frames: beyond, at least one is missing
SAME_INSTANT = 0.01  # of a period: at 60 rad/s and 1000 Hz the disc turns by 0.6 mrad in it


def usable_times(reader: FrameReader, frame_rate: float) -> Array | None:
    """Time stamps (n,) [s] of a reader, or None where there are none that fit the declared frame rate [Hz]."""
    times = reader.timestamps
    return None if times is None or _fault(times, frame_rate) else times


def check_time_stamps(
    left: FrameReader, right: FrameReader, frame_rate: float
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Doubts: stamps that are not used and why, frames of one camera that the other has not; and warnings: frames lost
    by each camera, and cameras that do not run together.

    frame_rate [Hz] as declared. Times count from frame 0 where the file has a camera's header, which tells how they lie
    to the other camera's.
    """
    doubts: list[str] = []
    warnings: list[str] = []
    usable: list[Array] = []
    for camera, reader in zip(CAMERAS, (left, right), strict=True):
        if reader.timestamps is None:
            continue
        fault = _fault(reader.timestamps, frame_rate)
        if fault:
            doubts.append(f"{camera} camera: time stamps are not used, frames are taken as evenly spaced: {fault}")
        else:
            usable.append(reader.timestamps)
            warnings += _lost_frames(camera, reader.timestamps, frame_rate)
    ours, theirs = left.header, right.header
    offset = start_offset(ours, theirs) if ours is not None and theirs is not None else None
    if len(usable) == 2 and len(usable[0]) == len(usable[1]) and (ours is None) == (theirs is None):
        theirs_shifted = usable[1] + (0.0 if offset is None else offset[0])
        slips = _slips(usable[0], theirs_shifted, 1.0 / frame_rate)
        doubts += slips
        warnings += [] if slips else _between_cameras(usable[0], theirs_shifted, 1.0 / frame_rate)
    return tuple(doubts), tuple(warnings)


def _fault(times: Array, frame_rate: float) -> str:
    """Why time stamps cannot be used; "" where they can."""
    bad = np.flatnonzero(~np.isfinite(times))
    if len(bad):
        return f"that of frame {bad[0]} is not a number"
    steps = np.diff(times)
    back = np.flatnonzero(steps <= 0)
    if len(back):
        return f"they do not increase from frame {back[0]} to {back[0] + 1}"
    if len(steps) and abs(float(np.median(steps)) * frame_rate - 1.0) > RATE_TOLERANCE:
        rate = 1.0 / float(np.median(steps))
        return f"they give {rate:.6g} frames/s, frame_rate_hz of {frame_rate:.6g} (are they in seconds?)"
    return ""


def _lost_frames(camera: str, times: Array, frame_rate: float) -> list[str]:
    steps = np.diff(times) * frame_rate
    gaps = np.flatnonzero(steps > LOST)
    if not len(gaps):
        return []
    lost = int(np.rint(steps[gaps] - 1).sum())
    return [f"{camera} camera: by its time stamps {lost} frame{'s' * (lost > 1)} missing, after frame {ranges(gaps)}"]


def _slips(left: Array, right: Array, period: float) -> list[str]:
    """From where on frame i of both cameras is not the same instant, if anywhere."""
    later = right - left
    # against the first frames: what the clocks' zeros differ by is constant, lost frames come on top
    slips = np.rint((later - later[0]) / period).astype(int)
    changes = np.flatnonzero(np.diff(slips)) + 1
    if len(changes):
        return [
            f"by the time stamps frame i of both cameras does not show the same instant from frame {changes[0]} on: "
            f"one camera lost frames that the other has (the offset changes at frame {ranges(changes)}). Poses from "
            "there on are wrong: take that frame from the other camera, too, or measure up to it with --frames"
        ]
    return []


def _between_cameras(left: Array, right: Array, period: float) -> list[str]:
    """How the right camera's times differ from the left one's: a constant, a drift, the rest."""
    later = right - left
    warnings = []
    index = np.arange(len(later)) - 0.5 * (len(later) - 1)
    offset = float(np.median(later))
    drift = float(index @ later / max(float(index @ index), 1.0)) / period
    rest = later - later.mean() - drift * period * index
    if abs(offset) > SAME_INSTANT * period:
        warnings.append(
            f"by the time stamps the right camera's frames are taken {1e6 * offset:.4g} µs after the left one's, "
            f"{abs(offset) / period:.2g} of a frame: the cameras are not synchronised, or their clocks have other zeros"
        )
    if abs(drift) * len(later) > SAME_INSTANT:
        warnings.append(
            f"by the time stamps the cameras' clocks drift apart by {1e6 * drift:+.3g} µs per second: each camera runs "
            "on a clock of its own"
        )
    worst = int(np.argmax(np.abs(rest)))
    if abs(rest[worst]) > SAME_INSTANT * period:
        warnings.append(
            f"by the time stamps the instants of the two cameras jitter by {1e6 * float(rest.std()):.3g} µs (rms), "
            f"most at frame {worst}: {1e6 * float(rest[worst]):+.3g} µs"
        )
    return warnings
