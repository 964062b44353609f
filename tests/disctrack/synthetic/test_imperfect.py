"""Imperfections of a scene do to the images what they say, and nothing where they are off."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from calibration import find_corners
from disctrack.synthetic import rig_of
from disctrack.synthetic.description import (
    BoardSettings,
    CameraSettings,
    ImperfectionSettings,
    RigSettings,
    Scene,
)
from disctrack.synthetic.optics import corner_rays, lens_rays
from disctrack.synthetic.recording import recording_toml
from disctrack.synthetic.sensor import sensor_pattern
from tests.rendering import render_board

SCENE = Scene(
    cameras=CameraSettings(image_size=(272, 272)),
    rig=RigSettings(mm_per_px=0.42),
    board=BoardSettings(square_mm=8.0),
)
FLAT_ON_TABLE = np.eye(3), np.array([0.0, 0.0, 3e-3])


def corners_of(imperfections):
    """(2 cameras, 54, 2) of the board on the table, without noise."""
    scene = replace(SCENE, imperfections=imperfections)
    left, right = render_board(*FLAT_ON_TABLE, rig_of(scene), scene)[0]
    return np.stack([find_corners(image, (9, 6)).points for image in (left, right)])


@pytest.fixture(scope="module")
def plain():
    return corners_of(ImperfectionSettings())


def test_a_bowed_and_stretched_board_is_seen_where_its_points_are(plain):
    seen = corners_of(ImperfectionSettings(board_bow_mm=0.2, board_stretch=2e-3))
    x, y = np.meshgrid(np.arange(9) * 8e-3, np.arange(6) * 8e-3)
    flat = np.column_stack([x.ravel(), y.ravel(), np.full(54, 3e-3)])
    along = 1.002 * flat[:, 0]
    bent = np.column_stack([along, flat[:, 1], 3e-3 + 0.2e-3 * (1 - ((along - 32e-3) / 40e-3) ** 2)])
    rig = rig_of(SCENE)
    # two images quantised to whole grey values: 0.01 px each
    assert_allclose(seen - plain, rig.project(bent) - rig.project(flat), atol=0.03)
    assert np.abs(seen - plain).max() > 0.2


def test_lens_field_has_its_size_and_moves_the_image_by_it(plain):
    settings, rig = ImperfectionSettings(lens_field_px=0.2), rig_of(SCENE)
    camera, pad = rig.left, 3
    straight = corner_rays(camera, pad)
    bent = lens_rays(camera, pad, 0.2, [SCENE.seed, 9, 0])
    off = -(bent - straight)[pad:-pad, pad:-pad] * [camera.fx, camera.fy]  # near enough: weak distortion
    assert_allclose(off.std((0, 1)), 0.2, rtol=0.1)
    moved = corners_of(settings)[0] - plain[0]
    at = np.rint(plain[0] + 0.5).astype(int)
    assert_allclose(moved, off[at[:, 1], at[:, 0]], atol=0.06)  # the field varies over a square by as much


def test_sensor_pattern_is_fixed_and_has_its_size(rng):
    settings = ImperfectionSettings(pixel_gain=0.01, column_offset_dn=0.3, response_curve=0.03)
    pattern = sensor_pattern(settings, (400, 300), [1, 10, 0])
    flat = pattern.seen(np.full((300, 400), 127.5, np.float32))
    assert_allclose(flat.mean(), 127.5 + 0.03 * 255, atol=0.1)
    assert_allclose(flat.mean(0).std(), np.hypot(0.3, 135 * 0.01 / np.sqrt(300)), rtol=0.15)
    assert_allclose((flat - flat.mean(0)).std(), 1.35, rtol=0.02)
    assert_array_equal(sensor_pattern(settings, (400, 300), [1, 10, 0]).gain, pattern.gain)


def test_off_by_default_and_declared_only_where_exact():
    assert sensor_pattern(ImperfectionSettings(), (40, 30), [1]) is None
    assert lens_rays(rig_of(SCENE).left, 3, 0.0, [1]) is corner_rays(rig_of(SCENE).left, 3)
    assert "square_tolerance_mm = 0.0" in recording_toml(Scene())
    assert "tolerance" not in recording_toml(replace(Scene(), imperfections=ImperfectionSettings(pixel_gain=0.01)))
