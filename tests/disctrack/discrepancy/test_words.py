"""What a recording leaves open is told in words: how large it may be, and what keeps it open."""

import numpy as np
import pytest

from disctrack.discrepancy.fit import Fit, fit
from disctrack.discrepancy.search import Found
from disctrack.discrepancy.system import Candidate, Quantity
from disctrack.discrepancy.words import bounds, correlated
from tests.oracles.linear_system import Linear, one

TILT = tuple(Quantity(f"table_tilt.tilt_{axis}", "rad", 1e-6) for axis in "xy")
DECLARED = Quantity("km.k_m", "m s^2", 1e-9)
CANDIDATE = Candidate("table_tilt", "table_tilt", "motion", "table tilted", "", TILT)


def told(values, sigmas, correlation=0.0):
    covariance = np.diag(np.square(sigmas)).astype(float)
    covariance[1, 2] = covariance[2, 1] = correlation * sigmas[1] * sigmas[2]
    numbers = dict(zip(("table_tilt.tilt_x", "table_tilt.tilt_y", "km.k_m"), values, strict=True))
    fitted = Fit((*TILT, DECLARED), numbers, covariance, 100.0, 0.0, 100, True, 3)
    return bounds(Found(CANDIDATE, 50.0, 10.0, 10.0, ()), fitted)


@pytest.mark.parametrize(
    ("tilt_y", "correlation", "why"),
    [(-4e-6, 0.0, None), (1e-6, 0.0, "by the noise"), (1e-6, -0.97, "as km.k_m moves with it")],
)
def test_a_number_that_may_be_zero_is_bounded_and_what_keeps_it_open_is_named(tilt_y, correlation, why):
    bounded = told((5e-6, tilt_y, 1.0), (1e-6, 1e-6, 0.1), correlation)
    assert bounded == ([f"tilt_y is only bounded, |tilt_y| < 2.96 µrad (95 %), {why}"] if why else [])


def two_nearly_equal_slopes(seed):
    """y = a t + b t^1.1 + c with noise of variance 1."""
    time = np.linspace(0.5, 1.5, 200)
    columns = {"a": time, "b": time**1.1, "c": np.ones(200)}
    observed = 3 * columns["a"] + 2 * columns["b"] + 1 + np.random.default_rng(seed).standard_normal(200)
    return Linear(time, observed, columns, [one(name) for name in "abc"])


def test_the_combination_that_is_known_is_known_as_well_as_stated():
    errors, sigmas, alone = [], [], []
    for seed in range(60):
        system = two_nearly_equal_slopes(seed)
        found = fit(system, system.base, {})
        (pair,) = correlated(found, ["a"], ["b"])
        errors.append(pair.value - (3.0 + pair.factor * 2.0))
        sigmas.append(pair.sigma)
        alone.append(found.sigma("a"))
    assert pair.correlation < -0.99
    assert max(sigmas) < 0.1 * min(alone)
    assert np.sqrt(np.mean((np.array(errors) / sigmas) ** 2)) == pytest.approx(1.0, abs=4 / np.sqrt(120))
