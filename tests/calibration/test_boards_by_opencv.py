"""Corners that OpenCV projects: boards that moved between exposures, cameras that moved between views, few views."""

import re
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

import calibration
from calibration import Board, BoardTolerances, calibrate_from_corners, calibrate_from_points, refine_stereo
from calibration.fit.board_motion import BoardMotion, motions
from calibration.fit.priors import BEND, MISPRINT, STRETCH, board_basis, priors_of
from calibration.fit.refinement import Problem
from calibration.fit.stereo_model import moved, predict_pixels
from calibration.judge.assessment import stereo_covariance
from calibration.judge.pairs import motion_between_exposures
from calibration.rig_file import read_rig_file, write_rig
from calibration.stereo import _observations
from tests.calibration.test_refinement import rig_error
from tests.oracles import moved_boards, point_laboratory
from tests.oracles.drawn_boards import make_scene, squared

BOARD = Board(moved_boards.INNER_CORNERS, moved_boards.SQUARE)
EXACT = BoardTolerances(square=0.0, flatness=0.0, thickness=0.0)


def calibrated_from(left, right, table_view=None):
    return calibrate_from_points(left, right, BOARD, moved_boards.IMAGE_SIZE, 0.1, EXACT, table_view)


def calibrated(rig, n, seed, **motion):
    return calibrated_from(*moved_boards.pairs(rig, n, seed, **motion))


def errors(found, rig):
    """Of intrinsics, of the pair's rotation and of its translation, and their covariance."""
    places = [*range(4), *range(9, 13), *range(18, 24)]
    return rig_error(found.rig, rig)[places], found.rig.covariance[np.ix_(places, places)]


@pytest.mark.parametrize("known", ["motion", "prior"])
def test_normal_equations_have_the_cost_and_the_gradient_that_they_say(rng, known):
    scene = make_scene(n_views=3, inner_corners=(4, 3))
    nominal, moving = scene.board.points, known == "motion"
    observations = scene.observations(0.1, rng)
    observations = observations[np.argsort(observations.view, kind="stable")]
    k = 12 if moving else 6
    deviation = 1e-4 * rng.normal(size=nominal.shape)
    model = moved(scene.model, 1e-4 * rng.normal(size=24), 1e-3 * rng.normal(size=(3, k // 6, 6)), deviation)
    basis = board_basis(nominal)
    prior = priors_of(scene.model, nominal, basis)
    problem = Problem(observations, np.linalg.inv(observations.covariance), basis, np.zeros(3, bool), prior)
    problem = {
        "motion": replace(problem, motion=BoardMotion(2e-3, 5e-4)),
        "prior": replace(problem, prior=replace(prior, weight=3.0)),
    }[known]

    def cost(model):
        r = observations.pixels - predict_pixels(model, observations)
        data = np.einsum("mi,mij,mj->", r, problem.weights, r)
        if problem.motion is not None:
            data += np.sum(motions(model)[0] ** 2 * problem.motion.weights)
        return data + problem.prior.normal(model)[-1, -1]

    normal = problem.linearise(model)
    assert_allclose(normal.cost, cost(model), rtol=1e-12)
    s = 24 + basis.shape[-1]
    for direction in rng.normal(size=(6, s + 3 * k)):
        squares = np.einsum("nii->ni", normal.products)[:, :-1]
        direction[:s] /= np.sqrt(squares[:, k:].sum(0) + np.diag(normal.prior)[:-1])
        direction[s:] /= np.sqrt(squares[:, :k].reshape(-1))
        shared, poses = 1e-3 * direction[:s], 1e-3 * direction[s:].reshape(3, k)
        there, back = (cost(problem.stepped(model, d * shared, d * poses)) for d in (1.0, -1.0))
        # turns of the motion count to first order: some 1e-3 of it here
        tolerance = 5e-6 * np.linalg.norm(direction)
        assert_allclose(-(there - back) / 4, normal.gain(shared, poses), rtol=5e-3, atol=tolerance)
    if not moving:
        behind = replace(model, t_left_board=model.t_left_board * [1, 1, -1])
        assert np.isinf(problem.linearise(behind).cost)


@pytest.mark.statistical
def test_cameras_and_pair_are_right_where_boards_moved_between_the_exposures():
    ratios, sizes = [], []
    for seed in range(6):
        rig = moved_boards.make_rig(seed)
        found = calibrated(rig, 10, seed, shift=0.5e-3, turn=0.5e-3)
        error, C = errors(found, rig)
        ratios.append((squared(error[-6:], C[-6:, -6:]), squared(error, C)))
        sizes.append(found.refinement.problem.motion)
        assert any("not synchronised" in text for text in found.warnings)
        assert not found.apart
        # each axis moves by 0.5 mm rms; the two poses share what moves along the common line of sight
        assert 0.4e-3 < found.assessment.motion.distance < 1.8e-3
        assert found.assessment.grade in ("usable", "poor")
        # one place of the board for both images, as of cameras that are triggered together
        r, model = found.refinement, found.refinement.model
        as_left = {name: getattr(model, name)[:, [0, 0]] for name in ("R_left_board", "t_left_board")}
        together = refine_stereo(r.observations, replace(model, **as_left), BOARD.points)
        by_one_place = rig_error(together.model.rig, rig)
        assert np.linalg.norm(error[[0, 1, 4, 5]]) < 0.8 * np.linalg.norm(by_one_place[[0, 1, 9, 10]])
    pair, everything = np.mean(ratios, axis=0)
    assert 0.5 < pair < 1.7  # chi-square of 36 at three sigma
    assert 0.6 < everything < 1.6
    assert_allclose([np.mean([m.shift for m in sizes]), np.mean([m.turn for m in sizes])], 0.5e-3, rtol=0.25)


@pytest.mark.statistical
def test_boards_that_were_held_still_count_for_more_than_those_that_moved():
    rig = moved_boards.make_rig(2)
    still, moving = (moved_boards.pairs(rig, 6, seed, shift=size, turn=size) for seed, size in ((1, 0.0), (2, 2e-3)))
    left, right = (np.concatenate(both) for both in zip(still, moving, strict=True))
    found = calibrated_from(left, right)
    pair_weights = found.refinement.problem.motion.pair_weights
    # a single board among those that move may be nearly at rest
    assert np.median(pair_weights[:6]) > 3.0 * np.median(pair_weights[6:])
    error, C = errors(found, rig)
    # the six still pairs alone
    alone, _ = errors(calibrated_from(left[:6], right[:6]), rig)
    assert np.all(np.abs(error) < 4 * np.sqrt(np.diag(C)))
    assert np.linalg.norm(error[[0, 1, 4, 5]]) < 1.5 * np.linalg.norm(alone[[0, 1, 4, 5]]) + 0.3


@pytest.mark.statistical
def test_pairs_that_were_synchronised_have_no_motion():
    for seed in range(3):
        rig = moved_boards.make_rig(seed)
        for correlation in (0.4, 0.0):
            found = calibrated(rig, 10, seed, correlation=correlation)
            assert found.refinement.problem.motion is None
            assert not found.assessment.motion.is_seen
            assert not any("synchronised" in text for text in found.warnings)
        # and where one is asked for, it is found to be next to nothing: 0.1 px are 0.07 mm here
        r = found.refinement
        asked = refine_stereo(r.observations, r.model, BOARD.points, motion=BoardMotion(1e-3, 1e-3))
        assert asked.problem.motion.shift < 0.1e-3
        assert asked.problem.motion.turn < 0.5e-3


@pytest.mark.statistical
@pytest.mark.parametrize("seed", [404, 416])
def test_a_field_of_the_lenses_is_no_motion_of_the_boards(seed, rng):
    plan, draws = point_laboratory.Plan(seed), np.random.default_rng([seed, 11])
    found = point_laboratory.calibration_of(plan, *point_laboratory.cameras_of(plan, draws), draws)
    assert found.rig.lens_field is not None
    assert found.refinement.problem.motion is None
    assert not any("synchronised" in text for text in found.warnings)
    # without the field it passes for one
    left, right = found.corner_views
    begun, points = found.refinement.model, found.board.points
    plain = refine_stereo(_observations((list(left), list(right))), begun, points)
    assert motion_between_exposures(plain)[0].is_seen
    # and boards that do move are still told: 0.1 px are 25 um here
    moving = [replace(view, points=view.points + 0.1 * rng.normal(size=2)) for view in right]
    both = calibrate_from_corners(left, moving, found.board, None, 0, 3e-3)
    assert_allclose(both.refinement.problem.motion.shift, 25e-6, rtol=0.5)
    assert any("synchronised" in text for text in both.warnings)


@pytest.mark.statistical
def test_motions_that_no_pair_shows_for_itself_are_in_the_sigma():
    ratios, sizes = [], []
    for seed in range(12):
        rig = moved_boards.make_rig(100 + seed)
        found = calibrated(rig, 5, seed, shift=0.1e-3, turn=0.1e-3)
        assert found.refinement.problem.motion is None
        sizes.append(motion_between_exposures(found.refinement)[0].size.shift)
        error, C = errors(found, rig)
        by_corners = stereo_covariance(found.refinement)[-6:, -6:]  # and by how the views disagree
        pair = error[-6:]
        ratios.append((squared(pair, C[-6:, -6:]), squared(error, C), squared(pair, by_corners)))
    pair, everything, without = np.mean(ratios, axis=0)
    assert 0.5 < pair < 1.5  # chi-square of 72 at three sigma
    assert 0.5 < everything < 1.5
    assert without > 1.5 * pair
    assert_allclose(np.median(sizes), 0.1e-3, rtol=0.4)
    at_rest = (calibrated(moved_boards.make_rig(seed), 8, seed).refinement for seed in range(3))
    assert max(motion_between_exposures(fit)[0].size.shift for fit in at_rest) < 0.02e-3


def test_a_rig_file_keeps_where_the_boards_were(tmp_path):
    found = calibrated(moved_boards.make_rig(1), 4, 1, shift=1e-3, turn=1e-3)
    assert found.refinement.model.apart.all()
    write_rig(tmp_path / "rig.h5", found)
    _, record = read_rig_file(tmp_path / "rig.h5")
    places = {name: record[name][:, None].repeat(2, axis=1) for name in ("R_left_board", "t_left_board")}
    model = replace(found.refinement.model, **places)
    o = calibration.Observations(*(record[name] for name in ("view", "camera", "point", "pixels", "pixels_covariance")))
    assert_allclose(o.pixels - predict_pixels(model, o), record["residuals"], atol=1e-9)
    assert [found.view_names[v] for v in record["apart"]] == list(found.view_names)


TOUCH = np.radians([0.05, -0.04, 0.03]), np.array([1e-4, 0.0, 0.0])  # 0.07 deg: 1.1 px


def calibrated_in_parts(parts, table_view=None, **motion):
    """parts : (rig, number of pairs) in the order in which the views are taken."""
    taken = [moved_boards.pairs(rig, n, 10 + k, **motion) for k, (rig, n) in enumerate(parts)]
    left, right = (np.concatenate(side) for side in zip(*taken, strict=True))
    return calibrated_from(left, right, table_view)


def pair_error(found, rig):
    """Squared error of how the cameras stand over its variance, per number."""
    error, C = errors(found, rig)
    return squared(error[-6:], C[-6:, -6:])


def told(found):
    return [text for text in found.warnings if "camera was moved" in text]


@pytest.fixture(scope="module")
def rig():
    return moved_boards.make_rig(3)


# turn and shift of the right camera before each further stretch; pairs in each; those that are apart; what is said
MOVES = {
    "touched": ([TOUCH], (12, 7), range(12, 19), "from left 12 and right 12 on", {}),
    "touched before the table": ([TOUCH], (12, 7), range(12), "those with the view on the table", {"table_view": 14}),
    "pushed by degrees, not synchronised": (
        [(np.radians([4.0, -1.0, 0.0]), [0.02, 0.0, 0.0])], (14, 9), range(14, 23), "", {"shift": 2e-3, "turn": 2e-3}
    ),
    "touched and turned": ([TOUCH, (10 * TOUCH[0][::-1], TOUCH[1])], (8, 6, 5), range(8, 19), "", {}),
}  # fmt: skip


@pytest.mark.statistical
@pytest.mark.parametrize("name", MOVES)
def test_a_camera_that_was_moved_between_the_views_is_named_and_sized(name, rig):
    moves, pairs, apart, said, how = MOVES[name]
    rigs = [rig]
    for move in moves:
        rigs.append(moved_boards.turned(rigs[-1], *move))
    found = calibrated_in_parts(list(zip(rigs, pairs, strict=True)), **how)
    (text,) = told(found)
    assert said in text
    steps = [float(size) for size in re.findall(r"by ([0-9.]+) deg", text)]
    sizes = [np.degrees(np.linalg.norm(turn)) for turn, _ in moves]
    assert_allclose(steps, sizes, rtol=0.03, atol=0.02)  # by medians of pairs that scatter by 0.03
    assert found.apart == tuple(apart)
    assert any("not synchronised" in other for other in found.warnings) == ("not synchronised" in name)
    kept, *others = rigs[::-1] if "table" in name else rigs
    assert pair_error(found, kept) < 3.0  # chi-square of six over six, at three sigma
    # negative control: another stretch is as far off as the camera was turned
    assert max(pair_error(found, other) for other in others) > 5.0


@pytest.mark.statistical
@pytest.mark.parametrize("motion", [{}, {"shift": 1e-3, "turn": 1e-3}, {"correlation": 0.6}])
def test_cameras_that_stood_still_are_not_said_to_have_moved(motion):
    for seed in range(4):
        found = calibrated_in_parts([(moved_boards.make_rig(seed), 16)], **motion)
        assert not told(found)
        assert not found.apart


def mean_square(n, rigs=16, displaced=None):
    """Squared error over stated variance of focal lengths, principal points and pair, mean over rigs."""
    found = []
    for seed in range(rigs):
        rig = moved_boards.make_rig(seed)
        points = None if displaced is None else moved_boards.board() + displaced[seed]
        calibration = calibrated_from(*moved_boards.pairs(rig, n, seed, correlation=0.4, points=points))
        found.append(squared(*errors(calibration, rig)))
    return np.mean(found)


def of_paper(size, rng, rigs=16):
    """(rigs, 54, 3) [m] deviations of boards by a fraction of the largest ones."""
    basis = board_basis(BOARD.points)
    return size * np.einsum("nij,rj->rni", basis, rng.normal(size=(rigs, basis.shape[-1])))


# with the most likely size of bends and of stretch: 1.8 with five views of paper
@pytest.mark.statistical
@pytest.mark.parametrize("size", [0.0, 0.3])
@pytest.mark.parametrize(("n", "most"), [(3, 2.0), (5, 1.5), (8, 1.4)])
def test_few_views_are_off_by_what_they_state(n, most, size, rng):
    assert 0.5 < mean_square(n, displaced=of_paper(size, rng)) < most


@pytest.mark.statistical
@pytest.mark.parametrize("size", [0.3, 0.03, 0.0])
def test_a_board_that_is_not_as_declared_is_in_the_sigmas(rng, size):
    assert 0.5 < mean_square(16, 12, of_paper(size, rng)) < 1.4


def test_what_is_known_of_a_board_is_its_bend_its_stretch_and_its_misprints():
    nominal = BOARD.points
    at = make_scene(n_views=1).model
    prior = priors_of(at, nominal, board_basis(nominal))

    def cost(points):
        own, declared = (prior.normal(replace(at, points=p))[-1, -1] for p in (points, nominal))
        return own - declared

    d, size = nominal - nominal.mean(0), 0.1  # half of eight squares of 25 mm
    stretched = nominal + STRETCH * d * [0.5, -0.5, 0.0]
    bent = nominal + BEND * size * (d[:, :1] / size) ** 2 * [0.0, 0.0, 1.0]
    for points in (stretched, bent):
        assert_allclose(cost(points), 1.0, rtol=1e-6)
    one = nominal.copy()
    one[20, 0] += size * MISPRINT
    # what of a single corner's misprint is no shift, turn, size or smooth shape of the board
    assert 0.85 < cost(one) < 1.0
