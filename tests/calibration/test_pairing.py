"""Which images are pairs: views late, reversed, mixed, copied, turned or at rest are named, and cost no crash."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from calibration import Board, BoardNotFound, CalibrationError, CalibrationSettings, calibrate_from_corners
from calibration.cameras.camera import rotation_from_vector
from tests.calibration.test_stereo import BOARD, FLAT, corner_views, small_scene


@pytest.fixture(scope="module")
def views(scene_maker):
    return corner_views(small_scene(scene_maker, n_views=12), np.random.default_rng(3))


@pytest.mark.parametrize(
    ("paired", "said"),
    [
        (lambda left, right: (left[:-1], right[1:]), "the right ones come 1 early"),
        (lambda left, right: (left[2:], right[:-2]), "the right ones come 2 late"),
        (lambda left, right: (left, right[::-1]), "in reversed order"),
        (
            lambda left, right: (left[:-1], right[:4] + right[5:]),
            "come 1 early|agree with the others if the right view 1 earlier is taken",
        ),
        (lambda left, right: (left, right[5:] + right[2:5] + right[:2]), "agree on no common place|5 early"),
        (
            lambda left, right: (left, [right[0]] * 12),
            "12 right images show the board in one place, right 0 to",
        ),
        (lambda left, right: ([left[3]] * 12, right), "12 left images show the board in one place"),
    ],
    ids=["late", "early", "reversed", "a lost frame", "mixed", "one right image", "one left image"],
)
def test_views_that_are_no_pairs_are_named(views, paired, said):
    with pytest.raises(CalibrationError, match=said):
        calibrate_from_corners(*paired(*views), BOARD, FLAT)


def test_a_frame_that_was_lost_near_the_end_costs_the_pairs_behind_it_and_is_named(views):
    left, right = views
    found = calibrate_from_corners(left[:-1], [*right[:7], *right[8:]], BOARD, FLAT)
    assert found.apart == (7, 8, 9, 10)
    (text,) = [text for text in found.warnings if "a frame was lost there" in text]
    # the right view of left 7 is lost itself
    assert text.startswith("left 8 to left 10: 3 pairs agree with the others if the right view 1 earlier is taken")
    assert found.rms_px < 0.05


def test_boards_of_two_sizes_end_in_a_rig_or_a_sentence(views, scene_maker):
    """Every other view shows a board of twice the size, twice as far away: each pair tells of twice the baseline."""
    scene = small_scene(scene_maker, n_views=12)
    m = scene.model
    far = replace(m, points=1.5 * m.points, t_left_board=m.t_left_board + np.array([0, 0, 0.05]))
    other = corner_views(replace(scene, model=far), np.random.default_rng(4))
    mixed = [[b if v % 3 == 1 else a for v, (a, b) in enumerate(zip(*s, strict=True))] for s in zip(views, other)]  # noqa: B905
    found = calibrate_from_corners(*mixed, BOARD, FLAT)
    assert found.apart == (1, 4, 7, 10)
    assert_allclose(found.rig.baseline, np.linalg.norm(m.t_right_left), rtol=0.01)


@pytest.mark.statistical
@pytest.mark.parametrize("counts", [(7, 7), (6, 6)])
def test_every_pair_of_a_square_board_is_used_whichever_way_a_camera_sees_it(scene_maker, rng, counts):
    """Cameras near to each other: what a pair tells of their distance scatters by more than a tenth of it."""
    board = Board(counts, 6e-3)
    scene = scene_maker(n_views=16, inner_corners=counts, square=6e-3)
    near = rotation_from_vector(np.array([0.0, -0.06, 0.0]))
    m = replace(scene.model, R_right_left=near, t_right_left=np.array([-0.02, 0.0, 0.002]))
    views = corner_views(replace(scene, model=m), rng, 0.1)
    for turned in (0, 1):  # and the right camera upside down
        right = [view.reordered(board.orders[(turned + v // 3) % board.symmetry]) for v, view in enumerate(views[1])]
        found = calibrate_from_corners(views[0], right, board, CalibrationSettings("k1", "flat"))
        assert not found.apart
        assert found.assessment.pairs == 16
        assert found.rms_px < 0.2
        assert min(found.rig.left.fy, found.rig.right.fy) > 0


@pytest.mark.statistical
def test_views_of_one_place_count_once(scene_maker, views):
    once = calibrate_from_corners(*views, BOARD, FLAT)
    thrice = calibrate_from_corners(*[3 * side for side in views], BOARD, FLAT, table_view=14)
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
    scene = small_scene(scene_maker, n_views=12)
    again = corner_views(scene, np.random.default_rng(9))
    rest = calibrate_from_corners(*[a + b for a, b in zip(views, again, strict=True)], BOARD, FLAT)
    assert len(rest.rejected_views) == 12


def test_an_image_that_is_missing_makes_no_two_views_one(views):
    left, right = views
    left = [BoardNotFound("covered") if v == 3 else view for v, view in enumerate(left)]
    found = calibrate_from_corners(left, right, BOARD, FLAT)
    assert not found.rejected_views
    assert not found.apart
    assert not any("frame was lost" in text for text in found.warnings)


@pytest.mark.statistical
@pytest.mark.parametrize("zoom", [1.05, 0.95])
def test_a_lens_that_was_zoomed_between_the_views_is_named_and_costs_its_later_images(scene_maker, zoom):
    scene = scene_maker(n_views=20)
    m, board = scene.model, scene.board
    right = m.cameras[1]
    zoomed = replace(m, cameras=(m.cameras[0], replace(right, fx=zoom * right.fx, fy=zoom * right.fy)))
    left, before = corner_views(scene, np.random.default_rng(0))
    after = corner_views(replace(scene, model=zoomed), np.random.default_rng(1))[1]
    right_views = [*before[:12], *after[12:]]
    found = calibrate_from_corners(left, right_views, board, CalibrationSettings(board="flat"))
    (text,) = [text for text in found.warnings if "zoomed" in text]
    assert text.startswith("right 12, right 13")
    assert "the right camera was zoomed or focused anew" in text
    assert not any("camera was moved" in text for text in found.warnings)
    assert found.assessment.pairs == 12
    sigma = np.sqrt(np.diag(found.rig.covariance))
    assert abs(found.rig.right.fx - right.fx) < 4 * sigma[9]
    assert np.abs((found.rig.t_right_left - m.t_right_left) / sigma[21:24]).max() < 4


def test_images_of_half_the_size_are_no_better_a_calibration(scene_maker):
    """The same cameras with half the pixels, corners as uncertain in space: the same verdict, half the misfit in px."""
    scene = small_scene(scene_maker, n_views=12)
    m = scene.model
    half = tuple(
        replace(c, fx=c.fx / 2, fy=c.fy / 2, cx=c.cx / 2 - 0.25, cy=c.cy / 2 - 0.25, image_size=(120, 96))
        for c in m.cameras
    )
    found = []
    for model, sigma in ((m, 0.1), (replace(m, cameras=half), 0.05)):
        sides = corner_views(replace(scene, model=model), np.random.default_rng(2), sigma)
        found.append(calibrate_from_corners(*sides, BOARD, FLAT).assessment)
    whole, less = found
    assert less.verdict.split(":")[0] == whole.verdict.split(":")[0]
    assert_allclose(less.stereo_misfit_px, 0.5 * whole.stereo_misfit_px, rtol=0.05)
    assert_allclose(less.held_out_error, whole.held_out_error, rtol=0.05)
    # 0.1 px of 0.55 mm at each of two cameras 45 deg apart, less what the board's place takes up
    assert 0.03e-3 < whole.held_out_error < 0.3e-3
    assert all(part in whole.figures for part in ("mdeg", f"stereo misfit {whole.stereo_misfit_px:.4f} px"))


def test_a_rig_is_beyond_use_where_points_are_off_by_a_twentieth_of_their_distance(views):
    good = calibrate_from_corners(*views, BOARD, FLAT).assessment
    assert not good.beyond_use
    assert replace(good, triangulation_sigma=(0.06 * good.distance, 1.0)).beyond_use
    assert replace(good, held_out_error=0.06 * good.distance).beyond_use
    assert replace(good, triangulation_sigma=(float("nan"), 1.0)).beyond_use
