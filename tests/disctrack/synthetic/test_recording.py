"""A rendered recording is a recording like any other; what was planted in it shows in its images and nowhere else."""

import tomllib
from dataclasses import replace

import cv2
import h5py
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from disctrack import synthetic
from disctrack.commands.sample import SCENE
from disctrack.errors import OutputError, SceneError
from disctrack.faults.keys import CameraFault, Faults, Occluder
from disctrack.frames import rotation_from_euler
from disctrack.recording.declaration import read_recording
from disctrack.synthetic.description import (
    BoardSettings,
    CameraSettings,
    LightSettings,
    MarkerSettings,
    MotionSettings,
    RigSettings,
    Scene,
    SensorSettings,
    load_scene,
    scene_from_tree,
)
from disctrack.synthetic.motion import motion_of
from disctrack.synthetic.truth import SCHEMA
from tests.rendering import expected_disc, render_disc

SMALL = Scene(
    name="small",
    cameras=CameraSettings(image_size=(256, 256), n_frames=4),
    rig=RigSettings(mm_per_px=0.5),
    board=BoardSettings(n_views=3),
    light=LightSettings(directed=0.0),
    motion=MotionSettings(kind="table", table="motion.csv"),
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


# perspective shifts a dot's centroid from its centre's image by 0.02 px here, noise by less
NOISE_PX = 0.06


@pytest.mark.statistical
def test_recording_round_trip(scene, tmp_path):
    truth = synthetic.write_recording(tmp_path / "r", scene)
    recording = read_recording(tmp_path / "r")
    assert recording.name == "small"
    assert recording.frame_rate == 1000.0
    assert_allclose(recording.disc.marker_centres_body, scene.declared_disc.marker_centres_body, atol=1e-9)
    assert recording.table.board_thickness == pytest.approx(0.003)
    assert images(tmp_path / "r", "left").shape == (4, 256, 256)
    assert len(list((tmp_path / "r/calibration/right").iterdir())) == 3
    again = synthetic.read_truth(tmp_path / "r/truth.h5")
    assert_array_equal(again.q, truth.q)
    assert_allclose(again.q, START + truth.time[:, None] * VELOCITY, atol=1e-12)
    assert_allclose(again.qdot, np.tile(VELOCITY, (4, 1)), atol=1e-9)
    with h5py.File(tmp_path / "r/truth.h5") as file:
        assert scene_from_tree(tomllib.loads(file.attrs["scene"])).board == scene.board
    assert_allclose(again.markers_px, truth.markers_px, atol=1e-9)
    assert_allclose(again.markers_px, truth.rig.project(markers_world(again)), atol=1e-9)


def markers_world(truth):
    R = rotation_from_euler(*truth.q[:, 3:].T)
    return truth.disc.marker_centres_body @ np.swapaxes(R, -1, -2) + truth.q[:, None, :3]


def test_board_lies_with_the_side_of_dark_corners_on_the_left(scene, tmp_path):
    truth = synthetic.write_recording(tmp_path / "r", scene)
    squares = np.array([[-0.5, -0.5], [-0.5, 5.5], [8.5, -0.5], [8.5, 5.5]]) * 8e-3  # dark, dark, light, light
    points = np.column_stack([squares, np.full(4, 3e-3)])
    for camera, name in enumerate(("left", "right")):
        image = cv2.imread(str(tmp_path / "r/calibration" / name / "00.png"), cv2.IMREAD_GRAYSCALE)
        u, v = np.rint(truth.rig.project(points)[camera]).astype(int).T
        assert_array_equal(image[v, u] < 110, [True, True, False, False])


def test_a_recording_declares_the_disc_of_any_scene_as_it_is(tmp_path):
    places = tuple((12.3456789 * np.cos(a), 12.3456789 * np.sin(a)) for a in (0.1, 1.3, 3.1, 4.4))
    scene = replace(SMALL, name='the "third"\\\n run', markers=MarkerSettings(diameter_mm=5.123456, centres_mm=places))
    (tmp_path / "recording.toml").write_text(synthetic.recording_toml(scene))
    recording = read_recording(tmp_path)
    assert recording.name == scene.name
    assert_array_equal(recording.disc.marker_centres_body, scene.declared_disc.marker_centres_body)


def test_faults_never_show_in_recording_toml(scene):
    faults = Faults(
        right_delay_s=1e-4,
        frame_rate_hz=990.0,
        misprint_sigma_mm=0.1,
        hidden_markers=(2,),
        left=CameraFault(rotation_deg=(0.1, 0.0, 0.0)),
    )
    assert synthetic.recording_toml(replace(scene, faults=faults)) == synthetic.recording_toml(scene)


@pytest.mark.statistical
def test_same_scene_gives_the_same_files_on_any_number_of_threads_and_another_seed_another_rig(scene, tmp_path):
    first, second = (
        synthetic.write_recording(tmp_path / name, replace(scene, render=replace(scene.render, threads=n)))
        for name, n in (("a", 1), ("b", 3))
    )
    assert_array_equal(images(tmp_path / "a", "right"), images(tmp_path / "b", "right"))
    assert_array_equal(first.markers_px, second.markers_px)
    other = synthetic.rig_of(replace(scene, seed=2))
    for mine, theirs in zip(first.rig.cameras, other.cameras, strict=True):
        assert (mine.parameters[:4] != theirs.parameters[:4]).all()
    assert (np.abs(other.project(markers_world(first)) - first.markers_px) > 1e-3).all()


def shift_of_faulty_dots(scene, tmp_path, faults, camera):
    """Dots of the first frame with the faults, minus where they would be without; checks that the images agree."""
    clean = synthetic.write_recording(tmp_path / "clean", scene)
    truth = synthetic.write_recording(tmp_path / "faulty", replace(scene, faults=faults))
    measured = dot_offsets_px(tmp_path / "faulty", camera, truth.markers_px[0, camera])
    assert np.abs(measured).max() < NOISE_PX  # the truth knows of it
    return truth.markers_px[0, camera] - clean.markers_px[0, camera]


@pytest.mark.statistical
def test_delayed_camera_sees_the_disc_later(scene, tmp_path):
    shift = shift_of_faulty_dots(scene, tmp_path, Faults(right_delay_s=1e-3), camera=1)
    truth = synthetic.read_truth(tmp_path / "faulty/truth.h5")
    assert_allclose(truth.q_right - truth.q, np.tile(VELOCITY * 1e-3, (4, 1)), atol=1e-12)
    assert np.abs(shift).max() > 0.5
    # the right camera's first frame is what the left's clock calls frame 1
    clean = synthetic.read_truth(tmp_path / "clean/truth.h5")
    assert_allclose(truth.markers_px[0, 1], clean.markers_px[1, 1], atol=1e-9)


def test_wrong_frame_rate_stretches_the_motion(scene, tmp_path):
    truth = synthetic.write_recording(tmp_path / "r", replace(scene, faults=Faults(frame_rate_hz=500.0)))
    assert_allclose(np.diff(truth.time), 2e-3)
    assert_allclose(truth.q[3] - truth.q[0], VELOCITY * 6e-3, atol=1e-12)
    assert read_recording(tmp_path / "r").frame_rate == 1000.0


def turned(camera, from_centre):
    """To the right: the picture moves left, by the focal length times the angle."""
    return np.array([-camera.fx * np.radians(0.1), 0.0])


def moved(camera, from_centre):
    """By parallax: 0.5 mm at 0.5 mm per pixel."""
    return np.array([-1.0, 0.0])


def changed(camera, from_centre):
    r2 = np.sum((from_centre / camera.fx) ** 2, axis=1, keepdims=True)
    return from_centre * (0.01 + 0.05 * r2)


@pytest.mark.statistical
@pytest.mark.parametrize(
    ("side", "fault", "expected", "tolerance"),
    [
        (0, CameraFault(rotation_deg=(0.0, 0.1, 0.0)), turned, (0.04, 0.03)),
        (1, CameraFault(translation_mm=(0.5, 0.0, 0.0)), moved, (0.15, np.inf)),  # nearer dots more
        (0, CameraFault(focal_scale=1.01, k1_change=0.05), changed, (0.01, 0.01)),
    ],
)
def test_what_happened_to_a_camera_shifts_its_picture(scene, tmp_path, side, fault, expected, tolerance):
    faults = Faults(**{("left", "right")[side]: fault})
    shift = shift_of_faulty_dots(scene, tmp_path, faults, side)
    clean = synthetic.read_truth(tmp_path / "clean/truth.h5")
    camera = clean.rig.cameras[side]
    from_centre = clean.markers_px[0, side] - [camera.cx, camera.cy]
    assert (np.abs(shift - expected(camera, from_centre)) <= tolerance).all()


@pytest.mark.statistical
def test_misprinted_dots_and_pattern_off_centre_shift_together(scene, tmp_path):
    misprint = tuple((0.1 * k, -0.1) for k in range(6))
    faults = Faults(misprint_mm=misprint, pattern_offset_mm=(0.2, 0.3))
    shift_of_faulty_dots(scene, tmp_path, faults, camera=0)
    truth = synthetic.read_truth(tmp_path / "faulty/truth.h5")
    moved = truth.disc.marker_centres_body - scene.declared_disc.marker_centres_body
    assert_allclose(moved[:, :2] * 1e3, np.array(misprint) + np.array([0.2, 0.3]), atol=1e-12)
    assert_allclose(truth.paper_centre_body, [2e-4, 3e-4])
    assert_allclose(
        read_recording(tmp_path / "faulty").disc.marker_centres_body, scene.declared_disc.marker_centres_body
    )


@pytest.mark.statistical
def test_hidden_dot_is_paper_and_occluder_is_dark(scene, tmp_path):
    rod = Occluder(camera="right", centre_px=(128.0, 100.0), width_px=10.0, grey=40.0, first_frame=2, last_frame=2)
    faulty = replace(scene, faults=Faults(hidden_markers=(3,), occluders=(rod,)))
    truth = synthetic.write_recording(tmp_path / "r", faulty)
    u, v = np.rint(truth.markers_px[0, 0, 3]).astype(int)
    assert images(tmp_path / "r", "left")[0, v, u] > 170
    right = images(tmp_path / "r", "right")
    assert_allclose(right[2, 97:104].mean(), 40.0, atol=1.5)
    assert right[1, 97:104].mean() > 70


def test_missing_frames_have_no_file(scene, tmp_path):
    synthetic.write_recording(tmp_path / "r", replace(scene, faults=Faults(right=CameraFault(missing_frames=(1,)))))
    assert sorted(p.name for p in (tmp_path / "r/right").iterdir()) == ["000000.png", "000002.png", "000003.png"]
    assert len(list((tmp_path / "r/left").iterdir())) == 4


def test_twelve_bits_are_written_as_such(scene, tmp_path):
    deep = replace(scene, cameras=replace(scene.cameras, bit_depth=12, n_frames=1))
    synthetic.write_recording(tmp_path / "r", deep)
    image = images(tmp_path / "r", "left", 1)
    assert image.dtype == np.uint16
    assert 190 / 255 * 4095 * 0.9 < np.percentile(image, 99) < 4095


@pytest.mark.statistical
def test_frame_shows_the_pose_of_its_mid_exposure(scene, tmp_path):
    quiet = replace(scene, sensor=SensorSettings(gain_e_per_dn=0.0, read_noise_dn=0.0))
    blurred = replace(quiet, cameras=replace(quiet.cameras, exposure_s=8e-4))
    truth = synthetic.write_recording(tmp_path / "r", blurred)
    still = render_disc(truth.q, truth.rig, truth.disc, quiet)
    moving = images(tmp_path / "r", "left")
    for frame, (u, v) in enumerate(np.rint(truth.markers_px[:, 0, 0]).astype(int)):
        window = np.s_[v - 9 : v + 10, u - 9 : u + 10]
        dots = [cv2.moments(190.0 - picture[window]) for picture in (still[frame, 0], moving[frame])]
        centres = [np.array([dot["m10"], dot["m01"]]) / dot["m00"] for dot in dots]
        # rounding to 8 bit: 0.003 px; the wrong end of the exposure would be 0.4 px away
        assert_allclose(centres[0], centres[1], atol=0.01)


def test_rolling_scene_starts_as_asked_and_knows_its_effects():
    rolling = replace(SMALL, cameras=replace(SMALL.cameras, n_frames=30), motion=MotionSettings(kind="rolling"))
    motion = motion_of(rolling)
    assert motion.n_frames == 30
    assert motion.simulated.model.values["km.k_m"] == pytest.approx(0.381e-7)
    q = motion.pose(np.arange(30) * 1e-3)
    assert np.degrees(q[0, 4]) == pytest.approx(20.0, abs=0.06)
    # the disc touches the table: z = r sin(theta) + h cos(theta)
    assert_allclose(q[:, 2], 0.0375 * np.sin(q[:, 4]) + 0.003 * np.cos(q[:, 4]), atol=1e-9)


def test_a_render_that_fails_leaves_nothing_behind_and_no_truth_is_replaced(scene, tmp_path):
    def stop(done, total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        synthetic.write_recording(tmp_path / "r", scene, progress=stop)
    assert not (tmp_path / "r").exists()
    assert not (tmp_path / "r.part").exists()
    (tmp_path / "mine.h5").write_text("data")
    with pytest.raises(OutputError, match="exists"):
        synthetic.write_recording(tmp_path / "r", scene, truth_path=tmp_path / "mine.h5")
    assert (tmp_path / "mine.h5").read_text() == "data"


def test_truth_of_another_file_is_refused(tmp_path):
    with h5py.File(tmp_path / "x.h5", "w") as file:
        file.attrs["schema"] = "something else"
    with pytest.raises(OutputError, match=SCHEMA):
        synthetic.read_truth(tmp_path / "x.h5")


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
        motion_of(load_scene(tmp_path / "scene.toml"))


def test_a_lens_that_folds_is_refused():
    lens = replace(SMALL, rig=replace(SMALL.rig, k1=(-30.0, -30.0), k2=(0.0, 0.0)))
    with pytest.raises(SceneError, match="folds inside the picture"):
        expected_disc(START, synthetic.rig_of(lens), lens.declared_disc, lens)


def test_sample_clip_is_what_its_scene_renders(sample_clip):
    scene = load_scene(SCENE)
    truth = synthetic.read_truth(sample_clip.parent / "truth" / "clip.h5")
    assert (sample_clip / "recording.toml").read_text() == synthetic.recording_toml(scene)
    assert_allclose(synthetic.rig_of(scene).project(markers_world(truth)), truth.markers_px, atol=1e-9)
    assert_allclose(motion_of(scene).pose(truth.time), truth.q, atol=1e-9)  # integrator: 1e-11 relative
    stored = np.stack([images(sample_clip, name, 300)[-1] for name in ("left", "right")]).astype(float)
    again = expected_disc(truth.q[-1], truth.rig, truth.disc, scene)[0]
    # grey levels: noise of variance 0.04 + 190 / 400 + 1 / 12 on the paper and less elsewhere; the last frame's motion
    # during 0.2 ms is 0.05 px and moves edges by less than the noise
    assert np.std(stored - again) < np.sqrt(0.04 + 190 / 400 + 1 / 12)
    assert abs(np.mean(stored - again)) < 0.05
