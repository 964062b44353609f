"""Steps and probabilities of many small least-squares problems at once."""

import math

import numpy as np
from numpy.typing import ArrayLike

from calibration.kit.arrays import Array

_NOT_SHARED = 4096  # numbers of a piece of a matrix, of whose product with a vector BLAS shares out 9000 and more


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


def inner_products(A: Array, B: Array) -> Array:
    """A^T B (k, l) of tall A (n, k), B (n, l), by one thread.

    BLAS libraries share a product of thousands of rows among all cores, and wait for the slowest of them. Where several
    threads work side by side that costs more than it saves: 400 frames took 340 ms instead of 60 on two busy cores.
    """
    k, m = A.shape[1], B.shape[1]
    rows = max(1, _NOT_SHARED // max(k, m))
    whole = len(A) // rows * rows
    pieces = np.swapaxes(A[:whole].reshape(-1, rows, k), 1, 2) @ B[:whole].reshape(-1, rows, m)
    return np.asarray(pieces.sum(axis=0) + A[whole:].T @ B[whole:])
