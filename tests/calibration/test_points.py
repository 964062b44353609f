"""Corners of another program: points and one sigma are enough, and what cannot be right is named."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from calibration import Board, CalibrationError, CalibrationSettings, calibrate_from_points

PLAIN = CalibrationSettings("k1 k2 p1 p2", "flat")


def noisy(scene, rng, sigma):
    return [[p + rng.normal(size=p.shape) * sigma for p in scene.pixels(camera)] for camera in (0, 1)]


def test_points_and_one_sigma_give_the_rig_and_say_that_the_noise_was_overstated(scene_maker, rng):
    scene = scene_maker(n_views=8)
    left, right = noisy(scene, rng, 0.04)
    left[3] = None
    found = calibrate_from_points(left, right, scene.board, (512, 512), 0.04, PLAIN)
    t = scene.model.t_right_left
    C = found.rig.covariance[21:24, 21:24]
    error = found.rig.t_right_left - t
    assert error @ np.linalg.solve(C, error) < 16  # chi-square of three
    assert not any("declared" in w for w in found.warnings)
    careful = calibrate_from_points(left, right, scene.board, ((512, 512), (512, 512)), 0.1, PLAIN)
    assert any("0.1 px were declared" in w for w in careful.warnings)
    assert_allclose(careful.rig.t_right_left, found.rig.t_right_left, atol=1e-5)


def test_what_cannot_be_right_is_named(scene_maker, rng):
    scene = scene_maker(n_views=5)
    left, right = noisy(scene, rng, 0.04)

    def refused(match, left=left, right=right, board=scene.board, size=(512, 512), sigma=0.04):
        with pytest.raises(CalibrationError, match=match):
            calibrate_from_points(left, right, board, size, sigma, PLAIN)

    refused("5 left and 4 right views", right=right[:-1])
    refused("right view 2: corners of shape \\(53, 2\\)", right=[*right[:2], right[2][1:], *right[3:]])
    spoiled = left[1].copy()
    spoiled[17, 0] = np.nan
    refused(r"left view 1: corner 17 at \(nan", left=[left[0], spoiled, *left[2:]])
    refused("8 mm is 0.008", board=Board((9, 6), 8.0))
    refused("not lie in the image of 200 x 512", size=(200, 512))
    refused("above 0 px", sigma=0.0)
