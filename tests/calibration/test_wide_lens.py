"""Lenses that Brown's polynomial cannot describe are named; wide ones that it can are not."""

import cv2
import numpy as np
import pytest

from calibration import Board, calibrate_from_points
from calibration.stereo import CalibrationSettings

BOARD = Board((9, 6), 25e-3)
SIZE = (960, 600)
K = np.array([[235.0, 0.0, 482.0], [0.0, 236.0, 297.0], [0.0, 0.0, 1.0]])
# a lens of 150 deg as OpenCV's rational model has it, and one of as many degrees that a polynomial is
RATIONAL = np.array([0.351, -0.017, 1e-3, -1e-3, -1e-3, 0.665, 0.023, -5e-3])
POLYNOMIAL = np.array([-0.05, 0.004, 1e-3, -1e-3, 0.0])


def corners(distortion, rng, n_views=14):
    """Corners (n_views) of both cameras, all inside the images, with 0.1 px of noise."""
    t_pair = np.array([-0.06, 0.002, 0.001])
    left, right = [], []
    while len(left) < n_views:
        R = cv2.Rodrigues(rng.normal(0, 0.35, 3))[0] @ np.diag([1.0, -1.0, -1.0])
        place = np.array([rng.uniform(-0.25, 0.25), rng.uniform(-0.14, 0.14), rng.uniform(0.14, 0.3)])
        t = place - R @ BOARD.points.mean(0)
        if ((BOARD.points @ R.T + t)[:, 2] < 0.05).any():
            continue
        views = [
            cv2.projectPoints(BOARD.points, cv2.Rodrigues(R)[0], t + shift, K, distortion)[0].reshape(-1, 2)
            for shift in (np.zeros(3), t_pair)
        ]
        if all(((view > 3) & (view < np.array(SIZE) - 4)).all() for view in views):
            left.append(views[0] + rng.normal(0, 0.1, views[0].shape))
            right.append(views[1] + rng.normal(0, 0.1, views[1].shape))
    return left, right


@pytest.mark.statistical
@pytest.mark.parametrize(
    ("distortion", "named"), [(RATIONAL, True), (POLYNOMIAL, False)], ids=["rational", "polynomial"]
)
def test_a_lens_wider_than_the_model_is_named(distortion, named, rng):
    settings = CalibrationSettings(distortion="k1 k2 p1 p2 k3", board="flat")
    found = calibrate_from_points(*corners(distortion, rng), BOARD, SIZE, 0.1, settings)
    told = [text for text in found.warnings if "wider than the model" in text]
    assert len(told) == (2 if named else 0), found.warnings
    assert ("wider than the model" in found.assessment.verdict) == named
    if named:
        assert told[0].startswith("the left lens")
