"""Few views: what they leave open is held by what is known of lenses and boards, and is in the sigmas."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from calibration import Board, CalibrationSettings, Terms, calibrate_from_corners
from calibration.fit.normal_equations import Problem
from calibration.fit.priors import BEND, MISPRINT, STRETCH, board_prior, priors_of
from calibration.fit.stereo_model import board_basis, moved, predict_pixels
from tests.calibration.test_board_motion import EXACT, corner_view, errors, squared
from tests.oracles import moved_boards

BOARD = Board(moved_boards.INNER_CORNERS, moved_boards.SQUARE)


def mean_square(n, distortion="auto", board="auto", rigs=16, displaced=None):
    """Squared error over stated variance of focal lengths, principal points and pair, mean over rigs; all warnings."""
    found, told = [], []
    settings = CalibrationSettings(distortion=distortion, board=board, tolerances=EXACT)
    for seed in range(rigs):
        rig = moved_boards.make_rig(seed)
        points = None if displaced is None else moved_boards.board() + displaced[seed]
        left, right = moved_boards.pairs(rig, n, seed, correlation=0.4, points=points)
        views = [corner_view(p) for p in left], [corner_view(p) for p in right]
        calibration = calibrate_from_corners(*views, BOARD, settings)
        error, places = errors(calibration, rig)
        found.append(squared(error, calibration.rig.covariance[np.ix_(places, places)]))
        told.append(" ".join(calibration.warnings))
    return np.mean(found), told


# 1.7, 1.2, 1.1; where terms were chosen for each set of views by its held-out error: 2.4, 2.7, 2.0
@pytest.mark.statistical
@pytest.mark.parametrize(("n", "most"), [(3, 2.0), (5, 1.5), (8, 1.4)])
def test_few_views_are_off_by_what_they_state(n, most):
    assert 0.5 < mean_square(n)[0] < most


@pytest.mark.statistical
def test_terms_that_are_left_out_make_sigmas_too_small():
    assert mean_square(8, "k1")[0] > 2.0


@pytest.mark.statistical
@pytest.mark.parametrize(("size", "least", "most"), [(1.0, 0.2, 1.2), (0.0, 0.5, 1.4)])
def test_a_board_that_is_told_to_be_flat_and_is_not_is_in_the_sigmas(rng, size, least, most):
    smooth = board_basis(BOARD.points, "warped") * 0.1 * np.array([3e-3, 3e-3, 3e-3, 1e-3, 1e-3])  # half a board: 0.1 m
    displaced = size * (
        np.einsum("nij,rj->rni", smooth, rng.normal(size=(12, 5))) + 3e-5 * rng.normal(size=(12, 54, 3))
    )
    ratio, told = mean_square(16, board="flat", rigs=12, displaced=displaced)
    assert least < ratio < most  # 2.8 without
    named = sum("taken as flat, as told, but the views show another shape" in text for text in told)
    assert named >= 8 if size else named == 0  # where a small bend pulls by less than a sigma, nothing is said


def test_a_prior_of_cameras_and_board_has_the_cost_it_says(scene_maker, rng):
    scene = scene_maker(n_views=3, inner_corners=(4, 3))
    observations = scene.observations(0.1, rng)
    observations = observations[np.argsort(observations.view, kind="stable")]
    nominal = scene.board.points
    basis = board_basis(nominal, "free")
    prior = replace(priors_of(scene.model, nominal, basis), weight=3.0)
    start = replace(scene.model, points=nominal)
    model = moved(start, np.zeros(24), np.zeros((3, 6)), 1e-4 * basis @ rng.normal(size=basis.shape[-1]))
    stereo_basis, weights = Terms("k1").stereo_basis(), np.linalg.inv(observations.covariance)
    problem = Problem(observations, weights, stereo_basis, basis, 3, prior=prior)

    def cost(model):
        r = observations.pixels - predict_pixels(model, observations)
        d = (model.points - nominal).reshape(-1)
        board = d @ prior.board.to_shape.T @ prior.board.information @ prior.board.to_shape @ d
        return np.einsum("mi,mij,mj->", r, problem.weights, r) + prior.normal(model)[2] + 3.0 * board

    normal = problem.linearise(model)
    assert_allclose(normal.cost, cost(model), rtol=1e-12)
    s = stereo_basis.shape[1] + basis.shape[-1]
    for direction in rng.normal(size=(6, s + 18)):
        direction[:s] /= np.sqrt(np.diag(normal.shared + normal.prior))
        direction[s:] /= np.sqrt(np.concatenate([np.diag(block) for block in normal.own[:3]]))
        shared, poses = 1e-3 * direction[:s], 1e-3 * direction[s:].reshape(3, 6)
        there, back = (cost(problem.stepped(model, d * shared, d * poses)) for d in (1.0, -1.0))
        gradient = normal.gain(shared, poses)
        assert_allclose(-(there - back) / 4, gradient, rtol=5e-3, atol=1e-5 * np.linalg.norm(direction))


@pytest.mark.parametrize("model", ["warped", "free"])
def test_what_is_known_of_a_board_is_the_same_whichever_model_has_it(model):
    nominal = BOARD.points
    prior = board_prior(nominal, board_basis(nominal, model))
    d, size = nominal - nominal.mean(0), 0.1  # half of eight squares of 25 mm
    stretched = nominal + STRETCH * d * [0.5, -0.5, 0.0]
    bent = nominal + BEND * size * (d[:, :1] / size) ** 2 * [0.0, 0.0, 1.0]
    for points in (stretched, bent):
        assert_allclose(prior.normal(points)[1], 1.0, rtol=1e-6)
    if model == "free":
        one = nominal.copy()
        one[20, 0] += size * MISPRINT
        # what of a single corner's misprint is no shift, turn, size or smooth shape of the board
        assert 0.85 < prior.normal(one)[1] < 1.0
