"""One least-squares refinement of both cameras, their mutual pose, all board poses and, if wanted, the board itself.

Outliers are rejected and the noise that the points' own covariances leave unexplained is measured on the way.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy

from calibration.fit.board_motion import BoardMotion, learnt, split
from calibration.fit.normal_equations import Normal, Problem, inverse_covariance, minimise, quadratic
from calibration.fit.priors import Prior, priors_of
from calibration.fit.stereo_model import Observations, StereoModel, Terms, board_basis, predict_pixels, restricted
from calibration.kit.arrays import Array, Mask
from calibration.kit.errors import CalibrationError

FREE_ROUNDS = 6  # of rejection, in which a point may come back; in as many more it may not, so that they come to an end
MOST_DISAGREEMENT = 100.0  # of views among each other that is believed, and the least: few of them tell it badly


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


def _degrees_of_freedom(problem: Problem, n_kept: int) -> int:
    seen = len(np.unique(problem.observations.view))
    return 2 * n_kept - problem.stereo_basis.shape[1] - problem.shape_basis.shape[-1] - 6 * seen


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
    start : cameras, stereo pose and board poses to a few percent and degrees, see `calibration.fit.start`
    nominal : (n, 3) [m] the target's points as declared
    reject_beyond : sigmas, after the noise that the residuals themselves show: of 10^4 good points none lies beyond
    begin : an earlier refinement of the same observations with other terms: spares the robust start
    priors : whether what is known of cameras and boards beforehand counts, see `priors`
    motion : about how far boards moved between the two exposures of a pair; None: they did not, or as `begin` has it

    Raises CalibrationError if the views cannot determine the parameters.
    """
    terms = terms or Terms()
    observations = observations[np.argsort(observations.view, kind="stable")]
    n_views = len(start.R_left_board)
    stereo_basis, shape_basis = terms.stereo_basis(), board_basis(nominal, terms.board)
    kept = np.ones(len(observations), bool)
    model, total = restricted(start if begin is None else begin.model, nominal, terms), 0
    prior = priors_of(model, nominal, shape_basis) if priors else None
    motion = begin.problem.motion if motion is None and begin is not None else motion
    if begin is None:
        model, extra = _robust_start(observations, model, stereo_basis, shape_basis, n_views, prior)
    else:
        kept, extra = begin.kept, begin.unexplained_sigma**2
    if motion is not None:
        model = split(model)
    for turn in range(2 * FREE_ROUNDS):
        used = observations[kept]
        weights = inverse_covariance(used.covariance, extra)
        problem = Problem(used, weights, stereo_basis, shape_basis, n_views, prior=prior, motion=motion)
        dof: float = _degrees_of_freedom(problem, len(used))
        if dof <= 0:
            raise CalibrationError(
                f"{len(used)} points in {len(np.unique(used.view))} views are fewer than the parameters to be found: "
                "take more views, or fewer free terms"
            )
        minimum = minimise(problem, model, tolerance=1e-5, damping=1e-6, rough=True)
        model, total, moved_as = minimum.model, total + minimum.iterations, motion
        if motion is not None:
            motion, determined = learnt(motion, model, minimum.normal.covariances()[1][:n_views])
            dof -= determined
        if prior is not None:
            disagreement = float(np.nan_to_num(minimum.normal.disagreement(stereo_basis.shape[1])))
            weight = min(max(disagreement, 1.0 / MOST_DISAGREEMENT), MOST_DISAGREEMENT)
            prior = replace(prior, weight=weight)
        residuals = observations.pixels - predict_pixels(model, observations)
        new_extra = _extra_variance(residuals[kept], used.covariance, dof)
        new_kept = _mahalanobis2(residuals, observations.covariance, new_extra) < reject_beyond**2
        if turn >= FREE_ROUNDS:
            new_kept &= kept
        settled = abs(new_extra - extra) <= 0.01 * extra + 1e-10 and bool((new_kept == kept).all())
        if motion is not None and moved_as is not None:
            settled = settled and motion.is_near(moved_as)
        extra = new_extra
        if settled or turn == 2 * FREE_ROUNDS - 1:  # what is returned belongs to the points that were fitted
            break
        kept = new_kept
    # noise and points are settled: now the minimum itself, and once more with the noise that is seen there, so that
    # nothing is left of where the rough rounds happened to stop
    for _ in range(2):
        problem = replace(problem, weights=inverse_covariance(used.covariance, extra), prior=prior, motion=motion)
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


def _robust_start(
    observations: Observations,
    model: StereoModel,
    stereo_basis: Array,
    shape_basis: Array,
    n_views: int,
    prior: Prior | None,
) -> tuple[StereoModel, float]:
    """Huber's fit with the noise set by the median residual, and the extra variance [px^2] it shows."""
    flat = shape_basis[..., :0]
    model = replace(model, boards_right=None)
    extra = 0.0
    for basis in (flat, shape_basis) if shape_basis.shape[-1] else (flat,):
        for _ in range(2):
            residuals = observations.pixels - predict_pixels(model, observations)
            extra = _median_variance(residuals)
            weights = inverse_covariance(observations.covariance, extra)
            problem = Problem(observations, weights, stereo_basis, basis, n_views, huber=2.0, prior=prior)
            model = minimise(problem, model, iterations=30, tolerance=1e-5, rough=True).model
    residuals = observations.pixels - predict_pixels(model, observations)
    return model, _median_variance(residuals)


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
