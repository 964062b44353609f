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


def direction(**only):
    """The one direction in which one tolerance moves the rig's parameters, from the covariance alone."""
    rig = rig_of(Scene())
    none = {"square": 0.0, "flatness": 0.0, "thickness": 0.0}
    C = with_tolerances(rig, BOARD.points, 0, THICK, BoardTolerances(**(none | only))).covariance - rig.covariance
    values, vectors = np.linalg.eigh(C)
    assert values[-2] < 1e-12 * values[-1]  # rank one
    return rig, vectors[:, -1] * np.sqrt(values[-1])


def test_longer_squares_make_everything_longer():
    rig, step = direction(square=1e-4)
    s = 1e-4 * np.sign(step[21:24] @ rig.t_right_left)  # an eigenvector has no sign
    # the printed face is the board's; the table under it stays one declared thickness away
    face = np.array([0.0, 0.0, THICK])
    seen = rig.perturbed(step).project((POINTS - face) * (1 + s) + face)
    assert_allclose(seen, rig.project(POINTS), atol=1e-7)


def test_a_thicker_board_lifts_the_table():
    rig, step = direction(thickness=1e-5)
    seen = rig.project(POINTS)
    shifts = [rig.perturbed(step).project(POINTS + np.array([0, 0, sign * 1e-5])) for sign in (1, -1)]
    assert min(np.abs(shift - seen).max() for shift in shifts) < 1e-7


def test_without_a_table_view_only_the_scale_is_uncertain():
    rig = rig_of(Scene())
    added = with_tolerances(rig, BOARD.points, None, THICK, BoardTolerances()).covariance - rig.covariance
    assert_allclose(np.delete(np.delete(added, np.s_[21:24], 0), np.s_[21:24], 1), 0.0, atol=0)
    assert added.shape == (N_RIG, N_RIG)
    assert_allclose(np.sqrt(np.trace(added)), 2e-4 * rig.baseline)
