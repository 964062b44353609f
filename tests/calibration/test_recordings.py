"""Calibration of real photographs and of the reference recording, against figures found elsewhere."""

import json

import cv2
import h5py
import numpy as np
import pytest

from calibration import Board, calibrate_from_corners, calibrate_stereo, find_corners, triangulate
from calibration.judge.assessment import stereo_covariance
from calibration.rig_file import read_rig_group
from tests.calibration.test_refinement import rig_error
from tests.oracles.drawn_boards import squared

pytestmark = pytest.mark.statistical


def read_pairs(folder, pattern, indices):
    return [
        [cv2.imread(str(folder / pattern.format(side=side, i=i)), cv2.IMREAD_UNCHANGED) for i in indices]
        for side in ("left", "right")
    ]


@pytest.fixture(scope="module")
def opencv_photographs(shared_data):
    folder = shared_data / "opencv_stereo_chessboard"
    reference = json.loads((folder / "reference.json").read_text())
    left, right = read_pairs(folder, "{side}{i:02d}.jpg", reference["pairs"])
    return [[find_corners(image, (9, 6)) for image in side] for side in (left, right)], reference


def test_opencv_photographs_with_their_board_freed(opencv_photographs):
    (left, right), reference = opencv_photographs
    found = calibrate_from_corners(left, right, Board((9, 6), 25e-3))
    assert found.rms_px <= 0.15  # PROVENANCE.md: a converged adjustment of cornerSubPix's corners reaches 0.1497
    assert found.assessment.stereo_misfit_px < 0.076  # of views left out: 0.0736 when this was written
    assert found.assessment.pairs == len(reference["pairs"])
    assert 83.2e-3 <= found.rig.baseline <= 83.4e-3
    # the reference's own sigma of the baseline is 0.036 mm, and its corners are other ones
    assert abs(1e3 * found.rig.baseline - reference["converged_ba_win5"]["free_board"]["baseline_mm"]) < 0.1
    assert len(found.rejected_corners()) < 0.05 * len(found.refinement.kept)
    # left08 too, although half of its corners lie 0.2-0.3 px to one side of where the other 25 images put them
    assert not found.rejected_views
    assert np.isfinite(found.rms_per_view_px).all()


@pytest.mark.slow
def test_halves_of_the_opencv_photographs_agree_within_what_each_states(opencv_photographs):
    left, right = opencv_photographs[0]
    order = np.arange(len(left))
    ratios = []
    for seed in range(3):
        order = np.random.default_rng(seed).permutation(order)
        halves = [[[side[v] for v in np.sort(order[k::2])] for side in (left, right)] for k in (0, 1)]
        fits = [calibrate_from_corners(*half, Board((9, 6), 25e-3)).refinement for half in halves]
        difference = rig_error(*(f.model.rig for f in fits))[:24]
        ratios.append(squared(difference, sum(stereo_covariance(f) for f in fits)))
    assert 0.5 < np.mean(ratios) < 2


def test_sample_clip_gives_the_cameras_it_was_rendered_with(sample_clip):
    with h5py.File(sample_clip.parent / "truth" / "clip.h5") as file:
        truth = read_rig_group(file["rig"])
    views = read_pairs(sample_clip / "calibration", "{side}/{i:02d}.png", range(18))
    found = calibrate_stereo(*views, Board((9, 6), 6e-3), None, 0, 3e-3)
    rig = found.rig
    error = rig_error(rig, truth)
    free = np.diag(rig.covariance) > 0
    sigma = np.sqrt(np.diag(rig.covariance)[free])
    # one draw of 28 numbers: chi-square over its degrees of freedom scatters by 0.27
    assert 0.3 < squared(error[free], rig.covariance[np.ix_(free, free)]) < 2.1
    assert np.abs(error[free][-3:] / sigma[-3:]).max() < 4
    # what is wanted of it: points above the table within a micrometre
    assert found.assessment.triangulation_sigma[1] < 1e-6
    points = np.array([[0.0, 0, 0], [50e-3, 0, 0], [0, 30e-3, 0], [25e-3, 15e-3, 20e-3]])
    assert np.abs(triangulate(truth.project(points), rig) - points).max() < 2e-6


def test_rec_a_lab_frame_is_where_the_views_suggest(shared_data):
    left, right = read_pairs(shared_data / "rec_a" / "calibration", "{side}/{i:02d}.png", range(20))
    found = calibrate_stereo(left, right, Board((9, 6), 8e-3), table_view=0, board_thickness=3e-3)
    assert found.rms_px < 0.01  # located to 0.003 px per axis by the corners' own noise
    assert np.ptp(found.board_points[:, 2]) < 1e-6
    for R, t in found.rig.camera_poses():
        assert (-R.T @ t)[2] > 0.2  # both cameras stand above the table
        assert R[2] @ [0, 0, -1] > 0.5  # and look down
    corners = found.rig.project(np.array([[0, 0, 3e-3], [64e-3, 0, 3e-3], [0, 40e-3, 3e-3]]))
    for camera in (0, 1):
        view = found.corner_views[camera][0]
        # of one corner each, at 3 sigma of the located corner plus what the rig adds
        assert np.abs(corners[camera] - view.points[[0, 8, 45]]).max() < 0.03
