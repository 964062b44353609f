"""Systems of which a prediction is all there is to say; one with an answer on one line: amounts times columns."""

import numpy as np

from disctrack.discrepancy.system import Candidate, Quantity, System


def one(name, **more):
    return Quantity(name, "1", 0.1, **more)


def candidate(name, *quantities):
    return Candidate(name, name, "motion", name, "", quantities or (one(name),))


class Predicted(System):
    """A system by its prediction alone: observed (n,) or (n, w), noise of one sigma, derivatives by differences."""

    def __init__(self, time, observed, base=(), candidates=(), sigma=1.0):
        self.time, self.observed, self.sigma = time, observed, sigma
        self.weights = np.full(len(time), float(np.size(observed) // len(time)))
        self.base, self.candidates = tuple(base), tuple(candidates)

    def predicted(self, values):
        raise NotImplementedError

    def linearise(self, values, names):
        def seen(name, step):
            return self.predicted(values | {name: values.get(name, 0.0) + step})

        columns = [(seen(name, 1e-6) - seen(name, -1e-6)) / 2e-6 for name in names]
        shape = len(self.time), -1
        J = np.reshape(np.stack(columns, axis=-1), (*shape, len(names))) if names else np.zeros((len(self.time), 1, 0))
        return np.reshape(self.observed - self.predicted(values), shape) / self.sigma, J / self.sigma


class Linear(Predicted):
    def __init__(self, time, observed, columns, *more):
        super().__init__(time, observed, *more)
        self.columns = columns

    def predicted(self, values):
        return sum((values.get(n, 0.0) * c for n, c in self.columns.items()), np.zeros_like(self.observed))
