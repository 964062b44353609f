"""Numbers that move together are given with the combination that is known."""

import numpy as np
import pytest

from disctrack.discrepancy.correlated import correlated
from disctrack.discrepancy.fit import fit
from disctrack.discrepancy.system import Quantity, System


class TwoNearlyEqualSlopes(System):
    """y = a t + b t^1.1 + c with noise of variance 1."""

    candidates = ()

    def __init__(self, seed: int) -> None:
        self.time = np.linspace(0.5, 1.5, 200)
        self.base = tuple(Quantity(name, "1", 0.1) for name in "abc")
        self.columns = np.stack([self.time, self.time**1.1, np.ones(200)], axis=1)
        self.data = self.columns @ [3.0, 2.0, 1.0] + np.random.default_rng(seed).standard_normal(200)
        self.weights = np.ones(200)

    def linearise(self, values, names):
        residual = self.data - self.columns @ [values[n] for n in "abc"]
        return residual[:, None], self.columns[:, None, ["abc".index(n) for n in names]]


def test_the_combination_that_is_known_is_known_as_well_as_stated():
    errors, sigmas, alone = [], [], []
    for seed in range(60):
        system = TwoNearlyEqualSlopes(seed)
        found = fit(system, system.base, {})
        (pair,) = correlated(found, ["a"], ["b"])
        errors.append(pair.value - (3.0 + pair.factor * 2.0))
        sigmas.append(pair.sigma)
        alone.append(found.sigma("a"))
    assert pair.correlation < -0.99
    assert max(sigmas) < 0.1 * min(alone)
    assert np.sqrt(np.mean((np.array(errors) / sigmas) ** 2)) == pytest.approx(1.0, abs=4 / np.sqrt(120))


def test_quantities_without_each_other_are_no_pair():
    system = TwoNearlyEqualSlopes(1)
    free = fit(system, system.base, {})
    assert correlated(free, ["a"], ["a", "unknown"]) == ()
    assert correlated(free, ["a"], ["b"], strong=1.1) == ()
