"""What a fit leaves: is it noise, and if not, is it of the motion or of the measurement?

A frame's dots are more numbers than a pose. What is missing in the motion shows in the six that a pose takes and in no
other; what is wrong with lenses, dots or light shows in all.
"""

from dataclasses import dataclass

import numpy as np

from disctrack.diagnosis.disc_system import DiscSystem
from disctrack.discrepancy.fit import Fit
from disctrack.discrepancy.significance import ljung_box, no_memory, whiteness

LEVEL = 1e-4  # probability with which noise alone is called more than noise, over all tests of a residual
DOUBTFUL = 0.05  # probability of what is left of the poses, below which laws outside the catalogue compete
MUCH = 25.0  # variances of the noise, beyond which nobody can say what the motion lacks
LIKE = 2.0  # times the excess of the numbers that no pose takes, up to which that of the poses is no motion's


@dataclass(frozen=True)
class LeftOver:
    """Tests of a residual; probabilities are corrected for the number of tests."""

    pose_chi_square: float  # per number of the poses, over the noise
    other_chi_square: float  # per number that no pose takes, over the noise
    pose_p_value: float  # of so much memory in the poses' part, if it were noise: Ljung-Box, and lines
    other_p_value: float  # likewise, of the rest: Ljung-Box
    n_tests: int

    @property
    def white(self) -> bool:
        """Is nothing to be seen but noise?"""
        return min(self.pose_p_value, self.other_p_value) >= LEVEL

    @property
    def of_the_motion(self) -> bool:
        """Do the poses hold more than noise, and more than what the measurement is seen to do to all numbers?"""
        return self.pose_p_value < LEVEL and not self.as_in_all

    @property
    def doubtful(self) -> bool:
        """May an effect of the motion be missing, although chi-square is that of noise?

        The poses' part is less like noise than that of one recording in twenty, and the numbers that no pose takes do
        not show as much of it: what those show is the measurement's, and is in the poses as well.
        """
        return self.pose_p_value < DOUBTFUL and not (self.other_p_value < DOUBTFUL and self.as_in_all)

    @property
    def as_in_all(self) -> bool:
        """Do the numbers that no pose takes exceed the noise as the poses do?"""
        return self.pose_chi_square - 1.0 <= LIKE * max(self.other_chi_square - 1.0, 0.0)

    @property
    def of_the_measurement(self) -> bool:
        """Is there more than noise, but as much in the numbers that no pose takes, and not much in all?"""
        excess = self.other_chi_square - 1.0
        return 0.05 < excess < MUCH and self.as_in_all


def left_over(system: DiscSystem, fit: Fit, noise: float) -> LeftOver | None:
    """Tests of what the fit leaves; None where too few rows are complete. noise : variance over that stated."""
    full = system.weights >= np.max(system.weights)
    n = int(full.sum())
    if n < 40 or np.max(system.weights) < 8:
        return None
    pose, other = (part[full] for part in system.parts_of_residual(fit.values))
    tested = whiteness(pose, float(1.0 / np.median(np.diff(system.time))), {})
    lags = min(20, max(1, n // 4))
    channels = other.shape[1]
    p_other = min(1.0, channels * no_memory(float(ljung_box(other, lags).max()), n, lags))
    p_pose = min(1.0, 2 * tested.p_value, 2 * 6 * float(tested.peak_p_value.min()))
    moved = sum(not np.isfinite(q.prior_sigma) for q in fit.quantities)
    return LeftOver(
        float(np.sum(pose**2) / max(6 * n - moved, 1) / noise),
        float(np.sum(other**2) / max((np.max(system.weights) - 6) * n, 1) / noise),
        p_pose,
        p_other,
        12 + channels,
    )
