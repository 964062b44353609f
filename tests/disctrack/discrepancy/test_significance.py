"""Sigmas of a gain of chi-square, beside arithmetic of 60 digits."""

import numpy as np
import pytest
from mpmath import mp
from numpy.testing import assert_allclose

from disctrack.discrepancy.significance import as_sigmas


def exact(gain, n):
    with mp.workdps(60):
        tail = mp.gammainc(mp.mpf(n) / 2, mp.mpf(gain) / 2, regularized=True)
        start = mp.sqrt(max(gain - (n - 1) * mp.log(gain + 2), 0.1))
        return float(mp.findroot(lambda z: mp.log(mp.erfc(z / mp.sqrt(2))) - mp.log(tail), start))


@pytest.mark.parametrize("gain", [0.5, 9.0, 40.0, 499.0, 501.0, 3e3, 5e4])
def test_sigmas_have_the_probability_of_the_gain(gain):
    assert_allclose(as_sigmas(gain, 1), np.sqrt(gain), rtol=1e-9)
    for n in (2, 3, 6):
        assert_allclose(as_sigmas(gain, n), exact(gain, n), rtol=1e-6)
    assert as_sigmas(gain, 1) > as_sigmas(gain, 2) > as_sigmas(gain, 6)


def test_noise_alone_is_no_sigma():
    assert as_sigmas(0.0, 2) == as_sigmas(-1.0, 1) == 0.0
    assert as_sigmas(9.0, 3) == pytest.approx(2.18, abs=0.01)  # not 3: three numbers gain 3 on average
