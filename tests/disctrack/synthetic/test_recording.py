"""Rendered images and recordings: shapes where OpenCV projects them; what was planted shows there and nowhere else."""

import tomllib
from dataclasses import replace

import cv2
import h5py
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial import ConvexHull

from calibration import find_corners
from calibration.rig_file import read_rig_group
from disctrack.commands.sample import SCENE
from disctrack.disc import MA_2014
from disctrack.errors import OutputError, SceneError
from disctrack.faults.keys import CameraFault, Faults, Occluder
from disctrack.frames import rotation_from_euler
from disctrack.recording.declaration import read_recording
from disctrack.synthetic import description
from disctrack.synthetic.cameras import rig_of
from disctrack.synthetic.motion import motion_of
from disctrack.synthetic.optics import corner_rays, digitise, sensor_pattern
from disctrack.synthetic.recording import recording_toml, run_render
from tests.rendering import expected_disc, render_board, render_disc

PLAIN = description.Scene().changed(
    appearance=dict.fromkeys(("table", "table_streaks", "table_blotches"), 0.0),
    light={"directed": 0.0},
    optics={"vignetting": 0.0},
)
POSES = [
    [0.032, 0.020, 0.0045, 0.3, np.radians(0.5), 1.0],
    [0.030, 0.022, 0.011, 2.2, np.radians(15.0), -2.0],
    [0.034, 0.018, 0.025, -1.9, np.radians(40.0), 0.4],
    [0.033, 0.020, 0.037, 0.5, np.radians(75.0), 3.0],
]


@pytest.fixture(scope="module")
def rig():
    # stronger lenses than the default, so that the inverse of the distortion has work to do
    lens = description.RigSettings(k1=(-0.25, 0.2), k2=(0.5, -0.4), p1=(2e-3, -2e-3), p2=(-2e-3, 2e-3), k3=(0.3, 0.0))
    return rig_of(replace(PLAIN, rig=lens))


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
    without = PLAIN.changed(appearance={"dot": PLAIN.appearance.paper})
    light, seen = (expected_disc(q, rig, MA_2014, scene)[0, index].astype(float) for scene in (without, PLAIN))
    dark = light - seen
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
    scene = PLAIN.changed(appearance=dict.fromkeys(("paper", "dot", "rim", "side", "underside"), 200.0))
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
    board = {"board_white": 0.0, "board_black": 200.0}
    fine = PLAIN.changed(appearance=board, cameras={"bit_depth": 16}, render={"subpixels": 5})
    R = rotation_from_euler(0.4, 0.3, -0.2)
    t = np.array([0.002, 0.004, 0.012])
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


def test_an_error_of_the_lens_model_would_be_noticed(rig):
    q = POSES[1]
    R = rotation_from_euler(*q[3:])
    outline = circle(MA_2014.marker_centres_body[3], MA_2014.marker_diameter / 2) @ R.T + q[:3]
    k1, k2, p1, p2, k3 = rig.left.distortion
    wrong = replace(rig, left=replace(rig.left, distortion=(k1, k2, -p1, p2, k3)))
    shift = area_and_centroid(cv2_pixels(outline, wrong, 0))[1] - area_and_centroid(cv2_pixels(outline, rig, 0))[1]
    assert np.abs(shift).max() > 10e-3  # ten times the tolerance above


# both cameras straight above the table at half the usual size: image x is world i, 0.5 mm per pixel
ABOVE = PLAIN.changed(
    cameras={"image_size": (256, 256), "exposure_s": 0.001},
    rig=dict.fromkeys(("off_vertical_deg", "k1", "k2", "p1", "p2"), (0.0, 0.0))
    | {"mm_per_px": 0.5, "azimuth_deg": (-90.0, -90.0), "variation": 0.0},
    appearance={"rim": 190.0},
    optics={"blur_px": (0.8, 1.3)},
)
FLAT = np.array([0.032, 0.020, 0.001, 0.0, 0.0, 0.0])  # upper face at the target's height of 4 mm: 0.5 mm per pixel
DOT = 0  # at (26, 0) mm
AWAY = np.array([5.0, 0, 0, 0, 0, 0])  # out of sight


@pytest.fixture(scope="module")
def top_rig():
    return rig_of(ABOVE)


def dot_moments(image, around, half=12):
    """Centroid (x, y) and second central moments (xx, yy) of what is darker than the paper near a pixel."""
    x0, y0 = (np.rint(around) - half).astype(int)
    found = cv2.moments(190.0 - image[y0 : y0 + 2 * half + 1, x0 : x0 + 2 * half + 1].astype(float))
    centre = np.array([x0 + found["m10"] / found["m00"], y0 + found["m01"] / found["m00"]])
    return centre, np.array([found["mu20"], found["mu02"]]) / found["m00"]


def dot_pixel(q, top_rig):
    return top_rig.project(MA_2014.marker_centres_body[[DOT]] + q[:3])[:, 0]


def test_blur_adds_its_variance_and_that_of_the_pixel(top_rig):
    images = expected_disc(FLAT, top_rig, MA_2014, ABOVE)[0]
    for image, around, sigma in zip(images, dot_pixel(FLAT, top_rig), (0.8, 1.3), strict=True):
        _, second = dot_moments(image, around)
        radius_px = MA_2014.marker_diameter / 2 / 0.5e-3
        # a disc of radius R has second moments R^2 / 4; the point spread is cut at 4.5 sigma (1e-3 of its variance)
        assert_allclose(second, radius_px**2 / 4 + sigma**2 + 1 / 12, atol=5e-3)


@pytest.mark.parametrize("speed", [0.3, 1.5, 4.0])
def test_motion_blurs_along_the_path_by_its_length(speed, top_rig):
    qdot = np.array([speed, 0.0, 0.0, 0.0, 0.0, 0.0])
    still = expected_disc(FLAT, top_rig, MA_2014, ABOVE)[0, 0]
    moving = expected_disc(FLAT, top_rig, MA_2014, ABOVE, qdot=qdot)[0, 0]
    around = dot_pixel(FLAT, top_rig)[0]
    (c_still, m_still), (c_moving, m_moving) = dot_moments(still, around, 14), dot_moments(moving, around, 14)
    path_px = speed * ABOVE.cameras.exposure_s / 0.5e-3
    assert_allclose(c_moving, c_still, atol=1e-3)  # q is the pose at mid exposure
    assert_allclose(m_moving - m_still, [path_px**2 / 12, 0.0], atol=2e-3)


@pytest.mark.parametrize("bit_depth", [8, 10, 12, 16])
def test_noise_variance_is_a_straight_line_in_grey(bit_depth, rng):
    sensor = description.SensorSettings(gain_e_per_dn=50.0, read_noise_dn=0.8)
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
    defaults = description.SensorSettings()
    predicted = defaults.read_noise_dn**2 + mean / defaults.gain_e_per_dn + 1 / 12
    assert measured == pytest.approx(predicted, rel=0.02)  # 1.8 million values; the mean varies by +-3 grey levels


def test_full_well_clips_and_black_level_lifts():
    sensor = description.SensorSettings(black_level_dn=10.0)
    levels = digitise(np.array([[0.0, 100.0, 300.0]], np.float32), sensor, 8, None)
    assert_array_equal(levels, [[10, 110, 255]])


def test_vignetting_and_gradient_are_where_the_scene_puts_them(top_rig):
    light = description.LightSettings(gradient_per_m=(2.0, 0.0))
    scene = ABOVE.changed(appearance={"table": 100.0}, optics={"vignetting": 0.2}, light=light)
    away = FLAT + AWAY
    image = expected_disc(away, top_rig, MA_2014, scene)[0, 0]
    assert image[128, 128] == pytest.approx(100.0, abs=0.2)
    # 100 px to the right: 50.5 mm on the table (4 mm below the target), 10 % brighter; loss (100 / 180)^2 of 20 %
    assert image[128, 228] == pytest.approx(100 * (1 + 2 * 0.0505) * (1 - 0.2 * (100.5 / 180.3) ** 2), rel=2e-3)


def test_glare_stays_in_the_image_while_the_disc_moves(top_rig):
    spot = description.GlareSettings("right", (100.0, 80.0), 10.0, 30.0)
    glare = replace(ABOVE, light=description.LightSettings(directed=0.0, glare=(spot,)))
    poses = np.stack([FLAT, FLAT + np.array([0.01, 0.005, 0, 0, 0, 0])])
    added = expected_disc(poses, top_rig, MA_2014, glare) - expected_disc(poses, top_rig, MA_2014, ABOVE)
    assert_allclose(added[:, 0], 0.0, atol=1e-3)
    assert_allclose(added[0, 1], added[1, 1], atol=1e-3)
    assert added[0, 1, 80, 100] == pytest.approx(30.0, abs=1e-3)


def test_a_face_turned_to_the_lamp_is_brighter(top_rig):
    scene = replace(ABOVE, light=description.LightSettings(directed=0.5, direction=(0.0, 1.0, 1.0)))
    towards, away = FLAT.copy(), FLAT.copy()
    towards[3:5], away[3:5] = (np.pi, 0.3), (0.0, 0.3)  # e3 leans to +j, to -j
    images = expected_disc(np.stack([towards, away]), top_rig, MA_2014, scene)[:, 0]
    grey = images[:, 128, 128]  # paper: the dots are elsewhere
    assert_allclose(grey, 190 * (0.5 + 0.5 * (np.cos(0.3) + np.array([1, -1]) * np.sin(0.3))), rtol=1e-3)


def test_hot_pixels_stay_where_they_are(top_rig):
    scene = replace(ABOVE, sensor=description.SensorSettings(hot_pixels=20, gain_e_per_dn=0.0, read_noise_dn=0.0))
    poses = np.stack([FLAT + AWAY] * 2)  # black table only
    first, second = render_disc(poses, top_rig, MA_2014, scene)[:, 0]
    assert 10 < np.count_nonzero(first) <= 20
    assert_array_equal(first, second)


ORDINARY = description.scene_from_tree(
    {"cameras": {"image_size": [272, 272]}, "rig": {"mm_per_px": 0.42}, "board": {"square_mm": 8.0}}
)


def corners_of(imperfections):
    """(2 cameras, 54, 2) of the board on the table, without noise."""
    scene = replace(ORDINARY, imperfections=imperfections)
    left, right = render_board(np.eye(3), [0.0, 0.0, 3e-3], rig_of(scene), scene)[0]
    return np.stack([find_corners(image, (9, 6)).points for image in (left, right)])


@pytest.fixture(scope="module")
def plain():
    return corners_of(description.ImperfectionSettings())


def test_a_bowed_and_stretched_board_is_seen_where_its_points_are(plain):
    seen = corners_of(description.ImperfectionSettings(board_bow_mm=0.2, board_stretch=2e-3))
    x, y = np.meshgrid(np.arange(9) * 8e-3, np.arange(6) * 8e-3)
    flat = np.column_stack([x.ravel(), y.ravel(), np.full(54, 3e-3)])
    along = 1.002 * flat[:, 0]
    bent = np.column_stack([along, flat[:, 1], 3e-3 + 0.2e-3 * (1 - ((along - 32e-3) / 40e-3) ** 2)])
    rig = rig_of(ORDINARY)
    # two images quantised to whole grey values: 0.01 px each
    assert_allclose(seen - plain, rig.project(bent) - rig.project(flat), atol=0.03)
    assert np.abs(seen - plain).max() > 0.2


def test_lens_field_has_its_size_and_moves_the_image_by_it(plain):
    settings, rig = description.ImperfectionSettings(lens_field_px=0.2), rig_of(ORDINARY)
    camera, pad = rig.left, 3
    straight = corner_rays(camera, pad)
    bent = corner_rays(camera, pad, 0.2, (ORDINARY.seed, 9, 0))
    off = -(bent - straight)[pad:-pad, pad:-pad] * [camera.fx, camera.fy]  # near enough: weak distortion
    assert_allclose(off.std((0, 1)), 0.2, rtol=0.1)
    moved = corners_of(settings)[0] - plain[0]
    at = np.rint(plain[0] + 0.5).astype(int)
    assert_allclose(moved, off[at[:, 1], at[:, 0]], atol=0.06)  # the field varies over a square by as much


def test_sensor_pattern_is_fixed_and_has_its_size(rng):
    settings = description.ImperfectionSettings(pixel_gain=0.01, column_offset_dn=0.3, response_curve=0.03)
    pattern = sensor_pattern(settings, (400, 300), [1, 10, 0])
    even = np.full((300, 400), 127.5, np.float32)
    flat = pattern(even)
    assert_allclose(flat.mean(), 127.5 + 0.03 * 255, atol=0.1)
    assert_allclose(flat.mean(0).std(), np.hypot(0.3, 135 * 0.01 / np.sqrt(300)), rtol=0.15)
    assert_allclose((flat - flat.mean(0)).std(), 1.35, rtol=0.02)
    assert_array_equal(sensor_pattern(settings, (400, 300), [1, 10, 0])(even), flat)


def test_off_by_default_and_declared_only_where_exact():
    even = np.full((30, 40), 127.5, np.float32)
    assert sensor_pattern(description.ImperfectionSettings(), (40, 30), [1])(even) is even
    assert_array_equal(corner_rays(rig_of(ORDINARY).left, 3, 0.0, (1,)), corner_rays(rig_of(ORDINARY).left, 3))
    assert "square_tolerance_mm = 0.0" in recording_toml(description.Scene())
    uneven = description.Scene(imperfections=description.ImperfectionSettings(pixel_gain=0.01))
    assert "tolerance" not in recording_toml(uneven)


SMALL = description.Scene(name="small", motion=description.MotionSettings("table", table="motion.csv")).changed(
    cameras={"image_size": (256, 256), "n_frames": 4},
    rig={"mm_per_px": 0.5},
    board={"n_views": 3},
    light={"directed": 0.0},
)
VELOCITY = np.array([0.5, -0.3, 0.0, 10.0, 1.0, -5.0])  # m/s, rad/s
START = np.array([0.032, 0.020, 0.012, 0.5, 0.3, 0.7])


@pytest.fixture
def scene(tmp_path):
    time = np.linspace(-0.01, 0.02, 31)
    np.savetxt(tmp_path / "motion.csv", np.column_stack([time, START + time[:, None] * VELOCITY]), delimiter=",")
    return replace(SMALL, folder=tmp_path)


def images(folder, camera, n=4):
    return np.stack([cv2.imread(str(folder / camera / f"{i:06d}.png"), cv2.IMREAD_UNCHANGED) for i in range(n)])


def dot_offsets_px(folder, camera_index, expected_px):
    """Centroids of the dots in the first frame minus the pixels expected of their centres, (m, 2)."""
    image = images(folder, ("left", "right")[camera_index], 1)[0].astype(float)
    found = []
    for x, y in np.rint(expected_px).astype(int):
        of = cv2.moments(np.clip(150.0 - image[y - 8 : y + 9, x - 8 : x + 9], 0, None))
        found.append([x - 8 + of["m10"] / of["m00"], y - 8 + of["m01"] / of["m00"]])
    return np.array(found) - expected_px


@pytest.mark.statistical
def test_recording_round_trip(scene, tmp_path):
    truth = run_render(scene, tmp_path / "r")
    recording = read_recording(tmp_path / "r")
    assert recording.name == "small"
    assert recording.frame_rate == 1000.0
    assert_allclose(recording.disc.marker_centres_body, scene.declared_disc.marker_centres_body, atol=1e-9)
    assert recording.table.board_thickness == pytest.approx(0.003)
    assert images(tmp_path / "r", "left").shape == (4, 256, 256)
    assert len(list((tmp_path / "r/calibration/right").iterdir())) == 3
    with h5py.File(tmp_path / "r/truth.h5") as file:
        for name in ("time", "q", "qdot", "q_right", "markers_px"):
            assert_array_equal(file[name], getattr(truth, name))
        assert_array_equal(file["disc/marker_centres_body"], truth.disc.marker_centres_body)
        assert file["disc"].attrs["radius"] == truth.disc.radius
        assert_array_equal(file["board/t_world_board"], truth.t_world_board)
        assert_array_equal(read_rig_group(file["rig"]).R_left_world, truth.rig.R_left_world)
        assert description.scene_from_tree(tomllib.loads(file.attrs["scene"])).board == scene.board
    assert_allclose(truth.q, START + truth.time[:, None] * VELOCITY, atol=1e-12)
    assert_allclose(truth.qdot, np.tile(VELOCITY, (4, 1)), atol=1e-9)
    assert_allclose(truth.markers_px, truth.rig.project(markers_world(truth.q, truth.disc)), atol=1e-9)


def markers_world(q, disc):
    R = rotation_from_euler(*q[:, 3:].T)
    return disc.marker_centres_body @ np.swapaxes(R, -1, -2) + q[:, None, :3]


def test_board_lies_with_the_side_of_dark_corners_on_the_left(scene, tmp_path):
    truth = run_render(scene, tmp_path / "r")
    squares = np.array([[-0.5, -0.5], [-0.5, 5.5], [8.5, -0.5], [8.5, 5.5]]) * 8e-3  # dark, dark, light, light
    points = np.column_stack([squares, np.full(4, 3e-3)])
    for camera, name in enumerate(("left", "right")):
        image = cv2.imread(str(tmp_path / "r/calibration" / name / "00.png"), cv2.IMREAD_GRAYSCALE)
        u, v = np.rint(truth.rig.project(points)[camera]).astype(int).T
        assert_array_equal(image[v, u] < 110, [True, True, False, False])


def test_a_recording_declares_the_disc_of_any_scene_as_it_is(tmp_path):
    places = tuple((12.3456789 * np.cos(a), 12.3456789 * np.sin(a)) for a in (0.1, 1.3, 3.1, 4.4))
    markers = {"diameter_mm": 5.123456, "centres_mm": places}
    scene = SMALL.changed(name='the "third"\\\n run', markers=markers)
    (tmp_path / "recording.toml").write_text(recording_toml(scene))
    recording = read_recording(tmp_path)
    assert recording.name == scene.name
    assert_array_equal(recording.disc.marker_centres_body, scene.declared_disc.marker_centres_body)


def test_faults_never_show_in_recording_toml(scene):
    left = CameraFault(rotation_deg=(0.1, 0.0, 0.0))
    faults = Faults(right_delay_s=1e-4, frame_rate_hz=990.0, misprint_sigma_mm=0.1, hidden_markers=(2,), left=left)
    assert recording_toml(replace(scene, faults=faults)) == recording_toml(scene)


@pytest.mark.statistical
def test_same_scene_gives_the_same_files_on_any_number_of_threads_and_another_seed_another_rig(scene, tmp_path):
    first, second = (
        run_render(scene.changed(render={"threads": n}), tmp_path / name) for name, n in (("a", 1), ("b", 3))
    )
    assert_array_equal(images(tmp_path / "a", "right"), images(tmp_path / "b", "right"))
    assert_array_equal(first.markers_px, second.markers_px)
    other = rig_of(replace(scene, seed=2))
    for mine, theirs in zip(first.rig.cameras, other.cameras, strict=True):
        assert (mine.parameters[:4] != theirs.parameters[:4]).all()
    assert (np.abs(other.project(markers_world(first.q, first.disc)) - first.markers_px) > 1e-3).all()


@pytest.mark.statistical
@pytest.mark.parametrize(
    "faults",
    [
        Faults(right_delay_s=1e-3),
        Faults(left=CameraFault(rotation_deg=(0.0, 0.1, 0.0))),
        Faults(right=CameraFault(translation_mm=(0.5, 0.0, 0.0))),
        Faults(left=CameraFault(focal_scale=1.01, k1_change=0.05)),
        Faults(misprint_mm=tuple((0.1 * k, -0.1) for k in range(6)), pattern_offset_mm=(0.2, 0.3)),
    ],
    ids=["late", "turned", "moved", "another lens", "misprinted"],
)
def test_images_with_a_fault_show_the_dots_where_the_truth_has_them(scene, tmp_path, faults):
    """Where faults move dots is held against formulas of its own in test_enlarged."""
    truth = run_render(replace(scene, faults=faults), tmp_path / "r")
    for camera, pixels in enumerate(truth.markers_px[0]):
        # perspective shifts a dot's centroid from its centre's image by 0.02 px here, noise by less
        assert np.abs(dot_offsets_px(tmp_path / "r", camera, pixels)).max() < 0.06
    faultless = scene.declared_disc.marker_centres_body @ rotation_from_euler(*START[3:]).T + START[:3]
    assert np.abs(truth.markers_px[0] - rig_of(scene).project(faultless)).max() > 0.5
    assert_allclose(truth.q_right - truth.q, np.tile(VELOCITY * faults.right_delay_s, (4, 1)), atol=1e-12)


def test_wrong_frame_rate_stretches_the_motion(scene, tmp_path):
    truth = run_render(replace(scene, faults=Faults(frame_rate_hz=500.0)), tmp_path / "r")
    assert_allclose(np.diff(truth.time), 2e-3)
    assert_allclose(truth.q[3] - truth.q[0], VELOCITY * 6e-3, atol=1e-12)
    assert read_recording(tmp_path / "r").frame_rate == 1000.0


@pytest.mark.statistical
def test_hidden_dot_is_paper_and_occluder_is_dark(scene, tmp_path):
    rod = Occluder(camera="right", centre_px=(128.0, 100.0), width_px=10.0, grey=40.0, first_frame=2, last_frame=2)
    faulty = replace(scene, faults=Faults(hidden_markers=(3,), occluders=(rod,)))
    truth = run_render(faulty, tmp_path / "r")
    u, v = np.rint(truth.markers_px[0, 0, 3]).astype(int)
    assert images(tmp_path / "r", "left")[0, v, u] > 170
    right = images(tmp_path / "r", "right")
    assert_allclose(right[2, 97:104].mean(), 40.0, atol=1.5)
    assert right[1, 97:104].mean() > 70


def test_missing_frames_have_no_file(scene, tmp_path):
    run_render(replace(scene, faults=Faults(right=CameraFault(missing_frames=(1,)))), tmp_path / "r")
    assert sorted(p.name for p in (tmp_path / "r/right").iterdir()) == ["000000.png", "000002.png", "000003.png"]
    assert len(list((tmp_path / "r/left").iterdir())) == 4


def test_a_render_that_fails_leaves_nothing_behind_and_no_truth_is_replaced(scene, tmp_path):
    def stop(done, total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_render(scene, tmp_path / "r", progress=stop)
    assert not (tmp_path / "r").exists()
    assert not (tmp_path / "r.part").exists()
    (tmp_path / "mine.h5").write_text("data")
    with pytest.raises(OutputError, match="exists"):
        run_render(scene, tmp_path / "r", truth_path=tmp_path / "mine.h5")
    assert (tmp_path / "mine.h5").read_text() == "data"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[cameras]\nframe_rate = 3.0", r"unknown key 'frame_rate' in \[cameras\]; .* 'frame_rate_hz'"),
        ("sead = 3", "unknown key 'sead' in the top level; .* 'seed'"),
        ("[faults.left]\nrotation = [1, 2, 3]", r"unknown key 'rotation' in \[faults.left\]; .*'rotation_deg'"),
        ("[cameras]\nbit_depth = 9", "bit_depth = 9; expected 8, 10, 12, 16"),
        ("[cameras]\nn_frames = 2.5", "cameras.n_frames = 2.5 is of the wrong kind; expected int"),
        ("[rig]\ndistance_mm = [400.0]", "rig.distance_mm has 1 values, 2 are expected"),
        ("seed = ", "not valid TOML"),
        ('folder = "x"', "unknown key 'folder'"),
        ("[rig]\nmm_per_px = 0.0", r"rig.mm_per_px = 0.0; expected a number from 1e-07 to 1e\+07"),
        ("[markers]\ncentres_mm = [[36, 0], [0, 9], [9, 0]]", "a dot over the disc's rim"),
        ("[motion]\nposes = [[1, 2, 3]]", "motion.poses has 3 values, 6 are expected"),
        ("[light]\ndirection = [1, 0, 0]", "light.direction = .*; expected a lamp above the table"),
        ("[cameras]\nn_frames = 1000000000", r"cameras.n_frames = 1000000000; expected a number from 1 to 1e\+07"),
        ("[light]\ndirected = 1.5", "light.directed = 1.5; expected a number from 0 to 1"),
        ("[[light.glare]]\nsigma_px = 0.0", "light.glare.sigma_px = 0.0; expected a number from 1e-07"),
        ("[[faults.occluders]]\nwidth_px = -5.0", "faults.occluders.width_px = -5.0; expected a number from 1e-07"),
        ('[motion]\nkind = "table"\ntable = "nowhere.csv"', r"nowhere\.csv"),
    ],
)
def test_mistakes_in_a_scene_are_named(text, message, tmp_path):
    (tmp_path / "scene.toml").write_text(text)
    with pytest.raises(SceneError, match=message):
        motion_of(description.load_scene(tmp_path / "scene.toml"))


def test_a_lens_that_folds_is_refused():
    lens = SMALL.changed(rig={"k1": (-30.0, -30.0), "k2": (0.0, 0.0)})
    with pytest.raises(SceneError, match="folds inside the picture"):
        expected_disc(START, rig_of(lens), lens.declared_disc, lens)


def test_sample_clip_is_what_its_scene_renders(sample_clip):
    scene = description.load_scene(SCENE)
    with h5py.File(sample_clip.parent / "truth" / "clip.h5") as file:
        time, q, markers_px = (file[name][()] for name in ("time", "q", "markers_px"))
    rig, disc = rig_of(scene), scene.declared_disc
    assert (sample_clip / "recording.toml").read_text() == recording_toml(scene)
    assert_allclose(rig.project(markers_world(q, disc)), markers_px, atol=1e-9)
    assert_allclose(motion_of(scene)[0](time), q, atol=1e-9)  # integrator: 1e-11 relative
    stored = np.stack([images(sample_clip, name, 300)[-1] for name in ("left", "right")]).astype(float)
    again = expected_disc(q[-1], rig, disc, scene)[0]
    # grey levels: noise of variance 0.04 + 190 / 400 + 1 / 12 on the paper and less elsewhere; the last frame's motion
    # during 0.2 ms is 0.05 px and moves edges by less than the noise
    assert np.std(stored - again) < np.sqrt(0.04 + 190 / 400 + 1 / 12)
    assert abs(np.mean(stored - again)) < 0.05
