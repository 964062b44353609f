"""From images to a rig: the lab frame is right, its uncertainty honest, and views that are no pairs are named."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from calibration import Board, BoardNotFound, CalibrationError, Camera, calibrate_from_corners, calibrate_stereo
from calibration.board.chessboard import board_orders
from calibration.cameras.camera import rotation_from_vector, triangulate
from calibration.judge.assessment import shifts_of_points
from calibration.judge.tolerances import BoardTolerances, table_pose
from tests.oracles.drawn_boards import corner_view, draw_board, make_scene

BOARD = Board((7, 4), 9e-3)
THICKNESS = 2e-3
EXACT = BoardTolerances(square=0.0, flatness=0.0, thickness=0.0)  # what is declared of a drawn board is true


def small_scene(**options):
    """The scene seen by cameras of fewer pixels, so that drawing it is quick."""
    scene = make_scene(inner_corners=BOARD.inner_corners, square=BOARD.square, **options)
    cameras = tuple(
        Camera(c.fx * 0.45, c.fy * 0.45, 119.0 + i, 96.0 - i, (-0.15, 0, 0, 0, 0), (240, 192))
        for i, c in enumerate(scene.model.rig.cameras)
    )
    return scene.with_rig(left=cameras[0], right=cameras[1])


@pytest.fixture(scope="module")
def drawn():
    scene, images, rng = small_scene(n_views=8), ([], []), np.random.default_rng(8)
    m, rig = scene.model, scene.model.rig
    for R, t in zip(m.R_left_board[:, 0], m.t_left_board[:, 0], strict=True):
        images[0].append(draw_board(rig.left, R, t, BOARD, rng=rng))
        R, t = rig.R_right_left @ R, rig.R_right_left @ t + rig.t_right_left
        images[1].append(draw_board(rig.right, R, t, BOARD, rng=rng))
    return scene, images


def corner_views(scene, rng, sigma=0.02):
    """What `find_corners` would return, without images."""
    return [
        [corner_view(p + rng.normal(size=p.shape) * sigma, sigma, camera.image_size) for p in scene.pixels(c)]
        for c, camera in enumerate(scene.model.rig.cameras)
    ]


def test_lab_frame_from_images_is_right_within_its_uncertainty(drawn):
    scene, (left, right) = drawn
    found = calibrate_stereo(left, right, BOARD, EXACT, table_view=3, board_thickness=THICKNESS)
    R, t = table_pose(scene.model.R_left_board[3, 0], scene.model.t_left_board[3, 0], THICKNESS)
    points = np.array([[0.0, 0, 0], [50e-3, 0, 0], [0, 25e-3, 0], [25e-3, 10e-3, 10e-3]])
    m = scene.model
    true_rig = replace(m.rig, R_left_world=R, t_left_world=t)
    error = triangulate(true_rig.project(points), found.rig) - points
    sigma = np.sqrt([np.diag(J @ found.rig.covariance @ J.T) for J in shifts_of_points(found.rig, points)])
    assert np.abs(error / sigma).max() < 4.5
    assert np.abs(error).max() < 20e-6  # cameras of 240 x 192 px, 0.55 mm per px, 8 views
    assert sigma.max() < 20e-6


def test_a_view_of_another_size_is_named_and_one_too_few(drawn):
    _, (left, right) = drawn
    with pytest.raises(CalibrationError, match="8 left and 7 right"):
        calibrate_stereo(left, right[:-1], BOARD)
    with pytest.raises(CalibrationError, match="left 4: left image is 240 x 182 px"):
        calibrate_stereo([*left[:4], left[4][:-10], *left[5:]], right, BOARD)


def test_views_without_a_board_are_left_out_with_the_reason(drawn):
    _, (left, right) = drawn
    blank = np.full_like(left[0], 90)
    found = calibrate_stereo([*left[:6], blank, left[7]], [*right[:5], blank, blank, right[7]], BOARD, EXACT)
    assert list(found.rejected_views) == [6]
    assert "left 6 and right 6: no board of 7 x 4" in found.rejected_views[6]
    said = "right 5: left out, the other image of the pair is used for its own camera: no board"
    assert any(text.startswith(said) for text in found.warnings)
    assert np.isnan(found.rms_per_view_px[5, 1])
    assert np.isfinite(found.rms_per_view_px[5, 0])


@pytest.mark.statistical
def test_no_board_anywhere_and_none_in_the_table_view_are_errors(drawn):
    _, (left, right) = drawn
    blank = np.full_like(left[0], 90)
    with pytest.raises(CalibrationError, match=r"found in 0 of 8 left images.*left 0 and 7 more: no board"):
        calibrate_stereo([blank] * 8, right, BOARD)
    with pytest.raises(CalibrationError, match=r"table view 0 cannot be used .left 0 and right 0: no board.*lab frame"):
        calibrate_stereo([blank, *left[1:]], [blank, *right[1:]], BOARD, EXACT, table_view=0)
    with pytest.raises(CalibrationError, match="table view 11 does not exist"):
        calibrate_stereo(left, right, BOARD, EXACT, table_view=11)


def test_exchanged_images_are_found_out(rng):
    scene = small_scene(n_views=10)
    left, right = corner_views(scene, rng)
    right[2], right[7] = right[7], right[2]
    found = calibrate_from_corners(left, right, BOARD, EXACT)
    assert found.apart == (2, 7)
    assert any("not a pair" in text and "left 2 " in text and "left 7 " in text for text in found.warnings)
    assert not found.rejected_views  # each image still says all that it can of its own camera
    assert found.assessment.pairs == 8
    assert found.rms_px < 0.05
    assert np.isfinite(found.rms_per_view_px).all()
    with pytest.raises(CalibrationError, match="table view 2 cannot be used"):
        calibrate_from_corners(left, right, BOARD, EXACT, table_view=2)


@pytest.mark.statistical
@pytest.mark.parametrize("size", [3.0, 6.0, 12.0])
def test_an_image_whose_corners_are_wrong_costs_itself_alone_however_wrong_they_are(size):
    scene = make_scene(n_views=14)
    left, right = corner_views(scene, np.random.default_rng(5), 0.02)
    wrong = size * np.random.default_rng(1).normal(size=right[4].points.shape)
    right[4] = replace(right[4], points=right[4].points + wrong)
    found = calibrate_from_corners(left, right, scene.board)
    (text,) = [text for text in found.warnings if "blurred, or the board was found wrongly" in text]
    assert text.startswith("right 4: left out, the other image of the pair is used for its own camera: RMS ")
    assert not found.apart
    assert found.rms_px < 0.05


@pytest.mark.statistical
def test_a_board_that_moved_between_the_exposures_costs_the_pair_and_no_camera(rng):
    left, right = corner_views(small_scene(n_views=10), rng)
    right[4] = replace(right[4], points=right[4].points + np.array([1.5, -1.0]))
    found = calibrate_from_corners(left, right, BOARD, EXACT)
    assert found.apart == (4,)
    assert found.assessment.pairs == 9
    assert any(text.startswith("left 4 and right 4 (") and "moved" in text for text in found.warnings)
    left[4] = right[4] = BoardNotFound("left out")
    without = calibrate_from_corners(left, right, BOARD, EXACT)
    sigma = np.sqrt(np.diag(without.rig.covariance))[:9]
    change = found.rig.left.parameters - without.rig.left.parameters
    assert np.abs(change[sigma > 0] / sigma[sigma > 0]).max() < 2
    assert found.rig.covariance[0, 0] < without.rig.covariance[0, 0]


def test_so_few_pairs_that_none_can_judge_another_are_all_used(rng):
    left, right = corner_views(small_scene(n_views=3), rng)
    right[1] = replace(right[1], points=right[1].points + np.array([1.5, -1.0]))
    assert not calibrate_from_corners(left, right, BOARD, EXACT).apart


@pytest.mark.statistical
def test_parallel_views_are_warned_of(rng):
    scene = small_scene(n_views=8)
    m = scene.model
    shift = rng.uniform(-0.02, 0.02, (8, 3))
    turns = rotation_from_vector(np.outer(np.arange(8), [0, 0, 0.1]))[:, None]
    parallel = replace(m, R_left_board=m.R_left_board[0] @ turns, t_left_board=m.t_left_board[0] + shift[:, None])
    found = calibrate_from_corners(*corner_views(replace(scene, model=parallel), rng), BOARD, EXACT)
    many = calibrate_from_corners(*corner_views(scene, rng), BOARD, EXACT)
    assert found.assessment.tilt_spread_deg < 1
    assert any("normals differ" in w for w in found.warnings)
    assert not any("normals differ" in w for w in many.warnings)
    # and the covariance says the same as the warning, although square pixels are known beforehand
    assert found.rig.covariance[0, 0] > many.rig.covariance[0, 0]
    error = found.rig.left.parameters[:4] - m.rig.left.parameters[:4]
    assert np.abs(error / np.sqrt(np.diag(found.rig.covariance)[:4])).max() < 4


@pytest.mark.parametrize("counts", [(7, 5), (6, 4), (5, 5), (4, 4)])
def test_a_board_that_looks_the_same_after_a_turn_still_gives_one_pair(rng, counts):
    board = Board(counts, 9e-3)
    assert len(board.orders) > 1
    scene = make_scene(n_views=8, inner_corners=counts, square=9e-3)
    scene = replace(scene, board=board)
    left, right = corner_views(scene, rng, 0.01)
    orders = board_orders(counts)
    orders = orders if len(board.orders) == len(orders) else orders[::2]
    turned = [view.reordered(orders[v % len(orders)]) for v, view in enumerate(right)]
    found = calibrate_from_corners(left, turned, board)
    assert not found.rejected_views
    assert found.rms_px < 0.03
    assert any("looks the same after a turn" in w for w in found.warnings)
    assert_allclose(found.rig.t_right_left, scene.model.rig.t_right_left, atol=5e-3)  # 5 x 5 corners tell little


def in_a_mirror(view, board):
    """What the finder sees in the image flipped left to right: it takes the board for an upright one."""
    columns, rows = board.inner_corners
    index = np.arange(columns * rows).reshape(rows, columns)
    order = index[::-1] if columns % 2 else index[:, ::-1]  # the dark corner square stays beside corner 0
    points = view.points * [-1.0, 1.0] + [view.image_size[0] - 1.0, 0.0]
    return replace(view, points=points).reordered(order.reshape(-1))


@pytest.mark.parametrize("counts", [(7, 4), (6, 5), (5, 5), (6, 4)])
def test_one_camera_that_shows_a_mirror_image_is_named_and_two_are_one_world(rng, counts):
    board = Board(counts, 9e-3)
    scene = replace(make_scene(n_views=9, inner_corners=counts, square=9e-3), board=board)
    sides = corner_views(scene, rng)
    mirrored = [[in_a_mirror(view, board) for view in side] for side in sides]
    for pair in ((sides[0], mirrored[1]), (mirrored[0], sides[1])):
        with pytest.raises(CalibrationError, match=r"images of one of the two cameras are mirrored: if they are, 9 of"):
            calibrate_from_corners(*pair, board, EXACT)
    assert calibrate_from_corners(*mirrored, board, EXACT).rms_px < 0.2


def test_the_images_of_one_camera_twice_are_no_pair(rng):
    left, right = corner_views(small_scene(n_views=6), rng, 0.02)
    with pytest.raises(CalibrationError, match=r"from one place .* do both patterns name the images of one camera"):
        calibrate_from_corners(left, left, BOARD, EXACT)
    assert calibrate_from_corners(left, right, BOARD, EXACT).rms_px < 0.1


def test_boards_that_are_none_are_refused():
    with pytest.raises(CalibrationError, match="3 x 3"):
        Board((2, 9), 1e-3)
    with pytest.raises(CalibrationError, match="positive"):
        Board((9, 6), 0.0)


@pytest.fixture(scope="module")
def views():
    return corner_views(small_scene(n_views=12), np.random.default_rng(3))


@pytest.mark.parametrize(
    ("paired", "said"),
    [
        (lambda left, right: (left[:-1], right[1:]), "the right ones come 1 early"),
        (lambda left, right: (left[2:], right[:-2]), "the right ones come 2 late"),
        (lambda left, right: (left, right[::-1]), "in reversed order"),
        (lambda left, right: (left[:-1], right[:4] + right[5:]), "come 1 early|if the right view 1 earlier is taken"),
        (lambda left, right: (left, right[5:] + right[2:5] + right[:2]), "agree on no common place|5 early"),
        (lambda left, right: (left, [right[0]] * 12), "12 right images show the board in one place, right 0 to"),
        (lambda left, right: ([left[3]] * 12, right), "12 left images show the board in one place"),
    ],
    ids=["late", "early", "reversed", "a lost frame", "mixed", "one right image", "one left image"],
)
def test_views_that_are_no_pairs_are_named(views, paired, said):
    with pytest.raises(CalibrationError, match=said):
        calibrate_from_corners(*paired(*views), BOARD, EXACT)


def test_a_frame_that_was_lost_near_the_end_costs_the_pairs_behind_it_and_is_named(views):
    left, right = views
    found = calibrate_from_corners(left[:-1], [*right[:7], *right[8:]], BOARD, EXACT)
    assert found.apart == (7, 8, 9, 10)
    (text,) = [text for text in found.warnings if "a frame was lost there" in text]
    # the right view of left 7 is lost itself
    assert text.startswith("left 8 to left 10: 3 pairs agree with the others if the right view 1 earlier is taken")
    assert found.rms_px < 0.05


def test_boards_of_two_sizes_end_in_a_rig_or_a_sentence(views):
    """Every other view shows a board of twice the size, twice as far away: each pair tells of twice the baseline."""
    scene = small_scene(n_views=12)
    m = scene.model
    far = replace(m, points=1.5 * m.points, t_left_board=m.t_left_board + np.array([0, 0, 0.05]))
    other = corner_views(replace(scene, model=far), np.random.default_rng(4))
    mixed = [[b if v % 3 == 1 else a for v, (a, b) in enumerate(zip(*s, strict=True))] for s in zip(views, other)]  # noqa: B905
    found = calibrate_from_corners(*mixed, BOARD, EXACT)
    assert found.apart == (1, 4, 7, 10)
    assert_allclose(found.rig.baseline, m.rig.baseline, rtol=0.01)


@pytest.mark.statistical
@pytest.mark.parametrize("counts", [(7, 7), (6, 6)])
def test_every_pair_of_a_square_board_is_used_whichever_way_a_camera_sees_it(rng, counts):
    """Cameras near to each other: what a pair tells of their distance scatters by more than a tenth of it."""
    board = Board(counts, 6e-3)
    scene = make_scene(n_views=16, inner_corners=counts, square=6e-3)
    near = rotation_from_vector(np.array([0.0, -0.06, 0.0]))
    views = corner_views(scene.with_rig(R_right_left=near, t_right_left=np.array([-0.02, 0.0, 0.002])), rng, 0.1)
    for turned in (0, 1):  # and the right camera upside down
        right = [view.reordered(board.orders[(turned + v // 3) % len(board.orders)]) for v, view in enumerate(views[1])]
        found = calibrate_from_corners(views[0], right, board)
        assert not found.apart
        assert found.assessment.pairs == 16
        assert found.rms_px < 0.2
        assert min(found.rig.left.fy, found.rig.right.fy) > 0


@pytest.mark.statistical
def test_views_of_one_place_count_once(views):
    once = calibrate_from_corners(*views, BOARD, EXACT)
    thrice = calibrate_from_corners(*[3 * side for side in views], BOARD, EXACT, table_view=14)
    assert len(thrice.rejected_views) == 24
    assert 14 not in thrice.rejected_views
    assert thrice.rejected_views[2] == "left 2: shows the board where left 14 does, and counts once; " + (
        "right 2: shows the board where right 14 does, and counts once"
    )
    assert thrice.assessment.pairs == once.assessment.pairs == 12
    t = once.rig.t_right_left / once.rig.baseline
    sigma = [float(np.sqrt(t @ f.rig.covariance[21:24, 21:24] @ t)) for f in (once, thrice)]
    assert_allclose(sigma[1], sigma[0], rtol=1e-3)
    # a board at rest in a video: other noise in every frame, the same place
    scene = small_scene(n_views=12)
    again = corner_views(scene, np.random.default_rng(9))
    rest = calibrate_from_corners(*[a + b for a, b in zip(views, again, strict=True)], BOARD, EXACT)
    assert len(rest.rejected_views) == 12


def test_an_image_that_is_missing_makes_no_two_views_one(views):
    left, right = views
    left = [BoardNotFound("covered") if v == 3 else view for v, view in enumerate(left)]
    found = calibrate_from_corners(left, right, BOARD, EXACT)
    assert not found.rejected_views
    assert not found.apart
    assert not any("frame was lost" in text for text in found.warnings)


@pytest.mark.statistical
@pytest.mark.parametrize("zoom", [1.05, 0.95])
def test_a_lens_that_was_zoomed_between_the_views_is_named_and_costs_its_later_images(zoom):
    scene = make_scene(n_views=20)
    m, board = scene.model, scene.board
    right = m.rig.right
    zoomed = scene.with_rig(right=replace(right, fx=zoom * right.fx, fy=zoom * right.fy))
    left, before = corner_views(scene, np.random.default_rng(0))
    after = corner_views(zoomed, np.random.default_rng(1))[1]
    right_views = [*before[:12], *after[12:]]
    found = calibrate_from_corners(left, right_views, board)
    (text,) = [text for text in found.warnings if "zoomed" in text]
    assert text.startswith("right 12, right 13")
    assert "the right camera was zoomed or focused anew" in text
    assert not any("camera was moved" in text for text in found.warnings)
    assert found.assessment.pairs == 12
    sigma = np.sqrt(np.diag(found.rig.covariance))
    assert abs(found.rig.right.fx - right.fx) < 4 * sigma[9]
    assert np.abs((found.rig.t_right_left - m.rig.t_right_left) / sigma[21:24]).max() < 4


@pytest.mark.statistical
def test_images_of_half_the_size_are_no_better_a_calibration():
    """The same cameras with half the pixels, corners as uncertain in space: the same verdict, half the misfit in px."""
    scene = small_scene(n_views=12)
    m = scene.model
    half = tuple(
        replace(c, fx=c.fx / 2, fy=c.fy / 2, cx=c.cx / 2 - 0.25, cy=c.cy / 2 - 0.25, image_size=(120, 96))
        for c in m.rig.cameras
    )
    found = []
    for one, sigma in ((scene, 0.1), (scene.with_rig(left=half[0], right=half[1]), 0.05)):
        sides = corner_views(one, np.random.default_rng(2), sigma)
        found.append(calibrate_from_corners(*sides, BOARD, EXACT).assessment)
    whole, less = found
    assert less.verdict.split(":")[0] == whole.verdict.split(":")[0]
    assert_allclose(less.stereo_misfit_px, 0.5 * whole.stereo_misfit_px, rtol=0.05)
    assert_allclose(less.held_out_error, whole.held_out_error, rtol=0.05)
    # 0.1 px of 0.55 mm at each of two cameras 45 deg apart, less what the board's place takes up
    assert 0.03e-3 < whole.held_out_error < 0.3e-3
    assert all(part in whole.figures for part in ("mdeg", f"stereo misfit {whole.stereo_misfit_px:.4f} px"))


def test_a_rig_is_beyond_use_where_points_are_off_by_a_twentieth_of_their_distance(views):
    good = calibrate_from_corners(*views, BOARD, EXACT).assessment
    assert not good.beyond_use
    assert replace(good, triangulation_sigma=(0.06 * good.distance, 1.0)).beyond_use
    assert replace(good, held_out_error=0.06 * good.distance).beyond_use
    assert replace(good, triangulation_sigma=(float("nan"), 1.0)).beyond_use
