"""Boards that moved between the left and the right exposure of a pair: a random motion, as large as the pairs tell.

Where the cameras are not triggered together, every right image shows the board a little elsewhere. Its motion, a turn w
about the board's middle and a shift s of it, has mean zero, one variance for w, one for s, and Student's distribution:
of boards in a hand some are still and some are not. So a pair still tells how the cameras stand, as well as its motion
lets it, and each image tells of its own camera in full. The variances are those of restricted maximum likelihood
(Patterson and Thompson 1971), found by the fixed point sigma^2 = sum m^2 / (gamma - 2), gamma the number of motions
that the pairs determine (MacKay 1992, Neural Computation 4, 415): what cameras not yet known leave open is not counted
as motion; and gamma - 2 makes it the mean of what sigma^2 may be, as few motions tell it, not its likeliest value. How
much a pair is heeded follows as by Lange, Little and Taylor (1989, J. Am. Stat. Assoc. 84, 881).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calibration.fit.stereo_model import StereoModel
from calibration.kit.arrays import Array, Mask

TAILS = 4.0  # degrees of freedom of Student's distribution, as usual where few pairs would have to tell them
LEAST = 1e-7  # [rad], and of the board's distance: far below what any view tells of a pose


@dataclass(frozen=True)
class BoardMotion:
    """Standard deviations per axis of what a board did between the two exposures."""

    turn: float  # [rad]
    shift: float  # [m]
    heeded: Array | None = None  # (n_views,) inverse variances of the pairs, in those of all: some are held still

    @property
    def weights(self) -> Array:
        """(6,) inverse variances of turn and shift."""
        return np.repeat([self.turn**-2.0, self.shift**-2.0], 3)

    def weights_of(self, n: int) -> Array:
        """(n, 6) inverse variances of each pair."""
        return self.weights * (np.ones((n, 1)) if self.heeded is None else self.heeded[:, None])

    def is_near(self, other: BoardMotion) -> bool:
        """True if both differ by some percent at most: they are never known better."""
        return bool(np.allclose(self.weights, other.weights, rtol=0.05, atol=0.0))


def motions(model: StereoModel) -> tuple[Array, Array]:
    """Turns and shifts (n_views, 6) of the boards, in the left camera's axes, and their derivative (n_views, 6, 12).

    By steps of the two poses of a board, as `stereo_model.moved` takes them; turns to first order.
    """
    R, t = np.moveaxis(model.R_left_board, 1, 0), np.moveaxis(model.t_left_board, 1, 0)
    arms = R @ model.points.mean(0)
    turn = R[1] @ np.swapaxes(R[0], 1, 2)
    vector = [0.5 * (turn[:, i, j] - turn[:, j, i]) for i, j in ((2, 1), (0, 2), (1, 0))]
    shift = (arms[1] + t[1]) - (arms[0] + t[0])
    motion = np.concatenate([np.stack(vector, axis=1), shift], axis=1)
    by_poses = np.zeros((len(turn), 6, 12))
    for first, (arm, sign) in zip((0, 6), zip(arms, (-1.0, 1.0), strict=True), strict=True):
        by_poses[:, :, first : first + 6] = sign * np.eye(6)
        for axis in range(3):  # a turn v of the board about its origin moves the middle by v x arm
            by_poses[:, 3:, first + axis] = sign * np.cross(np.eye(3)[axis], arm)
    return motion, by_poses


def learnt(motion: BoardMotion, model: StereoModel, covariance: Array, apart: Mask) -> tuple[BoardMotion, float]:
    """The motion's size as the pairs tell it, one step of the fixed point, and the number of motions determined.

    covariance : (n_views, 12, 12) of the poses, the shared parameters' part included
    apart : (n_views,) that are no pairs, and tell nothing
    """
    m, J = motions(model)
    C = np.einsum("vij,vjk,vik->vi", J, covariance, J)
    weights = motion.weights_of(len(m))
    determined = np.clip(1.0 - C * weights, 0.0, 1.0) * ~apart[:, None]
    heeded = weights[:, 0] / motion.weights[0] * ~apart
    sizes = []
    distance = float(np.median(np.linalg.norm(model.t_left_board[:, 0], axis=1)))
    for part, least in ((slice(0, 3), LEAST), (slice(3, 6), LEAST * distance)):
        square = float(np.sum(heeded[:, None] * m[:, part] ** 2)) / max(float(determined[:, part].sum()) - 2.0, 1.0)
        sizes.append(max(float(np.sqrt(square)), least))
    found = BoardMotion(sizes[0], sizes[1])
    heeded = (TAILS + 6.0) / (TAILS + np.sum((m**2 + C) * found.weights, axis=1))
    return replace(found, heeded=heeded), float(determined.sum())
