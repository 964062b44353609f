"""What a lens does beyond its polynomial: a smooth displacement of the image, found from the views of the board.

The coefficients of the splines (`splines`) have a normal prior; cameras, poses and the board's shape are refined with
them, and have none, so that the field holds only what those cannot. It is a sum of one that is smooth over two cells
of its grid, and of a smaller one that varies within them. How large both are is told by all views together, by their
marginal likelihood (MacKay 1992): a view at the edge of the images, which no other reaches, says nothing of that when
it is left out. The field is kept if views that were left out are met better with it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy

from calibration.cameras.splines import LensField
from calibration.fit.pairing import GOOD_VIEWS
from calibration.fit.refinement import FOLDS, Refinement, refine_stereo
from calibration.fit.stereo_model import Observations
from calibration.kit.arrays import Array
from calibration.kit.least_squares import eliminate

CELLS = 10  # of the spline's grid along the longer side of the image
# Standard deviations of a coefficient that are tried: of the part that varies within cells, and of the smooth one
SIZES_PX = ((0.003, 0.01), (0.003, 0.03), (0.01, 0.03), (0.01, 0.1), (0.03, 0.1))
BETTER = 2.5  # standard errors by which the views that were left out must be met better


def fit_lens_field(refinement: Refinement, nominal: Array) -> tuple[LensField | None, Refinement]:
    """The field of both lenses, and the refinement of observations that it has corrected.

    None, and the refinement as it is, where a field does not help on views that were left out.

    nominal : (n, 3) [m] the target's points as declared
    """
    used = refinement.observations[refinement.kept]
    views = np.unique(used.view)
    if len(views) < GOOD_VIEWS:
        return None, refinement
    size = np.array([camera.image_size for camera in refinement.model.rig.cameras]).max(0)
    spacing = float(size.max()) / CELLS
    columns, rows = (int(np.ceil(side / spacing)) + 3 for side in size)
    field = LensField(np.zeros((2, 2, rows, columns)), spacing)
    priors = [_precision(field, *sizes) for sizes in SIZES_PX]
    of_views = [_rows_of(refinement, used[used.view == view], field) for view in views]
    total = np.sum([rows.T @ rows for rows in of_views], axis=0)
    solution, prior = _likeliest(total, priors)
    others = np.append(np.arange(len(solution) - field.coefficients.size), len(solution))
    chi_square = np.zeros((2, len(views)))  # of each view, left out: without a field, and with one
    for fold in range(FOLDS):
        test = range(fold, len(views), FOLDS)
        train = total - np.sum([of_views[v].T @ of_views[v] for v in test], axis=0)
        for k, (free, precision) in enumerate(((others, prior[:0, :0]), (np.arange(len(total)), prior))):
            step = np.append(-_solved(train[np.ix_(free, free)], precision)[0], 1.0)
            chi_square[k, test] = [float(np.sum((of_views[v][:, free] @ step) ** 2)) for v in test]
    gain = chi_square[0] - chi_square[1]
    if gain.mean() < BETTER * gain.std() / np.sqrt(len(views) - 1):
        return None, refinement
    field = replace(field, coefficients=solution[-field.coefficients.size :].reshape(field.coefficients.shape))
    o = refinement.observations
    moved = np.stack([field.displacement(o.pixels, camera) for camera in (0, 1)])[o.camera, np.arange(len(o))]
    corrected = replace(o, pixels=o.pixels - moved)
    return field, refine_stereo(corrected, refinement.model, nominal, refinement.terms, begin=refinement)


def _precision(grid: LensField, sigma: float, smooth: float) -> Array:
    """Inverse covariance (ny nx, ny nx) of an axis' coefficients [px^-2].

    Independent ones of sigma [px]; and beside them what those of a grid of twice the spacing, of `smooth` [px], come to
    on this one, roughly: half their variance along each axis, alike over two steps. So what varies within a few cells
    is small, and zero where no corner lies.
    """
    steps = (np.subtract.outer(np.arange(n), np.arange(n)) for n in grid.coefficients.shape[2:])
    together = np.kron(*(0.5 * np.exp(-0.25 * step**2) for step in steps))
    return np.asarray(np.linalg.inv(sigma**2 * np.eye(len(together)) + smooth**2 * together), np.float64)


def _likeliest(total: Array, priors: list[Array]) -> tuple[Array, Array]:
    """Parameters (s,) under that of the priors (precisions) under which all corners are likeliest, and that prior."""
    found = []
    for prior in priors:
        solution, volume = _solved(total, prior)
        found.append((total[:-1, -1] @ solution + 4 * np.linalg.slogdet(prior)[1] - volume, solution, prior))
    return max(found, key=lambda one: float(one[0]))[1:]


def _rows_of(refinement: Refinement, seen: Observations, grid: LensField) -> Array:
    """Rows (r, s + 1) of a view, [cameras, board, field | residual], its pose projected out."""
    problem, each = refinement.problem, np.arange(len(seen))
    splines, values = np.zeros((len(seen), 2, 4, grid.coefficients.size // 4)), grid.splines(seen.pixels)
    for axis in (0, 1):
        splines[each, axis, 2 * seen.camera + axis] = values
    of_view = problem.seeing(seen, refinement.unexplained_sigma**2)
    rows, _, _ = of_view.rows(refinement.model, splines.reshape(len(seen), 2, -1))
    return eliminate(rows, problem.n_own)[1]


def _solved(square: Array, precision: Array) -> tuple[Array, float]:
    """Parameters (s,), the last of them the field with its prior, and the log determinant of their normal matrix.

    precision : the prior's, the same of every camera and axis
    """
    matrix, first = square[:-1, :-1].copy(), len(square) - 1 - 4 * len(precision)
    matrix[first:, first:] += np.kron(np.eye(4), precision)
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    factor = scipy.linalg.cho_factor(matrix / np.outer(size, size) + 1e-12 * np.eye(len(size)))
    volume = 2.0 * float(np.log(size * np.diag(factor[0])).sum())
    return scipy.linalg.cho_solve(factor, square[:-1, -1] / size) / size, volume
