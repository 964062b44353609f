"""The tail of chi-square against SciPy's."""

import numpy as np
from numpy.testing import assert_allclose
from scipy.special import chdtrc, chdtri

from disctrack.track.judging import _OF_SIX
from disctrack.track.least_squares import chance_beyond


def test_the_tail_of_chi_square_agrees_with_scipy(rng):
    freedom = rng.integers(1, 400, 2000)
    square = freedom * rng.uniform(0, 3, 2000)
    assert_allclose(chance_beyond(square, freedom), chdtrc(freedom, square), rtol=1e-11, atol=1e-300)
    assert_allclose(chance_beyond([0.0, 3.0, np.inf, np.nan], [4, 1, 6, 18]), [1.0, chdtrc(1, 3.0), 0.0, np.nan])
    assert not np.allclose(chance_beyond(square, freedom + 1), chdtrc(freedom, square))  # one too many shows
    for chance, limit in _OF_SIX.items():
        assert_allclose(chdtri(6, chance), limit, rtol=1e-12)
