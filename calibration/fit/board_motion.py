"""Random motion of the board between the left and the right exposure of a pair, with a size estimated from the pairs.

If the cameras are not triggered together, the board moves a little between the two images of a pair. The motion, a
rotation w about the board's middle and a shift s of it, has mean zero, one variance for w, one for s, and Student's
distribution: some hand-held boards are at rest, some are not. A pair determines the stereo pose to within this motion,
while each image determines its own camera in full. The variances are estimated by restricted maximum likelihood
(Patterson and Thompson 1971), with the fixed point sigma^2 = sum m^2 / (gamma - 2), where gamma is the number of
motions that the pairs determine (MacKay 1992, Neural Computation 4, 415): uncertainty of the cameras is not counted as
motion. With gamma - 2, sigma^2 is its posterior mean instead of its mode, as few motions determine it. Weights of the
pairs follow Lange, Little and Taylor (1989, J. Am. Stat. Assoc. 84, 881).
"""

from dataclasses import dataclass, replace

import numpy as np

from calibration.fit.stereo_model import StereoModel
from calibration.kit.types import Array, Mask

TAILS = 4.0  # degrees of freedom of Student's distribution, the usual value if few data would determine them
LEAST = 1e-7  # least size [rad], and relative to the board's distance: far below the uncertainty of any pose


@dataclass(frozen=True)
class BoardMotion:
    """Standard deviations per axis of the board's motion between the two exposures."""

    turn: float  # [rad]
    shift: float  # [m]
    pair_weights: Array | None = None  # (n_views,) inverse variances of the pairs' motions over the common one

    @property
    def weights(self) -> Array:
        """(6,) inverse variances of rotation and shift."""
        return np.repeat([self.turn**-2.0, self.shift**-2.0], 3)

    def weights_of(self, n: int) -> Array:
        """(n, 6) inverse variances of each pair."""
        return self.weights * (np.ones((n, 1)) if self.pair_weights is None else self.pair_weights[:, None])


def motions(model: StereoModel) -> tuple[Array, Array]:
    """Rotations and shifts (n_views, 6) of the boards in the left camera's axes, and their derivative (n_views, 6, 12).

    The derivative is by steps of the board's two poses as in `stereo_model.moved`; rotations are of first order.
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
        # a rotation v about the board's origin moves its middle by v x arm
        by_poses[:, 3:, first : first + 3] = sign * np.cross(np.eye(3), arm[:, None]).swapaxes(1, 2)
    return motion, by_poses


def updated(motion: BoardMotion, model: StereoModel, covariance: Array, apart: Mask) -> tuple[BoardMotion, float]:
    """One fixed-point step for the size of the motion, and the number of motions that the pairs determine.

    covariance : (n_views, 12, 12) of the poses, including the uncertainty of the shared parameters
    apart : (n_views,) views that are no pairs, and are ignored
    """
    m, J = motions(model)
    C = np.einsum("vij,vjk,vik->vi", J, covariance, J)
    weights = motion.weights_of(len(m))
    determined = np.clip(1.0 - C * weights, 0.0, 1.0) * ~apart[:, None]
    pair_weights = weights[:, 0] / motion.weights[0] * ~apart
    sizes = []
    distance = float(np.median(np.linalg.norm(model.t_left_board[:, 0], axis=1)))
    for part, least in ((slice(0, 3), LEAST), (slice(3, 6), LEAST * distance)):
        n_motions = max(float(determined[:, part].sum()) - 2.0, 1.0)
        sizes.append(max(float(np.sqrt(np.sum(pair_weights[:, None] * m[:, part] ** 2) / n_motions)), least))
    found = BoardMotion(sizes[0], sizes[1])
    pair_weights = (TAILS + 6.0) / (TAILS + np.sum((m**2 + C) * found.weights, axis=1))
    return replace(found, pair_weights=pair_weights), float(determined.sum())
