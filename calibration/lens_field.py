"""What a lens does beyond its polynomial: a smooth displacement of the image, found from the views of the board.

The coefficients of the splines (`splines`) have a normal prior; cameras, poses and the board's shape are refined with
them, and have none, so that the field holds only what those cannot. It is kept if views that were left out are met
better with it.
"""

from dataclasses import dataclass, replace

import numpy as np

from calibration.arrays import Array
from calibration.board_motion import motions
from calibration.normal_equations import inverse_covariance
from calibration.refinement import Refinement, refine_stereo
from calibration.splines import LensField, spline_weights
from calibration.stereo_model import N_STEREO, Observations, predict

CELLS = 5  # of the spline's grid along the longer side of the image
PRIORS_PX = (0.01, 0.03, 0.1)  # standard deviation of a coefficient; views left out choose
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
    size = np.array([camera.image_size for camera in refinement.model.cameras]).max(0)
    spacing = float(size.max()) / CELLS
    shape = (int(np.ceil(size[1] / spacing)) + 3, int(np.ceil(size[0] / spacing)) + 3)
    n_field = 4 * shape[0] * shape[1]
    extra = refinement.unexplained_sigma**2
    gain, error = 0.0, np.inf
    coefficients = np.zeros(n_field)
    for _ in range(2):  # the second time with the noise that the field leaves
        parts = [_reduced(refinement, used, view, spacing, shape, extra) for view in views]
        whole = [A.T @ A for A, _ in parts]
        rhs = [A.T @ r for A, r in parts]
        n_other = len(rhs[0]) - n_field
        gains = _held_out_gains(parts, whole, rhs, n_other, PRIORS_PX)
        gain, error = max(gains)
        sigma = PRIORS_PX[gains.index((gain, error))]
        solution = _solved(np.sum(whole, axis=0), np.sum(rhs, axis=0), n_other, sigma)
        coefficients = solution[n_other:]
        left = np.concatenate([r - A @ solution for A, r in parts])
        freedom = max(len(left) - len(solution) - 6 * len(views), 1)
        extra = max(extra * (float(left @ left) / freedom) if float(left @ left) < freedom else extra, 1e-8)
    if gain < BETTER * error or gain < LEAST_GAIN:
        return None
    field = LensField(coefficients.reshape(2, 2, *shape), spacing)
    o = refinement.observations
    moved = np.stack([field.displacement(o.pixels, camera) for camera in (0, 1)])[o.camera, np.arange(len(o))]
    corrected = replace(o, pixels=o.pixels - moved)
    again = refine_stereo(corrected, refinement.model, nominal, refinement.terms, begin=refinement)
    left_rms, right_rms = (float(np.sqrt(np.mean(moved[again.kept & (o.camera == c)] ** 2))) for c in (0, 1))
    return FieldFit(field, again, (left_rms, right_rms), gain)


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


def _solved(matrix: Array, rhs: Array, n_other: int, sigma: float) -> Array:
    """Parameters with the field's prior; sigma 0 leaves the field out."""
    n = len(rhs) if sigma else n_other
    matrix = matrix[:n, :n].copy()
    if sigma:
        matrix[np.arange(n_other, n), np.arange(n_other, n)] += sigma**-2
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    matrix = matrix * np.outer(scale, scale) + 1e-12 * np.eye(n)
    solution = np.zeros(len(rhs))
    solution[:n] = scale * np.linalg.solve(matrix, scale * rhs[:n])
    return solution


def _held_out_gains(
    parts: list[tuple[Array, Array]], whole: list[Array], rhs: list[Array], n_other: int, priors: tuple[float, ...]
) -> list[tuple[float, float]]:
    """Part of the chi-square of views left out that the field takes away, and its standard error, for each prior."""
    views = np.arange(len(parts))
    without, gained = np.zeros(len(parts)), np.zeros((len(priors), len(parts)))
    for fold in range(FOLDS):
        test = views[fold::FOLDS]
        train = np.setdiff1d(views, test)
        matrix, vector = np.sum([whole[v] for v in train], axis=0), np.sum([rhs[v] for v in train], axis=0)
        plain, *splined = (_solved(matrix, vector, n_other, sigma) for sigma in (0.0, *priors))
        for v in test:
            A, r = parts[v]
            without[v] = np.sum((r - A @ plain) ** 2)
            for k, solution in enumerate(splined):
                gained[k, v] = without[v] - np.sum((r - A @ solution) ** 2)
    mean = without.mean()
    return [(float(one.mean() / mean), float(one.std() / np.sqrt(len(views) - 1) / mean)) for one in gained]
