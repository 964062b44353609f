"""Corners of another program need one sigma; what is not right is named, also lenses no polynomial describes."""

from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from calibration import Board, CalibrationError, calibrate_from_points
from tests.oracles import moved_boards
from tests.oracles.drawn_boards import make_scene


def noisy(scene, rng, sigma):
    return [[p + rng.normal(size=p.shape) * sigma for p in scene.pixels(camera)] for camera in (0, 1)]


@pytest.mark.statistical
def test_points_and_one_sigma_give_the_rig_and_say_that_the_noise_was_overstated(rng):
    scene = make_scene(n_views=8)
    left, right = noisy(scene, rng, 0.04)
    left[3] = None
    found = calibrate_from_points(left, right, scene.board, (512, 512), 0.04)
    t = scene.model.rig.t_right_left
    C = found.rig.covariance[21:24, 21:24]
    error = found.rig.t_right_left - t
    assert error @ np.linalg.solve(C, error) < 16  # chi-square of three
    assert not any("declared" in w for w in found.warnings)
    careful = calibrate_from_points(left, right, scene.board, ((512, 512), (512, 512)), 0.1)
    assert any("0.1 px were declared" in w for w in careful.warnings)
    assert_allclose(careful.rig.t_right_left, found.rig.t_right_left, atol=1e-5)


def test_what_cannot_be_right_is_named(rng):
    scene = make_scene(n_views=5)
    left, right = noisy(scene, rng, 0.04)

    def refused(match, left=left, right=right, board=scene.board, size=(512, 512), sigma=0.04):
        with pytest.raises(CalibrationError, match=match):
            calibrate_from_points(left, right, board, size, sigma)

    refused("5 left and 4 right views", right=right[:-1])
    refused("right view 2: corners of shape \\(53, 2\\)", right=[*right[:2], right[2][1:], *right[3:]])
    spoiled = left[1].copy()
    spoiled[17, 0] = np.nan
    refused(r"left view 1: corner 17 at \(nan", left=[left[0], spoiled, *left[2:]])
    refused("8 mm is 0.008", board=Board((9, 6), 8.0))
    refused("not lie in the image of 200 x 512", size=(200, 512))
    refused("above 0 px", sigma=0.0)


K = np.array([[235.0, 0.0, 482.0], [0.0, 236.0, 297.0], [0.0, 0.0, 1.0]])
# a lens of 150 deg as OpenCV's rational model has it, and one of as many degrees that a polynomial is
RATIONAL = np.array([0.351, -0.017, 1e-3, -1e-3, -1e-3, 0.665, 0.023, -5e-3])
POLYNOMIAL = np.array([-0.05, 0.004, 1e-3, -1e-3, 0.0])


@pytest.mark.statistical
@pytest.mark.parametrize(
    ("distortion", "named"), [(RATIONAL, True), (POLYNOMIAL, False)], ids=["rational", "polynomial"]
)
def test_a_lens_wider_than_the_model_is_named(distortion, named):
    lens = SimpleNamespace(camera_matrix=K, distortion=distortion, image_size=(960, 600))
    t_pair = np.array([-0.06, 0.002, 0.001])
    rig = SimpleNamespace(left=lens, right=lens, R_right_left=np.eye(3), t_right_left=t_pair)
    corners = moved_boards.pairs(rig, 14, 1, places=((-0.25, 0.25), (-0.14, 0.14), (0.14, 0.3)))
    found = calibrate_from_points(*corners, Board((9, 6), 25e-3), lens.image_size, 0.1)
    told = [text for text in found.warnings if "wider than the model" in text]
    assert len(told) == (2 if named else 0), found.warnings
    assert ("wider than the model" in found.assessment.verdict) == named
    if named:
        assert told[0].startswith("the left lens")
