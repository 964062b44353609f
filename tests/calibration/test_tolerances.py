"""What a board's declared sizes may be off by, in the covariance of the rig."""

import numpy as np
from numpy.testing import assert_allclose

from calibration import Board
from calibration.camera import N_RIG
from calibration.tolerances import BoardTolerances, with_tolerances
from disctrack.render import rig_of
from disctrack.scene.description import Scene

BOARD = Board((9, 6), 8e-3)
THICK = 3e-3
POINTS = np.random.default_rng(5).uniform([0, 0, 0], [0.06, 0.04, 0.02], (20, 3))


def covariance_of(**only):
    """Rig, and what one tolerance adds to its covariance."""
    rig = rig_of(Scene())
    none = {"square": 0.0, "flatness": 0.0, "thickness": 0.0}
    return rig, with_tolerances(
        rig, BOARD.points, 0, THICK, BoardTolerances(**(none | only))
    ).covariance - rig.covariance


def test_longer_squares_make_everything_longer():
    s = 1e-4
    rig, C = covariance_of(square=s * np.sqrt(2))
    k = 21 + np.argmax(np.abs(rig.t_right_left))  # nothing else moves the cameras against each other
    step = C[:, k] / np.sqrt(C[k, k]) * np.sign(rig.t_right_left[k - 21])
    # the printed face is the board's; the table under it stays one declared thickness away
    face = np.array([0.0, 0.0, THICK])
    seen = rig.perturbed(step).project((POINTS - face) * (1 + s) + face)
    assert_allclose(seen, rig.project(POINTS), atol=1e-7)
    # a stretch along a side moves the middle of the board against its corner, the world's origin, by as much
    world = rig.R_left_world.T @ (C - np.outer(step, step))[27:30, 27:30] @ rig.R_left_world
    assert_allclose(np.sqrt(np.diag(world))[:2], s * BOARD.points.mean(0)[:2], rtol=1e-6)


def test_a_thicker_board_lifts_the_table():
    rig, C = covariance_of(thickness=1e-5)
    k = 27 + np.argmax(np.diag(C)[27:])
    step = C[:, k] / np.sqrt(C[k, k])
    seen = rig.project(POINTS)
    shifts = [rig.perturbed(step).project(POINTS + np.array([0, 0, sign * 1e-5])) for sign in (1, -1)]
    assert min(np.abs(shift - seen).max() for shift in shifts) < 1e-7


def test_without_a_table_view_only_the_scale_is_uncertain():
    rig = rig_of(Scene())
    added = with_tolerances(rig, BOARD.points, None, THICK, BoardTolerances()).covariance - rig.covariance
    assert_allclose(np.delete(np.delete(added, np.s_[21:24], 0), np.s_[21:24], 1), 0.0, atol=0)
    assert added.shape == (N_RIG, N_RIG)
    assert_allclose(np.sqrt(2 * np.trace(added)), 2e-4 * rig.baseline)
