"""Errors and stated sigmas in recordings of an imperfect laboratory, by the product's own renderer."""

import numpy as np
import pytest

from disctrack.validate.imperfect import GOAL_HEIGHT, GOAL_TILT, honesty, imperfect_table, imperfect_trials
from disctrack.validate.run import scene_of


@pytest.mark.slow
def test_height_tilt_and_what_is_stated_of_them():
    trials = imperfect_trials([scene_of(seed, quick=True) for seed in (31, 32)], 60)
    table = imperfect_table(trials)
    assert table.count("+-") == 13
    for trial in trials:
        # cameras of a quarter of the pixels: noise and what is left of the lens field are 1.7 times the paper's
        assert abs(trial.error[2]) < 1.7 * GOAL_HEIGHT
        assert np.abs(trial.error[3:5]).max() < 1.7 * GOAL_TILT
        assert 0.7 < trial.noise_ratio < 1.4
        assert np.all(np.abs(trial.error) < 4 * trial.sigma)
    assert honesty(trials).max() < 6.0  # two recordings: chi-square of 2 degrees exceeds 12 once in 400
