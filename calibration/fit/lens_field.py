"""Fit of the lens field, a smooth displacement of the image beyond the distortion polynomial, to views of the board.

The coefficients of the splines (`splines`) have a normal prior. Cameras, poses and the board's shape are refined with
them, with the priors that they have without a field. It is the sum of a field that is smooth over two cells of its
grid, and of a smaller one that varies within a cell. The sizes of both maximise the marginal likelihood of all views
(MacKay 1992), not the held-out error: a held-out view at the edge of the image covers an area that no other view
covers. The field is kept if it reduces the held-out error.
"""

from dataclasses import replace

import numpy as np
import scipy

from calibration.cameras.splines import LensField
from calibration.fit.pairing import GOOD_VIEWS
from calibration.fit.refinement import FOLDS, Refinement, refined
from calibration.fit.stereo_model import Observations
from calibration.kit.least_squares import eliminate
from calibration.kit.types import Array

CELLS = 10  # of the spline's grid along the longer side of the image
# Prior standard deviations of a coefficient that are tried: of the part that varies within cells, of the smooth part
SIZES_PX = ((0.003, 0.01), (0.003, 0.03), (0.01, 0.03), (0.01, 0.1), (0.03, 0.1))
BETTER = 2.5  # standard errors by which the held-out chi-square must decrease


def fit_lens_field(refinement: Refinement) -> Refinement:
    """The refinement with the field of both lenses; unchanged if a field does not reduce the held-out error."""
    used = refinement.problem.observations
    views = np.unique(used.view)
    if len(views) < GOOD_VIEWS:
        return refinement
    size = np.array([camera.image_size for camera in refinement.model.rig.cameras]).max(0)
    spacing = float(size.max()) / CELLS
    columns, rows = (int(np.ceil(side / spacing)) + 3 for side in size)
    field = LensField(np.zeros((2, 2, rows, columns)), spacing)
    of_views = [_rows_of(refinement, used[used.view == view], field) for view in views]
    total = np.sum([rows.T @ rows for rows in of_views], axis=0)
    known = np.append(np.arange(len(refinement.normal.prior) - 1), -1)
    total[known[:, None], known] += refinement.normal.prior
    tried = []
    for sizes in SIZES_PX:
        prior = _precision(field, *sizes)
        solution, volume = _solved(total, prior)
        likelihood = total[:-1, -1] @ solution + 4 * np.linalg.slogdet(prior)[1] - volume
        tried.append((float(likelihood), solution, prior))
    _, solution, prior = max(tried, key=lambda one: one[0])
    others = np.append(np.arange(len(solution) - field.coefficients.size), len(solution))
    chi_square = np.zeros((2, len(views)))  # held-out, of each view: without a field, and with one
    for fold in range(FOLDS):
        test = range(fold, len(views), FOLDS)
        train = total - np.sum([of_views[v].T @ of_views[v] for v in test], axis=0)
        for k, (free, precision) in enumerate(((others, prior[:0, :0]), (np.arange(len(total)), prior))):
            step = np.append(-_solved(train[np.ix_(free, free)], precision)[0], 1.0)
            chi_square[k, test] = [float(np.sum((of_views[v][:, free] @ step) ** 2)) for v in test]
    gain = chi_square[0] - chi_square[1]
    if gain.mean() < BETTER * gain.std() / np.sqrt(len(views) - 1):
        return refinement
    field = replace(field, coefficients=solution[-field.coefficients.size :].reshape(field.coefficients.shape))
    o = refinement.observations
    moved = np.stack([field.displacement(o.pixels, camera) for camera in (0, 1)])[o.camera, np.arange(len(o))]
    corrected = replace(o, pixels=o.pixels - moved)
    problem, extra = replace(refinement.problem, observations=corrected), refinement.unexplained_sigma**2
    return replace(refined(problem, refinement.model, refinement.kept, extra), lens_field=field)


def _precision(grid: LensField, sigma: float, smooth: float) -> Array:
    """Prior precision (ny nx, ny nx) of an axis' coefficients [px^-2].

    Independent coefficients of `sigma` [px], plus a smooth part: roughly that of coefficients of `smooth` [px] on a
    grid of twice the spacing, with half their variance along each axis and a correlation over two steps.
    """
    steps = (np.subtract.outer(np.arange(n), np.arange(n)) for n in grid.coefficients.shape[2:])
    together = np.kron(*(0.5 * np.exp(-0.25 * step**2) for step in steps))
    return np.asarray(np.linalg.inv(sigma**2 * np.eye(len(together)) + smooth**2 * together), np.float64)


def _rows_of(refinement: Refinement, seen: Observations, grid: LensField) -> Array:
    """Rows (r, s + 1) of a view, [cameras, board, field | residual], with its pose eliminated."""
    problem, each = refinement.problem, np.arange(len(seen))
    splines, values = np.zeros((len(seen), 2, 4, grid.coefficients.size // 4)), grid.splines(seen.pixels)
    for axis in (0, 1):
        splines[each, axis, 2 * seen.camera + axis] = values
    of_view = problem.seeing(seen, refinement.unexplained_sigma**2)
    rows, _ = of_view.rows(refinement.model, splines.reshape(len(seen), 2, -1))
    return eliminate(rows, problem.n_own)[1]


def _solved(square: Array, precision: Array) -> tuple[Array, float]:
    """Parameters (s,), the last of which are the field, and the log determinant of their normal matrix.

    precision : prior of the field, the same for every camera and axis
    """
    matrix, first = square[:-1, :-1].copy(), len(square) - 1 - 4 * len(precision)
    matrix[first:, first:] += np.kron(np.eye(4), precision)
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    factor = scipy.linalg.cho_factor(matrix / np.outer(size, size) + 1e-12 * np.eye(len(size)))
    volume = 2.0 * float(np.log(size * np.diag(factor[0])).sum())
    return scipy.linalg.cho_solve(factor, square[:-1, -1] / size) / size, volume
