"""What a long exposure does to the dots of a moving disc, taken off where the exposure time is known.

Over an exposure T a dot's image is smeared along its path; its centre is the mean of the path, which lies beside the
place at mid exposure by T^2 / 24 times the acceleration of the image (second order of the path; the first vanishes).
While the disc rolls, this makes theta read low by sin(theta) (psidot T)^2 / 24 = g T^2 / (6 r), at every theta alike
(steady precession, psidot^2 sin(theta) = 4 g / r): 0.6 mdeg at 0.5 ms and r = 37.5 mm.
"""

from __future__ import annotations

import numpy as np

from calibration.arrays import Array, Mask
from disctrack import frames
from disctrack.track.pose import marker_pixels
from disctrack.trajectory import FrameStatus, Trajectory

BORROWED_FROM = 2  # frames: beside a gap, the acceleration of a neighbour up to this far away is used


def shift_by_exposure(trajectory: Trajectory, exposure: tuple[float, float]) -> Array:
    """(n, 2, m, 2) [px] by which the dots of an exposure lie beside their places at mid exposure; zero where not known.

    exposure: of the left and the right camera [s]. The acceleration is that of the poses of three measured frames in a
    row: their noise adds at most 0.1 of itself (T as long as the frame interval), what differences leave out is
    (psidot / frame_rate)^2 / 12 of the shift.
    """
    measured = trajectory.frame_status == FrameStatus.MEASURED
    R = frames.rotation_from_quaternion(np.where(measured[:, None], trajectory.quaternion, [1.0, 0.0, 0.0, 0.0]))
    t = np.where(measured[:, None], trajectory.q[:, :3], np.nan)
    pixels, _ = marker_pixels(R, t, trajectory.rig, trajectory.disc.marker_centres_body)
    acceleration = np.full_like(pixels, np.nan)
    if len(pixels) > 2:
        before, after = (np.diff(trajectory.time)[part, None, None, None] for part in (slice(-1), slice(1, None)))
        step = np.diff(pixels, axis=0)
        acceleration[1:-1] = 2 * (step[1:] / after - step[:-1] / before) / (before + after)
    known = _all_finite(acceleration)
    for distance in range(1, BORROWED_FROM + 1):
        for way in (-distance, distance):
            wanted = np.flatnonzero(measured & ~known)
            wanted = wanted[(wanted + way >= 0) & (wanted + way < len(known))]
            wanted = wanted[known[wanted + way]]
            acceleration[wanted] = acceleration[wanted + way]
        known = _all_finite(acceleration)
    shift = np.array(exposure)[:, None, None] ** 2 / 24 * acceleration
    return np.where(np.isfinite(shift), shift, 0.0)


def _all_finite(values: Array) -> Mask:
    return np.asarray(np.isfinite(values).all(axis=(1, 2, 3)))
