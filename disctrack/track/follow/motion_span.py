"""Where the motion of a recording starts and ends, from a few of its frames, before anything is measured.

From each end of the recording, frames at intervals are held against the frame at that end until one differs: what lies
before it, less a margin, is rest. Only the ends are looked at, so a recording that moves throughout costs eight pairs,
and a pause in the middle stays. "Differs" means more than noise, a change of the light as a whole, or trembling below
VIBRATION_PX: anything else counts as motion, a hand as well as the disc, so that doubt costs time and not data.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.kit.arrays import Array32, robust_sigma
from calibration.kit.grey_levels import level_step
from disctrack.errors import RecordingError
from disctrack.recording.readers.base import FrameReader

Pair = tuple[NDArray, NDArray]

STRIDE = 16  # frames between two looks; irregular by up to 5, so that no turn of the disc comes back to every look
MARGIN = 0.25  # [s] kept before the last frame at rest: a disc that tips over starts below what can be seen
THRESHOLD = 5.0  # sigmas; of 65 000 pixels 0.04 exceed it by chance
MIN_PIXELS = 12  # of a quarter of the image's pixels: fewer are hot pixels or an insect
VIBRATION_PX = 0.03  # a fan's trembling; motion shows from THRESHOLD times this on, summed since rest
NOISE_BINS = 16


@dataclass(frozen=True)
class MotionSpan:
    """Frames start..stop-1 hold everything that moves, with a margin at either end."""

    start: int
    stop: int
    looked_at: int  # pairs read for this
    verdict: str


def still_scene(first: NDArray, second: NDArray) -> Callable[[NDArray], bool]:
    """Of one camera's view at rest: whether more has changed in an image than noise and the brightness of the whole."""
    mean = _reduced(first)
    steep = np.hypot(cv2.Sobel(mean, -1, 1, 0, scale=0.125), cv2.Sobel(mean, -1, 0, 1, scale=0.125))
    tremble = 0.5 * VIBRATION_PX * steep  # the reduced image has half the pixels per side
    weight = 1.0 / np.sqrt(_noise(mean, _reduced(second) - mean, steep) + tremble**2)
    centred = mean - mean.mean()
    square = float(np.vdot(centred, centred)) or 1.0

    def differs(image: NDArray) -> bool:
        now = _reduced(image)
        gain = float(np.vdot(centred, now)) / square
        z = np.abs(now - float(now.mean()) - gain * centred) * weight
        return int(np.count_nonzero(z > THRESHOLD)) >= MIN_PIXELS

    return differs


def _reduced(image: NDArray) -> Array32:
    """Means of two by two pixels, in steps of the grey value: images of any depth alike."""
    height, width = image.shape[0] // 2, image.shape[1] // 2
    whole = image[: 2 * height, : 2 * width].astype(np.float32) / np.float32(level_step(image))
    return np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA), np.float32)


def _noise(mean: Array32, difference: Array32, steep: Array32) -> float:
    """Variance of a difference of two reduced images at rest, of flat parts at the grey value where it is largest.

    Medians, because the two images may already show motion; where things move, they move at edges.
    """
    flat = steep <= np.quantile(steep, 0.6)
    alike = np.array_split(difference[flat][np.argsort(mean[flat])], NOISE_BINS)
    return max(1 / 12, *(robust_sigma(part) ** 2 for part in alike))


def find_motion(left: FrameReader, right: FrameReader, start: int, stop: int, frame_rate: float) -> MotionSpan:
    """The part of frames start..stop-1 in which something moves, with a margin of MARGIN seconds at either end.

    Frames that cannot be read are passed over.
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
    """Last of the frames, from the first on, that shows what the first shows, None where all do; pairs looked at."""
    scenes: list[Pair] = []
    last, looked = frames[0], 0
    for frame in _looks(frames):
        try:
            pair = left.read(frame), right.read(frame)
        except RecordingError:
            continue
        looked += 1
        if len(scenes) < 2:
            scenes.append(pair)
            still = tuple(map(still_scene, scenes[0], pair))
        elif any(differs(image) for differs, image in zip(still, pair, strict=True)):
            return last, looked
        last = frame
    return None, looked


def _looks(frames: range) -> Iterator[int]:
    """Frames to look at: two neighbours, one in STRIDE, and the last."""
    yield from frames[:2]
    for offset in (STRIDE * i + 5 * i * i % 11 - 5 for i in range(1, len(frames) // STRIDE + 1)):
        if offset < len(frames) - 1:
            yield frames[offset]
    yield frames[-1]
