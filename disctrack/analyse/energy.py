"""How much energy is lost, and whether the precession keeps to its adiabatic level."""

from dataclasses import dataclass

import numpy as np

from calibration.kit.arrays import Array
from calibration.kit.brief import Outline
from disctrack.analyse.derivatives import MeasuredMotion
from disctrack.analyse.quantities import COLUMN, Propagated
from disctrack.disc import precession_rate
from disctrack.errors import ModelError

TOTAL, LEVEL = COLUMN["total"], COLUMN["precession_level"]


@dataclass(frozen=True, repr=False)
class Energy(Outline):
    """Energy of a recording."""

    loss: float  # [J] from the first to the last known frame, positive when lost
    loss_sigma: float  # [J] noise
    loss_sigma_calibration: float  # [J]; most of the calibration's error is common to both ends and cancels
    level_ratio: float  # mean of psidot^2 sin theta over 4 g / r, over whole nutation periods if there are any
    level_ratio_sigma: float  # from the scatter about it
    level_ratio_steady: float  # what steady precession of this disc with its centre at rest has at the median theta


def energy_of(found: Propagated) -> Energy:
    """Loss over the recording with both uncertainties, and the adiabatic level."""
    motion, known = found.motion, np.isfinite(found.value[:, LEVEL])
    try:
        typical = float(np.median(motion.euler[known, 1])) if known.any() else float("nan")
        steady = precession_rate(typical, motion.disc, motion.gravity)[0] ** 2 * np.sin(typical)
    except ModelError:  # a disc that stands nearly upright does not precess with its centre at rest
        steady = float("nan")
    over = 4 * motion.gravity / motion.disc.radius
    ratios = _level_ratio(motion, found.value[:, LEVEL] / over)
    return Energy(*_loss(found), *ratios, float(steady / over))


def _loss(found: Propagated) -> tuple[float, float, float]:
    """Energy lost between the first and the last known frame, with its two sigmas [J]."""
    known, column = np.flatnonzero(np.isfinite(found.value[:, TOTAL])), slice(TOTAL, TOTAL + 1)
    if known.size < 2:
        return (float("nan"),) * 3
    ends, motion = known[[0, -1]], found.motion
    J = found.jacobian[ends, TOTAL]
    before, after = np.einsum("ns,nsr->nr", J, motion.calibration_sensitivity[ends])
    common = (after - before) @ motion.rig_covariance @ (after - before)
    common += np.einsum("ns,nst,nt->", J, motion.systematic_at(ends), J)
    noise = found.covariance_at(ends, column).sum()
    first, last = found.value[ends, TOTAL]
    return float(first - last), float(np.sqrt(noise)), float(np.sqrt(max(0.0, common)))


def _level_ratio(motion: MeasuredMotion, ratio: Array) -> tuple[float, float]:
    """Mean of a ratio (n,), weighted evenly over the turns of precession, and its scatter per turn."""
    known = np.flatnonzero(np.isfinite(ratio))
    if known.size < 2:
        return float("nan"), float("nan")
    ratio = ratio[known]
    turns = np.floor((motion.euler[known, 0] - motion.euler[known[0], 0]) / (2 * np.pi)).astype(int)
    means = np.array([ratio[turns == turn].mean() for turn in np.unique(turns)])
    if len(means) < 2:
        return float(ratio.mean()), float(ratio.std())
    return float(means.mean()), float(means.std(ddof=1) / np.sqrt(len(means)))
