"""Noise with a memory: white noise plus an error that changes smoothly, both sized from the data themselves.

What other people's instruments call a position holds errors that last for many samples (a tracker's bias that moves
with the object, a scale that differs from take to take). To take them for white noise makes every small effect
significant; to whiten with their covariance makes chi-squares, sigmas and predictive densities mean what they say.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.optimize import minimize

from calibration.kit.arrays import Array


@dataclass(frozen=True)
class SmoothNoise:
    """Covariance white^2 delta + smooth^2 exp(-(t - t')^2 / (2 memory^2))."""

    white: float
    smooth: float
    memory: float  # in the units of time

    def covariance(self, time: Array) -> Array:
        """(n, n) of one stretch of samples; different stretches are independent."""
        apart = (time[:, None] - time[None, :]) / self.memory
        # a share of 1e-9 keeps the Cholesky factor regular where the white part is next to nothing
        floor = (self.white**2 + 1e-9 * self.smooth**2) * np.eye(len(time))
        return np.asarray(self.smooth**2 * np.exp(-0.5 * apart**2) + floor, float)

    def whitening(self, time: Array) -> Array:
        """W (n, n), lower triangular, with W covariance W^T = 1: sample by sample what those before do not foretell."""
        root = np.linalg.cholesky(self.covariance(time))
        return np.asarray(solve_triangular(root, np.eye(len(time)), lower=True), float)


@dataclass(frozen=True)
class SampleStretch:
    """Samples that share errors, and what a model may absorb of them."""

    time: Array  # (n,)
    values: Array  # (n, c) channels with the same statistics
    basis: Array  # (n, k)
    part: NDArray[np.int64] | None = None  # (n,) samples of different parts have independent errors


def estimate(stretches: Sequence[SampleStretch], start: SmoothNoise) -> SmoothNoise:
    """Restricted maximum likelihood: what is left in all stretches after their bases are cleared out.

    A memory beyond a fifth of the longest stretch is not sought: such an error looks like the motion itself.
    """
    # of large numbers that the bases explain, the likelihood would leave rounding
    stretches = [
        replace(s, values=s.values - s.basis @ np.linalg.lstsq(s.basis, s.values, rcond=None)[0]) for s in stretches
    ]
    longest = 0.2 * max(float(np.ptp(s.time)) for s in stretches)
    bounds = [(np.log(1e-3 * x), np.log(1e3 * x)) for x in (start.white, start.smooth)]
    bounds.append((np.log(0.01 * longest), np.log(longest)))

    def cost(x: Array) -> float:
        noise = SmoothNoise(*np.exp(x).tolist())
        return sum(_minus_log_likelihood(s, noise) for s in stretches)

    x = np.log([start.white, start.smooth, min(start.memory, 0.9 * longest)])
    options = {"xatol": 0.02, "fatol": 0.1, "maxiter": 160}
    found = minimize(cost, x, method="Nelder-Mead", bounds=bounds, options=options)
    return SmoothNoise(*np.exp(found.x).tolist())


def _minus_log_likelihood(s: SampleStretch, noise: SmoothNoise) -> float:
    K = noise.covariance(s.time)
    if s.part is not None:
        K = np.where(s.part[:, None] == s.part[None, :], K, 0.0)
    factor = cho_factor(K, lower=True)
    KB, Ky = cho_solve(factor, s.basis), cho_solve(factor, s.values)
    inner = cho_factor(s.basis.T @ KB, lower=True)
    quadratic = np.sum(s.values * Ky) - np.sum((KB.T @ s.values) * cho_solve(inner, KB.T @ s.values))
    determinants = 2 * sum(float(np.sum(np.log(np.diag(f[0])))) for f in (factor, inner))
    return 0.5 * float(quadratic + s.values.shape[1] * determinants)
