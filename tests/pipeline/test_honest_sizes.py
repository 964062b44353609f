"""Honesty by many cheap laboratories: points instead of images, through cameras that share no line with the product.

No tolerance is declared. Seeds here are not those that anything was chosen by.
"""

import numpy as np
import pytest

from tests.oracles import point_laboratory
from tests.oracles.imperfect_laboratory import IDEAL, Imperfections, Plan

# What frames share counts once in each laboratory: 10 of them scatter by sqrt(2 / 10) of their share.
SHARED = (0.3, 2.0), (0.5, 1.5)
# Office printers and rulers: the pattern as a whole is off as well, by what only the dots' scatter tells, of which nine
# degrees of freedom tell in each of ten laboratories.
BY_SCATTER = (0.15, 2.5), (0.4, 1.7)
LABORATORIES = {  # what differs; bounds of squared error over variance, of every coordinate and of their mean; rms [um]
    # 0.02 % of the way to the board's corner are 6 um, and the bow lifts its mean plane by 16 or 44 um
    "as filmed": ({}, *SHARED, 2.5),
    "a narrow baseline": ({"azimuths": (-110.0, -70.0)}, *SHARED, 5.0),
    "a small board": ({"inner_corners": (7, 5), "square": 7e-3}, *SHARED, 2.5),
    "twice as many views": ({"n_views": 40}, *SHARED, 2.5),
    "ideal": ({"imperfections": IDEAL}, *SHARED, 0.8),
    "dots off by 30 um": ({"imperfections": Imperfections(misprint=3e-5)}, *BY_SCATTER, np.inf),
    "dots off by 100 um": ({"imperfections": Imperfections(misprint=1e-4)}, *BY_SCATTER, np.inf),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", LABORATORIES)
def test_errors_are_as_large_as_stated(name):
    changed, each, mean, most_um = LABORATORIES[name]
    found = []
    for seed in range(21, 31):
        tracking, R, t = point_laboratory.recorded(Plan(seed, 120, **changed))
        found.append(point_laboratory.errors_and_variances(tracking.trajectory, R, t))
    ratio = np.mean([np.mean(e**2 / v, axis=0) for e, v in found], axis=0)
    assert np.all((ratio > each[0]) & (ratio < each[1])), ratio
    assert mean[0] < ratio.mean() < mean[1], ratio
    rms = 1e6 * np.sqrt(np.mean([np.mean(e[:, :3] ** 2, axis=0) for e, _ in found], axis=0))
    assert np.all(rms < most_um), rms
