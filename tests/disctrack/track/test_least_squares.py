"""The tail of chi-square against SciPy's, products against NumPy's."""

import os
import subprocess
import sys

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.special import chdtrc, chdtri

from disctrack.track.judging import _OF_SIX
from disctrack.track.least_squares import chance_beyond, inner_products


def test_the_tail_of_chi_square_agrees_with_scipy(rng):
    freedom = rng.integers(1, 400, 2000)
    square = freedom * rng.uniform(0, 3, 2000)
    assert_allclose(chance_beyond(square, freedom), chdtrc(freedom, square), rtol=1e-11, atol=1e-300)
    assert_allclose(chance_beyond([0.0, 3.0, np.inf, np.nan], [4, 1, 6, 18]), [1.0, chdtrc(1, 3.0), 0.0, np.nan])
    assert not np.allclose(chance_beyond(square, freedom + 1), chdtrc(freedom, square))  # one too many shows
    for chance, limit in _OF_SIX.items():
        assert_allclose(chdtri(6, chance), limit, rtol=1e-12)


@pytest.mark.parametrize("n", [0, 1, 110, 111, 5000])
def test_products_in_pieces_are_those_of_the_whole(rng, n):
    A, B = rng.normal(size=(n, 37)), rng.normal(size=(n, 5))
    assert_allclose(inner_products(A, B), A.T @ B, rtol=0, atol=1e-15 * (n + 1) ** 0.5 * 10)
    assert_allclose(inner_products(A, A), A.T @ A, rtol=0, atol=1e-14 * (n + 1))
    if n > 110:  # the rows beyond the last whole piece count
        assert not np.allclose(inner_products(A, B), A[: n // 110 * 110].T @ B[: n // 110 * 110])


_SPENT = """
import time
import numpy as np
from disctrack.track.least_squares import inner_products
A = np.random.default_rng(0).normal(size=(9600, 38))
product = {product}
product(A, A)
others = time.process_time() - time.thread_time()
for _ in range(30):
    product(A, A)
print(time.process_time() - time.thread_time() - others)
"""


def test_products_are_left_to_the_thread_that_asks_for_them():
    def spent_by_others(product: str) -> float:
        environment = {**os.environ, "OMP_NUM_THREADS": "2", "OPENBLAS_NUM_THREADS": "2"}
        words = [sys.executable, "-c", _SPENT.format(product=product)]
        return float(subprocess.run(words, env=environment, check=True, capture_output=True, text=True).stdout)

    assert spent_by_others("inner_products") < 1e-3  # s; a clock's steps
    whole = spent_by_others("lambda A, B: A.T @ B")
    if whole < 5e-3:
        pytest.skip("NumPy's BLAS shares nothing on this machine")
