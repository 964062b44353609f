"""Corners: where they are, how well that is known, in which order, and what is refused."""

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose

from calibration import Board, BoardNotFound, Camera, CornerView, find_corners
from calibration.board.chessboard import luminance, margin_is_dark
from calibration.cameras.camera import project, rotation_from_vector
from tests.oracles.drawn_boards import corner_view, draw_board

CAMERA = Camera(900.0, 905.0, 158.0, 122.0, (-0.1, 0.1, 3e-4, -2e-4, 0.0), (320, 240))
BOARD = Board((9, 6), 8e-3)
FACING = np.diag([1.0, -1.0, -1.0])
TILT = (20.0, 15.0, 10.0)  # [deg]


def facing(board, R, distance=0.36):
    """R, t of a board that faces the camera but for the turn R, with its middle at the distance."""
    R = R @ FACING
    return R, np.array([0.0, 0.0, distance]) - R @ board.points.mean(0)


def seen(tilt=TILT, seed=None, board=BOARD, camera=CAMERA, distance=0.36, **drawing):
    """Image of a board, exact without a seed of its noise, and where its corners are in it."""
    R, t = facing(board, rotation_from_vector(np.radians(tilt)), distance)
    rng = None if seed is None else np.random.default_rng(seed)
    return draw_board(camera, R, t, board, rng=rng, **drawing), project(board.points @ R.T + t, camera)


def located(image, counts=(9, 6)):
    """The corners of a board that is found."""
    view = find_corners(image, counts)
    assert isinstance(view, CornerView), view
    return view


@pytest.fixture(scope="module")
def views():
    """(located, true) corners of views from frontal to steep, edges along the rows and askew."""
    found = []
    # no edges at 0 or 45 deg, where the grid of rays of the drawing itself would show
    for seed, tilt in enumerate([(3, 4, 7), TILT, (-35, 10, 33), (10, -50, 5), (55, 0, -20), (5, 8, 38)]):
        image, true = seen(tilt, 11 + seed)
        found.append((located(image), true))
    return found


def test_corners_at_every_slant_are_located_to_a_hundredth_of_a_pixel_without_bias_and_as_well_as_predicted(views):
    squares = []
    for view, true in views:
        assert view.accepted.all()
        error = view.points - true
        assert np.sqrt(np.mean(error**2)) < 0.01  # squares of 12 to 20 px: the light's limit is 0.004 to 0.007 px
        assert np.abs(error).max() < 0.05
        sigma = np.sqrt(np.mean(view.covariance[:, [0, 1], [0, 1]], axis=0) / len(true))
        # rays 1/6 px apart: their grid leaves some 5e-4 px
        assert np.abs(np.mean(error, axis=0)).max() < 4 * sigma.max() + 5e-4
        squares.append(np.mean(np.einsum("ni,nij,nj->n", error, np.linalg.inv(view.covariance), error)) / 2)
    # 648 coordinates: scatter of the mean square 0.056, four of these; no smaller than the noise
    assert 0.78 < np.mean(squares) < 1.25


def lit(image, added, fall_off):
    """Exact grey values under light that falls off across the image by a part, with glare of so many grey values."""
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    glare = added * np.exp(-0.5 * ((x - 210) ** 2 + (y - 150) ** 2) / 60.0**2)
    return image * (1 - fall_off * np.hypot(x, y) / 400) + glare


@pytest.mark.statistical
def test_added_light_shifts_no_corner():
    image, true = seen((10, 12, 7), sub=6)

    def found(grey):
        return find_corners(np.rint(16 * grey).astype(np.uint16), (9, 6)).points

    def shift(added):
        return np.sqrt(np.mean((found(lit(image, added, fall_off=0.15)) - plain) ** 2, axis=0)).max()

    plain = found(image)
    assert np.abs(plain - true).max() < 0.01  # the premise
    assert shift(added=0.0) < 5e-4
    assert shift(added=30.0) < 1e-3  # the noise of a good image shifts a corner by 0.004 px


@pytest.mark.statistical
@pytest.mark.parametrize(
    "optical_blur", [0.02, pytest.param(0.1, marks=pytest.mark.slow), pytest.param(0.2, marks=pytest.mark.slow)]
)
def test_edges_sharper_than_the_pixel_are_located_as_well(optical_blur):
    image, true = seen((-35, 10, 33), 1, sub=8, sigma=optical_blur)
    view = located(image)
    assert view.accepted.all()
    assert np.sqrt(np.mean((view.points - true) ** 2)) < 0.005  # the light's limit is 0.002 px


def spoiled(image, how):
    """An image as consumers' cameras and compression leave it."""
    if how == "sharpened":
        image = cv2.addWeighted(image, 3.0, cv2.GaussianBlur(image, (0, 0), 1.0), -2.0, 0)
    elif how == "jpeg":
        image = cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 60])[1], cv2.IMREAD_UNCHANGED)
    elif how == "small":
        image = cv2.resize(image, None, fx=0.6, fy=0.6, interpolation=cv2.INTER_AREA)
    elif how == "half-tone":
        y, x = np.mgrid[: image.shape[0], : image.shape[1]]
        image = np.clip(image + 40.0 * ((x + y) % 2) * (image > 100) - 20, 0, 255).astype(np.uint8)
    return image


@pytest.mark.statistical
@pytest.mark.parametrize("how", ["sharpened", "jpeg", "small", "half-tone"])
def test_spoiled_images_lose_no_corner_and_state_their_error(how):
    squares, rms = [], []
    for seed, tilt in enumerate([(3, 4, 7), TILT, (-35, 10, 33)]):
        image, true = seen(tilt, seed, sigma=0.4)
        image = spoiled(spoiled(image, how), "jpeg")
        true = (true + 0.5) * 0.6 - 0.5 if how == "small" else true
        view = located(image)
        assert view.accepted.all()
        error = view.points - true
        squares.append(np.mean(np.einsum("ni,nij,nj->n", error, np.linalg.inv(view.covariance), error)) / 2)
        half = max(int(0.35 * np.median(np.linalg.norm(np.diff(true.reshape(6, 9, 2), axis=1), axis=-1))), 2)
        usual = cv2.cornerSubPix(image, np.float32(true).reshape(-1, 1, 2), (half, half), (-1, -1), (3, 60, 1e-4))
        rms.append([np.sqrt(np.mean(e**2)) for e in (error, usual.reshape(-1, 2) - true)])
    ours, theirs = np.mean(rms, axis=0)
    assert ours < theirs
    assert 0.3 < np.mean(squares) < 3  # compression is no white noise


@pytest.mark.parametrize("turn", [0, 37, 90, 145, 180, 222, 270, 301])
def test_order_follows_the_dark_side_however_the_board_lies(turn):
    board = Board((9, 6), 6e-3)
    tilted = rotation_from_vector(np.array([0.3, -0.2, 0.0]))
    R, t = facing(board, tilted @ rotation_from_vector(np.radians([0, 0, turn])))
    view = find_corners(draw_board(CAMERA, R, t, board, rng=np.random.default_rng(turn)), (9, 6))
    assert_allclose(view.points, project(board.points @ R.T + t, CAMERA), atol=0.05)


def test_a_print_whose_corner_squares_are_light_is_found_as_well():
    image, _ = seen(board=Board((9, 7), 7e-3))
    dark, light = located(image, (9, 7)), located(image[:, ::-1], (9, 7))  # in a mirror the colours change
    assert light.accepted.all()
    unflipped = light.points * [-1, 1] + [image.shape[1] - 1, 0]
    grid = unflipped.reshape(7, 9, 2)
    either = [grid[::-1].reshape(-1, 2), grid[:, ::-1].reshape(-1, 2)]  # the same board after half a turn
    assert min(np.abs(points - dark.points).max() for points in either) < 0.02


@pytest.mark.parametrize("counts", [(5, 4), (4, 5), (7, 6), (12, 7), (3, 4)])
def test_other_boards_are_found_in_their_own_order(counts):
    board = Board(counts, 70e-3 / max(counts))
    assert len(board.orders) == 1
    image, true = seen((20, 15, 130), 1, board)
    assert_allclose(located(image, counts).points, true, atol=0.1)  # squares down to 10 px, and blur of 0.6 px


@pytest.mark.statistical
@pytest.mark.parametrize("counts", [(8, 6), (9, 5), (10, 6), (9, 7), (6, 4)])
def test_wrong_counts_are_refused(counts):
    found = find_corners(seen(seed=2)[0], counts)
    assert isinstance(found, BoardNotFound)
    assert "inner corners" in found.reason.lower()
    # OpenCV sees these parts of the board as a board; of larger counts there is none
    assert ("declare inner_corners = [9, 6]" in found.reason) == (counts in ((8, 6), (9, 5)))


def test_an_image_too_large_for_the_rough_search_loses_nothing():
    image, _ = seen((10, 20, 30), 6)
    large = np.full((1200, 2000), 80, np.uint8)
    large[700:940, 1500:1820] = image
    offset = np.array([1500, 700])
    assert_allclose(find_corners(large, (9, 6)).points - offset, find_corners(image, (9, 6)).points, atol=1e-4)


@pytest.mark.statistical
def test_squares_of_150_px_are_located_as_well_as_they_state():
    """Their first window is a small part of them."""
    board, camera = Board((4, 3), 8e-3), Camera(2400.0, 2410.0, 519.0, 403.0, (0.0,) * 5, (1040, 800))
    image, true = seen((12.0, 9.0, 7.0), 8, board, camera, distance=0.13, sub=3)
    view = find_corners(image, (4, 3))
    sigma = np.sqrt(np.diagonal(view.covariance, axis1=1, axis2=2))
    pull = (view.points - true) / sigma
    assert np.sqrt(np.mean(pull**2)) < 1.6  # 24 numbers


@pytest.mark.statistical
def test_squares_of_seven_pixels_are_found_where_opencv_stops(sample_clip):
    """The sample's views at 100 x 100: both finders 15 of 36, and each corner lies where the whole image has it."""
    views = [cv2.imread(str(f), cv2.IMREAD_GRAYSCALE) for f in sorted(sample_clip.glob("calibration/*/*.png"))]
    small = [cv2.resize(view, (100, 100), interpolation=cv2.INTER_AREA) for view in views]
    plain = [cv2.findChessboardCorners(view, (9, 6), None, 3)[0] for view in small]
    thorough = [cv2.findChessboardCornersSB(view, (9, 6), None, cv2.CALIB_CB_EXHAUSTIVE)[0] for view in small]
    found = [find_corners(view, (9, 6)) for view in small]
    extra = [i for i, view in enumerate(found) if not (plain[i] or thorough[i] or isinstance(view, BoardNotFound))]
    assert len(extra) >= 10
    for i in extra:
        whole, good = find_corners(views[i], (9, 6)), found[i].accepted
        error = (whole.points + 0.5) * 100 / len(views[i]) - 0.5 - found[i].points
        squares = np.einsum("ki,kij,kj->k", error, np.linalg.inv(found[i].covariance), error)[good]
        assert np.mean(squares) < 2 * 2  # two numbers a corner; what the reduction does to the edges is in no noise


def test_an_empty_or_noisy_image_holds_no_board(rng):
    for image in (np.full((240, 320), 90, np.uint8), rng.integers(0, 256, (240, 320)).astype(np.uint8)):
        assert isinstance(find_corners(image, (9, 6)), BoardNotFound)


@pytest.mark.statistical
def test_a_dirty_corner_is_rejected_with_its_reason():
    image, true = seen(seed=4)
    cv2.circle(image, tuple(int(v) for v in np.rint(true[22] + [3, 2])), 5, 110, -1)
    view = located(image)
    assert not view.accepted[22]
    assert view.reasons[22]
    others = np.delete(np.arange(54), 22)
    assert view.accepted[others].mean() > 0.95
    assert np.abs(view.points - true)[view.accepted].max() < 0.05


@pytest.mark.parametrize("rim", [0.3, 1.0])
def test_paper_round_the_squares_tells_a_negative_from_a_positive(rim):
    """Nothing else does: the colouring of a negative is that of the board turned by 180 deg."""
    board = Board((9, 6), 6e-3)
    image, true = seen(seed=3, board=board, table=60.0, rim=rim)  # darker than paper
    assert not margin_is_dark(image, corner_view(true), (9, 6))
    assert margin_is_dark(255 - image, corner_view(true), (9, 6))


def test_equal_channels_change_nothing():
    image, _ = seen(seed=5)
    plain = find_corners(image, (9, 6))
    triple = find_corners(np.dstack([image] * 3), (9, 6))
    assert np.array_equal(triple.points, plain.points)
    assert not triple.notes
    tinted = np.dstack([image, image, (image * 0.9).astype(np.uint8)])
    assert "luminance" in find_corners(tinted, (9, 6)).notes[0]


def test_an_image_of_another_type_is_refused():
    with pytest.raises(ValueError, match="8 or 16 bit"):
        luminance(np.zeros((10, 10), np.int64))
    with pytest.raises(ValueError, match="height, width"):
        luminance(np.zeros((10, 10, 2), np.uint8))
