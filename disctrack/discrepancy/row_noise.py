"""Noise that the numbers of a row share: cameras that shake, clocks that jitter, frames in a wrong order.

Errors common to all dots of a frame look like a pose, and poses are what effects are read from: a search that takes
each number's scatter for independent finds effects in them. Directions in which rows scatter more than independent
noise does are weighted by what they scatter.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calibration.kit.arrays import Array
from disctrack.discrepancy.fit import Fit
from disctrack.discrepancy.system import System, Values, Wrapped

MARGIN = 1.5  # over the largest eigenvalue that independent noise brings (Marchenko and Pastur's edge)
THIRD = 2.31  # samples per independent one among third differences: 1 + 2 (15^2 + 6^2 + 1) / 20^2


class RowWhitened(Wrapped):
    """A system whose rows are multiplied by a matrix, so that noise common to their numbers counts once."""

    def __init__(self, system: System, matrix: Array) -> None:
        """Matrix (w, w) acts on the numbers of every row."""
        super().__init__(system)
        self._matrix = matrix

    def linearise(self, values: Values, names: Sequence[str]) -> tuple[Array, Array]:
        """As the system's, every row multiplied."""
        residual, derivative = super().linearise(values, names)
        return residual @ self._matrix.T, self._matrix @ derivative


def third_differences(system: System, fit: Fit) -> tuple[Array, NDArray[np.intp]]:
    """Third differences in time of the residual (k, w) where four samples follow each other, and their rows (k,).

    Whatever is missing in a model of a motion that is sampled well moves slowly from sample to sample; differences of
    third order pass white noise (variance 20) and stop the rest.
    """
    residual, _ = system.linearise(fit.values, [])
    present = system.weights > 0
    rows = np.flatnonzero(present[3:] & present[2:-1] & present[1:-2] & present[:-3])
    return np.diff(residual, 3, axis=0)[rows], rows


def common_modes(system: System, fit: Fit) -> tuple[Array, Array] | None:
    """Directions (w, k) in which rows scatter more than independent noise does, and their variances (k,); or None."""
    difference, rows = third_differences(system, fit)
    full = system.weights[rows] >= difference.shape[1]  # missing numbers are zeros, not noise
    difference = difference[full]
    k, width = difference.shape
    if width < 2 or k < 4 * width:
        return None
    eigenvalues, vectors = np.linalg.eigh(difference.T @ difference / (20.0 * k))
    edge = (1.0 + np.sqrt(width * THIRD / k)) ** 2
    common = eigenvalues > MARGIN * edge * np.median(eigenvalues)
    if not common.any():
        return None
    return vectors[:, common], eigenvalues[common] / float(np.mean(eigenvalues[~common]))


def whitened(system: System, modes: tuple[Array, Array] | None) -> System:
    """The system with the scatter of these directions brought down to that of the others."""
    if modes is None:
        return system
    vectors, variances = modes
    matrix = np.eye(len(vectors)) + (vectors * (1.0 / np.sqrt(variances) - 1.0)) @ vectors.T
    return RowWhitened(system, matrix)
