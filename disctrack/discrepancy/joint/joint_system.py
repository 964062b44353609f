"""Many recordings as one system for the search: its samples are recordings, its rows what each says of the shared."""

from collections.abc import Sequence

import numpy as np

from calibration.kit.arrays import Array
from disctrack.discrepancy.joint.crew import Crew
from disctrack.discrepancy.joint.sharing import Sharing
from disctrack.discrepancy.system import Candidate, Quantity, System, Values


class JointSystem(System):
    """Recordings that share quantities. A row is a recording's least-squares problem in them, its own ones at best."""

    def __init__(self, sharing: Sharing, crew: Crew) -> None:
        """Crew : of the members of the sharing, each with a method `reduce` (`Reduction`)."""
        self.sharing, self._crew = sharing, crew
        n = len(sharing.members)
        self.time: Array = np.arange(n, dtype=float)
        free = [sum(not np.isfinite(q.prior_sigma) for q in own) for own in sharing.own]
        self.weights: Array = np.array([m.n_data - k for m, k in zip(sharing.members, free, strict=True)], float)
        self.base: tuple[Quantity, ...] = tuple(sharing.base.values())
        self.candidates: tuple[Candidate, ...] = sharing.candidates

    def linearise(self, values: Values, names: Sequence[str]) -> tuple[Array, Array]:
        """Rows (n, w) of the recordings' reduced problems, filled up with zeros, and their derivatives (n, w, k)."""
        sharing, n = self.sharing, len(self.time)
        local = [sharing.local_names(i, names) for i in range(n)]
        found = self._crew.call("reduce", [(sharing.local_values(i, values), local[i]) for i in range(n)])
        reduced = {i: each for i, each in enumerate(found) if isinstance(each, tuple)}
        width = max([1, *(len(right) for right, _ in reduced.values())])
        residual, derivative = np.full((n, width), np.nan), np.zeros((n, width, len(names)))
        for i, (right, matrix) in reduced.items():
            residual[i] = 0.0
            residual[i, : len(right)] = right
            derivative[i, : len(right)] = matrix @ sharing.mixing(i, local[i], names)
        return residual, derivative
