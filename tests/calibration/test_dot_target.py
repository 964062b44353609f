"""A real target of round dots goes through the same refinement as the chessboard."""

import cv2
import numpy as np
import pytest

from calibration import CalibrationError, Terms
from disctrack.calibrate.dot_target import DotTarget, calibrate_dots, find_dots

TARGET = DotTarget(pitch=3.5e-3, diameter=1.5e-3, x_mark=5, y_mark=3)


def photographs(shared_data, indices):
    folder = shared_data / "dice_stereo_dots"
    names = sorted(folder.glob("CalB-sys2-*_0.jpeg"))
    pairs = [(name, folder / name.name.replace("_0.", "_1.")) for name in names]
    return [[cv2.imread(str(pairs[i][camera]), cv2.IMREAD_UNCHANGED) for i in indices] for camera in (0, 1)]


def test_dots_are_numbered_from_the_three_marked_ones(shared_data):
    ((image,), _) = photographs(shared_data, [0])
    view = find_dots(image, TARGET)
    assert len(view.lattice) >= 45
    assert len(np.unique(view.lattice, axis=0)) == len(view.lattice)
    place = {tuple(ij): p for ij, p in zip(view.lattice.tolist(), view.pixels, strict=True)}
    # read off the photograph, to 10 px: the dots beside the marked ones
    assert np.allclose(place[1, 0], [698, 1369], atol=12)
    assert np.allclose(place[4, 0], [1389, 1395], atol=12)
    sigma = np.sqrt(view.covariance[:, 0, 0])
    assert 0.005 < np.median(sigma) < 0.05  # 0.026 px of scatter with simpler localisers


def test_a_picture_without_marked_dots_is_refused():
    image = np.full((400, 500), 200, np.uint8)
    for x in range(60, 460, 80):
        for y in range(60, 360, 80):
            cv2.circle(image, (x, y), 20, 30, -1)
    with pytest.raises(CalibrationError, match="0 dots with a hole"):
        find_dots(cv2.GaussianBlur(image, (0, 0), 1.0), TARGET)


@pytest.mark.slow
def test_dot_photographs_with_the_freed_target(shared_data):
    left, right = photographs(shared_data, range(14))
    found = calibrate_dots(left, right, TARGET)
    assert found.rms() <= 0.035  # PROVENANCE.md: 0.0349 px with edges found by rays
    fx = [camera.fx for camera in found.model.cameras]
    assert abs(fx[0] / fx[1] - 1) < 1e-3  # two equal lenses
    assert abs(np.linalg.norm(found.model.t_right_left) - 89.69e-3) < 0.15e-3
    nominal = found.model.points.copy()
    nominal[:, :2] = np.rint(nominal[:, :2] / 3.5e-3) * 3.5e-3
    deviation = found.model.points - nominal
    # print errors by simpler localisers: 24-25 um in the plane, 5 um out of it
    assert 15e-6 < deviation[:, :2].std() < 40e-6
    flat = calibrate_dots(left[:6], right[:6], TARGET, Terms("k1 k2", "flat"))
    assert flat.rms() > 5 * found.rms()
