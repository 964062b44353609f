"""The rendered shapes are where OpenCV projects their outlines, to a thousandth of a pixel; and they have converged."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial import ConvexHull

from disctrack import synthetic
from disctrack.disc import MA_2014
from disctrack.frames import rotation_from_euler
from disctrack.synthetic import raster
from disctrack.synthetic.description import (
    AppearanceSettings,
    CameraSettings,
    LightSettings,
    OpticsSettings,
    RigSettings,
    Scene,
)
from tests.rendering import expected_disc, render_board

PLAIN = Scene(
    appearance=AppearanceSettings(table=0.0, table_streaks=0.0, table_blotches=0.0),
    light=LightSettings(directed=0.0),
    optics=OpticsSettings(vignetting=0.0),
)
POSES = np.column_stack(
    [
        [0.032, 0.030, 0.034, 0.033],
        [0.020, 0.022, 0.018, 0.020],
        [0.0045, 0.011, 0.025, 0.037],
        [0.3, 2.2, -1.9, 0.5],
        np.radians([0.5, 15.0, 40.0, 75.0]),
        [1.0, -2.0, 0.4, 3.0],
    ]
)


@pytest.fixture(scope="module")
def rig():
    # stronger lenses than the default, so that the inverse of the distortion has work to do
    lens = RigSettings(k1=(-0.25, 0.2), k2=(0.5, -0.4), p1=(2e-3, -2e-3), p2=(-2e-3, 2e-3), k3=(0.3, 0.0))
    return synthetic.rig_of(replace(PLAIN, rig=lens))


def cv2_pixels(points_world, rig, index):
    camera, (R, t) = rig.cameras[index], rig.camera_poses()[index]
    rotation_vector = cv2.Rodrigues(R)[0]
    pixels, _ = cv2.projectPoints(points_world, rotation_vector, t, camera.camera_matrix, np.array(camera.distortion))
    return pixels.reshape(-1, 2)


def area_and_centroid(shape):
    """Of an image, by its grey values, or of a closed polygon (n, 2)."""
    found = cv2.moments(shape.astype(np.float32) if shape.shape[1] == 2 else shape)
    return found["m00"], np.array([found["m10"], found["m01"]]) / found["m00"]


def circle(centre, radius, n=2000):
    angle = 2 * np.pi * np.arange(n) / n
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
    return np.asarray(centre) + radius * ring


def upper_face_visible(q, rig, index):
    R, t = rig.camera_poses()[index]
    eye = -R.T @ t - q[:3]
    return eye @ rotation_from_euler(*q[3:])[:, 2] > 1.2 * MA_2014.half_thickness


@pytest.mark.parametrize("index", [0, 1])
@pytest.mark.parametrize("q", POSES)
def test_dots_lie_where_opencv_projects_their_outlines(q, index, rig):
    if not upper_face_visible(q, rig, index):
        pytest.skip("this camera looks at the underside")
    without = replace(PLAIN, appearance=replace(PLAIN.appearance, dot=PLAIN.appearance.paper))
    dark = (
        expected_disc(q, rig, MA_2014, without)[0, index].astype(float)
        - expected_disc(q, rig, MA_2014, PLAIN)[0, index]
    )
    R = rotation_from_euler(*q[3:])
    for centre in MA_2014.marker_centres_body:
        outline = cv2_pixels(circle(centre, MA_2014.marker_diameter / 2) @ R.T + q[:3], rig, index)
        area, centroid = area_and_centroid(outline)
        low, high = np.floor(outline.min(axis=0)).astype(int) - 6, np.ceil(outline.max(axis=0)).astype(int) + 7
        window = dark[low[1] : high[1], low[0] : high[0]]
        mass, found = area_and_centroid(window)
        # float32 sums and second-order edges: measured 2e-4 px at worst
        assert_allclose(found + low, centroid, atol=1e-3)
        assert_allclose(mass / (190.0 - 25.0), area, rtol=1e-3, atol=0.02)


@pytest.mark.parametrize("index", [0, 1])
@pytest.mark.parametrize("q", POSES)
def test_silhouette_is_the_hull_of_both_projected_rims(q, index, rig):
    same = {name: 200.0 for name in ("paper", "dot", "rim", "side", "underside")}
    scene = replace(PLAIN, appearance=replace(PLAIN.appearance, **same))
    image = expected_disc(q, rig, MA_2014, scene)[0, index].astype(float)
    R = rotation_from_euler(*q[3:])
    rims = np.concatenate([circle([0, 0, z * MA_2014.half_thickness], MA_2014.radius) for z in (-1, 1)])
    points = cv2_pixels(rims @ R.T + q[:3], rig, index)
    # straight sides of the hull are bent by distortion by less than 0.01 px over the thickness
    area, centroid = area_and_centroid(points[ConvexHull(points).vertices])
    mass, found = area_and_centroid(image)
    assert_allclose(found, centroid, atol=2e-3)
    assert_allclose(mass / 200.0, area, rtol=1e-4)


@pytest.mark.parametrize("index", [0, 1])
def test_black_squares_lie_where_opencv_projects_them(index, rig):
    scene = replace(PLAIN, appearance=replace(PLAIN.appearance, board_white=0.0, board_black=200.0))
    R = rotation_from_euler(0.4, 0.3, -0.2)
    t = np.array([0.002, 0.004, 0.012])
    fine = replace(scene, cameras=CameraSettings(bit_depth=16), render=replace(scene.render, subpixels=5))
    image = render_board(R, t, rig, fine)[0, index] / (65535 / 255)
    total, moment = 0.0, np.zeros(2)
    for i in range(-1, 9):
        for j in range(-1, 6):
            if (i + j) % 2 == 0:
                side = np.linspace(0, 1, 50, endpoint=False)
                along = np.column_stack([side, 0 * side])
                square = np.concatenate([along, along[:, ::-1] + [1, 0], 1 - along, 1 - along[:, ::-1] - [1, 0]])
                corners = np.column_stack([(square + np.array([i, j])) * 8e-3, np.zeros(len(square))])
                area, centroid = area_and_centroid(cv2_pixels(corners @ R.T + t, rig, index))
                total, moment = total + area, moment + area * centroid
    mass, found = area_and_centroid(image)
    assert_allclose(found, moment / total, atol=1e-3)  # 16-bit rounding and 16 x 16 samples at corners: 1e-4 px
    assert_allclose(mass / 200, total, rtol=1e-4)


@pytest.mark.statistical
def test_edges_and_squares_have_converged(rig):
    board = rotation_from_euler(0.4, 0.3, -0.2), np.array([0.002, 0.004, 0.012])
    scenes = [replace(PLAIN, render=replace(PLAIN.render, subpixels=s)) for s in (5, 10)]
    coarse, fine = (expected_disc(POSES, rig, MA_2014, scene) for scene in scenes)
    assert np.abs(coarse - fine).max() < 0.1  # grey levels of 165
    deep = (replace(scene, cameras=CameraSettings(bit_depth=16)) for scene in scenes)
    coarse, fine = (render_board(*board, rig, scene).astype(int) for scene in deep)
    assert np.abs(coarse - fine).max() / 257 < 0.1  # grey levels of 180


def test_an_error_of_the_lens_model_would_be_noticed(rig):
    q = POSES[1]
    R = rotation_from_euler(*q[3:])
    outline = circle(MA_2014.marker_centres_body[3], MA_2014.marker_diameter / 2) @ R.T + q[:3]
    k1, k2, p1, p2, k3 = rig.left.distortion
    wrong = replace(rig, left=replace(rig.left, distortion=(k1, k2, -p1, p2, k3)))
    shift = area_and_centroid(cv2_pixels(outline, wrong, 0))[1] - area_and_centroid(cv2_pixels(outline, rig, 0))[1]
    assert np.abs(shift).max() > 10e-3  # ten times the tolerance above


def test_area_and_moments_of_a_half_plane_in_a_cell(rng):
    half_plane = raster.half_plane.py_func
    grid = (np.arange(500) + 0.5) / 500 - 0.5
    x, y = np.meshgrid(grid, grid)
    for f0, a, b in [*(rng.normal(size=(40, 3)) * [0.5, 1.0, 1.0]), (0.1, 1.0, 0.0), (0.1, 1e-4, -1.0)]:
        inside = f0 + a * x + b * y > 0
        sampled = [np.mean(inside), np.mean(inside * x), np.mean(inside * y)]
        assert_allclose(half_plane(f0, a, b), sampled, atol=2e-3)  # one line of 500 samples
        # with the other half it makes the whole square: area 1, moments 0
        assert_allclose(np.add(half_plane(f0, a, b), half_plane(-f0, -a, -b)), [1, 0, 0], atol=1e-9)
