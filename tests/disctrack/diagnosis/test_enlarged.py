"""What a diagnosis found has a place in a scene: simulated, rendered or given to the next diagnosis, it acts again."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from calibration.cameras.camera import rotation_from_vector
from disctrack import diagnose, differentiate, simulate
from disctrack.diagnosis.model_file import declared_model, model_toml
from disctrack.diagnosis.motion import measurement_candidates
from disctrack.diagnosis.starts import first_state
from disctrack.faults.catalogue import scene_faults
from disctrack.faults.dots import predict
from disctrack.faults.keys import Faults
from disctrack.frames import rotation_from_euler
from disctrack.synthetic.cameras import rig_of
from disctrack.synthetic.description import load_scene
from disctrack.synthetic.motion import rolling_model, rolling_start
from disctrack.synthetic.recording import true_disc_of
from tests.disctrack.diagnosis.test_starts import sliding
from tests.oracles.measured_disc import measured, system_of


@pytest.fixture(scope="module")
def short():
    return measured(seed=61, n=60)


def saved(system, values, folder):
    path = folder / "model.toml"
    path.write_text(model_toml(system, values, "of any\n= name"))
    return path


def rolling_state(trajectory):
    return {n: v for n, v in first_state(differentiate(trajectory)).items() if not n.startswith("state.v_")}


@pytest.fixture
def everything_wrong(short, rng):
    """Every number of every fault of the measurement, some steps from null."""
    quantities = [q for c in measurement_candidates(short.disc) for q in c.quantities]
    size = {q.name: float(10 * q.scale * rng.uniform(0.5, 1.5)) for q in quantities}
    return {n: v if n.startswith("exposure") else v * rng.choice([-1, 1]) for n, v in size.items()}


def test_every_fault_of_the_measurement_survives_the_file(short, everything_wrong, tmp_path):
    system = system_of(short)
    values = rolling_state(short) | {"km.k_m": 3e-8} | everything_wrong
    _, again = declared_model(short, str(saved(system, values, tmp_path)))
    assert set(again) == set(everything_wrong)
    for name, value in everything_wrong.items():
        assert again[name] == pytest.approx(value, rel=1e-12), name  # degrees and back, 1 + change and back


def turned(vector_deg, points):
    return Rotation.from_rotvec(vector_deg, degrees=True).apply(points.reshape(-1, 3)).reshape(points.shape)


def seen_with(faults, rig, camera, points):
    """Pixels of points of the true table's world, one camera after the other moved and refocused, by OpenCV's lens."""
    lens, (R, t), fault = rig.cameras[camera], rig.camera_poses()[camera], (faults.left, faults.right)[camera]
    calibrated = turned([*faults.table_turn_deg, 0.0], points) + np.array([0.0, 0.0, 1e-3 * faults.table_height_mm])
    before = calibrated @ R.T + t - 1e-3 * np.array(fault.translation_mm)
    now = turned(-np.array(fault.rotation_deg), before)
    focal, middle = fault.focal_scale * np.array([lens.fx, lens.fy]), fault.principal_point_change_px
    matrix = np.array([[focal[0], 0.0, lens.cx + middle[0]], [0.0, focal[1], lens.cy + middle[1]], [0.0, 0.0, 1.0]])
    bent = np.array([lens.distortion[0] + fault.k1_change, *lens.distortion[1:]])
    return cv2.projectPoints(now.reshape(-1, 3), np.zeros(3), np.zeros(3), matrix, bent)[0].reshape(*now.shape[:-1], 2)


def test_images_of_a_faulty_scene_are_those_that_the_diagnosis_predicts(short, everything_wrong, tmp_path):
    """Cameras, table and dots are moved here by formulas that share nothing with those of the faults."""
    system = system_of(short)
    scene = load_scene(saved(system, rolling_state(short) | everything_wrong, tmp_path))
    rig, q, faults = rig_of(scene), short.q[:5], scene.faults
    centres = scene.declared_disc.marker_centres_body + np.pad(1e-3 * np.array(faults.misprint_mm), ((0, 0), (0, 1)))
    centres = turned([0.0, 0.0, faults.pattern_turn_deg], centres) * [faults.pattern_scale, faults.pattern_scale, 1.0]
    centres += 1e-3 * np.array([*faults.pattern_offset_mm, faults.pattern_height_mm])
    assert_allclose(true_disc_of(scene).marker_centres_body, centres, atol=1e-12)
    R = rotation_from_euler(*q[:, 3:].T)
    world = centres @ np.swapaxes(R, 1, 2) + q[:, None, :3]
    seen = np.stack([seen_with(faults, rig, camera, world) for camera in (0, 1)], axis=1)
    poses = np.stack([R, R]), np.stack([q[:, :3]] * 2)
    predicted, _ = predict(*poses, rig, short.disc, scene_faults(short.disc, everything_wrong))
    # arithmetic; the faults move the dots by some pixels
    assert_allclose(seen, predicted, atol=1e-9)
    plain, _ = predict(*poses, rig, short.disc, scene_faults(short.disc, {}))
    assert np.abs(plain - predicted).max() > 0.1


def test_a_saved_model_looks_at_the_disc_as_the_cameras_did(short, tmp_path):
    system = system_of(short)
    rig = rig_of(load_scene(saved(system, system.start(), tmp_path)))
    points = short.q[:3, None, :3] + [[0.0, 0.0, 0.0], [0.03, 0.0, 0.0], [0.0, 0.03, 0.0]]
    # principal points 4 px off the middle and focal lengths 0.5 % apart are not in a scene
    assert np.abs(rig.project(points) - short.rig.project(points)).max() < 20


@pytest.mark.statistical
def test_against_the_model_it_was_given_nothing_is_missing(tmp_path):
    """Found, saved, simulated anew with other noise, diagnosed against the saved model."""
    first = diagnose(measured(faults=Faults(table_turn_deg=(0.03, -0.02)), seed=62, n=150))
    (found,) = first.diagnosis.found
    assert "table_plane" in {found.candidate.name, *(r.candidate.name for r in found.cannot_be_told_from)}
    path = saved(first.system, first.diagnosis.after.values, tmp_path)
    scene = load_scene(path)
    model, start = rolling_model(scene), rolling_start(scene)
    again = measured(
        faults=scene.faults, seed=63, n=150, motion=lambda t: simulate(model, start, times=np.r_[0.0, t]).q[1:]
    )
    assert diagnose(again).diagnosis.verdict == "found"  # it is there ...
    second = diagnose(again, str(path))
    assert second.diagnosis.verdict == "nothing missing", second.sentence  # ... and known


@pytest.mark.statistical
def test_slip_at_the_start_is_part_of_the_saved_model(tmp_path):
    trajectory = measured(motion=sliding(0.2, (0.08, 0.04)), seed=64, n=120)
    first = diagnose(trajectory)
    path = saved(first.system, first.diagnosis.after.values, tmp_path)
    scene = load_scene(path)
    motion = simulate(rolling_model(scene), rolling_start(scene), 0.1)
    # noise 0.5 um a frame, some um from the rig
    assert np.abs(motion.q[:100, :3] - trajectory.q[:100, :3]).max() < 2e-5
    second = diagnose(trajectory, str(path))
    assert second.diagnosis.verdict == "nothing missing", second.sentence


def test_table_that_the_rim_levelled_wrongly_is_no_fault_of_the_saved_scene(short, tmp_path):
    """Paper on the face lifts the table by the rim; in the file the cameras stand above the one that is rolled on."""
    state = rolling_state(short)
    height, slope = -1e-4, 2e-3
    values = state | {"pattern_height.offset": 1e-4, "table_height.offset": height, "table_plane.tilt_x": slope}

    def eyes(rig):
        return np.array([-R.T @ t for R, t in rig.camera_poses()])

    levelled = system_of(replace(short, table_moved=(1e-4, 0.0, 2e-3)))
    scene = load_scene(saved(levelled, values, tmp_path))
    assert (scene.faults.table_height_mm, scene.faults.table_turn_deg) == (0.0, (0.0, 0.0))
    assert scene.faults.pattern_height_mm == pytest.approx(0.1)
    # from the board's axes to those of the table, which leans about x and lies lower
    lean = rotation_from_vector(np.array([slope, 0.0, 0.0]))
    assert_allclose(eyes(rig_of(scene)), (eyes(short.rig) - [0.0, 0.0, height]) @ lean, atol=1e-10)

    as_calibrated = system_of(short)  # nobody levelled it: a fault of the table view
    scene = load_scene(saved(as_calibrated, values, tmp_path))
    assert scene.faults.table_height_mm == pytest.approx(-0.1)
    assert_allclose(eyes(rig_of(scene)), eyes(short.rig), atol=1e-10)
