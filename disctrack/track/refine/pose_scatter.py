"""How far poses scatter from frame to frame, beside what their dots tell.

Dots that err alike leave no residual: a camera or table that trembles, an encoder that moves blocks of the image
together. The motion tells: it is smooth, and what it is not is noise, whatever the dots say. In sixth differences of
the poses white noise is 30 times itself, and what precesses by an angle a per frame is a^6 of itself: at SLOW, 0.3 um
of 5 mm. So only frames are counted between which the disc precesses by less.
"""

import numpy as np
import scipy
from numpy.typing import NDArray

from calibration.kit.arrays import Array
from disctrack.track.judge.outlier_tests import differences, sums_over_time
from disctrack.track.pose import PoseFits

SLOW = 0.2  # [rad] of precession from frame to frame
# Horizontal place, height, tilt, turn about the vertical: light and view make each of them scatter in a way of its own.
GROUPS = ((0, 1), (2,), (3, 4), (5,))
MIN_FRAMES = 40  # fewer tell as much as eight independent ones, whose variance chance alone doubles now and then
KEPT = 0.8  # of the squares: blows and smears are cut off with the largest
# Successive sixth differences are correlated by -0.86, 0.54, -0.24, ...: n tell as much as n / 3.2 independent ones
# (the sum of the squared correlations); without those that are cut off, n / 4.5 (4000 samples of white noise).
WORTH = 4.5


def scatter_of_poses(fits: PoseFits) -> tuple[Array, Array, Array]:
    """Variance of the poses from frame to frame over what their dots, as the covariances have it, tell.

    From sixth differences: (4,) found, by GROUPS, NaN where no frames are slow enough; (4,) its sigma by chance alone;
    (6,) at least 1, for the variances of POSE_COMPONENTS: the part of the excess that is no chance.
    """
    found, sigma, factor = np.full(4, np.nan), np.full(4, np.nan), np.ones(6)
    parts = [
        away[slow] ** 2 / np.diagonal(spread[slow], axis1=1, axis2=2)
        for rows, away, spread in sums_over_time(fits, differences(6, -3))
        for slow in [_precession(fits.R_world_body, rows) < SLOW]
    ]
    square = np.concatenate(parts) if parts else np.empty((0, 6))
    if len(square) < MIN_FRAMES:
        return found, sigma, factor
    # what is kept of chi-square with one degree of freedom has this mean
    mean = scipy.special.chdtr(3, scipy.special.chdtri(1, 1 - KEPT)) / KEPT
    kept = np.sort(square, axis=0)[: int(KEPT * len(square))].mean(axis=0) / mean
    for i, group in enumerate(GROUPS):
        part = list(group)
        found[i], sigma[i] = kept[part].mean(), np.sqrt(2 * WORTH / (len(square) * len(part)))
        excess = found[i] - 1.0
        # nothing below three sigmas, all of what is far above
        factor[part] = 1.0 + max(excess - (3.0 * sigma[i]) ** 2 / excess, 0.0) if excess > 0 else 1.0
    return found, sigma, factor


def _precession(R: Array, rows: NDArray[np.intp]) -> Array:
    """Largest angle [rad] per frame by which the disc's axis turns about the vertical, in the seven frames around."""
    axis = R[rows[:, None] + np.arange(-3, 4), :2, 2]
    tilt = np.linalg.norm(axis, axis=2)
    with np.errstate(divide="ignore", invalid="ignore"):
        # a disc that lies flat has no direction to precess in, and none is measured: it is not slow
        turn = 2.0 * np.linalg.norm(np.diff(axis, axis=1), axis=2) / (tilt[:, 1:] + tilt[:, :-1])
    return np.asarray(turn.max(axis=1))
