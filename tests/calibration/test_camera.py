"""The camera model against OpenCV's, its derivatives against differences, its inverse against itself."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from calibration import Camera, triangulate
from calibration.cameras.camera import N_RIG, normalise, normalised_maps, project, rotation_from_vector
from tests.oracles.drawn_boards import make_scene

CAMERA = Camera(1500.0, 1510.0, 250.0, 260.0, (-0.11, 0.15, 1e-3, -2e-3, 0.02), (512, 512))


@pytest.fixture
def rig():
    look = rotation_from_vector(np.array([1.0, 0.5, 0.2]))
    return make_scene().with_rig(left=CAMERA, R_left_world=look, t_left_world=np.array([0.0, 0.02, 0.5])).model.rig


def test_projection_is_opencvs(rng):
    points, zero = rng.uniform([-0.07, -0.07, 0.35], [0.07, 0.07, 0.5], (200, 3)), np.zeros(3)
    expected, _ = cv2.projectPoints(points, zero, zero, CAMERA.camera_matrix, np.array(CAMERA.distortion))
    assert_allclose(project(points, CAMERA), expected.reshape(-1, 2), atol=1e-10)


def test_a_point_behind_the_camera_has_no_image():
    assert np.isnan(project(np.array([[0.0, 0.0, -0.3], [0.0, 0.0, 0.0]]), CAMERA)).all()


@pytest.mark.parametrize("size", [(512, 512), (640, 48)])
def test_maps_of_whole_images_are_the_pixels_own_coordinates(size):
    wide = Camera(0.5 * size[0], 0.5 * size[0], 250.0, 20.0, (-0.2, 0.03, 1e-3, 1e-3, 0.0), size)
    grid = np.stack(np.meshgrid(np.arange(size[0]), np.arange(size[1])), axis=-1)
    for camera in (replace(CAMERA, image_size=size), wide):
        maps = np.stack(normalised_maps(camera), axis=-1)
        assert_allclose(project(np.dstack([maps, np.ones(size[::-1])]), camera), grid, atol=1e-9)


@pytest.mark.parametrize("focal", [300.0, 1000.0, 3000.0, 20000.0])
def test_every_pixel_has_a_ray_whatever_the_focal_length(focal, rng):
    """What ends the iteration keeps its result: the steps of a long lens are short in angle."""
    bends = -0.05, -1e-3 * (focal / 300) ** 4, 2e-4, -2e-4, 0.0
    camera = Camera(focal, 1.01 * focal, 250.0, 260.0, bends, (512, 512))
    pixels = rng.uniform(0, 511, (20, 500, 2))
    rays = np.array([normalise(some, camera) for some in pixels])  # the worst point ends the iteration of its company
    assert_allclose(project(np.insert(rays, 2, 1.0, axis=-1), camera), pixels, atol=1e-9)


def test_pixels_beyond_the_fold_of_a_lens_have_no_ray_and_spoil_no_other():
    folding = Camera(300.0, 300.0, 256.0, 256.0, (-0.5, 0.0, 0.0, 0.0, 0.0), (512, 512))
    x, _ = normalised_maps(folding)
    y_px, x_px = np.mgrid[:512, :512]
    r = np.hypot(x_px - 256, y_px - 256) / 300
    # r (1 - r^2 / 2) has its largest value 0.5443 at r = 0.816
    assert_array_equal(np.isfinite(x)[abs(r - 0.5443) > 1e-4], (r < 0.5443)[abs(r - 0.5443) > 1e-4])
    grid = np.array([[256.0, 256.0], [300.0, 200.0], [0.0, 0.0], [np.nan, 5.0]])
    rays = normalise(grid, folding)
    assert np.isnan(rays[2:]).all()
    assert_allclose(project(np.column_stack([rays[:2], np.ones(2)]), folding), grid[:2], atol=1e-9)


def test_rig_derivatives_agree_with_differences(rig, rng):
    world = rng.normal(scale=0.02, size=(4, 5, 3))
    pixels, d_world, d_rig = rig.project_with_jacobians(world)
    assert_allclose(pixels, rig.project(world), atol=1e-12)
    for k in range(N_RIG):
        step = np.zeros(N_RIG)
        step[k] = 1e-6
        numeric = (rig.perturbed(step).project(world) - rig.perturbed(-step).project(world)) / 2e-6
        assert_allclose(numeric, d_rig[..., k], atol=1e-6 * max(1.0, np.abs(d_rig[..., k]).max()))
    for k in range(3):
        step = np.zeros(3)
        step[k] = 1e-6
        numeric = (rig.project(world + step) - rig.project(world - step)) / 2e-6
        assert_allclose(numeric, d_world[..., k], atol=1e-6 * np.abs(d_world).max())


def test_triangulation_returns_the_point(rig, rng):
    world = rng.normal(scale=0.02, size=(30, 3))
    pixels = rig.project(world)
    pixels[0, 7] = np.nan
    found = triangulate(pixels, rig)
    assert np.isnan(found[7]).all()
    assert_allclose(np.delete(found, 7, axis=0), np.delete(world, 7, axis=0), atol=1e-12)
