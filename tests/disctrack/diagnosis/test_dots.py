"""A dot that is misprinted alone is a fault to be named; printing scatter of all dots is not."""

import numpy as np
import pytest

from disctrack.diagnosis.declared_dots import misprinted, with_declared_dots
from tests.oracles.measured_disc import measured

SIGMA = np.full((6, 2), 0.3)


def finding(shift):
    return {"marker_shift_um": np.asarray(shift).tolist(), "marker_shift_sigma_um": SIGMA.tolist()}


def test_one_or_two_dots_out_of_six_are_misprints():
    shift = np.zeros((6, 2))
    shift[2] = 120, -80
    assert misprinted(finding(shift)) == (2,)
    shift[4] = 0, 9
    assert misprinted(finding(shift)) == (2, 4)


@pytest.mark.parametrize("size", [0.5, 20.0], ids=["within what dots may differ by", "all of them are off"])
def test_scatter_of_all_dots_is_no_misprint(size, rng):
    assert misprinted(finding(size * rng.standard_normal((6, 2)))) == ()


def test_a_shift_within_its_sigma_is_no_misprint():
    shift = np.zeros((6, 2))
    shift[1] = 12.0, 0.0
    loose = finding(shift) | {"marker_shift_sigma_um": np.full((6, 2), 5.0).tolist()}
    assert misprinted(finding(shift)) == (1,)
    assert misprinted(loose) == ()


def test_findings_of_an_older_file_change_nothing():
    trajectory = measured(n=5)
    one = {"marker_shift_um": [[0.0, 50.0], *[[0.0, 0.0]] * 5]}
    assert with_declared_dots(trajectory, one) is trajectory
    told = one | {"marker_shift_sigma_um": [[1.0, 1.0]] * 6}
    assert with_declared_dots(trajectory, told) is not trajectory


def test_declared_places_come_back():
    trajectory = measured(n=5)
    shift = np.zeros((6, 2))
    shift[5] = -30, 10
    declared = with_declared_dots(trajectory, finding(shift)).disc.marker_centres_body
    np.testing.assert_allclose(trajectory.disc.marker_centres_body[5] - declared[5], [-30e-6, 10e-6, 0], atol=1e-15)
    np.testing.assert_array_equal(trajectory.disc.marker_centres_body[:5], declared[:5])
