"""Joint least-squares refinement of both cameras, their relative pose, all board poses and the board's shape.

Outliers are rejected, and the noise beyond the stated covariances of the points is estimated. No term is left out: one
that is not significant need not be zero, and without it, its error would bias all other parameters unnoticed (1.8 to
2.3 times the stated variance with three to eight views). All are fitted, with `priors` of their usual size.

Blocks of the least-squares problem are the views. The parameters of one view alone are the six of the board's pose, or
12 if its two images have separate poses.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy

from calibration.board.target import LEAST_POINTS
from calibration.cameras.camera import triangulate
from calibration.cameras.splines import LensField
from calibration.fit.board_motion import BoardMotion, motions, updated
from calibration.fit.priors import Prior, board_basis, priors_of
from calibration.fit.stereo_model import N_STEREO, Observations, StereoModel, moved, predict, predict_pixels
from calibration.kit import least_squares
from calibration.kit.errors import CalibrationError
from calibration.kit.least_squares import Minimum, Normal, normal_of_rows
from calibration.kit.types import Array, Indices, Mask, checked

FREE_ROUNDS = 6  # of robust weights, and of rejection with points accepted again; not in as many more, so that it ends
FOLDS = 5
OVERSTATED = 1e-2  # smallest variance of the residuals over that stated
NEGLIGIBLE = 1e-5  # relative decrease of chi-square: for 10^4 points, a third of a sigma of one parameter


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

    def seeing(self, observations: Observations, extra: float) -> "Problem":
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
        rank, count = np.argsort(np.argsort(view, kind="stable")), np.bincount(view, minlength=self.n_views)
        of_view = np.zeros((self.n_views, count.max(), rows.shape[1]))
        of_view[view, rank - (np.cumsum(count) - count)[view]] = rows
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


@dataclass(frozen=True)
class Refinement:
    """Result of `refine_stereo`."""

    model: StereoModel
    observations: Observations  # including the rejected ones
    kept: Mask  # (m,)
    residuals: Array  # (m, 2) observed - predicted [px], including the rejected ones
    unexplained_sigma: float  # [px per axis] added to the stated noise so that the reduced chi-square is 1
    chi_square: float  # reduced, with the stated covariances alone
    normal: Normal  # at the minimum, of the kept observations
    problem: Problem
    iterations: int
    converged: bool
    lens_field: LensField | None = None  # by which the observations were corrected

    @cached_property
    def inflation(self) -> float:
        """Variance of the parameters from the scatter of views, over that predicted by the corners' noise.

        At least 1, as for a correct model; larger if errors are common to the corners of a view.
        """
        return max(self.normal.disagreement(N_STEREO), 1.0)

    def rms(self, select: Mask | None = None) -> float:
        """Root mean square distance [px] of observed from predicted points, of those kept or also selected."""
        use = self.kept if select is None else self.kept & select
        return float(np.sqrt(np.mean(np.sum(self.residuals[use] ** 2, axis=-1)))) if use.any() else float("nan")


@checked
def refine_stereo(
    observations: Observations,
    start: StereoModel,
    nominal: Array,
    reject_beyond: float = 5.5,
    motion: BoardMotion | None = None,
) -> Refinement:
    """Refine cameras, their relative pose, poses and shape of a flat target from its image points.

    observations : image points with covariances, of any target with known points: corners of squares or dots
    start : cameras, stereo pose and board poses to a few percent and degrees, see `calibration.fit.start`; a view with
        two poses of the board keeps two
    nominal : (n, 3) [m] the declared points of the target
    reject_beyond : sigmas, with the noise estimated from the residuals; of 10^4 good points none exceeds the default
    motion : approximate motion of boards between the two exposures of a pair; None: none

    Raises CalibrationError if the views cannot determine the parameters.
    """
    observations = observations[np.argsort(observations.view, kind="stable")]
    basis, weights = board_basis(nominal), inverse_covariance(observations.covariance, 0.0)
    model = replace(start, points=nominal)
    problem = Problem(observations, weights, basis, start.apart, priors_of(model, nominal, basis))
    # robust, as whole images may be wrong, and with the declared board
    rough = Problem(observations, weights, basis[..., :0], start.apart, priors_of(model, nominal, basis[..., :0]))
    residuals = observations.pixels - predict_pixels(model, observations)
    for _ in range(FREE_ROUNDS):
        rough = rough.seeing(observations, _median_variance(residuals))
        sigmas = np.sqrt(quadratic(rough.weights, residuals))
        weights = rough.weights / np.fmax(sigmas / 2.0, 1.0)[:, None, None]  # Huber's, beyond 2 sigma
        model = minimise(replace(rough, weights=weights), model, iterations=30, tolerance=1e-5, rough=True).model
        residuals = observations.pixels - predict_pixels(model, observations)
    extra = _median_variance(residuals)
    kept = _accepted(problem, residuals, extra, reject_beyond)
    return refined(replace(problem, motion=motion), model, kept, extra, reject_beyond)


def refined(problem: Problem, model: StereoModel, kept: Mask, extra: float, reject_beyond: float = 5.5) -> Refinement:
    """The refinement from a model near the minimum, see `_settled`."""
    observations = problem.observations
    problem, model, kept, extra, dof, total = _settled(problem, model, kept, extra, reject_beyond)
    used = observations[kept]
    # with noise and points fixed, the exact minimum; then again with the noise estimated there, so that the result does
    # not depend on where the rough rounds stopped
    for _ in range(2):
        problem = problem.seeing(used, extra)
        minimum = minimise(problem, model, tolerance=1e-14, damping=1e-6)
        model, total = minimum.model, total + minimum.iterations
        residuals = observations.pixels - predict_pixels(model, observations)
        final, extra = extra, _extra_variance(residuals[kept], used.covariance, dof)
    own = quadratic(inverse_covariance(used.covariance, 0.0), residuals[kept])
    return Refinement(
        model=model,
        observations=observations,
        kept=kept,
        residuals=residuals,
        unexplained_sigma=float(np.sqrt(final)),
        chi_square=float(own.sum() / dof),
        normal=minimum.normal,
        problem=problem,
        iterations=total,
        converged=minimum.converged,
    )


def _settled(
    problem: Problem, model: StereoModel, kept: Mask, extra: float, reject_beyond: float
) -> tuple[Problem, StereoModel, Mask, float, float, int]:
    """Rounds of rough fits until noise, accepted points, motion of the boards and the prior are consistent.

    problem : of all observations, of which those `kept` are fitted first; extra : [px^2] in addition to their noise
    returns : problem and model, points that were fitted, extra variance, degrees of freedom, number of steps
    """
    whole, observations, total, found = problem, problem.observations, 0, np.inf
    place = problem.places
    for turn in range(2 * FREE_ROUNDS):
        used, motion = observations[kept], problem.motion
        problem = problem.seeing(used, extra)
        seen = len(np.unique(place[kept]))
        left = 2 * len(used) - N_STEREO - 6 * seen
        minimum = minimise(problem, model, tolerance=1e-5, damping=1e-6, rough=True)
        model, total = minimum.model, total + minimum.iterations
        # the stated noise may be too large: the prior is weighted by that of the residuals
        noise = float(minimum.normal.costs.sum()) / max(left, 1)
        weight = max(float(np.nan_to_num(minimum.normal.disagreement(N_STEREO))), min(noise, 1.0), OVERSTATED)
        learnt, determined = problem.prior.learnt(minimum.normal, model, weight)
        steady, dof = abs(determined - found) < 0.01, left - determined
        problem, found = replace(problem, prior=learnt), determined
        if motion is not None:
            moves, determined = updated(motion, model, minimum.normal.covariances()[1], problem.apart)
            # some percent are below the uncertainty of the motion's size
            dof, steady = dof - determined, steady and np.allclose(moves.weights, motion.weights, rtol=0.05, atol=0.0)
            problem = replace(problem, motion=moves)
        residuals = observations.pixels - predict_pixels(model, observations)
        if dof <= 0:
            raise CalibrationError(
                f"{len(used)} points in {seen} views are fewer than the parameters to be found: take more views"
            )
        before, extra = extra, _extra_variance(residuals[kept], used.covariance, dof)
        good = _accepted(whole, residuals, extra, reject_beyond, kept if turn >= FREE_ROUNDS else True)
        if steady and abs(extra - before) <= 0.01 * before + 1e-10 and bool((good == kept).all()):
            break
        if turn < 2 * FREE_ROUNDS - 1:  # the returned values are those of the fitted points
            kept = good
    return problem, model, kept, extra, dof, total


def _median_variance(residuals: Array) -> float:
    """Variance per axis from the median of squared 2-D residuals, 2 ln 2 sigma^2 for a Gaussian."""
    return float(np.median(np.sum(residuals**2, axis=-1)) / (2 * np.log(2))) + 1e-12


def _accepted(problem: Problem, residuals: Array, extra: float, beyond: float, among: Mask | bool = True) -> Mask:
    """Points (m,) whose residuals are below a number of sigmas; none of a place with too few of them for its pose."""
    place = problem.places
    square = quadratic(inverse_covariance(problem.observations.covariance, extra), residuals)
    good = (square < beyond**2) & among
    return np.asarray(good & (np.bincount(place, good)[place] >= min(LEAST_POINTS, len(problem.shape_basis))), bool)


def _extra_variance(residuals: Array, covariance: Array, dof: float) -> float:
    """Variance per axis [px^2] which, added to the covariances, makes chi-square equal to the degrees of freedom."""
    own, axes = np.linalg.eigh(covariance)  # the extra variance adds to the eigenvalues of each point
    squares = np.einsum("mij,mi->mj", axes, residuals) ** 2

    def excess(extra: float) -> float:
        return float(np.sum(squares / (own + extra))) - dof

    if excess(0.0) <= 0:
        return 0.0
    most = 2.0 * float(np.sum(residuals**2)) / dof + 1e-12
    return float(scipy.optimize.brentq(excess, 0.0, most, xtol=1e-12 * most))


def error_in_space(model: StereoModel, seen: Observations) -> float:
    """Rms distance [m] of a view's triangulated corners from the board fitted to them; NaN with one camera."""
    left, right = (seen[seen.camera == camera] for camera in (0, 1))
    common, a, b = np.intersect1d(left.point, right.point, return_indices=True)
    found = triangulate(np.stack([left.pixels[a], right.pixels[b]]), model.rig)
    met = np.isfinite(found).all(axis=1)
    if met.sum() < LEAST_POINTS:
        return float("nan")
    board, found = model.points[common][met], found[met]
    d, e = board - board.mean(0), found - found.mean(0)
    off = scipy.spatial.transform.Rotation.align_vectors(e, d)[1]
    return float(off / np.sqrt(len(d)))


def fit_poses(problem: Problem, model: StereoModel) -> StereoModel:
    """The model with the poses of the target fitted to the problem's observations, everything else fixed."""
    poses = replace(problem, shape_basis=problem.shape_basis[..., :0])
    own = np.append(np.arange(poses.n_own), -1)

    def linearise(model: StereoModel) -> Normal:
        normal = poses.linearise(model)
        return replace(normal, products=normal.products[:, own[:, None], own], prior=np.zeros((1, 1)))

    return least_squares.minimise(linearise, poses.stepped, model, 12, NEGLIGIBLE, damping=1e-7, rough=True).model


def held_out(refinement: Refinement) -> tuple[float, float]:
    """Rms distance of points in held-out views [px], and of corners in space from the board fitted to them [m].

    The poses of held-out views are fitted. The second is NaN if no view has both cameras.
    """
    problem, extra, errors = refinement.problem, refinement.unexplained_sigma**2, []
    used, views = problem.observations, np.unique(problem.observations.view)
    residuals = np.empty_like(used.pixels)
    for left_out in (views[fold::FOLDS] for fold in range(min(FOLDS, len(views)))):
        test = np.isin(used.view, left_out)
        others, theirs = (problem.seeing(used[which], extra) for which in (~test, test))
        model = minimise(others, refinement.model, iterations=8, tolerance=NEGLIGIBLE, damping=1e-7, rough=True).model
        model = fit_poses(theirs, model)
        residuals[test] = used.pixels[test] - predict_pixels(model, used[test])
        errors += [error_in_space(model, used[used.view == v]) for v in left_out[~problem.apart[left_out]]]
    error = np.array(errors)[np.isfinite(errors)]
    rms = float(np.sqrt(np.nansum(residuals**2) / len(used)))
    return rms, float(np.sqrt(np.mean(error**2))) if len(error) else np.nan
