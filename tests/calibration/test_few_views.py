"""Few views: what they leave open is held by what is known of lenses and boards, and is in the sigmas."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from calibration import CalibrationSettings, calibrate_from_corners
from calibration.fit.priors import BEND, MISPRINT, STRETCH, board_prior
from calibration.fit.stereo_model import board_basis
from tests.calibration.conftest import corner_view, squared
from tests.calibration.test_board_motion import BOARD, EXACT, errors
from tests.oracles import moved_boards


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
        found.append(squared(*errors(calibration, rig)))
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
    named = sum("taken as flat, requested, but the views show another shape" in text for text in told)
    assert named >= 8 if size else named == 0  # where a small bend pulls by less than a sigma, nothing is said


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
