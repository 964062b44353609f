"""Joint least-squares refinement of both cameras, their relative pose, all board poses and optionally the board.

Outliers are rejected, and the noise beyond the stated covariances of the points is estimated. The model of the board's
shape is selected by cross-validation.

The distortion model is not selected in this way. A term that is not significant need not be zero: without it, its error
would bias all other parameters unnoticed (1.8 to 2.3 times the stated variance with three to eight views). All terms
are fitted, with `priors` of their usual size.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from calibration.board.target import LEAST_POINTS
from calibration.cameras.camera import triangulate
from calibration.fit.board_motion import BoardMotion, updated
from calibration.fit.normal_equations import Normal, Problem, inverse_covariance, minimise, quadratic
from calibration.fit.priors import priors_of
from calibration.fit.stereo_model import (
    Observations,
    StereoModel,
    Terms,
    board_basis,
    predict_pixels,
    restricted,
)
from calibration.kit.arguments import checked
from calibration.kit.arrays import Array, Mask
from calibration.kit.errors import CalibrationError

FREE_ROUNDS = 6  # of rejection in which points may be accepted again; not in as many more, so that the rounds end
MOST_DISAGREEMENT = 100.0  # bound of the disagreement of views, which few views determine poorly
FOLDS = 5
NEGLIGIBLE = 1e-5  # relative decrease of chi-square: for 10^4 points, a third of a sigma of one parameter
TRUNCATE = 30.0  # squared sigmas: one bad corner must not decide between two models
SIMPLER_WITHIN = 0.25  # standard errors of the paired difference by which a simpler model may be worse


@dataclass(frozen=True)
class Refinement:
    """Result of `refine_stereo`."""

    model: StereoModel
    terms: Terms
    observations: Observations  # including the rejected ones
    kept: Mask  # (m,)
    residuals: Array  # (m, 2) observed - predicted [px], including the rejected ones
    unexplained_sigma: float  # [px per axis] added to the stated noise so that the reduced chi-square is 1
    chi_square: float  # reduced, with the stated covariances alone
    normal: Normal  # at the minimum, of the kept observations
    problem: Problem
    iterations: int
    converged: bool

    @property
    def disagreement(self) -> float:
        """Variance of the parameters from the scatter of views, over that predicted by the corners' noise.

        1 for a correct model, larger if errors are common to the corners of a view.
        """
        return self.normal.disagreement(self.problem.stereo_basis.shape[1])

    def rms(self, select: Mask | None = None) -> float:
        """Root mean square distance [px] of observed from predicted points, of those kept or also selected."""
        use = self.kept if select is None else self.kept & select
        return float(np.sqrt(np.mean(np.sum(self.residuals[use] ** 2, axis=-1)))) if use.any() else float("nan")


def _degrees_of_freedom(problem: Problem) -> int:
    used = problem.observations
    seen = len(np.unique(2 * used.view + used.camera * problem.apart[used.view]))
    left = 2 * len(used) - problem.stereo_basis.shape[1] - problem.shape_basis.shape[-1] - 6 * seen
    if left <= 0:
        raise CalibrationError(
            f"{len(used)} points in {seen} views are fewer than the parameters to be found: take more views, or fewer "
            "free terms"
        )
    return left


@checked
def refine_stereo(
    observations: Observations,
    start: StereoModel,
    nominal: Array,
    terms: Terms | None = None,
    reject_beyond: float = 5.5,
    begin: Refinement | None = None,
    priors: bool = True,
    motion: BoardMotion | None = None,
) -> Refinement:
    """Refine all free parameters of `terms` from image points of a flat target.

    observations : image points with covariances, of any target with known points: corners of squares or dots
    start : cameras, stereo pose and board poses to a few percent and degrees, see `calibration.fit.start`; a view with
        two poses of the board keeps two
    nominal : (n, 3) [m] the declared points of the target
    reject_beyond : sigmas, with the noise estimated from the residuals; of 10^4 good points none exceeds the default
    begin : an earlier refinement of the same observations with other terms, which replaces the robust start
    priors : whether the priors of cameras and boards are used, see `priors`
    motion : approximate motion of boards between the two exposures of a pair; None: none, or that of `begin`

    Raises CalibrationError if the views cannot determine the parameters.
    """
    terms, observations = terms or Terms(), observations[np.argsort(observations.view, kind="stable")]
    shape_basis = board_basis(nominal, terms.board)
    model = restricted(start if begin is None else begin.model, nominal, terms)
    motion = begin.problem.motion if motion is None and begin is not None else motion
    prior = priors_of(model, nominal, shape_basis) if priors else None
    weights, bases = inverse_covariance(observations.covariance, 0.0), (terms.stereo_basis(), shape_basis)
    problem = Problem(observations, weights, *bases, start.apart if begin is None else begin.problem.apart, prior=prior)
    if begin is None:
        kept = np.ones(len(observations), bool)
        model, extra = _robust_start(problem, model)
    else:
        kept, extra = begin.kept, begin.unexplained_sigma**2
    rough = replace(problem, motion=motion)
    problem, model, kept, extra, dof, total = _settled(rough, model, kept, extra, reject_beyond)
    used = observations[kept]
    # with noise and points fixed, the exact minimum; then again with the noise estimated there, so that the result does
    # not depend on where the rough rounds stopped
    for _ in range(2):
        problem = problem.seeing(used, extra)
        minimum = minimise(problem, model, tolerance=1e-14, damping=1e-6)
        model, total = minimum.model, total + minimum.iterations
        residuals = observations.pixels - predict_pixels(model, observations)
        final, extra = extra, _extra_variance(residuals[kept], used.covariance, dof)
    own = _mahalanobis2(residuals[kept], observations.covariance[kept], 0.0)
    return Refinement(
        model=model,
        terms=terms,
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
    """Rounds of rough fits until noise, accepted points, motion of the boards and weight of the prior are consistent.

    problem : of all observations, of which those `kept` are fitted first; extra : [px^2] in addition to their noise
    returns : problem and model, points that were fitted, extra variance, degrees of freedom, number of steps
    """
    observations, total = problem.observations, 0
    place = 2 * observations.view + observations.camera * problem.apart[observations.view]  # of the board
    for turn in range(2 * FREE_ROUNDS):
        used, motion, prior = observations[kept], problem.motion, problem.prior
        problem = problem.seeing(used, extra)
        dof: float = _degrees_of_freedom(problem)
        minimum = minimise(problem, model, tolerance=1e-5, damping=1e-6, rough=True)
        model, total = minimum.model, total + minimum.iterations
        steady = True
        if motion is not None:
            moves, determined = updated(motion, model, minimum.normal.covariances()[1], problem.apart)
            dof, steady = dof - determined, moves.is_near(motion)
            problem = replace(problem, motion=moves)
        if prior is not None:
            disagreement = float(np.nan_to_num(minimum.normal.disagreement(problem.stereo_basis.shape[1])))
            weight = min(max(disagreement, 1.0 / MOST_DISAGREEMENT), MOST_DISAGREEMENT)
            problem = replace(problem, prior=replace(prior, weight=weight))
        residuals = observations.pixels - predict_pixels(model, observations)
        before, extra = extra, _extra_variance(residuals[kept], used.covariance, dof)
        good = _mahalanobis2(residuals, observations.covariance, extra) < reject_beyond**2
        good = good & kept if turn >= FREE_ROUNDS else good
        good &= np.bincount(place, good)[place] >= min(LEAST_POINTS, len(model.points))  # fewer determine no pose
        if steady and abs(extra - before) <= 0.01 * before + 1e-10 and bool((good == kept).all()):
            break
        if turn < 2 * FREE_ROUNDS - 1:  # the returned values are those of the fitted points
            kept = good
    return problem, model, kept, extra, dof, total


def _robust_start(problem: Problem, model: StereoModel) -> tuple[StereoModel, float]:
    """Huber fit with the noise estimated from the median residual, and the extra variance [px^2]."""
    observations = problem.observations
    for _ in range(2):
        extra = _median_variance(observations.pixels - predict_pixels(model, observations))
        rough = replace(problem.seeing(observations, extra), huber=2.0)
        model = minimise(rough, model, iterations=30, tolerance=1e-5, rough=True).model
    return model, _median_variance(observations.pixels - predict_pixels(model, observations))


def _median_variance(residuals: Array) -> float:
    """Variance per axis from the median of squared 2-D residuals, 2 ln 2 sigma^2 for a Gaussian."""
    return float(np.median(np.sum(residuals**2, axis=-1)) / (2 * np.log(2))) + 1e-12


def _mahalanobis2(residuals: Array, covariance: Array, extra: float) -> Array:
    return quadratic(inverse_covariance(covariance, extra), residuals)


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


@dataclass(frozen=True)
class TermsTried:
    """One row of the cross-validation table."""

    terms: Terms
    n_parameters: int  # shared by all views
    rms_px: float  # of the fitted views
    held_out_rms_px: float  # of held-out views, with their poses fitted
    held_out_error: float  # [m] the same for corners in space, rms over those views; NaN if no view has both cameras
    held_out_chi_square: float  # per observation, truncated, in units of the noise of this comparison
    noise_px: float  # sigma per axis beyond the corners' noise, for all models: the least of them
    per_view: Array  # (n_views,) held-out chi-square of each view, NaN if it was not used


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
    nothing = problem.stereo_basis[:, :0], problem.shape_basis[..., :0]
    poses = replace(problem, stereo_basis=nothing[0], shape_basis=nothing[1], prior=None, huber=3.0)
    return minimise(poses, model, iterations=12, tolerance=NEGLIGIBLE, damping=1e-7, rough=True).model


def candidate(refinement: Refinement, quietest: Refinement) -> TermsTried:
    """Cross-validation of one fitted model; in held-out views the pose is fitted.

    Noise, points for distances and motion of the boards are those of `quietest`, the same for all candidates.
    """
    o, problem = refinement.observations, replace(refinement.problem, motion=quietest.problem.motion)
    used, sigma, views = o[refinement.kept], quietest.unexplained_sigma, np.unique(problem.observations.view)
    residuals, tested, errors = np.zeros_like(o.pixels), np.isin(o.view, views), []
    for fold in range(min(FOLDS, len(views))):
        left_out = views[fold :: min(FOLDS, len(views))]
        train, test = ~np.isin(used.view, left_out), np.isin(o.view, left_out)
        others = problem.seeing(used[train], sigma**2)
        model = minimise(others, refinement.model, iterations=8, tolerance=NEGLIGIBLE, damping=1e-7, rough=True).model
        model = fit_poses(problem.seeing(o[test], sigma**2), model)
        residuals[test] = o.pixels[test] - predict_pixels(model, o[test])
        pairs = left_out[~problem.apart[left_out]]
        errors += [error_in_space(model, o[quietest.kept & (o.view == v)]) for v in pairs]
    chi_square = np.minimum(quadratic(inverse_covariance(o.covariance, sigma**2), residuals), TRUNCATE)
    chi_square = np.where(np.isfinite(chi_square), chi_square, TRUNCATE)  # behind a camera
    sums, count = (np.bincount(o.view[tested], of, problem.n_views) for of in (chi_square[tested], None))
    good, error = tested & quietest.kept, np.array(errors)[np.isfinite(errors)]
    return TermsTried(
        terms=refinement.terms,
        n_parameters=problem.stereo_basis.shape[1] + problem.shape_basis.shape[-1],
        rms_px=refinement.rms(),
        held_out_rms_px=float(np.sqrt(np.nansum(residuals[good] ** 2) / max(good.sum(), 1))),
        held_out_error=float(np.sqrt(np.mean(error**2))) if len(error) else np.nan,
        held_out_chi_square=float(sums.sum() / max(count.sum(), 1)),
        noise_px=sigma,
        per_view=sums / np.where(count > 0, count, np.nan),
    )


def is_near(row: TermsTried, best: TermsTried) -> bool:
    """Whether a model's held-out chi-square is not significantly worse than the best."""
    difference = row.per_view - best.per_view
    difference = difference[np.isfinite(difference)]
    error = float(np.std(difference) / np.sqrt(max(len(difference) - 1, 1)))
    return bool(np.mean(difference) <= SIMPLER_WITHIN * error)


def choose_board(
    observations: Observations,
    start: StereoModel,
    nominal: Array,
    tried: Sequence[Terms],
    motion: BoardMotion | None = None,
) -> tuple[Refinement, tuple[TermsTried, ...]]:
    """Select the model of the board's shape among the terms `tried`, simplest first; a single one is used unchanged.

    Returns the refinement with the selected terms and the table of candidates. motion : as in `refine_stereo`
    """
    fits: list[Refinement] = []
    for terms in tried:
        begin = fits[0] if fits else None
        fits.append(refine_stereo(observations, start, nominal, terms, begin=begin, motion=None if begin else motion))
    quietest = min(fits, key=lambda fit: fit.unexplained_sigma)
    table = [candidate(fit, quietest) for fit in fits]
    best = min(table, key=lambda row: row.held_out_chi_square)
    return next(fit for fit, row in zip(fits, table, strict=True) if is_near(row, best)), tuple(table)
