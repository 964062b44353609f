"""ChArUco boards: located where an independent homography puts them, calibrated end to end; and the search for boards.

The prints are drawn by OpenCV, brought into the image by
OpenCV's warp at six times the resolution, and averaged over the pixels; it shares no line with the code under test.
"""

import json
import re
from functools import cache

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from calibration import Board, BoardNotFound, CalibrationError, Camera, CornerView
from calibration.board import chessboard
from calibration.board.charuco import find_charuco
from calibration.board.search import board_size, located, other_board
from calibration.board.target import CharucoBoard, described, target_of
from disctrack import calibrate_recording, read_recording
from disctrack.errors import RecordingError
from tests.oracles.drawn_boards import draw_board

CHARUCO = CharucoBoard((9, 6), 12e-3, 8.5e-3, "DICT_4X4_50")
K = np.array([[620.0, 0.0, 201.0], [0.0, 615.0, 148.0], [0.0, 0.0, 1.0]])
SIZE = (400, 300)
FINE = 6  # samples of the warp per pixel, each way
PIXEL = 0.1e-3  # [m] of the drawn print
RIM = 200  # light pixels round it


@cache
def drawn_print():
    """Image of the print, and the homogeneous (3, 3) from its pixels to the board, x right and y up [m]."""
    columns, rows = CHARUCO.squares
    side = round(CHARUCO.square / PIXEL)
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, CHARUCO.dictionary))
    board = cv2.aruco.CharucoBoard(CHARUCO.squares, CHARUCO.square, CHARUCO.marker, dictionary)
    image = np.pad(board.generateImage((columns * side, rows * side)), RIM, constant_values=255)
    # the lower left inner corner lies between pixels, one square from the left, one from below
    origin = np.array([RIM + side - 0.5, RIM + (rows - 1) * side - 0.5])
    return image, np.array([[PIXEL, 0, -PIXEL * origin[0]], [0, -PIXEL, PIXEL * origin[1]], [0, 0, 1]])


def photograph(R, t, rng) -> np.ndarray:
    """Image (300, 400) of the print at pose R, t in the camera's axes: blur of 0.6 px, noise of 1.5 grey values."""
    image, board_from_pixel = drawn_print()
    H = K @ np.column_stack([R[:, 0], R[:, 1], t]) @ board_from_pixel
    fine = np.array([[FINE, 0, (FINE - 1) / 2], [0, FINE, (FINE - 1) / 2], [0, 0, 1.0]])
    size = (SIZE[0] * FINE, SIZE[1] * FINE)
    big = cv2.warpPerspective(image, fine @ H, size, flags=cv2.INTER_LINEAR, borderValue=130)
    grey = cv2.resize(cv2.GaussianBlur(big.astype(np.float32), (0, 0), 0.6 * FINE), SIZE, interpolation=cv2.INTER_AREA)
    noisy = 25.0 + 190.0 * grey / 255 + rng.normal(0, 1.5, grey.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def pose(degrees, distance=0.33, aside=(0.0, 0.0)):
    """Upright and facing the camera, then turned by these angles about x, y, z."""
    R = Rotation.from_euler("XYZ", degrees, degrees=True).as_matrix() @ np.diag([1.0, -1.0, -1.0])
    return R, np.array([*aside, distance]) - R @ CHARUCO.points.mean(0)


def seen(degrees, rng, **where):
    """A photograph of the board, and where its corners are in it."""
    R, t = pose(degrees, **where)
    image = (CHARUCO.points @ R.T + t) @ K.T
    return photograph(R, t, rng), image[:, :2] / image[:, 2:]


@pytest.mark.parametrize("negative", [False, True])
def test_charuco_corners_are_located_several_times_better_than_opencvs(negative, rng):
    image, truth = seen((20, -15, 10), rng, distance=0.28)
    view = find_charuco(255 - image if negative else image, CHARUCO)
    assert isinstance(view, CornerView), view
    assert view.accepted.all()
    error = view.points - truth
    assert np.sqrt(np.mean(error**2)) < 0.006  # its own sigma is 0.003 px
    squares = np.einsum("ni,nij,nj->n", error, np.linalg.inv(view.covariance), error)
    assert 0.5 < np.mean(squares) / 2 < 2.5
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    detector = cv2.aruco.CharucoDetector(cv2.aruco.CharucoBoard((9, 6), 12e-3, 8.5e-3, dictionary))
    corners, ids, _, _ = detector.detectBoard(image)
    theirs = np.asarray(corners).reshape(-1, 2) - truth[np.ravel(ids)]
    assert np.sqrt(np.mean(theirs**2)) > 0.02


def test_a_charuco_board_may_reach_out_of_the_image(rng):
    image, truth = seen((-10, 20, 170), rng, aside=(0.07, 0.04))
    view = find_charuco(image, CHARUCO)
    assert isinstance(view, CornerView), view
    inside = ((truth > 0) & (truth < np.array(SIZE) - 1)).all(1)
    assert not view.accepted[~inside].any()
    assert set(view.reasons) == {""}  # none was struck: they were not in view
    assert 8 <= view.accepted.sum() < len(truth)
    assert np.abs(view.points - truth)[view.accepted].max() < 0.03


def test_other_markers_are_not_found_and_unknown_ones_refused(rng):
    image, _ = seen((0, 10, 0), rng)
    other = find_charuco(image, CharucoBoard((9, 6), 12e-3, 8.5e-3, "DICT_6X6_250"))
    assert isinstance(other, BoardNotFound)
    assert "dictionary" in other.reason
    with pytest.raises(CalibrationError, match="DICT_4X4_50"):
        find_charuco(image, CharucoBoard((9, 6), 12e-3, 8.5e-3, "4X4"))
    assert isinstance(find_charuco(np.full_like(image, 128), CHARUCO), BoardNotFound)


@pytest.mark.parametrize(
    ("target", "symmetry"),
    [(Board((9, 6), 8e-3), 1), (Board((9, 5), 8e-3), 2), (Board((6, 6), 8e-3), 4), (CHARUCO, 1)],
    ids=str,
)
def test_targets_know_their_symmetry_and_survive_a_file(target, symmetry):
    assert len(target.orders) == symmetry
    for order in target.orders:  # a turn keeps all distances
        d = target.points[order] - target.points[order].mean(0)
        unturned = target.points - target.points.mean(0)
        assert_allclose(d @ d.T, unturned @ unturned.T, atol=1e-15)
    assert target_of(json.loads(json.dumps(described(target)))) == target


AS_CHARUCO = 'target = "charuco"\nsquares = [9, 6]\nsquare_mm = 12.0\nmarker_mm = 8.5\ndictionary = "DICT_4X4_50"'


def declared(sample_clip, folder, keys):
    """The sample with views in `folder / views`, of a target with these keys."""
    text = (sample_clip / "recording.toml").read_text()
    views = '[calibration]\nleft = "views/left*.png"\nright = "views/right*.png"\n'
    (folder / "recording.toml").write_text(
        re.sub(r"\[calibration\].*(?=\[table\])", f"{views}{keys}\n", text, flags=re.S)
    )
    return read_recording(folder)


@pytest.mark.statistical
def test_a_recording_with_a_charuco_board_is_calibrated(sample_clip, tmp_path, rng):
    R_pair = cv2.Rodrigues(np.array([0.0, -0.5, 0.0]))[0]
    meeting = np.array([0.0, 0.0, 0.33])
    t_pair = meeting - R_pair @ meeting
    angles = [(0, 14, 0), (25, 10, 5), (-22, 15, -10), (10, 40, 20)]
    angles += [(5, -12, 90), (30, 20, -40), (-25, 0, 30), (0, 30, 10)]
    (tmp_path / "views").mkdir()
    poses = []
    for v, degrees in enumerate(angles):
        R, t = pose(degrees, aside=tuple(rng.uniform(-0.01, 0.01, 2)))
        poses.append((R, t))
        cv2.imwrite(str(tmp_path / f"views/left_{v}.png"), photograph(R, t, rng))
        right = photograph(R_pair @ R, R_pair @ t + t_pair, rng)
        cv2.imwrite(str(tmp_path / f"views/right_{v}.png"), right)
    recording = declared(sample_clip, tmp_path, AS_CHARUCO)
    assert recording.chessboard is None
    found, problems = calibrate_recording(recording)
    assert not problems
    assert not found.rejected_views
    assert found.rms_px < 0.02
    rig, sigma = found.rig, np.sqrt(np.diag(found.rig.covariance))
    assert abs(rig.left.fx - K[0, 0]) < 4 * sigma[0] + 0.05
    assert np.all(np.abs(rig.t_right_left - t_pair) < 4 * sigma[21:24] + 2e-6)
    R, t = poses[0]
    table = t - 3e-3 * R[:, 2]
    assert np.all(np.abs(rig.t_left_world - table) < 4 * sigma[27:30] + 2e-6)
    assert np.degrees(np.arccos(np.clip(rig.R_left_world[:, 2] @ R[:, 2], -1, 1))) < 0.1
    assert (rig.R_left_world[:, 0] @ R[:, 0]) > 0.9999  # x along the rows of the upright print


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ('target = "checkers"\ninner_corners = [9, 6]\nsquare_mm = 8.0', 'expected "chessboard" or "charuco"'),
        ('target = "charuco"\nsquares = [9, 6]\nsquare_mm = 12.0\nmarker_mm = 8.5', "dictionary is missing"),
        (AS_CHARUCO.replace("8.5", "12.5"), "does not fit into a square"),
        ("inner_corners = [9, 6]\nsquares = [9, 6]\nsquare_mm = 12.0", "both inner_corners and squares"),
    ],
)
def test_a_target_that_is_not_wholly_declared_is_refused_by_its_key(keys, said, sample_clip, tmp_path):
    with pytest.raises(RecordingError, match=said):
        declared(sample_clip, tmp_path, keys)


@pytest.mark.statistical
def test_images_of_another_board_are_told_by_its_size():
    camera, R = Camera(700.0, 700.0, 160.0, 120.0, (0.0,) * 5, (320, 240)), cv2.Rodrigues(np.array([3.0, 0.2, 0.1]))[0]
    image = draw_board(camera, R, np.array([-0.03, 0.02, 0.3]), Board((7, 5), 8e-3), rng=np.random.default_rng(1))
    declared = Board((8, 5), 8e-3)
    views = located([image] * 16, declared)
    assert all("8 of 8 images looked at show 7 x 5: inner_corners = [7, 5]" in view.reason for view in views)
    # half of the images having the declared one is enough
    assert not other_board([image] * 10, [False] * 5 + [True] * 5, declared)
    blank = np.full_like(image, 128)
    assert board_size([image, image, blank]) == ((7, 5), 2)
    assert board_size([blank] * 3) == (None, 0)


def test_corners_of_which_whole_lines_were_passed_over_are_no_board(rng):
    """As OpenCV's finder returned them in photographs of a dim board of 11 x 8: rows 0, 4, 6 and 7."""
    i, j = np.meshgrid(np.arange(11.0), np.arange(8.0))
    w = 1 + 0.04 * j + 0.02 * i  # seen obliquely from near: nearest squares 1.9 times as large as the farthest
    grid = np.stack([50 * i / w, 50 * j / w], axis=-1) + rng.normal(0, 1, (8, 11, 2))
    assert chessboard._even(grid)
    assert chessboard._even(grid[:3, :3])
    for rows in ([0, 4, 6, 7], [0, 1, 3], [0, 2, 3, 4, 5, 6, 7]):
        assert not chessboard._even(grid[rows])
        assert not chessboard._even(grid[rows].swapaxes(0, 1))
