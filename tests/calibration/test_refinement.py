"""The joint refinement finds the minimum, the truth, and how far it may be from it."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from calibration import refine_stereo
from calibration.cameras.camera import N_RIG
from calibration.fit.pairing import FLOOR
from calibration.fit.priors import BEND, PARTS, VARIANCES, board_basis
from calibration.fit.refinement import minimise
from calibration.fit.start import start_stereo
from calibration.fit.stereo_model import N_STEREO, moved
from calibration.judge.pairs import compared
from calibration.judge.tolerances import rig_with_covariance, table_pose
from tests.oracles.drawn_boards import make_scene, squared


def disturbed(scene, rng, size=1.0):
    """A start a few px and degrees off."""
    n = len(scene.model.R_left_board)
    stereo = np.zeros(24)
    stereo[[0, 1, 9, 10]] = rng.normal(size=4) * 20 * size
    stereo[[2, 3, 11, 12]] = rng.normal(size=4) * 5 * size
    stereo[18:21], stereo[21:24] = rng.normal(size=3) * 0.01 * size, rng.normal(size=3) * 2e-3 * size
    poses = rng.normal(size=(n, 1, 6)) * np.array([0.02, 0.02, 0.02, 1e-3, 1e-3, 1e-3]) * size
    return replace(moved(scene.model, stereo, poses, np.zeros_like(scene.model.points)), points=scene.board.points)


def parameters(model):
    return np.concatenate([*(camera.parameters for camera in model.rig.cameras), model.rig.t_right_left])


def rig_error(found, truth):
    """(30,) difference of two rigs in RIG_PARAMETERS, rotation vectors from the left."""

    names = ("R_right_left", "t_right_left", "R_left_world", "t_left_world")
    pairs = [(getattr(found, name), getattr(truth, name)) for name in names]
    intrinsics = [a.parameters - b.parameters for a, b in zip(found.cameras, truth.cameras, strict=True)]
    places = [Rotation.from_matrix(a @ b.T).as_rotvec() if a.ndim == 2 else a - b for a, b in pairs]
    return np.concatenate([*intrinsics, *places])


def true_rig(scene, view, thickness):
    m = scene.model
    R, t = table_pose(m.R_left_board[view, 0], m.t_left_board[view, 0], thickness)
    found = refine_stereo(scene.observations(1e-3), m, scene.board.points)
    covariance = rig_with_covariance(found, view, thickness, 1.0).covariance
    return replace(m.rig, R_left_world=R, t_left_world=t, covariance=covariance)


def test_a_minimum_is_one_where_only_rounding_is_left_to_gain(rng):
    """No tolerance can be met where rounding moves chi-square by more: pixels 0.7 wide ended so, in a warning."""
    scene = make_scene(n_views=8, inner_corners=(6, 5))
    found = refine_stereo(scene.observations(0.005), scene.model, scene.board.points)
    impossible = [
        minimise(found.problem, disturbed(scene, rng, size), tolerance=0.0, damping=1e-6, iterations=iterations)
        for size, iterations in ((0.01, 60), (0.01, 60), (0.01, 60), (1.0, 3))
    ]
    assert [m.converged for m in impossible] == [True, True, True, False]
    costs = [m.normal.cost for m in impossible]
    assert np.ptp(costs[:3]) < 1e-6 < costs[3] - costs[0]


def test_exact_corners_give_back_the_exact_rig(rng):
    scene = make_scene()
    o = scene.observations(1e-4)
    found = refine_stereo(o, disturbed(scene, rng), scene.board.points)
    assert found.converged
    assert found.rms() < 1e-7  # round-off: pixels of size 500 in double precision, some 1e-13 each, ill-conditioned
    assert_allclose(parameters(found.model)[:4], parameters(scene.model)[:4], rtol=1e-7)
    assert_allclose(found.model.rig.t_right_left, scene.model.rig.t_right_left, atol=1e-9)


def rig_errors(scene, seeds, inflation=1.0):
    """Of each draw the errors of the rig's free parameters in sigmas, and their mean square by the whole covariance."""
    truth = true_rig(scene, 2, 3e-3)
    errors, squares = [], []
    for seed in range(seeds):
        o = scene.observations(0.02, np.random.default_rng(seed))
        rig = rig_with_covariance(refine_stereo(o, scene.model, scene.board.points), 2, 3e-3, inflation)
        free = np.diag(rig.covariance) > 0
        error = rig_error(rig, truth)[free]
        errors.append(error / np.sqrt(np.diag(rig.covariance)[free]))
        squares.append(squared(error, rig.covariance[np.ix_(free, free)]))
    return np.array(errors), np.mean(squares)


@pytest.mark.parametrize(
    "seeds", [pytest.param(12, marks=pytest.mark.statistical), pytest.param(200, marks=pytest.mark.slow)]
)
def test_squared_error_of_the_rig_equals_its_covariance(seeds):
    errors, mean = rig_errors(make_scene(n_views=10), seeds)
    # mean of n chi-squares of p degrees of freedom over p: scatter sqrt(2 / (n p))
    assert abs(mean - 1) < 4.0 * np.sqrt(2 / errors.size)
    each = np.mean(np.square(errors), axis=0)
    assert np.abs(each - 1).max() < 1.2 * 4.0 * np.sqrt(2 / seeds)  # every parameter by itself, 28 at once


@pytest.mark.statistical
def test_a_covariance_of_half_the_size_would_be_noticed():
    assert rig_errors(make_scene(n_views=10), 10, 0.5)[1] > 1.5


def test_thickness_of_the_board_moves_the_origin_down_and_couples_it_to_the_tilt():
    scene = make_scene(n_views=8)
    found = refine_stereo(scene.observations(0.02), scene.model, scene.board.points)
    thin, thick = (rig_with_covariance(found, 0, h, 1.0) for h in (0.0, 20e-3))
    assert_allclose(thick.t_left_world, thin.t_left_world - 20e-3 * thin.R_left_world[:, 2], atol=1e-12)
    # by central differences: the same step of the pose, seen through either thickness
    for axis in range(3):
        v = np.zeros(N_RIG)
        v[24 + axis] = 1e-6
        moved_thin = thin.perturbed(v)
        R, t = moved_thin.R_left_world, moved_thin.t_left_world
        shift = (table_pose(R, t, 20e-3)[1] - thick.t_left_world) / 1e-6
        arm = 20e-3 * thin.R_left_world[:, 2]
        assert_allclose(shift, np.cross(arm, np.eye(3)[axis]), atol=1e-6)


@pytest.mark.statistical
def test_gross_outliers_are_rejected_and_do_no_harm(rng):
    scene = make_scene(inner_corners=(6, 5))
    o = scene.observations(0.02, rng)
    clean = refine_stereo(o, disturbed(scene, rng), scene.board.points)
    bad = rng.choice(len(o), 15, replace=False)
    pixels = o.pixels.copy()
    pixels[bad] += rng.choice([-1, 1], (15, 2)) * rng.uniform(0.5, 5.0, (15, 2))
    dirty = refine_stereo(replace(o, pixels=pixels), disturbed(scene, rng), scene.board.points)
    assert not dirty.kept[np.isin(np.arange(len(o)), bad)].any()
    assert (~dirty.kept).sum() <= 17
    # 15 of 720 points fewer: far less than a standard deviation of change
    sigma = np.sqrt(np.diag(rig_with_covariance(clean, None, 0, 1.0).covariance))[:9]
    change = dirty.model.rig.cameras[0].parameters - clean.model.rig.cameras[0].parameters
    assert np.abs(change[sigma > 0] / sigma[sigma > 0]).max() < 1.0


def test_rejection_that_does_not_settle_leaves_a_fit_of_the_points_that_it_names(rng):
    scene = make_scene(n_views=8)
    o = scene.observations(0.05, rng)
    # beyond one sigma lie a third of all good points: each round strikes others
    found = refine_stereo(o, disturbed(scene, rng), scene.board.points, reject_beyond=1.0)
    assert len(found.problem.observations) == found.kept.sum()
    assert np.array_equal(found.problem.observations.pixels, found.observations.pixels[found.kept])


@pytest.mark.parametrize("aspect", [0.5, 1.33])
def test_pixels_that_are_not_square_are_no_hindrance_to_the_start(rng, aspect):
    scene = make_scene(n_views=10)
    cameras = tuple(
        replace(c, fy=c.fy * aspect, cy=c.cy * aspect, image_size=(512, int(512 * aspect)))
        for c in scene.model.rig.cameras
    )
    scene = scene.with_rig(left=cameras[0], right=cameras[1])
    o = scene.observations(0.02, rng)
    sizes = cameras[0].image_size, cameras[1].image_size
    begun, _, _ = start_stereo(o, scene.board, sizes, [("left", "right")] * 10)
    assert not compared(o, begun, None, FLOOR).apart
    found = refine_stereo(o, begun.joined(o), scene.board.points)
    left = found.model.rig.left
    assert_allclose(left.fy / left.fx, cameras[0].fy / cameras[0].fx, rtol=2e-3)


def test_a_bent_board_is_recovered(rng):
    flat = make_scene(n_views=12)
    bends = board_basis(flat.board.points)[..., :3] / BEND / 0.032  # half of eight squares of 8 mm
    scene = make_scene(n_views=12, deviation=bends @ np.array([0.15e-3, 0.05e-3, -0.1e-3]))
    o = scene.observations(0.02, rng)
    begun, _, _ = start_stereo(o, scene.board, ((512, 512), (512, 512)), [("left", "right")] * 12)
    assert not compared(o, begun, None, FLOOR).apart
    found = refine_stereo(o, begun.joined(o), scene.board.points)
    assert_allclose(found.model.points[:, 2], scene.model.points[:, 2], atol=5e-6)  # 0.02 px of 0.25 mm, 24 images each
    assert 0.9 < found.chi_square < 1.1


def test_a_flat_board_stays_flat_and_a_lens_without_distortion_has_none_within_its_sigma(rng):
    scene = make_scene(distortion=False)
    found = refine_stereo(scene.observations(0.02, rng), scene.model, scene.board.points)
    # a corner of one image scatters by 5 um, a bend or stretch from all of them by about 0.5 um
    assert np.abs(found.model.points - scene.board.points).max() < 1e-6
    distortion = np.concatenate([camera.distortion for camera in found.model.rig.cameras])
    of_distortion = [*range(4, 9), *range(13, 18)]
    C = found.normal.covariances()[0][np.ix_(of_distortion, of_distortion)]
    assert squared(distortion, C) < 2.96  # of 10 numbers: p = 0.001


@pytest.mark.parametrize("size", [0.0, 0.3])
def test_the_shape_of_a_board_is_the_mean_over_all_variances_by_their_likelihood(rng, size):
    board = make_scene(n_views=1, inner_corners=(4, 3)).board.points
    deviation = size * (board_basis(board) @ rng.normal(size=29))
    scene = make_scene(n_views=4, inner_corners=(4, 3), deviation=deviation)
    found = refine_stereo(scene.observations(0.05, rng), scene.model, board)
    prior, C = found.problem.prior, found.normal.covariances()[0][24:, 24:]
    for part in PARTS:
        shape, own = prior.shape(found.model)[part], np.linalg.inv(C[part, part]) / prior.weight
        H, y = own - prior.known[part, part], own @ shape - prior.towards[part]  # of the views alone
        S = [np.linalg.inv(H + np.eye(len(H)) / v) for v in VARIANCES]
        logs = [
            0.5 * (y @ s @ y - np.linalg.slogdet(np.eye(len(H)) + v * H)[1]) for s, v in zip(S, VARIANCES, strict=True)
        ]
        p, means = np.exp(logs - np.max(logs)) / np.sum(np.exp(logs - np.max(logs))), np.array(S) @ y
        between = np.einsum("k,ki,kj->ij", p, means - p @ means, means - p @ means)
        covariance = np.tensordot(p, S, 1) + between
        sigma = np.sqrt(np.diag(covariance))
        assert_allclose(shape / sigma, p @ means / sigma, atol=0.02)
        # in one direction of the misprints the variances differ by more than the views alone leave open
        lost = 0.1 if part == PARTS[2] else 0.02
        assert_allclose(np.sqrt(prior.weight * np.diag(C[part, part])) / sigma, 1.0, atol=lost)


def test_errors_common_to_a_view_inflate_the_covariance(rng):
    scene = make_scene(n_views=16)
    o = scene.observations(0.02, rng)
    quiet = refine_stereo(o, scene.model, scene.board.points).normal.disagreement(N_STEREO)
    shear = rng.normal(size=(16, 2, 2)) * 3e-4  # a bend of the images that changes from view to view
    centred = o.pixels - 256.0
    pixels = o.pixels + shear[o.view, o.camera] * centred[:, :1] * centred[:, 1:] / 256
    noisy = refine_stereo(replace(o, pixels=pixels), scene.model, scene.board.points).normal.disagreement(N_STEREO)
    assert 0.4 < quiet < 1.8  # 16 views: scatter of about 0.25
    assert noisy > 1.5 * quiet
