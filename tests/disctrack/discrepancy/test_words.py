"""What a recording leaves open is told in words: how large it may be, and what keeps it open."""

import numpy as np

from disctrack.discrepancy.fit import Fit
from disctrack.discrepancy.score import Score
from disctrack.discrepancy.search import Found, _bounds
from disctrack.discrepancy.system import Candidate, Quantity
from disctrack.discrepancy.words import bounds

TILT = tuple(Quantity(f"table_tilt.tilt_{axis}", "rad", 1e-6) for axis in "xy")
DECLARED = Quantity("km.k_m", "m s^2", 1e-9)
CANDIDATE = Candidate("table_tilt", "table_tilt", "motion", "table tilted", "", TILT)


def told(values, sigmas, correlation=0.0):
    covariance = np.diag(np.square(sigmas)).astype(float)
    covariance[1, 2] = covariance[2, 1] = correlation * sigmas[1] * sigmas[2]
    numbers = dict(zip(("table_tilt.tilt_x", "table_tilt.tilt_y", "km.k_m"), values, strict=True))
    fitted = Fit((*TILT, DECLARED), numbers, covariance, 100.0, 0.0, 100, True, 3)
    return bounds(Found(CANDIDATE, 50.0, 10.0, 10.0, ()), fitted)


def test_a_number_that_is_told_from_nought_has_no_bound():
    assert told((5e-6, -4e-6, 1.0), (1e-6, 1e-6, 0.1)) == []


def test_a_number_within_its_sigma_is_bounded_by_the_noise():
    (text,) = told((5e-6, 1e-6, 1.0), (1e-6, 1e-6, 0.1))
    assert text == "tilt_y is only bounded, |tilt_y| < 2.96 urad (95 %), by the noise"


def test_a_number_that_another_keeps_open_names_it():
    (text,) = told((5e-6, 1e-6, 1.0), (1e-6, 1e-6, 0.1), correlation=-0.97)
    assert text.endswith("(95 %), as km.k_m moves with it")


def test_a_candidate_that_gains_no_more_than_noise_is_told_with_its_bound():
    score = Score(CANDIDATE, np.array([1e-6, -2e-6]), np.array([1e-6, np.inf]), 1.0, True)
    assert _bounds(score) == "; only bounded: tilt_x < 3e-06 rad (95 %)"
