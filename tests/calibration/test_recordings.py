"""Calibration of real photographs and of the reference recording, against figures found elsewhere."""

import json

import cv2
import numpy as np
import pytest

from calibration import Board, calibrate_stereo


def read_pairs(folder, pattern, indices):
    return [
        [cv2.imread(str(folder / pattern.format(side=side, i=i)), cv2.IMREAD_UNCHANGED) for i in indices]
        for side in ("left", "right")
    ]


@pytest.fixture(scope="module")
def opencv_photographs(shared_data):
    folder = shared_data / "opencv_stereo_chessboard"
    reference = json.loads((folder / "reference.json").read_text())
    return read_pairs(folder, "{side}{i:02d}.jpg", reference["pairs"]), reference


@pytest.fixture(scope="module")
def rec_a_calibration(shared_data):
    left, right = read_pairs(shared_data / "rec_a" / "calibration", "{side}/{i:02d}.png", range(20))
    return calibrate_stereo(left, right, Board((9, 6), 8e-3), table_view=0, board_thickness=3e-3)


def test_opencv_photographs_with_their_board_freed(opencv_photographs):
    (left, right), reference = opencv_photographs
    found = calibrate_stereo(left, right, Board((9, 6), 25e-3))
    assert found.refinement.terms.board == "free"  # held-out error finds that this board is not flat
    assert found.rms_px <= 0.15  # PROVENANCE.md: a converged adjustment of cornerSubPix's corners reaches 0.1497
    assert 83.2e-3 <= found.rig.baseline <= 83.4e-3
    # the reference's own sigma of the baseline is 0.036 mm, and its corners are other ones
    assert abs(1e3 * found.rig.baseline - reference["converged_ba_win5"]["free_board"]["baseline_mm"]) < 0.1
    assert len(found.rejected_corners()) < 0.05 * len(found.refinement.kept)
    assert np.isfinite(found.rms_per_view_px).all()


def test_rec_a_lab_frame_is_where_the_views_suggest(rec_a_calibration):
    found = rec_a_calibration
    assert found.rms_px < 0.01  # located to 0.003 px per axis by the corners' own noise
    assert found.refinement.terms.board == "flat"
    for R, t in found.rig.camera_poses():
        assert (-R.T @ t)[2] > 0.2  # both cameras stand above the table
        assert R[2] @ [0, 0, -1] > 0.5  # and look down
    corners = found.rig.project(np.array([[0, 0, 3e-3], [64e-3, 0, 3e-3], [0, 40e-3, 3e-3]]))
    for camera in (0, 1):
        view = found.corner_views[camera][0]
        # of one corner each, at 3 sigma of the located corner plus what the rig adds
        assert np.abs(corners[camera] - view.points[[0, 8, 45]]).max() < 0.03
