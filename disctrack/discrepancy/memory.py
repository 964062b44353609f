"""Standard deviations in the presence of a residual with a memory.

A fit counts its samples as independent. Where what is left of the data lasts for many samples, an estimate scatters
more: by the long-run variance of its influence function over the variance that independent samples would give
(Newey and West 1987, with the bandwidth of Andrews 1991 for Bartlett's weights).
"""

from dataclasses import replace

import numpy as np

from calibration.kit.arrays import Array
from disctrack.discrepancy.fit import Fit
from disctrack.discrepancy.nuisances import is_linear, projection
from disctrack.discrepancy.own import Own
from disctrack.discrepancy.system import System

SHORTEST = 40  # samples from which a memory is looked for
SURE = 3.0  # standard deviations of the long-run variance itself, below which it says nothing


def inflation(system: System, fit: Fit) -> Array:
    """(k,) by which the standard deviation of each fitted quantity grows; 1 where no memory is seen.

    Linear quantities with priors keep theirs, and those that blocks of rows have of their own.
    """
    factors = np.ones(len(fit.quantities))
    moved = [i for i, q in enumerate(fit.quantities) if not (is_linear(q) or q.slot)]
    here = [fit.shared.index(fit.names[i]) for i in moved]
    covariance = fit.covariance[np.ix_(here, here)]
    rows = np.flatnonzero(system.weights > 0)
    if len(rows) < SHORTEST or not moved or not covariance.any():
        return factors
    own = Own(system, fit.quantities)
    residual, derivative = system.linearise(fit.values, [*own.slots, *(fit.names[i] for i in moved)])
    derivative = own.cleared(derivative, fit.heads) if fit.heads else derivative
    common = projection(system, fit.quantities, fit.values)
    cleared = common.cleared(derivative.reshape(residual.size, -1))[: residual.size].reshape(derivative.shape)
    by_number = cleared[rows] @ covariance  # (n, w, k)
    influence = np.einsum("nw,nwk->nk", residual[rows], by_number)
    alone = np.einsum("nwk,nwk->k", by_number, by_number)
    power = float(np.sum(residual[rows] ** 2) / max(np.sum(system.weights[rows]), 1.0))
    in_common = alone.copy()
    for lag, share in enumerate(autocorrelation(residual[rows]), start=1):
        in_common += 2 * share * np.einsum("nwk,nwk->k", by_number[lag:], by_number[:-lag])
    for i, x, one, together in zip(moved, influence.T, alone, in_common, strict=True):
        if power * one > 0:
            variance, spread = long_run_variance(x)
            ratio = variance * len(x) / (power * one)
            factors[i] = np.sqrt(max(ratio if ratio > 1.0 + SURE * spread else 1.0, together / one))
    return factors


def autocorrelation(residual: Array) -> list[float]:
    """Of the numbers (n, w) of each row with the same ones of rows 1, 2, ... later; up to where none is seen any more.

    All numbers together tell it far better than the one series of a quantity's influence. A sensor's pattern of gains
    and offsets is such a memory: images of a dot that lie within two pixels err alike.
    """
    found: list[float] = []
    power = float(np.sum(residual**2)) / max(int(np.count_nonzero(residual)), 1)
    for lag in range(1, len(residual) // 4):
        products = residual[lag:] * residual[:-lag]  # of missing numbers zero
        count = max(int(np.count_nonzero(products)), 1)
        share = float(np.sum(products)) / count / power if power > 0 else 0.0
        if share < SURE / np.sqrt(count):
            break
        found.append(share)
    return found


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
