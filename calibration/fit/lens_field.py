"""What a lens does beyond its polynomial: a smooth displacement of the image, found from the views of the board.

The coefficients of the splines (`splines`) have a normal prior; cameras, poses and the board's shape are refined with
them, and have none, so that the field holds only what those cannot. It is kept if views that were left out are met
better with it. A coarse grid decides that. What varies within its cells (of 0.02 px over a third of the image, 0.003)
is taken up by a finer one beside it, whose coefficients are smaller; how large both are is told by all views together,
by their marginal likelihood (MacKay 1992): a view at the edge of the images, which no other reaches, says nothing of
that when it is left out.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import reduce

import numpy as np

from calibration.cameras.splines import LensField
from calibration.fit.pairing import GOOD_VIEWS
from calibration.fit.refinement import FOLDS, Refinement, refine_stereo
from calibration.fit.stereo_model import Observations
from calibration.kit.arrays import Array
from calibration.kit.least_squares import eliminate

CELLS = 5  # of the spline's grid along the longer side of the image; twice as many of the finer one
# Standard deviations of a coefficient that are tried: but the smallest of the coarse grid, the largest of the finer one
SIZES_PX = (0.003, 0.01, 0.03, 0.1)
BETTER = 2.5  # standard errors by which the views that were left out must be met better
LEAST_GAIN = 0.03  # and part of their chi-square: less is not worth its parameters


def fit_lens_field(refinement: Refinement, nominal: Array) -> tuple[LensField | None, Refinement]:
    """The field of both lenses, and the refinement of observations that it has corrected.

    None, and the refinement as it is, where a field does not help on views that were left out.

    nominal : (n, 3) [m] the target's points as declared
    """
    used = refinement.observations[refinement.kept]
    views = np.unique(used.view)
    if len(views) < GOOD_VIEWS:
        return None, refinement
    coarse, finer = _grid(refinement, CELLS), _grid(refinement, 2 * CELLS)
    left = refinement.unexplained_sigma**2
    for _ in range(2):  # once more with the noise that the field leaves
        gain, error, left = _worth(refinement, used, coarse, left)
    if gain < BETTER * error or gain < LEAST_GAIN:
        return None, refinement
    both = [_precision(finer, small, large) for large in SIZES_PX[1:] for small in SIZES_PX[:-1]]
    solution, _ = _likeliest(reduce(np.add, _squares(refinement, used, finer, left)), both)
    field = replace(finer, coefficients=solution[-finer.coefficients.size :].reshape(finer.coefficients.shape))
    o = refinement.observations
    moved = np.stack([field.displacement(o.pixels, camera) for camera in (0, 1)])[o.camera, np.arange(len(o))]
    corrected = replace(o, pixels=o.pixels - moved)
    return field, refine_stereo(corrected, refinement.model, nominal, refinement.terms, begin=refinement)


def _grid(refinement: Refinement, cells: int) -> LensField:
    """A field of zero with so many cells along the longer side of the images."""
    size = np.array([camera.image_size for camera in refinement.model.rig.cameras]).max(0)
    spacing = float(size.max()) / cells
    return LensField(
        np.zeros((2, 2, int(np.ceil(size[1] / spacing)) + 3, int(np.ceil(size[0] / spacing)) + 3)), spacing
    )


def _precision(grid: LensField, sigma: float, smooth: float = 0.0) -> Array:
    """Inverse covariance (ny nx, ny nx) of an axis' coefficients [px^-2].

    Independent ones of sigma [px]; and beside them what those of a grid of twice the spacing, of `smooth` [px], come to
    on this one, roughly: half their variance along each axis, alike over two steps. So what varies within a few cells
    is small, and zero where no corner lies.
    """
    steps = (np.subtract.outer(np.arange(n), np.arange(n)) for n in grid.coefficients.shape[2:])
    together = np.kron(*(0.5 * np.exp(-0.25 * step**2) for step in steps))
    return np.asarray(np.linalg.inv(sigma**2 * np.eye(len(together)) + smooth**2 * together), np.float64)


def _worth(refinement: Refinement, used: Observations, grid: LensField, extra: float) -> tuple[float, float, float]:
    """Part of the chi-square of views left out that a field on a grid takes away, and its error.

    extra : [px^2] by which corners scatter beside their noise; the third item is what the field leaves of it
    """
    squares = np.stack(list(_squares(refinement, used, grid, extra)))
    total, views = squares.sum(0), np.arange(len(squares))
    solution, prior = _likeliest(total, [_precision(grid, sigma) for sigma in SIZES_PX[1:]])
    chi_square = np.zeros((2, len(views)))  # of each view, left out: without a field, and with one
    for fold in range(FOLDS):
        test = views[fold::FOLDS]
        train = total - squares[test].sum(0)
        for k, precision in enumerate((1e12 * prior, prior)):  # held at zero, and free
            step = np.append(-_solved(train, precision)[0], 1.0)
            chi_square[k, test] = squares[test] @ step @ step
    mean, gained = chi_square[0].mean(), chi_square[0] - chi_square[1]
    step = np.append(-solution, 1.0)
    square, freedom = float(step @ total @ step), max(2 * len(used) - len(solution) - 6 * len(views), 1)
    error = gained.std() / np.sqrt(len(views) - 1)
    return float(gained.mean() / mean), float(error / mean), max(extra * min(square / freedom, 1.0), 1e-8)


def _likeliest(total: Array, priors: list[Array]) -> tuple[Array, Array]:
    """Parameters (s,) under that of the priors (precisions) under which all corners are likeliest, and that prior."""
    found = []
    for prior in priors:
        solution, volume = _solved(total, prior)
        found.append((total[:-1, -1] @ solution + 4 * np.linalg.slogdet(prior)[1] - volume, solution, prior))
    return max(found, key=lambda one: float(one[0]))[1:]


def _squares(refinement: Refinement, used: Observations, grid: LensField, extra: float) -> Iterator[Array]:
    """Of each view (s + 1, s + 1): products of its rows [cameras, board, field | residual], its pose projected out."""
    problem, n = refinement.problem, grid.coefficients.size // 4
    for view in np.unique(used.view):
        o = used[used.view == view]
        field = np.zeros((len(o), 2, 4, n))
        for axis in (0, 1):
            field[np.arange(len(o)), axis, 2 * o.camera + axis] = grid.splines(o.pixels)
        rows, of_view, _ = problem.seeing(o, extra).rows(refinement.model, field.reshape(len(o), 2, -1))
        rest = eliminate(rows[of_view == view], problem.n_own)[1]
        yield rest.T @ rest


def _solved(square: Array, precision: Array) -> tuple[Array, float]:
    """Parameters (s,), the last of them the field with its prior, and the log determinant of their normal matrix.

    precision : the prior's, the same of every camera and axis
    """
    matrix, n_field = square[:-1, :-1].copy(), 4 * len(precision)
    matrix[-n_field:, -n_field:] += np.kron(np.eye(4), precision)
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    scaled = matrix / np.outer(size, size) + 1e-12 * np.eye(len(size))
    return np.linalg.solve(scaled, square[:-1, -1] / size) / size, float(
        np.linalg.slogdet(scaled)[1] + 2 * np.log(size).sum()
    )
