"""Blur, motion, light and noise of rendered images have the sizes that the scene names."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from disctrack import synthetic
from disctrack.disc import MA_2014
from disctrack.synthetic.description import (
    AppearanceSettings,
    CameraSettings,
    GlareSettings,
    LightSettings,
    OpticsSettings,
    RigSettings,
    Scene,
    SensorSettings,
)
from disctrack.synthetic.sensor import digitise
from tests.rendering import expected_disc, render_disc

# both cameras straight above the table at half the usual size: image x is world i, 0.5 mm per pixel
ABOVE = Scene(
    cameras=CameraSettings(image_size=(256, 256), exposure_s=0.001),
    rig=RigSettings(
        mm_per_px=0.5,
        off_vertical_deg=(0.0, 0.0),
        azimuth_deg=(-90.0, -90.0),
        k1=(0.0, 0.0),
        k2=(0.0, 0.0),
        p1=(0.0, 0.0),
        p2=(0.0, 0.0),
        variation=0.0,
    ),
    appearance=AppearanceSettings(table=0.0, table_streaks=0.0, table_blotches=0.0, rim=190.0),
    light=LightSettings(directed=0.0),
    optics=OpticsSettings(vignetting=0.0, blur_px=(0.8, 1.3)),
)
FLAT = np.array([0.032, 0.020, 0.001, 0.0, 0.0, 0.0])  # upper face at the target's height of 4 mm: 0.5 mm per pixel
DOT = 0  # at (26, 0) mm
AWAY = np.array([5.0, 0, 0, 0, 0, 0])  # out of sight


@pytest.fixture(scope="module")
def rig():
    return synthetic.rig_of(ABOVE)


def dot_moments(image, around, half=12):
    """Centroid (x, y) and second central moments (xx, yy) of what is darker than the paper near a pixel."""
    x0, y0 = (np.rint(around) - half).astype(int)
    found = cv2.moments(190.0 - image[y0 : y0 + 2 * half + 1, x0 : x0 + 2 * half + 1].astype(float))
    centre = np.array([x0 + found["m10"] / found["m00"], y0 + found["m01"] / found["m00"]])
    return centre, np.array([found["mu20"], found["mu02"]]) / found["m00"]


def dot_pixel(q, rig):
    return rig.project(MA_2014.marker_centres_body[[DOT]] + q[:3])[:, 0]


def test_blur_adds_its_variance_and_that_of_the_pixel(rig):
    images = expected_disc(FLAT, rig, MA_2014, ABOVE)[0]
    for image, around, sigma in zip(images, dot_pixel(FLAT, rig), (0.8, 1.3), strict=True):
        _, second = dot_moments(image, around)
        radius_px = MA_2014.marker_diameter / 2 / 0.5e-3
        # a disc of radius R has second moments R^2 / 4; the point spread is cut at 4.5 sigma (1e-3 of its variance)
        assert_allclose(second, radius_px**2 / 4 + sigma**2 + 1 / 12, atol=5e-3)


@pytest.mark.parametrize("speed", [0.3, 1.5, 4.0])
def test_motion_blurs_along_the_path_by_its_length(speed, rig):
    qdot = np.array([speed, 0.0, 0.0, 0.0, 0.0, 0.0])
    still = expected_disc(FLAT, rig, MA_2014, ABOVE)[0, 0]
    moving = expected_disc(FLAT, rig, MA_2014, ABOVE, qdot=qdot)[0, 0]
    around = dot_pixel(FLAT, rig)[0]
    (c_still, m_still), (c_moving, m_moving) = dot_moments(still, around, 14), dot_moments(moving, around, 14)
    path_px = speed * ABOVE.cameras.exposure_s / 0.5e-3
    assert_allclose(c_moving, c_still, atol=1e-3)  # q is the pose at mid exposure
    assert_allclose(m_moving - m_still, [path_px**2 / 12, 0.0], atol=2e-3)


def test_wrong_mid_exposure_would_be_noticed(rig):
    qdot = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    start = FLAT + qdot * ABOVE.cameras.exposure_s / 2  # q given at the exposure's end instead of its middle
    found, _ = dot_moments(expected_disc(start, rig, MA_2014, ABOVE, qdot=qdot)[0, 0], dot_pixel(FLAT, rig)[0])
    right, _ = dot_moments(expected_disc(FLAT, rig, MA_2014, ABOVE)[0, 0], dot_pixel(FLAT, rig)[0])
    assert found[0] - right[0] == pytest.approx(1.0, abs=0.01)  # px: half of 1 m/s for 1 ms at 0.5 mm per pixel


@pytest.mark.parametrize("bit_depth", [8, 10, 12, 16])
def test_noise_variance_is_a_straight_line_in_grey(bit_depth, rng):
    sensor = SensorSettings(gain_e_per_dn=50.0, read_noise_dn=0.8)
    grey = np.repeat(np.array([20.0, 85.0, 140.0, 190.0], np.float32), 40_000).reshape(4, 200, 200)
    levels = digitise(grey, sensor, bit_depth, rng)
    assert levels.dtype == (np.uint8 if bit_depth == 8 else np.uint16)
    step = 255 / (2**bit_depth - 1)
    values = levels * step
    variance = values.reshape(4, -1).var(axis=1)
    predicted = 0.8**2 + grey[:, 0, 0] / 50 + step**2 / 12
    # relative scatter of a variance of 40 000 values: sqrt(2 / 40 000) = 0.7 %
    assert_allclose(variance, predicted, rtol=4 * 0.0071)
    assert_allclose(values.reshape(4, -1).mean(axis=1), grey[:, 0, 0], atol=4 * np.sqrt(predicted.max() / 40_000))


def test_noise_resembles_the_reference_recording(shared_data):
    frames = [cv2.imread(str(shared_data / f"rec_a/left/{i:06d}.png"), cv2.IMREAD_GRAYSCALE) for i in range(60)]
    table = np.stack(frames)[:, :60, :].astype(float)  # upper strip: the disc does not get there
    measured, mean = table.var(axis=0, ddof=1).mean(), table.mean()
    defaults = SensorSettings()
    predicted = defaults.read_noise_dn**2 + mean / defaults.gain_e_per_dn + 1 / 12
    assert measured == pytest.approx(predicted, rel=0.02)  # 1.8 million values; the mean varies by +-3 grey levels


def test_full_well_clips_and_black_level_lifts():
    sensor = SensorSettings(black_level_dn=10.0)
    levels = digitise(np.array([[0.0, 100.0, 300.0]], np.float32), sensor, 8, None)
    assert_array_equal(levels, [[10, 110, 255]])


def test_vignetting_and_gradient_are_where_the_scene_puts_them(rig):
    paper = replace(ABOVE.appearance, table=100.0)
    scene = replace(
        ABOVE,
        appearance=paper,
        optics=replace(ABOVE.optics, vignetting=0.2),
        light=LightSettings(gradient_per_m=(2.0, 0.0)),
    )
    away = FLAT + AWAY
    image = expected_disc(away, rig, MA_2014, scene)[0, 0]
    assert image[128, 128] == pytest.approx(100.0, abs=0.2)
    # 100 px to the right: 50.5 mm on the table (4 mm below the target), 10 % brighter; loss (100 / 180)^2 of 20 %
    assert image[128, 228] == pytest.approx(100 * (1 + 2 * 0.0505) * (1 - 0.2 * (100.5 / 180.3) ** 2), rel=2e-3)


def test_glare_stays_in_the_image_while_the_disc_moves(rig):
    glare = replace(
        ABOVE, light=LightSettings(directed=0.0, glare=(GlareSettings("right", (100.0, 80.0), 10.0, 30.0),))
    )
    poses = np.stack([FLAT, FLAT + np.array([0.01, 0.005, 0, 0, 0, 0])])
    added = expected_disc(poses, rig, MA_2014, glare) - expected_disc(poses, rig, MA_2014, ABOVE)
    assert_allclose(added[:, 0], 0.0, atol=1e-3)
    assert_allclose(added[0, 1], added[1, 1], atol=1e-3)
    assert added[0, 1, 80, 100] == pytest.approx(30.0, abs=1e-3)


def test_a_face_turned_to_the_lamp_is_brighter(rig):
    scene = replace(ABOVE, light=LightSettings(directed=0.5, direction=(0.0, 1.0, 1.0)))
    towards, away = FLAT.copy(), FLAT.copy()
    towards[3:5], away[3:5] = (np.pi, 0.3), (0.0, 0.3)  # e3 leans to +j, to -j
    images = expected_disc(np.stack([towards, away]), rig, MA_2014, scene)[:, 0]
    grey = images[:, 128, 128]  # paper: the dots are elsewhere
    assert_allclose(grey, 190 * (0.5 + 0.5 * (np.cos(0.3) + np.array([1, -1]) * np.sin(0.3))), rtol=1e-3)


def test_hot_pixels_stay_where_they_are(rig):
    scene = replace(ABOVE, sensor=SensorSettings(hot_pixels=20, gain_e_per_dn=0.0, read_noise_dn=0.0))
    poses = np.stack([FLAT + AWAY] * 2)  # black table only
    first, second = render_disc(poses, rig, MA_2014, scene)[:, 0]
    assert 10 < np.count_nonzero(first) <= 20
    assert_array_equal(first, second)
