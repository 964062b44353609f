"""Fit on the first part, free run over the rest: the judge that a flexible model cannot flatter."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.arrays import Array, Mask
from disctrack.diagnosis.engine.fit import Fit, fit, triangle
from disctrack.diagnosis.engine.system import Quantity, Subset, System, Values

TRAIN_FRACTION = 0.65  # of the time


@dataclass(frozen=True)
class HeldOut:
    """Prediction of samples that the fit has not seen."""

    train: Fit
    test_rows: Mask  # (n,)
    chi_square: float  # of the free run on the test rows; infinite where it ends too early
    expected: float  # what noise and the fitted quantities' uncertainty make of it
    log_density: float  # of the test data under the predictive distribution (up to a constant)
    n_data: int

    @property
    def ratio_to_floor(self) -> float:
        """Rms of the free run's residual over what noise and uncertainty of the fit allow; 1 is perfect."""
        return float(np.sqrt(self.chi_square / self.expected)) if self.expected > 0 else float("nan")


def training_rows(system: System, fraction: float = TRAIN_FRACTION) -> Mask:
    """(n,) True in the first part of the time that has data."""
    seen = system.time[system.weights > 0]
    return np.asarray(system.time <= seen[0] + fraction * (seen[-1] - seen[0]), bool)


def held_out(system: System, quantities: Sequence[Quantity], start: Values, rows: Mask) -> HeldOut:
    """Fit on `rows`, then predict the others from that fit alone.

    The predictive distribution of the test data is normal with covariance 1 + J P J^T (P: covariance of the fit), so
    that a quantity which the first part leaves open is not punished for it.
    """
    train = fit(Subset(system, rows), quantities, start)
    test = ~rows & (system.weights > 0)
    residual, derivative = system.linearise(train.values, train.names)
    residual, derivative = residual[test].reshape(-1), derivative[test]
    derivative = derivative.reshape(residual.size, len(train.names))
    n_data = int(np.sum(system.weights[test]))
    if not (np.isfinite(residual).all() and np.isfinite(derivative).all()):
        return HeldOut(train, test, np.inf, float(n_data), -np.inf, n_data)
    root = _square_root(train.covariance)
    B = derivative @ root
    # R of [B, residual] over [1, 0]: its squares, which a run-away motion would make singular, are never formed
    k = B.shape[1]
    R = triangle(np.block([[B, residual[:, None]], [np.eye(k), np.zeros((k, 1))]]))
    quadratic = R[k, k] ** 2 if R.shape[0] > k else 0.0
    log_density = -0.5 * (quadratic + 2 * np.sum(np.log(np.abs(np.diag(R)[:k]))))
    expected = n_data + float(np.sum(B * B))
    return HeldOut(train, test, float(residual @ residual), expected, float(log_density), n_data)


def _square_root(covariance: Array) -> Array:
    if covariance.size == 0:  # a model without quantities
        return covariance
    scale = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    safe = np.where(scale > 0, scale, 1.0)
    eigenvalues, vectors = np.linalg.eigh(covariance / np.outer(safe, safe))
    return np.asarray(safe[:, None] * vectors * np.sqrt(np.maximum(eigenvalues, 0.0)), float)
