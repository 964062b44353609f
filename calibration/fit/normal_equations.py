"""Levenberg-Marquardt over cameras, stereo pose, board poses and board shape, the views' poses eliminated.

Parameters fall into shared ones and six per view that only their own view sees, so the normal equations are solved
through the Schur complement of the views' 6 x 6 blocks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.fit._normal_kernel import N_COLUMNS, accumulate
from calibration.fit.board_motion import BoardMotion, motions
from calibration.fit.priors import Prior, board_prior
from calibration.fit.stereo_model import N_STEREO, Observations, StereoModel, moved
from calibration.kit.arrays import Array
from calibration.kit.errors import CalibrationError


@dataclass(frozen=True)
class Normal:
    """Normal equations of one linearisation: shared parameters first, the views' poses kept apart.

    A prior is one more view at the end, whose pose tells nothing.
    """

    stereo: Array  # (n_views, s1, s1) each view's part, stereo parameters alone
    stereo_point: Array  # (n_views, s1, 3 n) the same between stereo parameters and the target's points
    point: Array  # (n_views, n, 3, 3) and of each point
    shape: Array  # (3 n, s2) directions in which the points may move
    gradient: Array  # (n_views, s)
    cross: Array  # (n_views, s, k); k = 6, or 12 where boards moved between the two exposures
    pose: Array  # (n_views, k, k)
    pose_gradient: Array  # (n_views, k)
    costs: Array  # (n_views,) chi-square, or Huber's sum when robust
    n_views: int  # without the prior
    board: Array  # (s2, s2) what is known of the target's shape beforehand: the prior's part

    @property
    def cost(self) -> float:
        """Of all views; inf where a prediction failed."""
        return float(self.costs.sum())

    def of_views(self, kept: NDArray[np.intp]) -> Normal:
        """The normal equations of some of the views alone, and of the prior."""
        use = np.arange(len(self.costs)) >= self.n_views
        use[kept] = True

        def part(values: Array) -> Array:
            return np.where(use.reshape(-1, *[1] * (values.ndim - 1)), values, 0.0)

        return replace(
            self,
            stereo=part(self.stereo),
            stereo_point=part(self.stereo_point),
            point=part(self.point),
            gradient=part(self.gradient),
            cross=part(self.cross),
            pose=np.where(use[:, None, None], self.pose, np.eye(self.pose.shape[-1])),
            pose_gradient=part(self.pose_gradient),
            costs=part(self.costs),
        )

    def _assembled(self, stereo: Array, stereo_point: Array, point: Array) -> Array:
        """(s, s) of all shared parameters, from one view's parts or from their sums."""
        s1, s2 = len(stereo), self.shape.shape[1]
        if not s2:
            return stereo
        total = np.empty((s1 + s2, s1 + s2))
        total[:s1, :s1] = stereo
        total[:s1, s1:] = stereo_point @ self.shape
        total[s1:, :s1] = total[:s1, s1:].T
        moved_points = (point @ self.shape.reshape(len(point), 3, s2)).reshape(-1, s2)
        total[s1:, s1:] = self.shape.T @ moved_points
        return total

    @property
    def shared(self) -> Array:
        """(s, s) of the shared parameters, all views together, before the poses are eliminated."""
        return self._with_board(self._assembled(self.stereo.sum(0), self.stereo_point.sum(0), self.point.sum(0)))

    def _with_board(self, total: Array) -> Array:
        s1 = self.stereo.shape[1]
        total[s1:, s1:] += self.board
        return total

    def solve(self, damping: float) -> tuple[Array, Array]:
        """Damped step of the shared parameters (s,) and of the poses (n_views, k)."""
        pose = self.pose * (1 + damping * np.eye(self.pose.shape[-1]))
        carried, own = self._eliminated(pose)
        total = self.shared
        schur = total + damping * np.diag(np.diag(total)) - self._by_poses(carried)
        step = scaled_solve(schur, (self.gradient - np.einsum("vsi,vi->vs", self.cross, own)).sum(0))
        return step, own - carried @ step

    def _eliminated(self, pose: Array) -> tuple[Array, Array]:
        carried = np.linalg.solve(pose, np.swapaxes(self.cross, 1, 2))  # (v, k, s)
        own: Array = np.asarray(np.linalg.solve(pose, self.pose_gradient[..., None])[..., 0], np.float64)
        return np.asarray(carried, np.float64), own

    def _by_poses(self, carried: Array) -> Array:
        """What the poses take from the shared parameters' information (s, s)."""
        V, s, k = self.cross.shape
        taken: Array = np.swapaxes(self.cross, 1, 2).reshape(k * V, s).T @ carried.reshape(k * V, s)
        return taken

    def view_information(self) -> tuple[Array, Array]:
        """What each view, its pose eliminated, tells of the shared parameters: (v, s, s) and gradient (v, s)."""
        carried, own = self._eliminated(self.pose)
        parts = zip(self.stereo, self.stereo_point, self.point, strict=True)
        shared = np.stack([self._assembled(*part) for part in parts])
        if len(shared) > self.n_views:
            self._with_board(shared[-1])
        return shared - self.cross @ carried, self.gradient - np.einsum("vsi,vi->vs", self.cross, own)

    def shifts_by_views(self, s1: int, common: Array | None = None) -> tuple[Array, Array, Array, Array]:
        """What each view, left out in turn, tells of the first s1 shared parameters, each in units of a `scale`.

        To first order the shift is H^-1 g_v with g_v the view's gradient at the common minimum; noise alone gives
        E[g_v g_v^T] = H_v - H_v H^-1 H_v. A prior is no view, and part of H alone.

        common : (n_views, s, s) covariance of what else the views' gradients contain, apart from their points' noise
        returns : shifts (n_views, s1), the sum of the expected g_v g_v^T (s, s), H^-1 (s, s1), and the covariance
            (s1, s1) by `common`
        """
        information, gradient = self.view_information()
        scale = 1.0 / np.sqrt(np.diag(information.sum(0)))  # the parameters' units differ by 10^6
        information, gradient = information * scale[:, None] * scale, gradient * scale
        inverse = np.linalg.inv(information.sum(0))
        views = information[: self.n_views]
        expected = (views - views @ inverse @ views).sum(0)
        covariance: Array = inverse[:, :s1]
        by_common = np.zeros((s1, s1))
        if common is not None:
            common = common * scale[:, None] * scale
            total, part = common.sum(0), views @ inverse
            left = common - part @ common - np.swapaxes(part @ common, 1, 2)
            expected = expected + (left + part @ total @ np.swapaxes(part, 1, 2)).sum(0)
            by_common = covariance.T @ total @ covariance
        return gradient[: self.n_views] @ covariance, expected, covariance, by_common

    def disagreement(self, s1: int) -> float:
        """Variance of the first s1 parameters as the views disagree about them, over what the noise predicts."""
        shift, spread, covariance, _ = self.shifts_by_views(s1)
        # the board's own shape is nuisance: compare the stereo parameters' shifts only
        metric = np.linalg.inv(covariance[:s1])
        seen = float(np.einsum("vi,ij,vj->", shift, metric, shift))
        expected = float(np.sum(metric * (covariance.T @ spread @ covariance)))
        return seen / expected if expected > 0 else float("nan")

    def covariances(self) -> tuple[Array, Array, Array]:
        """Of the shared parameters (s, s), of each pose (v, k, k), and between shared and pose (v, s, k)."""
        carried, _ = self._eliminated(self.pose)
        information = self.shared - self._by_poses(carried)
        shared = scaled_solve(information, np.eye(len(information)))
        cross = -shared @ np.swapaxes(carried, 1, 2)
        return shared, np.linalg.inv(self.pose) - carried @ cross, cross


def scaled_solve(A: Array, b: Array) -> Array:
    """Solve A x = b after scaling A to a unit diagonal: the parameters' units differ by 10^6."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(A), 1e-300))
    columns = scale if b.ndim == 1 else scale[:, None]
    try:
        return np.linalg.solve(A * scale[:, None] * scale, b * columns) * columns
    except np.linalg.LinAlgError as error:
        raise CalibrationError(
            "the views do not determine all parameters: add views with the board tilted in several directions"
        ) from error


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
        n_views, V = self.n_views, self.n_views + (self.prior is not None)
        exposures = 1 if self.motion is None else 2
        places, boards = o.view, (model.R_left_board, model.t_left_board)
        if model.boards_right is not None:
            places = o.view + V * o.camera  # the prior's has no board
            (R, t), pad = model.boards_right, V - n_views
            boards = np.concatenate([boards[0], R[:pad], R]), np.concatenate([boards[1], t[:pad], t])
        full, costs = np.zeros((exposures * V, N_COLUMNS, N_COLUMNS)), np.zeros(exposures * V)
        of_point, point = (np.zeros((len(full), n if s2 else 0, 3, columns)) for columns in (N_COLUMNS, 3))
        cameras = np.stack([camera.parameters for camera in model.cameras])
        given = (o.pixels, self.weights, cameras, model.R_right_left, model.t_right_left, *boards, model.points)
        if not _accumulated((places, o.camera, o.point), self.huber, given, full, of_point, point, costs):
            costs[...] = np.inf
        free = np.zeros((N_COLUMNS, s1 + 7))
        free[:N_STEREO, :s1], free[N_STEREO:, s1:] = self.stereo_basis, np.eye(7)
        squares = (free.T @ full @ free).reshape(exposures, V, s1 + 7, s1 + 7)
        shape = self.shape_basis.reshape(3 * n, s2) if s2 else np.zeros((0, 0))
        flat = of_point.reshape(exposures, V, len(shape), N_COLUMNS) @ free
        of_shape = shape.T @ flat[..., s1:]  # (exposures, V, s2, 7)
        normal = Normal(
            stereo=squares[..., :s1, :s1].sum(0),
            stereo_point=np.swapaxes(flat[..., :s1], 2, 3).sum(0),
            point=point.reshape(exposures, V, *point.shape[1:]).sum(0),
            shape=shape,
            gradient=np.concatenate([squares[..., :s1, -1], of_shape[..., -1]], axis=2).sum(0),
            cross=np.concatenate([*np.concatenate([squares[..., :s1, s1:-1], of_shape[..., :-1]], axis=2)], axis=2),
            pose=np.zeros((V, 6 * exposures, 6 * exposures)),
            pose_gradient=np.concatenate([*squares[..., s1:-1, -1]], axis=1),
            costs=costs.reshape(exposures, V).sum(0),
            n_views=n_views,
            board=np.zeros((s2, s2)),
        )
        for k in range(exposures):
            normal.pose[:, 6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = squares[k, :, s1:-1, s1:-1]
        if self.motion is not None:
            between, by_poses = motions(model)
            weights = self.motion.weights_of(n_views)
            weighted = by_poses * weights[..., None]
            normal.pose[:n_views] += np.swapaxes(by_poses, 1, 2) @ weighted
            normal.pose_gradient[:n_views] -= np.einsum("vij,vi->vj", weighted, between)
            normal.costs[:n_views] += np.sum(between**2 * weights, axis=1)
        unseen = np.bincount(o.view, minlength=V) == 0
        normal.pose[unseen], normal.pose_gradient[unseen] = np.eye(6 * exposures), 0.0
        normal.costs[unseen] = 0.0
        if self.prior is not None:
            information, towards, normal.costs[-1] = self.prior.normal(model)
            normal.stereo[-1] = self.stereo_basis.T @ information @ self.stereo_basis
            normal.gradient[-1, :s1] = self.stereo_basis.T @ towards
            if s2 and self.prior.board is not None:
                weight, (pull, cost) = self.prior.weight, self.prior.board.normal(model.points)
                normal.board[...] = weight * self.prior.board.information
                normal.gradient[-1, s1:] = weight * pull
                normal.costs[-1] += weight * cost
        return normal

    def stepped(self, model: StereoModel, shared: Array, poses: Array) -> StereoModel:
        """The model after a step."""
        s1 = self.stereo_basis.shape[1]
        return moved(model, self.stereo_basis @ shared[:s1], poses[: self.n_views], self.shape_basis @ shared[s1:])


def _accumulated(indices: Sequence[NDArray[np.intp]], huber: float, values: Sequence[Array], *sums: Array) -> bool:
    """The kernel, given what it is compiled for."""
    whole = [np.ascontiguousarray(index, np.int64) for index in indices]
    return bool(accumulate(*whole, float(huber), *(np.ascontiguousarray(value, np.float64) for value in values), *sums))


def prepare() -> None:
    """Compile the kernel, or load it: once per installation some tenths of a second, then nothing."""
    values = [np.zeros(shape) for shape in ((0, 2), (0, 2, 2), (2, 9), (3, 3), (3,), (0, 3, 3), (0, 3), (0, 3))]
    sums = [np.zeros(shape) for shape in ((0, 1, 1), (0, 0, 3, 1), (0, 0, 3, 3), (0,))]
    _accumulated([np.zeros(0, np.int64)] * 3, np.inf, values, *sums)


def quadratic(matrix: Array, vector: Array) -> Array:
    """v^T M v of (m, 2, 2) and (m, 2)."""
    x, y = vector[:, 0], vector[:, 1]
    value: Array = matrix[:, 0, 0] * x * x + 2 * matrix[:, 0, 1] * x * y + matrix[:, 1, 1] * y * y
    return value


def inverse_covariance(covariance: Array, extra: float) -> Array:
    """Inverse of covariance (m, 2, 2) + extra [px^2] in both axes."""
    a, b, c = covariance[:, 0, 0] + extra, covariance[:, 0, 1], covariance[:, 1, 1] + extra
    inverse = np.stack([np.stack([c, -b], axis=-1), np.stack([-b, a], axis=-1)], axis=-2)
    result: Array = inverse / (a * c - b * b)[:, None, None]
    return result


# Of chi-square: a thousandth of a sigma. Rounding hides so much where no step is taken any more: chi-square is a sum of
# squared differences of pixels that are a million times as large.
ROUNDED_AWAY = 1e-6


@dataclass(frozen=True)
class Minimum:
    """Where Levenberg-Marquardt ended."""

    model: StereoModel
    normal: Normal
    iterations: int
    converged: bool


def minimise(
    problem: Problem,
    start: StereoModel,
    iterations: int = 60,
    tolerance: float = 1e-10,
    damping: float = 1e-3,
    normal: Normal | None = None,
    rough: bool = False,
) -> Minimum:
    """Levenberg-Marquardt; converged when the cost to be gained by a full step is below tolerance x cost.

    The predicted gain g^T H^-1 g is free of the parameters' units, and a vanishing gradient is what it says.

    normal : the problem's normal equations at the start, where they are known
    rough : a step that gains less than the tolerance is taken unseen, and `normal` is the one before it: for those who
        want the model alone
    """
    model, normal = start, problem.linearise(start) if normal is None else normal
    to_gain = np.inf  # by the last step that was hardly damped
    if not np.isfinite(normal.cost):
        raise CalibrationError(
            "the start of the refinement puts the board behind a camera: check the order of the views"
        )
    for iteration in range(1, iterations + 1):
        shared, poses = normal.solve(damping)
        gain = float(shared @ normal.gradient.sum(0) + np.sum(poses * normal.pose_gradient))
        to_gain = gain if damping < 1e-2 else to_gain
        trial = problem.stepped(model, shared, poses)
        small = gain <= tolerance * max(normal.cost, 1.0)
        if rough and small and damping < 1e-4:
            return Minimum(trial, normal, iteration, True)
        trial_normal = problem.linearise(trial)
        if trial_normal.cost <= normal.cost * (1 + 1e-14):
            model, normal, damping = trial, trial_normal, max(damping * 0.1, 1e-12)
            if damping < 1e-4 and small:
                return Minimum(model, normal, iteration, True)
        else:
            if small:
                return Minimum(model, normal, iteration, damping < 1e-2 or to_gain <= ROUNDED_AWAY)
            damping *= 10.0
            if damping > 1e10:
                break
    return Minimum(model, normal, iterations, to_gain <= ROUNDED_AWAY)
