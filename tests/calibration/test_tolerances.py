"""What a board's sizes may be off by, as declared or as its views tell, in the covariance of the rig."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from calibration import Board, BoardTolerances, refine_stereo
from calibration.cameras.camera import N_RIG
from calibration.judge.tolerances import BoardShape, board_shape, rig_with_covariance, with_tolerances
from disctrack.synthetic.cameras import rig_of
from disctrack.synthetic.description import Scene
from tests.oracles.drawn_boards import make_scene

BOARD = Board((9, 6), 8e-3)
THICK = 3e-3
AS_DRAWN = BoardShape(*np.zeros(7), origin=np.zeros(3))
POINTS = np.random.default_rng(5).uniform([0, 0, 0], [0.06, 0.04, 0.02], (20, 3))


def covariance_of(**only):
    """Rig, and what one tolerance adds to its covariance."""
    rig = rig_of(Scene())
    none = {"square": 0.0, "flatness": 0.0, "thickness": 0.0}
    board = BoardTolerances(**(none | only))
    return rig, with_tolerances(rig, BOARD.points, THICK, board, AS_DRAWN).covariance - rig.covariance


def test_longer_squares_make_everything_longer():
    s = 1e-4
    rig, C = covariance_of(square=s * np.sqrt(2))
    k = 21 + np.argmax(np.abs(rig.t_right_left))  # nothing else moves the cameras against each other
    step = C[:, k] / np.sqrt(C[k, k]) * np.sign(rig.t_right_left[k - 21])
    # the printed face is the board's; the table under it stays one declared thickness away
    face = np.array([0.0, 0.0, THICK])
    seen = rig.perturbed(step).project((POINTS - face) * (1 + s) + face)
    assert_allclose(seen, rig.project(POINTS), atol=1e-7)


def test_a_thicker_board_lifts_the_table():
    rig, C = covariance_of(thickness=1e-5)
    k = 27 + np.argmax(np.diag(C)[27:])
    step = C[:, k] / np.sqrt(C[k, k])
    seen = rig.project(POINTS)
    shifts = [rig.perturbed(step).project(POINTS + np.array([0, 0, sign * 1e-5])) for sign in (1, -1)]
    assert min(np.abs(shift - seen).max() for shift in shifts) < 1e-7


def test_without_a_table_view_only_the_scale_is_uncertain():
    rig, tolerances = replace(rig_of(Scene()), world_is_table=False), BoardTolerances(square=2e-4)
    added = with_tolerances(rig, BOARD.points, THICK, tolerances, AS_DRAWN).covariance - rig.covariance
    assert_allclose(np.delete(np.delete(added, np.s_[21:24], 0), np.s_[21:24], 1), 0.0, atol=0)
    assert added.shape == (N_RIG, N_RIG)
    assert_allclose(np.sqrt(2 * np.trace(added)), 2e-4 * rig.baseline)


def found_shape(rng, stretch=0.0, bow=0.0, sigma=0.005):
    """The board's shape from noisy corners, and the rig; stretch along i, middle higher by bow."""
    d = BOARD.points - BOARD.points.mean(0)
    deviation = np.zeros_like(d)
    deviation[:, 0] = stretch * BOARD.points[:, 0]
    deviation[:, 2] = bow * (1 - (d[:, 0] / (5 * BOARD.square)) ** 2)
    scene = make_scene(n_views=14, deviation=deviation)
    refinement = refine_stereo(scene.observations(sigma, rng), scene.model, BOARD.points)
    return scene, refinement, board_shape(refinement, BOARD.points, 1.0), rig_with_covariance(refinement, 0, THICK, 1.0)


def test_stretch_and_bow_are_seen_by_the_views(rng):
    scene, refinement, shape, rig = found_shape(rng, stretch=2e-4, bow=60e-6)
    assert abs(shape.stretch - 2e-4) < 4 * shape.stretch_sigma < 1e-4
    # the face as bent touches the table with its ends, one square beyond the corners
    d = (BOARD.points - BOARD.points.mean(0))[:, 0] / (5 * BOARD.square)
    assert abs(shape.lift - 60e-6 * np.mean(1 - d**2)) < 5 * shape.lift_sigma < 5e-6
    # both sides are as likely to be off: half of the stretch is taken for each, so lengths are 0.01 % short
    truth = np.linalg.norm(scene.model.rig.t_right_left)
    sigma = 4 * np.sqrt(rig.covariance[21, 21]) / truth
    assert_allclose(np.linalg.norm(refinement.model.rig.t_right_left) / truth - 1, -1e-4, atol=sigma + 2e-5)
    # and the world's origin lies below corner 0
    corner = refinement.model.points[0] - shape.origin
    assert_allclose(corner[:2], 0.0, atol=4 * (shape.stretch_sigma * 0.032 + 0.005 * 0.25e-3))
    told = with_tolerances(rig, BOARD.points, THICK, BoardTolerances(), shape).allowances
    size = np.linalg.norm(told[0].shift[21:24]) / rig.baseline
    assert_allclose(size, 1e-4, rtol=0.3)  # as large as the error is


@pytest.mark.parametrize("seed", [1, 2])
def test_a_board_that_looks_exact_is_taken_for_exact(seed):
    *_, shape, rig = found_shape(np.random.default_rng(seed))
    assert abs(shape.stretch) < 4 * shape.stretch_sigma < 5e-5
    told = with_tolerances(rig, BOARD.points, THICK, BoardTolerances(), shape).allowances
    assert np.linalg.norm(told[0].shift[21:24]) / rig.baseline < 3 * shape.stretch_sigma
    assert next(a.cause for a in told if a.assumed) == "the board's thickness"
    # what was declared counts as declared
    declared = with_tolerances(rig, BOARD.points, THICK, BoardTolerances(2e-4, 20e-6, 0.0), shape)
    assert_allclose(np.linalg.norm(declared.allowances[0].shift[21:24]), 2e-4 / np.sqrt(2) * rig.baseline)
    assert not any(a.assumed for a in declared.allowances)
    grown = replace(rig, covariance=declared.covariance - sum(np.outer(a.shift, a.shift) for a in declared.allowances))
    assert_allclose(grown.covariance, rig.covariance, atol=1e-9)
