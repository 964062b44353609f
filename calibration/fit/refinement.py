"""One least-squares refinement of both cameras, their mutual pose, all board poses and, if wanted, the board itself.

Outliers are rejected and the noise that the points' own covariances leave unexplained is measured on the way. Which
shape of the board the data support is chosen by the error on views that the fit has not seen.

The lens is not chosen so. A term that the views do not tell from zero is not zero for that: left out, it would put its
error into all others, which nothing would say (1.8 to 2.3 times the stated variance by three to eight views). All terms
are fitted, and `priors` knows how large they are in lenses.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from calibration.board.target import LEAST_POINTS
from calibration.cameras.camera import triangulate
from calibration.fit.board_motion import BoardMotion, learnt
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

FREE_ROUNDS = 6  # of rejection, in which a point may come back; in as many more it may not, so that they come to an end
MOST_DISAGREEMENT = 100.0  # of views among each other that is believed, and the least: few of them tell it badly
FOLDS = 5
NEGLIGIBLE = 1e-5  # of chi-square, still to be gained: of 10^4 points, a third of a sigma of one parameter
TRUNCATE = 30.0  # squared sigmas: one bad corner must not decide between two models
SIMPLER_WITHIN = 0.25  # standard errors of the paired difference that a simpler model may be worse


@dataclass(frozen=True)
class Refinement:
    """Result of `refine_stereo`."""

    model: StereoModel
    terms: Terms
    observations: Observations  # all that were given
    kept: Mask  # (m,)
    residuals: Array  # (m, 2) observed - predicted [px], of the rejected ones too
    unexplained_sigma: float  # [px per axis] added to the corners' own noise so that the residuals are explained
    chi_square: float  # reduced, with the points' own covariances alone
    normal: Normal  # at the minimum, of the kept observations
    problem: Problem
    iterations: int
    converged: bool

    @property
    def disagreement(self) -> float:
        """Variance of the parameters as the views disagree about them, over what the corners' noise predicts.

        1 for a right model, and more where errors are common to the corners of a view.
        """
        return self.normal.disagreement(self.problem.stereo_basis.shape[1])

    def rms(self, select: Mask | None = None) -> float:
        """Root mean square distance [px] of the kept observations, or of some of them."""
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
    """Refine everything `terms` frees, from image points of any flat target.

    observations : image points with covariances, of any target with known points: corners of squares or dots
    start : cameras, stereo pose and board poses to a few percent and degrees, see `calibration.fit.start`; where it has
        two places of a board, so has what is refined
    nominal : (n, 3) [m] the target's points as declared
    reject_beyond : sigmas, after the noise that the residuals themselves show: of 10^4 good points none lies beyond
    begin : an earlier refinement of the same observations with other terms: spares the robust start
    priors : whether what is known of cameras and boards beforehand counts, see `priors`
    motion : about how far boards moved between the two exposures of a pair; None: they did not, or as `begin` has it

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
    # noise and points are settled: now the minimum itself, and once more with the noise that is seen there, so that
    # nothing is left of where the rough rounds happened to stop
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
    """Rounds of a rough fit until noise, points, boards' motion and the prior's weight belong together.

    problem : of all observations, of which those `kept` are fitted first; extra : [px^2] beside their own noise
    returns : problem and model, points that were fitted, extra variance, degrees of freedom, steps that were taken
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
            moves, determined = learnt(motion, model, minimum.normal.covariances()[1], problem.apart)
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
        good &= np.bincount(place, good)[place] >= min(LEAST_POINTS, len(model.points))  # fewer tell no place
        if steady and abs(extra - before) <= 0.01 * before + 1e-10 and bool((good == kept).all()):
            break
        if turn < 2 * FREE_ROUNDS - 1:  # what is returned belongs to the points that were fitted
            kept = good
    return problem, model, kept, extra, dof, total


def _robust_start(problem: Problem, model: StereoModel) -> tuple[StereoModel, float]:
    """Huber's fit with the noise set by the median residual, and the extra variance [px^2] it shows."""
    observations = problem.observations
    for _ in range(2):
        extra = _median_variance(observations.pixels - predict_pixels(model, observations))
        rough = replace(problem.seeing(observations, extra), huber=2.0)
        model = minimise(rough, model, iterations=30, tolerance=1e-5, rough=True).model
    return model, _median_variance(observations.pixels - predict_pixels(model, observations))


def _median_variance(residuals: Array) -> float:
    """Variance per axis that puts the median of squared 2-D residuals where a Gaussian has it, 2 ln 2 sigma^2."""
    return float(np.median(np.sum(residuals**2, axis=-1)) / (2 * np.log(2))) + 1e-12


def _mahalanobis2(residuals: Array, covariance: Array, extra: float) -> Array:
    return quadratic(inverse_covariance(covariance, extra), residuals)


def _extra_variance(residuals: Array, covariance: Array, dof: float) -> float:
    """Variance per axis [px^2] which, added to the points' own, makes chi-square equal to the degrees of freedom."""
    own, axes = np.linalg.eigh(covariance)  # of each point: along its axes what is added is a plain sum
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
    rms_px: float  # on the views that were fitted
    held_out_rms_px: float  # on views left out, each with its own pose fitted
    held_out_error: float  # [m] the same of corners in space, rms over those views; NaN where both cameras saw none
    held_out_chi_square: float  # per observation, truncated, in units of the noise of this comparison
    noise_px: float  # sigma per axis of this comparison beyond the corners' own noise: the least of its models
    per_view: Array  # (n_views,) the same, NaN where a view was not used


def error_in_space(model: StereoModel, seen: Observations) -> float:
    """Rms distance [m] of a view's corners, triangulated, from the board where they put it best; NaN by one camera."""
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
    """Poses of the target in the views of the problem's observations, everything else held."""
    nothing = problem.stereo_basis[:, :0], problem.shape_basis[..., :0]
    poses = replace(problem, stereo_basis=nothing[0], shape_basis=nothing[1], prior=None, huber=3.0)
    return minimise(poses, model, iterations=12, tolerance=NEGLIGIBLE, damping=1e-7, rough=True).model


def candidate(refinement: Refinement, quietest: Refinement) -> TermsTried:
    """The row of one fitted model: each view left out in turn, its own pose fitted.

    The noise, the points that count in distances and the boards' motion are those of another fit, for all candidates.
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
    """Whether a model's held-out chi-square is not clearly worse than the least."""
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
    """Choose what the board's shape may be: of the terms `tried`, the simplest first; one alone is taken, not chosen.

    Returns the refinement of the chosen terms and the table of what was compared. motion : as in `refine_stereo`
    """
    fits: list[Refinement] = []
    for terms in tried:
        begin = fits[0] if fits else None
        fits.append(refine_stereo(observations, start, nominal, terms, begin=begin, motion=None if begin else motion))
    quietest = min(fits, key=lambda fit: fit.unexplained_sigma)
    table = [candidate(fit, quietest) for fit in fits]
    best = min(table, key=lambda row: row.held_out_chi_square)
    return next(fit for fit, row in zip(fits, table, strict=True) if is_near(row, best)), tuple(table)
