"""A system with an answer on one line: observed = amounts times columns, and noise of one standard deviation."""

import numpy as np

from disctrack.discrepancy.system import Candidate, Quantity, System


def one(name, **more):
    return Quantity(name, "1", 0.1, **more)


def candidate(name, *quantities):
    return Candidate(name, name, "motion", name, "", quantities or (one(name),))


class Linear(System):
    def __init__(self, time, observed, columns, base=(), candidates=(), sigma=1.0):
        self.time, self.observed, self.columns, self.sigma = time, observed, columns, sigma
        self.weights = np.ones(len(time))
        self.base, self.candidates = tuple(base), tuple(candidates)

    def linearise(self, values, names):
        left = self.observed - sum((values.get(n, 0.0) * c for n, c in self.columns.items()), np.zeros(len(self.time)))
        J = np.array([self.columns[n] for n in names]).reshape(len(names), len(left)).T
        return left[:, None] / self.sigma, J[:, None] / self.sigma
