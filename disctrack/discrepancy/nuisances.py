"""Linear quantities with priors, taken out of a least-squares problem once and for all.

Errors of lenses, dots and calibration enter the prediction linearly, with derivatives that no step of a fit changes.
There may be hundreds of them, and none is asked for: every fit needs only what of its residual and of its derivatives
they cannot absorb (variable projection), and their values at the end.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
from scipy.linalg import solve_triangular

from calibration.kit.arrays import Array
from disctrack.discrepancy.system import Quantity, Subset, System, Values

_KNOWN: WeakKeyDictionary[System, dict[tuple[object, ...], Projection]] = WeakKeyDictionary()


@dataclass(frozen=True)
class Projection:
    """What a set of linear quantities (k) with priors can absorb of m whitened numbers."""

    names: tuple[str, ...]
    null: Array  # (k,)
    scale: Array  # (k,) prior standard deviations
    root: Array  # (k, k) L of L L^T = N^T N + 1, N: columns times prior standard deviations
    rows: Array  # (m, k) orthonormal together with `prior_rows`
    prior_rows: Array  # (k, k)

    def cleared(self, columns: Array) -> Array:
        """(m + k, p): columns (m, p) without what the quantities absorb, and below what their priors then lack."""
        if not self.names:
            return columns
        taken = self.rows.T @ columns
        return np.concatenate([columns - self.rows @ taken, -self.prior_rows @ taken])

    def absorbed(self, columns: Array) -> Array:
        """(k, p) values of the quantities, less their nulls, that fit columns (m, p) best."""
        return self.scale[:, None] * solve_triangular(self.root, self.rows.T @ columns, lower=True, trans=1)

    @property
    def covariance(self) -> Array:
        """(k, k) of the quantities if nothing else is unknown."""
        inverse = self.scale[:, None] * solve_triangular(self.root, np.eye(len(self.names)), lower=True, trans=1)
        return np.asarray(inverse @ inverse.T, float)

    @property
    def degrees(self) -> float:
        """How many numbers the data determine rather than the priors."""
        return float(np.sum(self.rows**2))


def is_linear(q: Quantity) -> bool:
    """Is the quantity taken out beforehand? One without a prior never is."""
    return q.linear and bool(np.isfinite(q.prior_sigma))


def projection(system: System, quantities: Sequence[Quantity], values: Values) -> Projection:
    """Of the linear ones among the quantities; `values` of the others only have to lie where there is a prediction."""
    linear = [q for q in quantities if is_linear(q)]
    names = tuple(q.name for q in linear)
    null, scale = np.array([q.null for q in linear]), np.array([q.prior_sigma for q in linear])
    if not linear:
        return Projection((), null, scale, *np.zeros((3, 0, 0)))
    whole, part = (system.whole, system.key) if isinstance(system, Subset) else (system, b"")
    known = _KNOWN.setdefault(whole, {})
    key = (part, names, scale.tobytes())
    if key not in known:
        _, derivative = system.linearise(values, names)
        columns = derivative.reshape(-1, len(names)) * scale
        if not np.isfinite(columns).all():  # no prediction here: the fit says so
            return Projection(names, null, scale, np.eye(len(names)), np.zeros_like(columns), np.eye(len(names)))
        root = np.linalg.cholesky(columns.T @ columns + np.eye(len(names)))
        rows = solve_triangular(root, columns.T, lower=True).T
        prior_rows = solve_triangular(root, np.eye(len(names)), lower=True).T
        known[key] = Projection(names, null, scale, root, rows, prior_rows)
    return known[key]
