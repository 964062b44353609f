"""What a lens does beyond its polynomial: a smooth displacement of the image, found from the views of the board.

The coefficients of the splines (`splines`) have a normal prior; cameras, poses and the board's shape are refined with
them, and have none, so that the field holds only what those cannot. It is kept if views that were left out are met
better with it. A coarse grid decides that. What varies within its cells (of 0.02 px over a third of the image, 0.003)
is taken up by a finer one beside it, whose coefficients are smaller; how large both are is told by all views together,
by their marginal likelihood (MacKay 1992): a view at the edge of the images, which no other reaches, says nothing of
that when it is left out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calibration.cameras.splines import LensField, spline_weights
from calibration.fit.board_motion import motions
from calibration.fit.normal_equations import inverse_covariance
from calibration.fit.refinement import Refinement, refine_stereo
from calibration.fit.stereo_model import N_STEREO, Observations, predict
from calibration.kit.arrays import Array

CELLS = 5  # of the spline's grid along the longer side of the image; twice as many of the finer one
PRIORS_PX = (0.01, 0.03, 0.1)  # standard deviation of a coefficient; views left out choose
FINER_PX = (0.003, 0.01, 0.03)  # the same of a coefficient of the finer grid
FOLDS = 5
MIN_VIEWS = 8
BETTER = 2.5  # standard errors by which the views that were left out must be met better
LEAST_GAIN = 0.03  # and part of their chi-square: less is not worth its parameters


@dataclass(frozen=True)
class FieldFit:
    """The field and what it is worth."""

    field: LensField
    refinement: Refinement  # with observations that the field has corrected
    rms_px: tuple[float, float]  # of the field per axis where corners were seen, left and right camera
    gain: float  # part of the chi-square of views left out that it takes away


def fit_lens_field(refinement: Refinement, nominal: Array) -> FieldFit | None:
    """The field of both lenses; None where it does not help on views that were left out.

    nominal : (n, 3) [m] the target's points as declared
    """
    used = refinement.observations[refinement.kept]
    views = np.unique(used.view)
    if len(views) < MIN_VIEWS:
        return None
    coarse, finer = _grid(refinement, CELLS), _grid(refinement, 2 * CELLS)
    priors = [coarse.precision(sigma) for sigma in PRIORS_PX]
    rough = _tried(refinement, used, coarse, priors, refinement.unexplained_sigma**2)
    best = _tried(refinement, used, coarse, priors, rough.left)  # with the noise that the field leaves
    if best.gain < BETTER * best.error or best.gain < LEAST_GAIN:
        return None
    both = [finer.precision(small, coarse, large) for large in PRIORS_PX for small in FINER_PX]
    field = _likeliest(refinement, used, finer, both, best.left)
    o = refinement.observations
    moved = np.stack([field.displacement(o.pixels, camera) for camera in (0, 1)])[o.camera, np.arange(len(o))]
    corrected = replace(o, pixels=o.pixels - moved)
    again = refine_stereo(corrected, refinement.model, nominal, refinement.terms, begin=refinement)
    left_rms, right_rms = (float(np.sqrt(np.mean(moved[again.kept & (o.camera == c)] ** 2))) for c in (0, 1))
    return FieldFit(field, again, (left_rms, right_rms), best.gain)


@dataclass(frozen=True)
class _Grid:
    """Of splines over both images."""

    spacing: float  # [px]
    shape: tuple[int, int]

    def precision(self, sigma: float, coarser: _Grid | None = None, of_coarser: float = 0.0) -> Array:
        """Inverse covariance (ny nx, ny nx) of an axis' coefficients [px^-2].

        Independent ones of sigma [px]; and beside them those of a grid of twice the spacing, each a sum of these
        splines. So what varies within a few cells is small, and nought where no corner lies.
        """
        n = self.shape[0] * self.shape[1]
        covariance = sigma**2 * np.eye(n)
        if coarser is not None:
            rows, columns = (_two_scales(few, many) for few, many in zip(coarser.shape, self.shape, strict=True))
            onto = np.kron(rows, columns)
            covariance += of_coarser**2 * onto @ onto.T
        return np.asarray(np.linalg.inv(covariance), np.float64)


def _grid(refinement: Refinement, cells: int) -> _Grid:
    """With so many cells along the longer side of the images."""
    size = np.array([camera.image_size for camera in refinement.model.cameras]).max(0)
    spacing = float(size.max()) / cells
    return _Grid(spacing, (int(np.ceil(size[1] / spacing)) + 3, int(np.ceil(size[0] / spacing)) + 3))


def _two_scales(few: int, many: int) -> Array:
    """(many, few) cubic splines as sums of those of half the spacing: 1, 4, 6, 4, 1 eighths of them."""
    onto = np.zeros((many, few))
    for step, part in zip(range(-2, 3), (1, 4, 6, 4, 1), strict=True):
        node = 2 * np.arange(few) - 1 + step  # node i of the coarser grid is node 2 i - 1 of the finer one
        inside = (node >= 0) & (node < many)
        onto[node[inside], np.flatnonzero(inside)] = part / 8.0
    return onto


@dataclass(frozen=True)
class _Tried:
    """A field on a grid under the prior with which views that were left out are met best."""

    gain: float  # part of the chi-square of these views that it takes away
    error: float  # of the gain
    left: float  # [px^2] variance beside the corners' noise, with the field


def _tried(refinement: Refinement, used: Observations, grid: _Grid, priors: list[Array], extra: float) -> _Tried:
    """Fit a field to corners that scatter by `extra` [px^2] more than their noise; priors: precisions to try."""
    parts, whole, rhs = _systems(refinement, used, grid, extra)
    n_other = len(rhs[0]) - 4 * len(priors[0])
    gains = _held_out_gains(parts, whole, rhs, n_other, priors)
    gain, error = max(gains)
    solution = _solved(np.sum(whole, axis=0), np.sum(rhs, axis=0), n_other, priors[gains.index((gain, error))])
    left = np.concatenate([r - A @ solution for A, r in parts])
    freedom = max(len(left) - len(solution) - 6 * len(parts), 1)
    square = float(left @ left)
    less = max(extra * (square / freedom if square < freedom else 1.0), 1e-8)
    return _Tried(gain, error, less)


def _likeliest(refinement: Refinement, used: Observations, grid: _Grid, priors: list[Array], extra: float) -> LensField:
    """The field under that of the priors (precisions) under which all corners are likeliest; the others as above."""
    _, whole, rhs = _systems(refinement, used, grid, extra)
    matrix, vector = np.sum(whole, axis=0), np.sum(rhs, axis=0)
    n_other = len(vector) - 4 * len(priors[0])
    best, likeliest = np.zeros(len(vector)), -np.inf
    for prior in priors:
        solution = _solved(matrix, vector, n_other, prior)
        likelihood = 0.5 * (vector @ solution + 4 * np.linalg.slogdet(prior)[1] - _log_determinant(matrix, prior))
        if likelihood > likeliest:
            best, likeliest = solution, likelihood
    return LensField(best[n_other:].reshape(2, 2, *grid.shape), grid.spacing)


def _systems(
    refinement: Refinement, used: Observations, grid: _Grid, extra: float
) -> tuple[list[tuple[Array, Array]], list[Array], list[Array]]:
    """Of each view: `_reduced`, normal matrix and right-hand side."""
    parts = [_reduced(refinement, used, view, grid.spacing, grid.shape, extra) for view in np.unique(used.view)]
    return parts, [A.T @ A for A, _ in parts], [A.T @ r for A, r in parts]


def _reduced(
    refinement: Refinement, used: Observations, view: int, spacing: float, shape: tuple[int, int], extra: float
) -> tuple[Array, Array]:
    """Whitened derivatives (2m, s) by cameras, board and field, residuals (2m,) of a view, its pose projected out."""
    o = used[used.view == view]
    pixels, d_stereo, d_pose, d_point = predict(refinement.model, o)
    problem, m = refinement.problem, len(o)
    n = shape[0] * shape[1]
    index, weight = spline_weights(o.pixels, spacing, shape)
    field = np.zeros((m, 2, 4 * n))
    for axis in (0, 1):
        np.put_along_axis(field[:, axis], (2 * o.camera[:, None] + axis) * n + index, weight, axis=1)
    blocks = [(d_stereo.reshape(2 * m, N_STEREO) @ problem.stereo_basis).reshape(m, 2, -1)]
    if problem.shape_basis.shape[-1]:
        blocks.append(d_point @ problem.shape_basis[o.point])
    if problem.motion is not None:  # a place of the board for each of the two images
        d_pose = np.concatenate([np.where((o.camera == c)[:, None, None], d_pose, 0.0) for c in (0, 1)], axis=-1)
    whole = np.concatenate([*blocks, field, d_pose, (o.pixels - pixels)[..., None]], axis=-1)
    L = np.linalg.cholesky(inverse_covariance(o.covariance, extra))
    rows = (np.swapaxes(L, 1, 2) @ whole).reshape(2 * m, -1)
    k = d_pose.shape[-1]
    if problem.motion is not None:
        between, by_poses = (values[view] for values in motions(refinement.model))
        more = np.zeros((6, rows.shape[1]))
        more[:, -k - 1 : -1], more[:, -1] = by_poses, -between
        rows = np.concatenate([rows, np.sqrt(problem.motion.weights_of(problem.n_views)[view])[:, None] * more])
    Q, _ = np.linalg.qr(rows[:, -k - 1 : -1])
    rows = rows - Q @ (Q.T @ rows)
    return rows[:, : -k - 1], rows[:, -1]


def _with_prior(matrix: Array, precision: Array) -> Array:
    """The normal matrix with the field's prior (n, n), the same of every camera and axis."""
    matrix = matrix.copy()
    for last in range(len(matrix), len(matrix) - 4 * len(precision), -len(precision)):
        own = slice(last - len(precision), last)
        matrix[own, own] += precision
    return matrix


def _scaled(matrix: Array) -> tuple[Array, Array]:
    """The matrix with ones on its diagonal, and by what rows and columns were multiplied."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    return matrix * np.outer(scale, scale) + 1e-12 * np.eye(len(matrix)), scale


def _log_determinant(matrix: Array, precision: Array) -> float:
    scaled, scale = _scaled(_with_prior(matrix, precision))
    return float(np.linalg.slogdet(scaled)[1] - 2.0 * np.log(scale).sum())


def _solved(matrix: Array, rhs: Array, n_other: int, precision: Array | None) -> Array:
    """Parameters with the field's prior; None leaves the field out."""
    n = n_other if precision is None else len(rhs)
    matrix, scale = _scaled(matrix[:n, :n] if precision is None else _with_prior(matrix, precision))
    solution = np.zeros(len(rhs))
    solution[:n] = scale * np.linalg.solve(matrix, scale * rhs[:n])
    return solution


def _held_out_gains(
    parts: list[tuple[Array, Array]], whole: list[Array], rhs: list[Array], n_other: int, priors: list[Array]
) -> list[tuple[float, float]]:
    """Part of the chi-square of views left out that the field takes away, and its standard error, for each prior."""
    views = np.arange(len(parts))
    without, gained = np.zeros(len(parts)), np.zeros((len(priors), len(parts)))
    for fold in range(FOLDS):
        test = views[fold::FOLDS]
        train = np.setdiff1d(views, test)
        matrix, vector = np.sum([whole[v] for v in train], axis=0), np.sum([rhs[v] for v in train], axis=0)
        plain, *splined = (_solved(matrix, vector, n_other, prior) for prior in (None, *priors))
        for v in test:
            A, r = parts[v]
            without[v] = np.sum((r - A @ plain) ** 2)
            for k, solution in enumerate(splined):
                gained[k, v] = without[v] - np.sum((r - A @ solution) ** 2)
    mean = without.mean()
    return [(float(one.mean() / mean), float(one.std() / np.sqrt(len(views) - 1) / mean)) for one in gained]
