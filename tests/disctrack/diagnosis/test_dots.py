"""A dot that is misprinted alone is a fault to be named; printing scatter of all dots is not."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from disctrack.diagnosis.recorded import with_declared_dots
from tests.oracles.measured_disc import measured

SIGMA = np.full((6, 2), 0.3)


def shifts(of_dots):
    shift = np.zeros((6, 2))
    for dot, by in of_dots.items():
        shift[dot] = by
    return shift


@pytest.mark.parametrize("of_dots", [{2: (120, -80)}, {2: (120, -80), 4: (0, 9)}, {1: (12, 0)}])
def test_one_or_two_dots_out_of_six_come_back_to_their_declared_places(of_dots):
    trajectory, shift = measured(n=5), shifts(of_dots)
    told = {"marker_shift_um": shift.tolist(), "marker_shift_sigma_um": SIGMA.tolist()}
    declared = with_declared_dots(trajectory, told).disc.marker_centres_body
    moved = trajectory.disc.marker_centres_body - declared
    assert_allclose(moved[:, :2], 1e-6 * shift, atol=1e-15)
    assert_array_equal(moved[:, 2], 0.0)


@pytest.mark.parametrize(
    ("shift", "sigma"),
    [
        (0.5 * np.ones((6, 2)), SIGMA),  # within what dots may differ by
        (np.random.default_rng(1).normal(0, 20, (6, 2)), SIGMA),  # all of them are off
        (shifts({1: (12, 0)}), 5.0 + 0 * SIGMA),  # within its sigma
        (shifts({1: (400, 0)}), SIGMA),  # declared wrongly, and told by the tracking
        (shifts({1: (0, 50)}), []),  # an older file
    ],
)
def test_anything_else_is_no_misprint(shift, sigma):
    trajectory = measured(n=5)
    told = {"marker_shift_um": np.asarray(shift).tolist(), "marker_shift_sigma_um": np.asarray(sigma).tolist()}
    assert with_declared_dots(trajectory, told) is trajectory
