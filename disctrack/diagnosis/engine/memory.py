"""Standard deviations in the presence of a residual with a memory.

A fit counts its samples as independent. Where what is left of the data lasts for many samples, an estimate scatters
more: by the long-run variance of its influence function over the variance that independent samples would give
(Newey and West 1987, with the bandwidth of Andrews 1991 for Bartlett's weights).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calibration.arrays import Array
from disctrack.diagnosis.engine.fit import Fit
from disctrack.diagnosis.engine.nuisances import is_linear, projection
from disctrack.diagnosis.engine.system import System

SHORTEST = 40  # samples from which a memory is looked for
SURE = 3.0  # standard deviations of the long-run variance itself, below which it says nothing


def inflation(system: System, fit: Fit) -> Array:
    """(k,) by which the standard deviation of each fitted quantity grows; 1 where no memory is seen.

    Linear quantities with priors keep theirs.
    """
    factors = np.ones(len(fit.quantities))
    moved = [i for i, q in enumerate(fit.quantities) if not is_linear(q)]
    covariance = fit.covariance[np.ix_(moved, moved)]
    rows = np.flatnonzero(system.weights > 0)
    if len(rows) < SHORTEST or not moved or not covariance.any():
        return factors
    residual, derivative = system.linearise(fit.values, [fit.names[i] for i in moved])
    common = projection(system, fit.quantities, fit.values)
    cleared = common.cleared(derivative.reshape(residual.size, -1))[: residual.size].reshape(derivative.shape)
    influence = np.einsum("nw,nwk->nk", residual[rows], cleared[rows]) @ covariance
    independent = np.einsum("nwk,nwk->nk", (cleared[rows] @ covariance), cleared[rows] @ covariance)
    power = float(np.sum(residual[rows] ** 2) / max(np.sum(system.weights[rows]), 1.0))
    for i, x, alone in zip(moved, influence.T, power * independent.sum(axis=0), strict=True):
        if alone > 0:
            variance, spread = long_run_variance(x)
            ratio = variance * len(x) / alone
            if ratio > 1.0 + SURE * spread:
                factors[i] = np.sqrt(ratio)
    return factors


def long_run_variance(x: Array) -> tuple[float, float]:
    """Variance of a sum of x (n,) over n, with its memory; and the relative standard deviation of that."""
    n = len(x)
    power = float(x @ x)
    if power == 0:
        return 0.0, 0.0
    rho = float(np.clip((x[1:] @ x[:-1]) / power, -0.97, 0.97))
    alpha = 4 * rho**2 / ((1 - rho) ** 2 * (1 + rho) ** 2)
    width = int(np.clip(np.ceil(1.1447 * (alpha * n) ** (1 / 3)), 1, n // 4))
    total = power
    for lag in range(1, width):
        total += 2 * (1 - lag / width) * float(x[lag:] @ x[:-lag])
    return total / n, float(np.sqrt(4 * width / (3 * n)))


def with_memory(system: System, fit: Fit) -> Fit:
    """The fit with standard deviations that know the residual's size and memory; correlations stay."""
    factors = inflation(system, fit) * np.sqrt(max(1.0, fit.reduced_chi_square))
    return replace(fit, covariance=fit.covariance * np.outer(factors, factors))
