"""Many recordings as one system for the engine: its samples are recordings, its rows what each says of the shared."""

from collections.abc import Callable, Sequence

import numpy as np

from calibration.kit.arrays import Array
from disctrack.discrepancy.joint.reduction import Reduced
from disctrack.discrepancy.joint.sharing import Sharing
from disctrack.discrepancy.system import Candidate, Quantity, System, Values

Request = tuple[int, dict[str, float], tuple[str, ...]]  # recording, its shared values, names
Reduce = Callable[[Sequence[Request]], list[Reduced | None]]  # what each recording says of its shared quantities


class JointSystem(System):
    """Recordings that share quantities. A row is a recording's least-squares problem in them, its own ones at best."""

    def __init__(self, sharing: Sharing, reduce: Reduce) -> None:
        """The requests number recordings as the sharing does."""
        self.sharing, self._reduce = sharing, reduce
        n = len(sharing.members)
        self.time: Array = np.arange(n, dtype=float)
        free = [sum(not np.isfinite(q.prior_sigma) for q in own) for own in sharing.own]
        self.weights: Array = np.array([m.n_data - k for m, k in zip(sharing.members, free, strict=True)], float)
        self.base: tuple[Quantity, ...] = tuple(sharing.base.values())
        self.candidates: tuple[Candidate, ...] = sharing.candidates

    def linearise(self, values: Values, names: Sequence[str]) -> tuple[Array, Array]:
        """Rows (n, w) of the recordings' reduced problems, filled up with zeros, and their derivatives (n, w, k)."""
        requests = [
            (i, self.sharing.local_values(i, values), self.sharing.local_names(i, names))
            for i in range(len(self.sharing.members))
        ]
        found = self._reduce(requests)
        width = max([1, *(len(r.right) for r in found if r is not None)])
        residual, derivative = np.zeros((len(found), width)), np.zeros((len(found), width, len(names)))
        for i, (reduced, (_, _, local)) in enumerate(zip(found, requests, strict=True)):
            if reduced is None:
                residual[i] = np.nan
                continue
            m = len(reduced.right)
            residual[i, :m] = reduced.right
            derivative[i, :m] = reduced.matrix @ self.sharing.mixing(i, local, names)
        return residual, derivative
