"""Least-squares problem of cameras, stereo pose, board shape and board poses; its blocks are the views.

The parameters of one view alone are the six of the board's pose, or 12 if its two images have separate poses.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from calibration.fit.board_motion import BoardMotion, motions
from calibration.fit.priors import Prior
from calibration.fit.stereo_model import N_STEREO, Observations, StereoModel, moved, predict
from calibration.kit import least_squares
from calibration.kit.arrays import Array, Indices, Mask
from calibration.kit.errors import CalibrationError
from calibration.kit.least_squares import Minimum, Normal, normal_of_rows


@dataclass(frozen=True)
class Problem:
    """All inputs of a refinement except the initial guess."""

    observations: Observations  # sorted by view
    weights: Array  # (m, 2, 2) inverse covariance [1/px^2]
    shape_basis: Array  # (n, 3, s2) directions of the target's points
    apart: Mask  # (n_views,) views whose two images have independent poses of the board
    prior: Prior  # of the cameras and of the board's shape
    motion: BoardMotion | None = None  # of the boards between the two exposures, for a model with two poses per view

    @property
    def n_views(self) -> int:
        """Number of views, with or without observations."""
        return len(self.apart)

    @property
    def n_own(self) -> int:
        """Number of parameters of one view: of one pose of the board, or of two."""
        return 6 if self.motion is None and not self.apart.any() else 12

    @property
    def places(self) -> Indices:
        """(m,) place of the board at each observation: twice its view, or one more for its second place."""
        o = self.observations
        return 2 * o.view + o.camera * self.apart[o.view]

    def seeing(self, observations: Observations, extra: float) -> Problem:
        """The same with other observations, and `extra` [px^2] added to their covariances in both axes."""
        return replace(self, observations=observations, weights=inverse_covariance(observations.covariance, extra))

    def rows(self, model: StereoModel, beyond: Array | None = None) -> tuple[Array, Indices]:
        """Whitened rows (r, c) of all data, and the view of each (r,).

        Columns: pose of the board, or both if some views have two | stereo | shape | beyond (m, 2, b) | residual.
        NaN for points behind their camera.
        """
        o, V = self.observations, self.n_views
        with np.errstate(all="ignore"):  # a step may move a board behind its camera
            pixels, d_stereo, d_pose, d_point = predict(model, o)
            if self.n_own == 12:
                place = o.camera * (self.apart[o.view] | (self.motion is not None))
                d_pose = np.concatenate([np.where((place == c)[:, None, None], d_pose, 0.0) for c in (0, 1)], axis=-1)
            whitener = np.swapaxes(np.linalg.cholesky(self.weights), 1, 2)
            columns = [whitener @ of for of in (d_pose, d_stereo, d_point, (o.pixels - pixels)[..., None])]
            columns[2] = columns[2] @ self.shape_basis[o.point]
            columns[3:3] = [] if beyond is None else [whitener @ beyond]
            rows = np.concatenate(columns, axis=-1).reshape(2 * len(o), -1)
            view = np.repeat(o.view, 2)
        if self.motion is not None:
            between, by_poses = motions(model)
            root = np.sqrt(self.motion.weights_of(V) * ((np.bincount(o.view, minlength=V) > 0) & ~self.apart)[:, None])
            tied = np.zeros((V, 6, rows.shape[1]))
            tied[..., :12], tied[..., -1] = root[..., None] * by_poses, -root * between
            rows, view = np.concatenate([rows, tied.reshape(6 * V, -1)]), np.append(view, np.repeat(np.arange(V), 6))
        return rows, view

    def linearise(self, model: StereoModel) -> Normal:
        """Normal equations at the model."""
        rows, view = self.rows(model)
        order, count = np.argsort(view, kind="stable"), np.bincount(view, minlength=self.n_views)
        place, of_view = np.empty(len(view), int), np.zeros((self.n_views, count.max(), rows.shape[1]))
        place[order] = np.arange(len(view)) - np.repeat(np.cumsum(count) - count, count)
        of_view[view, place] = rows
        normal = normal_of_rows(of_view, self.n_own)
        costs = np.where(np.isfinite(normal.costs), normal.costs, np.inf)
        return replace(normal, costs=costs, prior=self.prior.normal(model))

    def stepped(self, model: StereoModel, shared: Array, poses: Array) -> StereoModel:
        """The model after a step."""
        steps = poses.reshape(self.n_views, -1, 6)
        if self.motion is None:
            steps = np.where(self.apart[:, None, None], steps, steps[:, :1])
        return moved(model, shared[:N_STEREO], steps, self.shape_basis @ shared[N_STEREO:])


def quadratic(matrix: Array, vector: Array) -> Array:
    """v^T M v (m,) for M (m, 2, 2) and v (m, 2)."""
    return np.asarray(np.einsum("mi,mij,mj->m", vector, matrix, vector), np.float64)


def inverse_covariance(covariance: Array, extra: float) -> Array:
    """Inverse of covariance (m, 2, 2) + extra [px^2] in both axes."""
    return np.asarray(np.linalg.inv(covariance + extra * np.eye(2)), np.float64)


def minimise(problem: Problem, start: StereoModel, **how: Any) -> Minimum[StereoModel]:
    """`least_squares.minimise`. Raises CalibrationError if the initial guess has a board behind its camera."""
    found = least_squares.minimise(problem.linearise, problem.stepped, start, **how)
    if not found.iterations:
        raise CalibrationError(
            "the start of the refinement puts the board behind a camera: check the order of the views"
        )
    return found
