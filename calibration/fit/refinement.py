"""One least-squares refinement of both cameras, their mutual pose, all board poses and, if wanted, the board itself.

Outliers are rejected and the noise that the points' own covariances leave unexplained is measured on the way.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy

from calibration.fit.board_motion import BoardMotion, learnt, split
from calibration.fit.normal_equations import Normal, Problem, inverse_covariance, minimise, quadratic
from calibration.fit.priors import priors_of
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


def _degrees_of_freedom(problem: Problem) -> int:
    used = problem.observations
    seen = len(np.unique(used.view))
    left = 2 * len(used) - problem.stereo_basis.shape[1] - problem.shape_basis.shape[-1] - 6 * seen
    if left <= 0:
        raise CalibrationError(
            f"{len(used)} points in {seen} views are fewer than the parameters to be found: take more views, or fewer "
            "free terms"
        )
    return left


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
    terms, observations = terms or Terms(), observations[np.argsort(observations.view, kind="stable")]
    shape_basis = board_basis(nominal, terms.board)
    model = restricted(start if begin is None else begin.model, nominal, terms)
    motion = begin.problem.motion if motion is None and begin is not None else motion
    prior = priors_of(model, nominal, shape_basis) if priors else None
    weights, bases = inverse_covariance(observations.covariance, 0.0), (terms.stereo_basis(), shape_basis)
    problem = Problem(observations, weights, *bases, len(start.R_left_board), prior=prior)
    if begin is None:
        kept = np.ones(len(observations), bool)
        model, extra = _robust_start(problem, model)
    else:
        kept, extra = begin.kept, begin.unexplained_sigma**2
    rough = replace(problem, motion=motion), model if motion is None else split(model)
    problem, model, kept, extra, dof, total = _settled(*rough, kept, extra, reject_beyond)
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
    for turn in range(2 * FREE_ROUNDS):
        used, motion, prior = observations[kept], problem.motion, problem.prior
        problem = problem.seeing(used, extra)
        dof: float = _degrees_of_freedom(problem)
        minimum = minimise(problem, model, tolerance=1e-5, damping=1e-6, rough=True)
        model, total = minimum.model, total + minimum.iterations
        steady = True
        if motion is not None:
            moves, determined = learnt(motion, model, minimum.normal.covariances()[1][: problem.n_views])
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
        if steady and abs(extra - before) <= 0.01 * before + 1e-10 and bool((good == kept).all()):
            break
        if turn < 2 * FREE_ROUNDS - 1:  # what is returned belongs to the points that were fitted
            kept = good
    return problem, model, kept, extra, dof, total


def _robust_start(problem: Problem, model: StereoModel) -> tuple[StereoModel, float]:
    """Huber's fit with the noise set by the median residual, and the extra variance [px^2] it shows."""
    observations = problem.observations
    model = replace(model, boards_right=None)
    for basis in (problem.shape_basis[..., :0], problem.shape_basis)[: 1 + bool(problem.shape_basis.shape[-1])]:
        for _ in range(2):
            extra = _median_variance(observations.pixels - predict_pixels(model, observations))
            rough = replace(problem.seeing(observations, extra), shape_basis=basis, huber=2.0)
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
