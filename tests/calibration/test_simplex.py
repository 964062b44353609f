"""The simplex against SciPy's, and at places that are known."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.optimize import minimize, rosen

from calibration.simplex import lowest


def bowl(x):
    return float((x - 2.0) @ np.diag([1.0, 30.0, 4.0][: len(x)]) @ (x - 2.0))


def walled(x):
    return np.inf if x[0] > 0.9 else float((x[0] - 1.0) ** 2 + abs(x[1]))


@pytest.mark.parametrize("function", [rosen, bowl, walled])
@pytest.mark.parametrize("start", [(-1.2, 1.0), (0.0, 3.0), (-9.2, -6.9), (0.4, 0.0, -2.0)])
@pytest.mark.parametrize("tolerance", [0.02, 1e-6])
def test_the_simplex_goes_where_scipys_goes_to_the_last_bit(function, start, tolerance):
    ours, ours_counted, theirs_counted = None, [], []
    ours = lowest(lambda x: ours_counted.append(x.copy()) or function(x), np.array(start), tolerance, tolerance)
    theirs = minimize(
        lambda x: theirs_counted.append(x.copy()) or function(x),
        start,
        method="Nelder-Mead",
        options={"xatol": tolerance, "fatol": tolerance},
    )
    assert_array_equal(ours[0], theirs.x)
    assert ours[1] == theirs.fun
    assert_array_equal(np.array(ours_counted), np.array(theirs_counted))


def test_the_lowest_place_of_a_bowl_is_its_middle():
    place, value = lowest(bowl, np.array([10.0, -3.0, 0.0]), 1e-8, 1e-12)
    assert_allclose(place, 2.0, atol=1e-6)
    assert value < 1e-10
    rough = lowest(bowl, np.array([10.0, -3.0, 0.0]), 0.5, 0.5)[0]
    assert np.abs(rough - 2.0).max() > 1e-3  # tolerances count
