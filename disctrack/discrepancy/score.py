"""Score test: what each effect would gain, and which effects predict the same, from one linearisation.

The derivatives by every candidate are orthogonalised to those by the fitted quantities ("cleared"). To first order the
best value, its sigma and the decrease of chi-square follow from inner products: a whole catalogue costs one fit.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.kit.least_squares import solve_bounded
from calibration.kit.types import Array
from disctrack.discrepancy.elimination import Own, is_linear, prior_rows, projection
from disctrack.discrepancy.fit import Fit
from disctrack.discrepancy.system import Candidate, System

DEPENDENT = 1e-9  # singular value over the largest, below which columns are linearly dependent
INVISIBLE = 1e-6  # share of a column that is left after orthogonalisation, below which the data do not show the effect


@dataclass(frozen=True)
class Score:
    """First-order result for one candidate."""

    candidate: Candidate
    values: Array  # (k,) best values within bounds
    sigma: Array  # (k,) standard deviations; infinite where the data do not see the quantity
    gain: float  # decrease of chi-square
    visible: bool


class Linearisation:
    """Residuals and all derivatives at one fit, compressed by a QR decomposition, with the rows of the priors."""

    def __init__(self, system: System, fit: Fit, candidates: Sequence[Candidate]) -> None:
        """Linearise at the fit by its own quantities and by those of all candidates.

        A candidate may free a quantity to which the fit gives a prior: there are then two columns of the same name.
        """
        held = {q.name: q.prior_sigma for q in fit.quantities}
        new = {q.name: q for c in candidates for q in c.quantities if q.prior_sigma > held.get(q.name, 0.0)}
        common = projection(system, fit.quantities, fit.values)
        own = Own(system, fit.quantities)
        self.fitted = tuple(q for q in fit.quantities if not (is_linear(q) or q.slot))
        values = {name: q.null for name, q in new.items()} | fit.values
        values |= dict(zip(common.names, common.null.tolist(), strict=True))
        names = list(dict.fromkeys([*(q.name for q in self.fitted), *new]))
        residual, derivative = system.linearise(values, [*own.slots, *names])
        self.usable = bool(np.isfinite(derivative).all())  # one derivative that cannot be computed spoils all others
        residual, derivative = (np.nan_to_num(x, posinf=0.0, neginf=0.0) for x in (residual, derivative))
        right, matrix, _ = own.reduced(residual, derivative, values, common)
        # a column that a block's own quantities absorb completely is left with rounding errors
        before = np.linalg.norm(derivative[..., len(own.slots) :], axis=(0, 1))
        matrix[:, np.linalg.norm(matrix, axis=0) < DEPENDENT * before] = 0.0
        everything = [*self.fitted, *new.values()]
        prior, prior_matrix = prior_rows(everything, values)
        self.right = np.concatenate([right, prior])
        self.matrix = np.vstack([matrix[:, [names.index(q.name) for q in everything]], prior_matrix])
        self.column = {q.name: i for i, q in enumerate(everything)}  # of two columns of a name, the free one
        self.quantities = {q.name: q for q in everything}
        self.values = values | {name: q.null for name, q in new.items()}
        self._at = np.array([*(values[q.name] for q in self.fitted), *(q.null for q in new.values())])
        self.basis = self.basis_without(())

    def basis_without(self, freed: Sequence[str]) -> Array:
        """Orthonormal basis (m, b) of the fitted columns, without those of quantities that a candidate frees."""
        free = [i for i, q in enumerate(self.fitted) if q.name not in freed and q.lower < self._at[i] < q.upper]
        columns = self.matrix[:, free]
        length = np.linalg.norm(columns, axis=0)
        return np.linalg.qr(columns / np.where(length > 0, length, 1.0))[0]

    def columns(self, names: Sequence[str]) -> Array:
        """Columns (m, k), not orthogonalised."""
        return self.matrix[:, [self.column[n] for n in names]]

    def cleared(self, columns: Array) -> Array:
        """Columns orthogonalised to those of the fitted quantities."""
        return cleared(columns, self.basis)

    def seen(self, names: Sequence[str]) -> Array:
        """(m, b) orthogonalised columns, without those that the fitted quantities absorb completely."""
        columns = self.columns(names)
        left = self.cleared(columns)
        return left[:, np.linalg.norm(left, axis=0) > INVISIBLE * np.maximum(np.linalg.norm(columns, axis=0), 1e-300)]

    def gain_of(self, names: Sequence[str]) -> tuple[float, Array]:
        """Decrease of chi-square if these are fitted too, all within their bounds; and their values (k,)."""
        mine = [self.column[n] for n in names]
        fitted = [i for i in range(len(self.fitted)) if i not in mine]
        A, x0 = self.matrix[:, [*fitted, *mine]], self._at[[*fitted, *mine]]
        quantities = [*(self.fitted[i] for i in fitted), *(self.quantities[n] for n in names)]
        lower = np.array([q.lower for q in quantities]) - x0
        upper = np.array([q.upper for q in quantities]) - x0
        step = solve_bounded(self.right, A, lower, upper)
        gain = self.right @ self.right - np.sum((self.right - A @ step) ** 2)
        return float(max(gain, 0.0)), (x0 + step)[len(fitted) :]


def cleared(columns: Array, basis: Array) -> Array:
    """Columns (m,) or (m, k) orthogonalised to an orthonormal basis (m, b)."""
    for _ in range(2):  # twice is enough (Kahan): the first pass leaves rounding errors of the size of what it removes
        columns = columns - basis @ (basis.T @ columns)
    return columns


def span(columns: Array) -> Array:
    """(m, b) orthonormal basis of the span of columns (m, k) of any sizes."""
    length = np.linalg.norm(columns, axis=0)
    U, singular, _ = np.linalg.svd(columns[:, length > 0] / length[length > 0], full_matrices=False)
    return np.asarray(U[:, singular > DEPENDENT * singular[0]] if singular.size else U, float)


def score(linear: Linearisation, candidate: Candidate) -> Score:
    """Gain, values and sigmas of one candidate to first order."""
    if not linear.seen(candidate.names).size:
        k = len(candidate.names)
        return Score(candidate, np.full(k, np.nan), np.full(k, np.inf), 0.0, False)
    gain, values = linear.gain_of(candidate.names)
    freed = any(q.name in candidate.names for q in linear.fitted)
    basis = linear.basis_without(candidate.names) if freed else linear.basis
    return Score(candidate, values, sigmas(linear.columns(candidate.names), basis), gain, True)


def sigmas(columns: Array, basis: Array) -> Array:
    """Standard deviations (k,) by columns (m, k), with `basis` fitted too; infinite where the data show nothing."""
    length = np.linalg.norm(columns, axis=0)
    left = cleared(columns, basis) / np.where(length > 0, length, 1.0)
    eigenvalues, vectors = np.linalg.eigh(left.T @ left)
    seen = eigenvalues > INVISIBLE**2
    variance = (vectors[:, seen] ** 2) @ (1.0 / eigenvalues[seen])
    variance[np.any(np.abs(vectors[:, ~seen]) > INVISIBLE, axis=1)] = np.inf
    return np.asarray(np.sqrt(variance) / np.where(length > 0, length, 1.0), float)


def score_all(linear: Linearisation, candidates: Sequence[Candidate]) -> list[Score]:
    """Scores of all candidates, largest gain first."""
    return sorted((score(linear, c) for c in candidates), key=lambda s: -s.gain)


def angle(linear: Linearisation, signal: Array, names: Sequence[str]) -> float:
    """Angle [rad] between a signal (m,) and what the named quantities can predict, both orthogonalised.

    0: no fit distinguishes them; pi/2: orthogonal.
    """
    signal, basis = linear.cleared(signal), span(linear.seen(names))
    if not basis.size or not signal.any():
        return float(np.pi / 2)
    within = basis @ (basis.T @ signal)
    return float(np.arctan2(np.linalg.norm(signal - within), np.linalg.norm(within)))
