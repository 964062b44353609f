"""A real target of round dots goes through the same calibration as the chessboard."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from calibration import BoardNotFound, CalibrationSettings
from calibration.board.target import DotTarget
from disctrack.calibrate.dot_target import find_dots, on_common_lattice
from disctrack.calibrate.views import calibrate_views, find_views

TARGET = DotTarget(spacing=3.5e-3, marked=(5, 3))


@pytest.fixture
def photograph(shared_data):
    return cv2.imread(
        str(sorted((shared_data / "dice_stereo_dots").glob("CalB-sys2-*_0.jpeg"))[0]), cv2.IMREAD_UNCHANGED
    )


def test_dots_are_numbered_from_the_three_marked_ones(photograph):
    view = find_dots(photograph, TARGET)
    assert len(view.lattice) >= 45
    assert len(np.unique(view.lattice, axis=0)) == len(view.lattice)
    place = {tuple(ij): p for ij, p in zip(view.lattice.tolist(), view.circles.centres.pixels, strict=True)}
    # read off the photograph, to 10 px: the dots beside the marked ones
    assert np.allclose(place[1, 0], [698, 1369], atol=12)
    assert np.allclose(place[4, 0], [1389, 1395], atol=12)
    sigma = np.sqrt(view.circles.centres.covariance_px2[view.circles.good][:, 0, 0])
    assert 0.005 < np.median(sigma) < 0.05  # 0.026 px of scatter with simpler localisers
    assert abs(view.circles.radius * 2 * 3.5 - 1.5) < 0.1  # PROVENANCE.md: dots of 1.5 mm
    target, (ordered,) = on_common_lattice([view], TARGET)
    assert ordered.accepted.sum() == len(target.points) == view.circles.good.sum()


def test_ink_clipped_to_black_costs_no_dot(photograph):
    """Where the ink has no noise at all, the paper's counts; the template's misfit is learnt from the dots."""
    plain = find_dots(photograph, TARGET)
    assert plain.circles.good.mean() > 0.9
    dark = np.clip(photograph.astype(float) - 15.0, 0, 255).astype(np.uint8)  # most ink lies between 4 and 16
    assert np.mean(dark == 0) > 0.08
    view = find_dots(dark, TARGET)
    assert view.circles.good.sum() >= 0.95 * plain.circles.good.sum()
    known = {tuple(ij): p for ij, p in zip(plain.lattice.tolist(), plain.circles.centres.pixels, strict=True)}
    seen = zip(view.lattice.tolist(), view.circles.centres.pixels, strict=True)
    off = [place - known[tuple(ij)] for ij, place in seen if tuple(ij) in known]
    assert np.nanmedian(np.abs(off)) < 0.05  # its own sigma is 0.03 px


def test_a_picture_without_marked_dots_is_refused():
    image = np.full((400, 500), 200, np.uint8)
    for x in range(60, 460, 80):
        for y in range(60, 360, 80):
            cv2.circle(image, (x, y), 20, 30, -1)
    found = find_dots(cv2.GaussianBlur(image, (0, 0), 1.0), TARGET)
    assert isinstance(found, BoardNotFound)
    assert "0 dots with a hole" in found.reason


@pytest.mark.slow
def test_dot_photographs_with_the_freed_target(shared_data):
    views = find_views("CalB-sys2-*_0.jpeg", "CalB-sys2-*_1.jpeg", shared_data / "dice_stereo_dots")
    some = replace(views, left=views.left[:14], right=views.right[:14])
    found, problems = calibrate_views(some, TARGET, settings=CalibrationSettings(distortion="k1 k2", board="free"))
    assert not problems
    assert found.rms_px <= 1.05 * 0.0349  # PROVENANCE.md: with edges found by rays; 0.0360 with half as many dots again
    f, sigma = (found.rig.left.fx, found.rig.right.fx), np.sqrt(np.diag(found.rig.covariance))[[0, 9]]
    assert abs(f[0] - f[1]) < 3 * np.hypot(*sigma)  # two equal lenses
    assert abs(f[0] / f[1] - 1) < 2e-3
    assert abs(found.rig.baseline - 89.69e-3) < 0.15e-3
    deviation = found.board_points - found.board.points
    # print errors by simpler localisers: 24-25 um in the plane, 5 um out of it
    assert 15e-6 < deviation[:, :2].std() < 40e-6
    fewer = replace(views, left=views.left[:6], right=views.right[:6])
    flat, _ = calibrate_views(fewer, TARGET, settings=CalibrationSettings(distortion="k1 k2", board="flat"))
    assert flat.rms_px > 5 * found.rms_px
