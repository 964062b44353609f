"""Which distortion terms and which board shape the data support: by the error on views that the fit has not seen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.arrays import Array, Mask
from calibration.board_motion import BoardMotion, split
from calibration.normal_equations import Problem, inverse_covariance, minimise
from calibration.refinement import Refinement, refine_stereo
from calibration.stereo_model import (
    BOARD_MODELS,
    DISTORTION_MODELS,
    N_STEREO,
    Observations,
    StereoModel,
    Terms,
    predict_pixels,
)

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
    held_out_chi_square: float  # per observation, truncated, in units of the noise of this comparison
    noise_px: float  # sigma per axis of this comparison beyond the corners' own noise: the least of its models
    per_view: Array  # (n_views,) the same, NaN where a view was not used


def held_out(
    refinement: Refinement, sigma: float, good: Mask, motion: BoardMotion | None = None
) -> tuple[Array, Array, NDArray[np.intp], NDArray[np.intp]]:
    """Per view, each view left out in turn: chi-square (truncated) of all points, squared distance [px^2] of good ones.

    sigma : unexplained noise [px] for the comparison, the same for every candidate
    good : (m,) the observations that count in the distance
    motion : of the boards between the exposures, for the comparison
    returns : chi-square, squared distance, number of all and of good points, each (n_views,)
    """
    used = refinement.observations[refinement.kept]
    everything = refinement.observations
    n_views = refinement.problem.n_views
    chi2, square = np.full(n_views, np.nan), np.full(n_views, np.nan)
    count, good_count = np.zeros(n_views, int), np.zeros(n_views, int)
    views = np.unique(used.view)
    weights = inverse_covariance(used.covariance, sigma**2)
    whole = replace(refinement.problem, observations=used, weights=weights, motion=motion)
    at_minimum = whole.linearise(refinement.model)
    for fold in range(min(FOLDS, len(views))):
        left_out = views[fold :: min(FOLDS, len(views))]
        train = ~np.isin(used.view, left_out)
        problem = replace(whole, observations=used[train], weights=whole.weights[train])
        model = minimise(
            problem,
            refinement.model,
            iterations=8,
            tolerance=NEGLIGIBLE,
            damping=1e-7,
            normal=at_minimum.of_views(np.setdiff1d(views, left_out)),
            rough=True,
        ).model
        tested = np.isin(everything.view, left_out)
        test = everything[tested]
        model = fit_poses(test, model, sigma, motion)
        residuals = test.pixels - predict_pixels(model, test)
        distance = np.einsum("mi,mij,mj->m", residuals, inverse_covariance(test.covariance, sigma**2), residuals)
        for v in left_out:
            of_view = test.view == v
            chi2[v] = np.minimum(distance[of_view], TRUNCATE).sum()
            square[v] = np.sum(residuals[of_view & good[tested]] ** 2)
            count[v], good_count[v] = of_view.sum(), (of_view & good[tested]).sum()
    return chi2, square, count, good_count


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
    """The row of one fitted model, by the noise, the good points and the boards' motion of another; see `held_out`."""
    sigma = quietest.unexplained_sigma
    chi2, square, count, good_count = held_out(refinement, sigma, quietest.kept, quietest.problem.motion)
    with np.errstate(invalid="ignore"):
        per_view = chi2 / np.where(count > 0, count, np.nan)
    return TermsTried(
        terms=refinement.terms,
        n_parameters=refinement.problem.stereo_basis.shape[1] + refinement.problem.shape_basis.shape[-1],
        rms_px=refinement.rms(),
        held_out_rms_px=float(np.sqrt(np.nansum(square) / max(good_count.sum(), 1))),
        held_out_chi_square=float(np.nansum(chi2) / max(count.sum(), 1)),
        noise_px=sigma,
        per_view=per_view,
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


def choose_terms(
    observations: Observations,
    start: StereoModel,
    nominal: Array,
    distortions: tuple[str, ...] | None = None,
    boards: tuple[str, ...] = BOARD_MODELS,
    equal_aspect: bool = False,
    progress: Callable[[str], None] = lambda _: None,
    motion: BoardMotion | None = None,
) -> tuple[Refinement, tuple[TermsTried, ...]]:
    """Choose distortion terms, then the board's shape, then the distortion again if the board is not flat.

    Returns the refinement of the chosen terms and the table of everything that was compared: up to three comparisons
    in turn, each with a noise of its own; the last row of a model is the one that counted last. Names that are given as
    one-element tuples are taken, not chosen. motion : as in `refine_stereo`
    """
    distortions = tuple(DISTORTION_MODELS) if distortions is None else distortions
    richest = max(distortions, key=lambda name: len(DISTORTION_MODELS[name]))
    board = boards[0]
    terms = Terms(richest, board, equal_aspect)
    fits = {(richest, board): refine_stereo(observations, start, nominal, terms, motion=motion)}
    table: list[TermsTried] = []
    judged: dict[tuple[tuple[str, str], Terms], TermsTried] = {}  # by the model, and by the one that gave the noise

    def compare(keys: list[tuple[str, str]], begin: Refinement) -> tuple[str, str]:
        for key in keys:
            if key not in fits:
                progress(f"trying distortion {key[0]!r}, {key[1]} board")
                terms = Terms(key[0], key[1], equal_aspect)
                fits[key] = refine_stereo(observations, start, nominal, terms, begin=begin)
        quietest = min((fits[key] for key in keys), key=lambda fit: fit.unexplained_sigma)
        worst = HOPELESS * quietest.unexplained_sigma + 1e-3
        keys = [key for key in keys if fits[key].unexplained_sigma <= worst]
        if len(keys) == 1:
            return keys[0]
        noise = quietest.terms
        for key in keys:
            if (key, noise) not in judged:
                judged[key, noise] = candidate(fits[key], quietest)
        rows = [judged[key, noise] for key in keys]
        table.extend(rows)
        return keys[best(rows)]

    chosen = compare([(d, board) for d in distortions], fits[richest, board])
    if len(boards) > 1:
        chosen = compare([(chosen[0], b) for b in boards], fits[chosen])
        if chosen[1] != board and len(distortions) > 1:
            least = len(DISTORTION_MODELS[chosen[0]]) - 1  # far fewer terms were seen to fail with the flat board
            again = [(d, chosen[1]) for d in distortions if len(DISTORTION_MODELS[d]) >= least]
            chosen = compare(again, fits[chosen])
    fit = fits[chosen]
    if not table:
        table.append(candidate(fit, fit))
    return fit, tuple(table)
