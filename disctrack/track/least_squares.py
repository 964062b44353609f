"""Steps and probabilities of many small least-squares problems at once."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from calibration.arrays import Array


def step_to_minimum(residuals: Array, jacobian: Array) -> Array:
    """Gauss-Newton steps (n, p) for residuals (n, k) and Jacobians (n, k, p); none where a parameter is not seen.

    A trace of damping stands in for the pseudo-inverse where data leave a combination open; that costs ten times more.
    """
    transposed = np.swapaxes(jacobian, 1, 2)
    gradient, normal = (transposed @ residuals[..., None])[..., 0], transposed @ jacobian
    diagonal = np.einsum("nii->ni", normal)  # a view
    diagonal *= 1 + 1e-10
    diagonal += diagonal < 1e-300
    return np.asarray(np.linalg.solve(normal, gradient[..., None])[..., 0], float)


def chance_beyond(chi_square: ArrayLike, freedom: ArrayLike) -> Array:
    """Probability that chi-square of so many degrees of freedom (whole numbers) is larger; NaN stays.

    The finite sums of Abramowitz & Stegun 26.4.4 and 26.4.5; scipy.special would take a third of a second to import.
    """
    half, freedom = 0.5 * np.clip(chi_square, 1e-300, 1e12), np.asarray(freedom)  # finite, and so is the logarithm
    odd, log = freedom % 2 == 1, np.log(half)
    tail = np.where(odd, np.vectorize(math.erfc, [float])(np.sqrt(half)), 0.0)
    for k in range(int(freedom.max(initial=0)) // 2):
        power, scale = np.where(odd, k + 0.5, k), np.where(odd, math.lgamma(k + 1.5), math.lgamma(k + 1.0))
        tail = tail + np.where(2 * k + 2 <= freedom, np.exp(power * log - half - scale), 0.0)
    return tail
