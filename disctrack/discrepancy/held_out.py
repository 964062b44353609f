"""Prediction of held-out data: fit to the first part, predict the rest; it penalises flexible models."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.kit.least_squares import OwnNumbers, triangle
from calibration.kit.types import Array, Mask
from disctrack.discrepancy.elimination import Own
from disctrack.discrepancy.fit import ROUGHLY, Fit, fit
from disctrack.discrepancy.score import INVISIBLE, cleared, span
from disctrack.discrepancy.system import Quantity, System, Values, subset

TRAIN_FRACTION = 0.65  # of the time


@dataclass(frozen=True)
class HeldOut:
    """Prediction of held-out samples."""

    train: Fit
    test_rows: Mask  # (n,)
    chi_square: float  # of the prediction of the test rows; infinite where there is none
    expected: float  # expectation of it, by the noise and by the uncertainty of the fit
    log_density: float  # held-out log predictive density, up to a constant
    n_data: int

    @property
    def ratio_to_floor(self) -> float:
        """Rms prediction error over its expectation by noise and uncertainty of the fit (the noise floor)."""
        return float(np.sqrt(self.chi_square / self.expected)) if self.expected > 0 else float("nan")

    def gain_over(self, before: "HeldOut", noise: float) -> float:
        """Gain of twice the log density over another prediction of the same samples, in units of the noise."""
        gain = 2 * (self.log_density - before.log_density) / noise
        return -np.inf if np.isnan(gain) else float(gain)  # NaN where neither has a prediction


def training_rows(system: System) -> Mask:
    """(n,) True in the first part of the time covered by data."""
    seen = system.time[system.weights > 0]
    return np.asarray(system.time <= seen[0] + TRAIN_FRACTION * (seen[-1] - seen[0]), bool)


def held_out(system: System, quantities: Sequence[Quantity], start: Values, rows: Mask) -> HeldOut:
    """Fit to `rows`, then predict the other rows from that fit.

    The predictive distribution of the test data is normal with covariance 1 + J P J^T (P: covariance of the fit), so
    that quantities which the first part does not determine are not penalised. Own quantities of a block that is held
    out as a whole (a run's initial state) are projected out: what they cannot absorb is judged.
    """
    train = fit(subset(system, rows), quantities, start, tolerance=ROUGHLY)
    test = ~rows & (system.weights > 0)
    own = Own(system, train.quantities)
    kept = [b for b in own.blocks if test[b.rows].any() and not (rows & (system.weights > 0))[b.rows].any()]
    if kept:  # linearise at their best values
        alone = np.zeros(len(test), bool)
        alone[np.concatenate([b.rows for b in kept])] = True
        theirs = fit(subset(system, alone), [q for b in kept for q in b.quantities], train.values)
        train = replace(train, values=theirs.values)
    residual, derivative = system.linearise(train.values, [*own.slots, *train.shared])
    n_data = int(np.sum(system.weights[test]))
    finite = np.isfinite(residual[test]).all() and np.isfinite(derivative[test]).all()
    if not finite or len(train.heads) < len(own.blocks):
        return HeldOut(train, test, np.inf, float(n_data), -np.inf, n_data)
    root = square_root(train.covariance)
    k = root.shape[1]
    # B: derivative of the prediction by independent standard normal numbers, which span the uncertainty of the fit
    both = np.zeros((*residual.shape, k + 1))
    m, w = int(np.sum(test)), residual.shape[1]
    by_shared = own.cleared(derivative, train.heads)[test].reshape(m * w, k)
    both[test, :, :k], both[test, :, k] = (by_shared @ root).reshape(m, w, k), residual[test]
    parts = [both[own.rest][test[own.rest]].reshape(-1, k + 1)]
    predicted, log_determinant, spread = [parts[0]], 0.0, 0.0
    for block, head in zip(own.blocks, train.heads, strict=True):
        here = block.rows[test[block.rows]]
        part, J = both[here].reshape(-1, k + 1), derivative[here][..., block.columns].reshape(-1, len(block.columns))
        if block in kept:  # of what is known beforehand, that is the expectation
            known = [np.isfinite(q.prior_sigma) for q in block.quantities]
            away = [train.values[q.name] - q.null for q in block.quantities]
            part[:, k] += J @ np.where(known, away, 0.0)
        part, R, B, free = _own_marginalised(part, J, head)
        n_data -= free
        spread += float(np.sum(B * B))
        log_determinant += float(np.sum(np.log(np.abs(np.diag(R)[: B.shape[1]]))))
        predicted.append(R[B.shape[1] :, B.shape[1] :])
        parts.append(part)
    everything, whitened = np.concatenate(parts), np.concatenate(predicted)
    R = _stacked_triangle(whitened[:, :k], whitened[:, k:])
    quadratic = R[k, k] ** 2 if R.shape[0] > k else 0.0
    log_density = -0.5 * (quadratic + 2 * (np.sum(np.log(np.abs(np.diag(R)[:k]))) + log_determinant))
    expected = n_data + spread + float(np.sum(everything[:, :k] ** 2))
    return HeldOut(train, test, float(np.sum(everything[:, k] ** 2)), expected, float(log_density), n_data)


def _own_marginalised(part: Array, J: Array, head: OwnNumbers) -> tuple[Array, Array, Array, int]:
    """Rows (m, k + 1) of a block without its undetermined own quantities; R with the own ones; these; number projected.

    J : (m, p) derivative by the own quantities. Directions that the fit does not determine (all of a run that is held
    out) are projected out; the others have the covariance of the fit.
    """
    open_, largest = J @ head.open, np.linalg.norm(J, axis=0) @ np.abs(head.open)
    free = span(open_[:, np.linalg.norm(open_, axis=0) > INVISIBLE * largest])
    part, B = cleared(part, free), cleared(J @ head.root, free)
    return part, _stacked_triangle(B, part), B, free.shape[1]


def _stacked_triangle(B: Array, others: Array) -> Array:
    """R of the QR decomposition of [B, others] over [1, 0]; B^T B, singular for a diverging motion, is never formed."""
    ones = np.eye(B.shape[1], B.shape[1] + others.shape[1])
    return triangle(np.concatenate([np.concatenate([B, others], axis=1), ones]))


def square_root(covariance: Array) -> Array:
    """R (k, k) with R R^T = covariance (k, k), which may be singular and badly scaled."""
    if covariance.size == 0:  # a model without quantities
        return covariance
    scale = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    safe = np.where(scale > 0, scale, 1.0)
    eigenvalues, vectors = np.linalg.eigh(covariance / np.outer(safe, safe))
    return np.asarray(safe[:, None] * vectors * np.sqrt(np.maximum(eigenvalues, 0.0)), float)


def most_that_hold(holds: Callable[[int], bool], least: int, whole: int, resolution: int = 1) -> int:
    """The most samples, fewer than the whole, for which `holds` is true; 0 if not even for the least.

    By bisection: it has to hold for fewer samples, too. The result is smaller by less than the resolution.
    """
    if least >= whole or not holds(least):
        return 0
    while whole - least > resolution:
        middle = (least + whole) // 2
        least, whole = (middle, whole) if holds(middle) else (least, middle)
    return least
