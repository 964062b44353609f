"""Grey values of any depth: their step, their full scale, saturation; corners do not depend on the unit of grey."""

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from calibration.board.chessboard import find_corners
from calibration.kit.grey_levels import full_scale, level_step, mosaic_gains, saturation_level


@pytest.mark.parametrize(("bits", "step"), [(8, 1), (8, 16), (8, 257), (10, 64), (12, 1), (12, 16), (16, 1)])
def test_step_and_full_scale_of_a_camera_are_found_from_its_grey_values(rng, bits, step):
    light = rng.uniform(0.02, 0.7, (64, 64))  # of full scale
    image = (step * np.rint(light * (2**bits - 1))).astype(np.uint16)
    assert level_step(image) == step
    assert full_scale(image) == step * (2**bits - 1)
    assert level_step(image.astype(np.uint8)) == 1


def test_images_of_few_values_have_no_step():
    assert level_step(np.full((8, 8), 4000, np.uint16)) == 1
    assert level_step(np.where(np.eye(8) > 0, 160, 4000).astype(np.uint16)) == 1


@pytest.mark.parametrize(("dtype", "level"), [(np.uint8, 255), (np.uint16, 4095), (np.uint16, 3700)])
def test_saturation_shows_where_pixels_are_clipped_and_only_there(rng, dtype, level):
    light = rng.normal(0.9 * level, 0.03 * level, (200, 200))
    light[:, :60] *= 0.2
    assert saturation_level(np.rint(light * 0.8).astype(dtype)) is None
    evenly = (level // 2 + rng.integers(0, 50, light.shape)).astype(dtype)  # hundreds of pixels at the largest value,
    assert saturation_level(evenly) is None  # and as many at every other
    clipped = np.minimum(np.rint(light * 1.1), level).astype(dtype)
    assert saturation_level(clipped) == level


@pytest.mark.parametrize("scale", [3, 16, 257])
def test_corners_do_not_depend_on_the_unit_of_grey(sample_clip, scale):
    image = cv2.imread(str(sample_clip / "calibration" / "left" / "03.png"), cv2.IMREAD_UNCHANGED)
    plain, scaled = find_corners(image, (9, 6)), find_corners(image.astype(np.uint16) * np.uint16(scale), (9, 6))
    assert_array_equal(scaled.points, plain.points)
    assert_array_equal(scaled.covariance, plain.covariance)


@pytest.mark.parametrize("gains", [[[0.75, 1.0], [1.0, 0.55]], [[1.02, 0.99], [0.99, 1.0]], [[1.0, 1.0], [1.0, 0.97]]])
def test_a_colour_filter_shows_in_every_image_of_a_scene_and_in_no_other(rng, gains):
    y, x = np.mgrid[:121, :161]
    light = 150 * (1 - x / 330) * (1 - y / 400) * np.where(np.hypot(x - 70, y - 60) < 15, 0.2, 1.0)  # falls off by half
    # columns of a sensor without a filter differ by 0.3 %
    plain = light * np.array([1.0, 1.003])[x % 2] + rng.normal(0, 1.0, (4, *light.shape))
    assert mosaic_gains(np.rint(plain).astype(np.uint8)) is None
    filtered = np.rint(plain * np.array(gains)[y % 2, x % 2]).astype(np.uint8)
    found = mosaic_gains(filtered)
    assert_allclose(found, np.array(gains) / np.mean(gains), atol=0.004)  # the columns, and rounding
    assert mosaic_gains(np.concatenate([filtered[:3], np.rint(plain[:1]).astype(np.uint8)])) is None
