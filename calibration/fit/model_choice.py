"""Which shape of the board the data support: by the error on views that the fit has not seen.

The lens is not chosen so. A term that the views do not tell from zero is not zero for that: left out, it would put its
error into all others, which nothing would say (1.8 to 2.3 times the stated variance by three to eight views). All terms
are fitted, and `priors` knows how large they are in lenses.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from calibration.board.target import LEAST_POINTS
from calibration.cameras.camera import triangulate
from calibration.fit.board_motion import BoardMotion, split
from calibration.fit.normal_equations import Problem, inverse_covariance, minimise, quadratic
from calibration.fit.refinement import Refinement, refine_stereo
from calibration.fit.stereo_model import (
    N_STEREO,
    Observations,
    StereoModel,
    Terms,
    predict_pixels,
)
from calibration.kit.arrays import Array

HOPELESS = 1.5  # times the noise of the best model, left in the views it was fitted to: not worth views left out
FOLDS = 5
NEGLIGIBLE = 1e-5  # of chi-square, still to be gained: of 10^4 points, a third of a sigma of one parameter
TRUNCATE = 30.0  # squared sigmas: one bad corner must not decide between two models
SIMPLER_WITHIN = 0.25  # standard errors of the paired difference that a simpler model may be worse


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


def fit_poses(
    observations: Observations, model: StereoModel, sigma: float, motion: BoardMotion | None = None
) -> StereoModel:
    """Poses of the target in the views of the observations, everything else held."""
    model = replace(model, boards_right=None) if motion is None else split(model)
    problem = Problem(
        observations,
        inverse_covariance(observations.covariance, sigma**2),
        np.zeros((N_STEREO, 0)),
        np.zeros((*model.points.shape, 0)),
        len(model.R_left_board),
        huber=3.0,
        motion=motion,
    )
    return minimise(problem, model, iterations=12, tolerance=NEGLIGIBLE, damping=1e-7, rough=True).model


def candidate(refinement: Refinement, quietest: Refinement) -> TermsTried:
    """The row of one fitted model: each view left out in turn, its own pose fitted.

    The noise, the points that count in distances and the boards' motion are those of another fit, for all candidates.
    """
    o, problem, views = refinement.observations, refinement.problem, np.unique(refinement.problem.observations.view)
    used, sigma, motion = o[refinement.kept], quietest.unexplained_sigma, quietest.problem.motion
    residuals, tested, errors = np.zeros_like(o.pixels), np.isin(o.view, views), []
    for fold in range(min(FOLDS, len(views))):
        left_out = views[fold :: min(FOLDS, len(views))]
        train, test = ~np.isin(used.view, left_out), np.isin(o.view, left_out)
        others = replace(problem, motion=motion).seeing(used[train], sigma**2)
        model = minimise(others, refinement.model, iterations=8, tolerance=NEGLIGIBLE, damping=1e-7, rough=True).model
        model = fit_poses(o[test], model, sigma, motion)
        residuals[test] = o.pixels[test] - predict_pixels(model, o[test])
        errors += [error_in_space(model, o[quietest.kept & (o.view == v)]) for v in left_out]
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


def best(candidates: list[TermsTried]) -> int:
    """Least held-out chi-square; a simpler model that is not clearly worse comes first."""
    winner = min(candidates, key=lambda c: c.held_out_chi_square)
    for i in sorted(range(len(candidates)), key=lambda i: candidates[i].n_parameters):
        difference = candidates[i].per_view - winner.per_view
        difference = difference[np.isfinite(difference)]
        error = float(np.std(difference) / np.sqrt(max(len(difference) - 1, 1)))
        if np.mean(difference) <= SIMPLER_WITHIN * error:
            return i
    return candidates.index(winner)


def choose_board(
    observations: Observations,
    start: StereoModel,
    nominal: Array,
    tried: Sequence[Terms],
    progress: Callable[[str], None] = lambda _: None,
    motion: BoardMotion | None = None,
) -> tuple[Refinement, tuple[TermsTried, ...]]:
    """Choose what the board's shape may be: of the terms `tried`, the simplest first; one alone is taken, not chosen.

    Returns the refinement of the chosen terms and the table of what was compared. motion : as in `refine_stereo`
    """
    fits: list[Refinement] = []
    for terms in tried:
        if fits:
            progress(f"trying a {terms.board} board")
        begin = fits[0] if fits else None
        fits.append(refine_stereo(observations, start, nominal, terms, begin=begin, motion=None if begin else motion))
    quietest = min(fits, key=lambda fit: fit.unexplained_sigma)
    fits = [fit for fit in fits if fit.unexplained_sigma <= HOPELESS * quietest.unexplained_sigma + 1e-3]
    table = [candidate(fit, quietest) for fit in fits]
    return fits[best(table)], tuple(table)
