"""Clock jumps: image pairs lost by both cameras, with files numbered without a gap.

A jump has a unique signature: the pose in the next frame is that of the same motion some frames later. Around a jump,
a polynomial in the frame numbers does not fit the pose. A polynomial in frame numbers increased by k after the jump
does, with the same k for all twelve numbers of the pose. A blow changes velocities, a moved camera positions: neither
yields a later pose of the same motion.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from calibration.kit.types import Array, Indices, Mask
from disctrack.frames import rotation_from_quaternion
from disctrack.trajectory import Trajectory

SIDE = 10  # frames on either side of a cut
DEGREE = 6  # of the polynomials: half a turn in 2 SIDE frames has a misfit of a hundredth of the noise
MOST_LOST = 12  # pairs, and frames without a pose at the cut
STANDS_OUT = 30.0  # misfit over that with a jump, and over the median; noise alone in 168 numbers reaches 1.6
UNEVEN = 0.1  # of a period: irregularity of frames with time stamps of their own


def in_words(lost: int) -> str:
    """Description of a jump with so many lost pairs."""
    return f"the clock jumps by {lost} frame{'s' * (lost > 1)}: both cameras lost as many pairs there"


def clock_jumps(trajectory: Trajectory) -> dict[int, int]:
    """First row after each jump, in order of time -> number of lost pairs.

    Empty if the frames have time stamps of their own.
    """
    period = 1.0 / trajectory.frame_rate
    if len(trajectory) < 2 * SIDE or np.abs(np.diff(trajectory.time) / period - 1).max() > UNEVEN:
        return {}
    q, R = trajectory.q, rotation_from_quaternion(trajectory.quaternion)
    seen = trajectory.measured & np.isfinite(q).all(axis=1) & np.isfinite(R).all(axis=(1, 2))
    pose = np.where(seen[:, None], np.column_stack([q[:, :3] / trajectory.disc.radius, R.reshape(-1, 9)]), 0.0)
    found: list[tuple[int, Array]] = []
    for gap, rows in _cuts(seen):
        around = np.r_[-SIDE:0, gap : gap + SIDE]
        stretch = pose[rows[:, None] + around]
        misfit = np.stack([_misfit(stretch, around + k * (around >= 0)) for k in range(MOST_LOST + 1)], axis=-1)
        found += zip((rows + gap).tolist(), misfit, strict=True)
    usual = float(np.median([misfit[0] for _, misfit in found])) if found else 0.0
    found = [(row, m) for row, m in found if m[0] > STANDS_OUT * max(usual, m.min())]
    jumps: dict[int, int] = {}
    for row, misfit in sorted(found, key=lambda one: one[1].min() / one[1][0]):
        if all(abs(row - other) >= SIDE for other in jumps):
            jumps[row] = int(misfit.argmin())
    return dict(sorted(jumps.items()))


def _cuts(seen: Mask) -> Iterator[tuple[int, Indices]]:
    """Numbers of frames without a pose at a cut, and the rows that follow SIDE poses and precede such a cut."""
    for gap in range(min(MOST_LOST, len(seen) - 2 * SIDE) + 1):
        around = np.lib.stride_tricks.sliding_window_view(seen, 2 * SIDE + gap)
        lost = ~around[:, SIDE : SIDE + gap].any(axis=1)
        first = np.flatnonzero(around[:, :SIDE].all(axis=1) & lost & around[:, SIDE + gap :].all(axis=1))
        if len(first):
            yield gap, first + SIDE


def _misfit(stretches: Array, numbers: Array) -> Array:
    """(n,) sums of squared residuals of polynomials in these frame numbers; stretches : (n, 2 SIDE, columns)."""
    scaled = 2 * (numbers - numbers[0]) / (numbers[-1] - numbers[0]) - 1
    basis, _ = np.linalg.qr(np.polynomial.chebyshev.chebvander(scaled, DEGREE))
    left = stretches - basis @ (basis.T @ stretches)
    return np.asarray(np.sum(left**2, axis=(1, 2)))


def without_jumps(trajectory: Trajectory, jumps: Mapping[int, int]) -> Trajectory:
    """The trajectory with times and frame numbers corrected for these lost pairs."""
    lost = np.zeros(len(trajectory), np.int64)
    for row, pairs in jumps.items():
        lost[row:] += pairs
    return replace(trajectory, time=trajectory.time + lost / trajectory.frame_rate, frame=trajectory.frame + lost)
