"""Pairs that both cameras lost, and whose files were numbered on as if nothing had happened: the clock jumps.

Nothing else moves a disc so: from one frame to the next, position and attitude are where the same motion has them some
frames later. Over a stretch on both sides of a cut, a polynomial in the frames' numbers cannot follow; one in numbers
that are higher by k after the cut can, with one k for all twelve numbers of the pose. A blow changes velocities, a
camera that moved changes places: neither is a later pose of the same motion.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calibration.kit.arrays import Array
from disctrack.frames import rotation_from_quaternion
from disctrack.trajectory import Trajectory

SIDE = 10  # frames on either side of a cut
DEGREE = 6  # of the polynomials: half a turn in a stretch leaves a hundredth of the noise
MOST_LOST = 12  # pairs, and frames without a pose at the cut
STANDS_OUT = 30.0  # times what a jump leaves, and the usual misfit; of 168 numbers chance alone reaches 1.6
UNEVEN = 0.1  # of a period: frames with time stamps of their own need no number


def in_words(lost: int) -> str:
    """What a jump is, by which so many pairs were lost."""
    return f"the clock jumps by {lost} frame{'s' * (lost > 1)}: both cameras lost as many pairs there"


def clock_jumps(trajectory: Trajectory) -> dict[int, int]:
    """First row after every jump of the recording, in the order of time -> pairs that were lost there.

    None where the frames have uneven times of their own.
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


def _cuts(seen: NDArray[np.bool_]) -> Iterator[tuple[int, NDArray[np.intp]]]:
    """Frames without a pose at a cut, and the rows behind which such a cut lies with SIDE poses on either side."""
    whole = np.convolve(seen, np.ones(SIDE), "valid") == SIDE  # rows i .. i + SIDE - 1
    for gap in range(MOST_LOST + 1):
        n = len(seen) - 2 * SIDE - gap + 1
        if n <= 0:
            return
        lost = np.convolve(seen, np.ones(gap), "valid")[SIDE : SIDE + n] == 0 if gap else np.ones(n, bool)
        first = np.flatnonzero(whole[:n] & whole[SIDE + gap : SIDE + gap + n] & lost)
        if len(first):
            yield gap, first + SIDE


def _misfit(stretches: Array, numbers: Array) -> Array:
    """(n,) squares that polynomials in these frame numbers leave of the columns of stretches (n, 2 SIDE, columns)."""
    scaled = 2 * (numbers - numbers[0]) / (numbers[-1] - numbers[0]) - 1
    basis, _ = np.linalg.qr(np.polynomial.chebyshev.chebvander(scaled, DEGREE))
    left = stretches - basis @ (basis.T @ stretches)
    return np.asarray(np.sum(left**2, axis=(1, 2)))


def without_jumps(trajectory: Trajectory, jumps: Mapping[int, int]) -> Trajectory:
    """The trajectory with the times and numbers that its frames have if these pairs were lost."""
    lost = np.zeros(len(trajectory), np.int64)
    for row, pairs in jumps.items():
        lost[row:] += pairs
    return replace(trajectory, time=trajectory.time + lost / trajectory.frame_rate, frame=trajectory.frame + lost)
