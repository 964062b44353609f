"""Cameras, stereo pose, board shape and board poses as a problem of least squares, whose blocks are the views.

The six numbers of a board's pose are its view's own, 12 where boards moved between the two exposures.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from calibration.fit._normal_kernel import N_COLUMNS, accumulate
from calibration.fit.board_motion import BoardMotion, motions
from calibration.fit.priors import Prior, board_prior
from calibration.fit.stereo_model import Observations, StereoModel, moved
from calibration.kit import least_squares
from calibration.kit.arrays import Array
from calibration.kit.errors import CalibrationError
from calibration.kit.least_squares import Minimum, Normal


def _shared(stereo: Array, stereo_point: Array, point: Array, shape: Array) -> Array:
    """(..., s, s) of all shared parameters, from each view's parts (n_views, ...) or from their sums.

    stereo : (..., s1, s1) stereo parameters alone; stereo_point (..., s1, 3 n) between them and the target's points;
    point (..., n, 3, 3) of each point; shape (3 n, s2) directions in which the points may move
    """
    across = stereo_point @ shape
    moved_points = point @ shape.reshape(*point.shape[-3:-1], shape.shape[1])
    among = shape.T @ moved_points.reshape(*across.shape[:-2], *shape.shape)
    return np.block([[stereo, across], [np.swapaxes(across, -1, -2), among]])


@dataclass(frozen=True)
class Problem:
    """What a refinement needs besides a start."""

    observations: Observations  # sorted by view
    weights: Array  # (m, 2, 2) inverse covariance [1/px^2]
    stereo_basis: Array  # (24, s1) free directions of intrinsics and stereo pose
    shape_basis: Array  # (n, 3, s2) free directions of the target's points
    n_views: int
    huber: float = np.inf  # residuals beyond this many sigmas count linearly
    prior: Prior | None = None  # of the cameras
    motion: BoardMotion | None = None  # of the boards between the two exposures, for a model that has such places

    def seeing(self, observations: Observations, extra: float) -> Problem:
        """The same with other observations, whose covariances are by `extra` [px^2] larger in both axes."""
        return replace(self, observations=observations, weights=inverse_covariance(observations.covariance, extra))

    def with_shape(self, nominal: Array, basis: Array) -> Problem:
        """The same with points (n, 3) that may move along `basis` (n, 3, s2), and what is known of that beforehand."""
        prior = self.prior and replace(self.prior, board=board_prior(nominal, basis))
        return replace(self, shape_basis=basis, prior=prior)

    def linearise(self, model: StereoModel) -> Normal:
        """Normal equations at the model."""
        o = self.observations
        if np.any(np.diff(o.view) < 0):
            raise ValueError("observations must be sorted by view")
        s1, s2, n = self.stereo_basis.shape[1], self.shape_basis.shape[-1], len(self.shape_basis)
        V, boards = self.n_views, zip((model.R_left_board, model.t_left_board), model.boards_in_right, strict=True)
        full, costs = np.zeros((V, N_COLUMNS, N_COLUMNS)), np.zeros(V)
        of_point, point = (np.zeros((V, n if s2 else 0, 3, columns)) for columns in (N_COLUMNS, 3))
        cameras = np.stack([camera.parameters for camera in model.cameras])
        given = (o.pixels, self.weights, cameras, model.R_right_left, model.t_right_left, *map(np.stack, boards))
        if not _accumulated(
            (o.view, o.camera, o.point), self.huber, (*given, model.points), full, of_point, point, costs
        ):
            costs[...] = np.inf
        poses = np.tile(np.eye(6), (2, 1)) if self.motion is None else np.eye(12)  # the same at both exposures, or two
        free = scipy.linalg.block_diag(self.stereo_basis, poses, 1.0)
        squares = free.T @ full @ free
        shape = self.shape_basis.reshape(3 * n, s2) if s2 else np.zeros((0, 0))
        flat = of_point.reshape(V, len(shape), N_COLUMNS) @ free
        of_shape = shape.T @ flat[..., s1:]  # (V, s2, k + 1)
        stereo, stereo_point = squares[:, :s1, :s1], np.swapaxes(flat[..., :s1], 1, 2)
        pose, pose_gradient = squares[:, s1:-1, s1:-1], squares[:, s1:-1, -1]
        if self.motion is not None:
            between, by_poses = motions(model)
            weights = self.motion.weights_of(V) * (np.bincount(o.view, minlength=V) > 0)[:, None]
            weighted = by_poses * weights[..., None]
            pose = pose + np.swapaxes(by_poses, 1, 2) @ weighted
            pose_gradient = pose_gradient - np.einsum("vij,vi->vj", weighted, between)
            costs += np.sum(between**2 * weights, axis=1)
        known = np.zeros((s1 + s2, s1 + s2)), np.zeros(s1 + s2), 0.0
        prior, towards, prior_cost = (
            known if self.prior is None else self.prior.normal(model, self.stereo_basis, s2 > 0)
        )
        return Normal(
            shared=_shared(stereo.sum(0), stereo_point.sum(0), point.sum(0), shape),
            cross=np.concatenate([squares[:, :s1, s1:-1], of_shape[..., :-1]], axis=1),
            own=pose,
            gradient=np.concatenate([squares[:, :s1, -1], of_shape[..., -1]], axis=1),
            own_gradient=pose_gradient,
            costs=costs,
            of_each=partial(_shared, stereo, stereo_point, point, shape),
            prior=prior,
            prior_gradient=towards,
            prior_cost=prior_cost,
        )

    def stepped(self, model: StereoModel, shared: Array, poses: Array) -> StereoModel:
        """The model after a step."""
        s1 = self.stereo_basis.shape[1]
        return moved(model, self.stereo_basis @ shared[:s1], poses, self.shape_basis @ shared[s1:])


def _accumulated(indices: Sequence[NDArray[np.intp]], huber: float, values: Sequence[Array], *sums: Array) -> bool:
    """The kernel, given what it is compiled for."""
    whole = [np.ascontiguousarray(index, np.int64) for index in indices]
    return bool(accumulate(*whole, float(huber), *(np.ascontiguousarray(value, np.float64) for value in values), *sums))


def prepare() -> None:
    """Compile the kernel, or load it: once per installation some tenths of a second, then nothing."""
    values = [np.zeros(shape) for shape in ((0, 2), (0, 2, 2), (2, 9), (3, 3), (3,), (2, 0, 3, 3), (2, 0, 3), (0, 3))]
    sums = [np.zeros(shape) for shape in ((0, 1, 1), (0, 0, 3, 1), (0, 0, 3, 3), (0,))]
    _accumulated([np.zeros(0, np.int64)] * 3, np.inf, values, *sums)


def quadratic(matrix: Array, vector: Array) -> Array:
    """v^T M v of (m, 2, 2) and (m, 2)."""
    value: Array = np.einsum("mi,mij,mj->m", vector, matrix, vector)
    return value


def inverse_covariance(covariance: Array, extra: float) -> Array:
    """Inverse of covariance (m, 2, 2) + extra [px^2] in both axes."""
    return np.asarray(np.linalg.inv(covariance + extra * np.eye(2)), np.float64)


def minimise(problem: Problem, start: StereoModel, **how: Any) -> Minimum[StereoModel]:
    """`least_squares.minimise` from a start that shows every board before its camera."""
    found = least_squares.minimise(problem.linearise, problem.stepped, start, **how)
    if not found.iterations:
        raise CalibrationError(
            "the start of the refinement puts the board behind a camera: check the order of the views"
        )
    return found
