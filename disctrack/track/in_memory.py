"""The measurement on frames in memory: arrays in, trajectory out."""

import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.cameras.camera import StereoRig
from calibration.kit.arguments import FrameRate, Gravity, Threads, Times, checked, grey_values
from calibration.kit.threads import one_blas_thread
from disctrack.analyse.declaration import contradictions
from disctrack.disc import Disc
from disctrack.errors import TrackingError
from disctrack.findings import warn_of_doubts
from disctrack.frames import CAMERAS
from disctrack.recording.readers.blocks import PairBlock
from disctrack.track.follow.tracking import TrackingSettings, prepare, track
from disctrack.track.measurement import Measurement, Progress

Images = NDArray[Any]  # of any real type; uint8 and uint16 are measured where they are

BLOCK, COPIED_BLOCK = 256, 16  # pairs


@one_blas_thread
@checked
def measure_pairs(
    images: tuple[Images, Images] | Images,
    rig: StereoRig,
    disc: Disc,
    frame_rate: FrameRate,
    *,
    gravity: Gravity = 9.81,
    settings: TrackingSettings | None = None,
    timestamps: Times | None = None,
    threads: Threads = 1,
    progress: Progress = lambda n: None,
) -> Measurement:
    """Measure the disc's pose in every pair; every frame is measured (no rest is left out).

    images     : (n, 2, height, width) grey values, left and right; or the pair of arrays (n, height, width)
    rig, disc  : or what holds them: the path of a rig file, a calibration, a recording
    frame_rate : [Hz]; timestamps (n,) [s], increasing, where the camera wrote them
    gravity    : [m/s^2], kept with the trajectory for the physics
    Raises TrackingError if the arrays are not such images, do not belong to the rig, or show the disc in no pair.

        >>> pairs = open_pairs("clip")
        >>> images = np.array([[pairs.left.read(i), pairs.right.read(i)] for i in range(20)])
        >>> len(measure_pairs(images, "clip/results/rig.h5", read_recording("clip"), 1000.0).trajectory)
        20
    """
    if not isinstance(images, tuple | list):
        images = grey_values(images, "images")
    left, right = _sides(images)
    # pairs that lie together are measured where they are: of their pixels the dots' alone are looked at
    whole = images if isinstance(images, np.ndarray) and images.flags.carray else None
    block = BLOCK if whole is not None else COPIED_BLOCK
    n = len(left)
    times = None if timestamps is None else np.asarray(timestamps, float)
    if times is not None and (times.shape != (n,) or not np.all(np.diff(times) > 0)):
        raise TrackingError(f"timestamps of shape {times.shape} for {n} pairs; expected ({n},), increasing, in seconds")
    prepare(left.dtype)

    def read_blocks(start: int, stop: int) -> Iterator[PairBlock]:
        for first in range(start, stop, block):
            rows = slice(first, min(first + block, stop))
            pair = whole[rows] if whole is not None else np.stack([left[rows], right[rows]], axis=1)
            yield PairBlock(np.arange(rows.start, rows.stop), pair)

    began = time.perf_counter()
    tracking = track(
        read_blocks,
        range(n),
        rig,
        disc,
        frame_rate,
        gravity=gravity,
        settings=settings,
        timestamps=times,
        workers=threads,
        progress=progress,
    )
    seconds = time.perf_counter() - began
    found = contradictions(tracking.trajectory, disc, noticed=tracking.findings)
    warn_of_doubts(found)
    return Measurement(replace(tracking.trajectory, findings=found), (), tracking.details, seconds)


def _sides(images: Images | tuple[Images, Images]) -> tuple[Images, Images]:
    expected = "expected (n, 2, height, width), or two arrays (n, height, width) of one type"
    if isinstance(images, tuple | list) and len(images) == 2:
        left, right = (grey_values(side, f"{name} images") for side, name in zip(images, CAMERAS, strict=True))
    else:
        whole = np.asarray(images)
        if whole.ndim != 4 or whole.shape[1] != 2:
            raise TrackingError(f"images of shape {whole.shape}; {expected}")
        left, right = whole[:, 0], whole[:, 1]
    if left.shape != right.shape or left.ndim != 3 or left.dtype != right.dtype:
        raise TrackingError(f"images of shape {left.shape} {left.dtype} and {right.shape} {right.dtype}; {expected}")
    if not len(left):
        raise TrackingError("no image in the arrays")
    return left, right
