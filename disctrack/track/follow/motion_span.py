"""Start and end of the motion in a recording, from a few of its frames, before anything is measured.

From each end of the recording, frames at intervals are compared with the frame at that end until one differs: all
before it, minus a margin, is rest. Only the ends are searched, so a recording without rest costs eight pairs, and a
pause in the middle is kept. A frame differs if it changes by more than noise, a global change of brightness, or
vibration below VIBRATION_PX. All else counts as motion, also a hand, so that doubt costs time and not data.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from calibration.kit.grey_levels import level_step
from calibration.kit.types import AnyArray, Array32, robust_sigma
from disctrack.analyse.quantities import SIGMAS
from disctrack.errors import RecordingError
from disctrack.recording.readers.base import FrameReader

STRIDE = 16  # frames between two samples; irregular by up to 5, so that no period of the disc is in step with them
MARGIN = 0.25  # [s] kept before the last frame at rest: a disc that tips over starts too slowly to be seen
MIN_PIXELS = 12  # in the image of half size: fewer are hot pixels or an insect
VIBRATION_PX = 0.03  # by a fan; motion is detected from SIGMAS times this displacement on
NOISE_BINS = 16


@dataclass(frozen=True)
class MotionSpan:
    """Frames start..stop-1 contain all motion, with a margin at either end."""

    start: int
    stop: int
    looked_at: int  # number of pairs read
    verdict: str


def still_scene(first: AnyArray, second: AnyArray) -> Callable[[AnyArray], bool]:
    """Test for motion from two images at rest: has an image changed by more than noise and global brightness?"""
    mean = _reduced(first)
    steep = np.hypot(cv2.Sobel(mean, -1, 1, 0, scale=0.125), cv2.Sobel(mean, -1, 0, 1, scale=0.125))
    tremble = 0.5 * VIBRATION_PX * steep  # the reduced image has half the pixels per side
    weight = 1.0 / np.sqrt(_noise(mean, _reduced(second) - mean, steep) + tremble**2)
    centred = mean - mean.mean()
    square = float(np.vdot(centred, centred)) or 1.0

    def differs(image: AnyArray) -> bool:
        now = _reduced(image)
        gain = float(np.vdot(centred, now)) / square
        z = np.abs(now - float(now.mean()) - gain * centred) * weight
        return int(np.count_nonzero(z > SIGMAS)) >= MIN_PIXELS

    return differs


def _reduced(image: AnyArray) -> Array32:
    """Means of two by two pixels, in steps of the grey value, so that the bit depth does not matter."""
    height, width = image.shape[0] // 2, image.shape[1] // 2
    whole = image[: 2 * height, : 2 * width].astype(np.float32) / np.float32(level_step(image))
    return np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA), np.float32)


def _noise(mean: Array32, difference: Array32, steep: Array32) -> float:
    """Variance of the difference of two reduced images at rest, in flat regions; the largest over the grey values.

    A robust estimate, because something may already move; motion changes the image at edges.
    """
    flat = steep <= np.quantile(steep, 0.6)
    alike = np.array_split(difference[flat][np.argsort(mean[flat])], NOISE_BINS)
    return max(1 / 12, *(robust_sigma(part) ** 2 for part in alike))


def find_motion(left: FrameReader, right: FrameReader, start: int, stop: int, frame_rate: float) -> MotionSpan:
    """The part of frames start..stop-1 with motion, and a margin of MARGIN seconds at either end.

    Frames that cannot be read are skipped.
    """
    margin = max(int(np.ceil(MARGIN * frame_rate)), 2 * STRIDE)
    if stop - start < 2 * margin:
        return MotionSpan(start, stop, 0, "too short to leave anything out")
    last_still, looked = _last_still(left, right, range(start, stop))
    if last_still is None:
        return MotionSpan(start, stop, looked, "nothing moves in the whole recording")
    first_still, more = _last_still(left, right, range(stop - 1, start - 1, -1))
    begin, end = last_still - margin, (stop - 1 if first_still is None else first_still) + margin + 1
    begin, end = max(begin, start), min(end, stop)
    rest = [f"rest in frames {a}-{b - 1}" for a, b in ((start, begin), (end, stop)) if a < b]
    return MotionSpan(begin, end, looked + more, " and ".join(rest) or "moves from end to end")


def _last_still(left: FrameReader, right: FrameReader, frames: range) -> tuple[int | None, int]:
    """Last of the sampled frames before one that differs from the first, None if none does; number of pairs read."""
    last, looked = frames[0], 0
    for frame in _looks(frames):
        try:
            pair = left.read(frame), right.read(frame)
        except RecordingError:
            continue
        looked += 1
        if looked == 1:
            first = pair
        elif looked == 2:
            still = tuple(map(still_scene, first, pair))
        elif any(differs(image) for differs, image in zip(still, pair, strict=True)):
            return last, looked
        last = frame
    return None, looked


def _looks(frames: range) -> Iterator[int]:
    """Frames that are sampled: the first two, one in STRIDE, and the last."""
    yield from frames[:2]
    for offset in (STRIDE * i + 5 * i * i % 11 - 5 for i in range(1, len(frames) // STRIDE + 1)):
        if offset < len(frames) - 1:
            yield frames[offset]
    yield frames[-1]
