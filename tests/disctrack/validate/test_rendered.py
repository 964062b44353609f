"""Render, calibrate, measure, compare: small recordings meet the claim, and a validation notices where it fails."""

import json
from dataclasses import replace

import numpy as np
import pytest

from disctrack.faults.keys import CameraFault, Faults
from disctrack.frames import rotation_from_euler
from disctrack.recording.declaration import read_recording
from disctrack.synthetic.cameras import rig_of
from disctrack.track.dots.template import NoiseModel
from disctrack.track.measurement import measure, open_pairs
from disctrack.trajectory import joined, part
from disctrack.validate import accuracy as summary
from disctrack.validate import rendered
from disctrack.validate.tables import write_validation

GOAL_HEIGHT, GOAL_TILT = 5e-6, np.radians(5e-3)  # [m, rad] of the mean error in an imperfect laboratory


@pytest.fixture(scope="module")
def outcomes():
    cases = rendered.ideal_cases(rendered.scene_of(2014, quick=True), 24, 16)
    return [rendered.render_and_measure(case) for case in cases]


@pytest.fixture(scope="module")
def accuracy(outcomes):
    return summary.Accuracy(outcomes)


@pytest.mark.statistical
def test_own_calibration_keeps_the_papers_claim_and_finds_every_pose_without_a_prior(accuracy):
    """With a quarter of the paper's pixels; for all but psi and phi, which 1/sin(theta) spoils."""
    assert set(accuracy.rows) == {rendered.STATIC, rendered.ROLLING, rendered.FINAL}
    assert not list(summary.complaints(accuracy))
    two, one, none, *_ = accuracy.sights.values()
    assert (two["found"], two["wrong"]) == (two["poses"], 0)
    assert two["poses"] > 10
    assert one["wrong"] == none["wrong"] == 0
    assert 1 < accuracy.law_limit_deg < 15


@pytest.mark.statistical
def test_covariances_are_honest(outcomes, accuracy):
    """Of 50 poses through the true cameras chance allows 1 +- 0.08; one rig has six degrees of freedom."""
    pooled = summary.noise_consistency(joined(outcome.seen_by_both[1] for outcome in outcomes))
    assert abs(pooled["value"] - 1) < 4 * pooled["standard error"]
    # chi-square / 6 exceeds 3.7 once in a thousand rigs
    assert next(c for name, c in accuracy.consistency.items() if name.startswith("calibration"))["value"] < 3.7


@pytest.mark.statistical
def test_a_biased_calibration_turns_the_verdict(outcomes):
    """Negative control of the summary: 20 um added to the measured heights."""
    static = outcomes[0]
    raised = replace(static.own, error=static.own.error + np.array([0, 0, 20e-6, 0, 0, 0]))
    wrong = summary.Accuracy([replace(static, own=raised)])
    assert "holds in part" in summary.verdict(wrong)
    assert any("95 % of z" in line for line in summary.complaints(wrong))
    assert any(line.startswith("calibration") and "squared error" in line for line in summary.complaints(wrong))


@pytest.mark.statistical
def test_a_camera_turned_since_the_calibration_is_noticed_by_the_measurement_and_by_the_truth():
    turned = Faults(left=CameraFault(rotation_deg=(0.0, np.degrees(1e-3), 0.0)))
    static, *_ = rendered.ideal_cases(replace(rendered.scene_of(2014, quick=True), faults=turned), 24, 1)
    found = summary.accuracy_validation([rendered.render_and_measure(static)])
    assert "does not hold" in found.headline or "holds in part" in found.headline
    assert found.complaints
    assert found.remarks


@pytest.mark.statistical
def test_files_are_whole_and_a_page_keeps_what_stands_around_the_tables(outcomes, tmp_path):
    validation = summary.accuracy_validation(outcomes)
    page = tmp_path / "accuracy.md"
    marked = "<!-- validation: validation -->\nformer table\n<!-- end of validation -->"
    page.write_text(f"# Accuracy\n\n{marked}\n\nLast words.\n")
    for _ in range(2):  # writing it once more changes nothing
        numbers, text, _ = write_validation(tmp_path, validation, "disctrack validate", page)
    tree = json.loads(numbers.read_text())
    assert tree["headline"] == validation.headline
    assert {"2", "1", "0"} < set(tree["outcomes"][0]["sights"])
    assert validation.headline in text.read_text()
    text = page.read_text()
    assert text.startswith("# Accuracy\n")
    assert text.endswith("\n\nLast words.\n")
    assert "former table" not in text
    assert text.count("## Who sees the face, and nutation (static") == 1


@pytest.mark.statistical
def test_command_prints_the_verdict_and_tells_of_failed_checks(outcomes, tmp_path, monkeypatch, cli):
    """The measurement itself is that of the other tests."""
    command = "validate", "--quick", "-o", tmp_path / "out"
    monkeypatch.setattr("disctrack.commands.validate.measure_all", lambda *_: outcomes)
    assert cli(*command).out.startswith(summary.verdict(summary.Accuracy(outcomes)))
    static, *rolling = outcomes
    late = np.arange(len(static.own.q))[:, None] > 2
    lost = replace(static.own, error=np.where(late, static.own.error, np.nan))
    bad = [replace(static, own=lost), *rolling]
    monkeypatch.setattr("disctrack.commands.validate.measure_all", lambda *_: bad)
    assert "were not found" in cli(*command, code=1).err


def test_static_poses_cover_the_range_and_stand_on_the_table(rng):
    scene = rendered.scene_of(1, quick=True)
    rig, disc = rig_of(scene), scene.declared_disc
    q = rendered.static_poses(40, scene, rng)
    theta = np.degrees(q[:, 4])
    counts = [np.sum((theta >= low) & (theta < high)) for low, high in rendered.STRATA_DEG]
    assert counts == [5] * len(rendered.STRATA_DEG)
    angle = np.linspace(0, 2 * np.pi, 3601)
    ring = disc.radius * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    rims = np.concatenate([ring + np.array([0, 0, z]) for z in (-disc.half_thickness, disc.half_thickness)])
    R = rotation_from_euler(*q[:, 3:].T)
    lowest = (rims @ np.swapaxes(R, 1, 2) + q[:, None, :3])[..., 2].min(axis=1)
    # 0.1 deg between the points of the ring: r (1 - cos 0.05 deg) = 14 nm
    np.testing.assert_allclose(lowest, 0, atol=2e-8)
    assert set(rendered.cameras_in_sight(q, rig, disc)) >= {1, 2}


def seen_by_both(n, scene, rng):
    """n poses that both cameras see, from 3 to 30 deg of nutation, and one view of the board."""
    scene = scene.changed(board={"n_views": 1})
    rig, disc = rig_of(scene), scene.declared_disc
    q = rendered.static_poses(64, scene, rng)
    seen = (rendered.cameras_in_sight(q, rig, disc) == 2) & (np.radians(3) < q[:, 4]) & (q[:, 4] < np.radians(30))
    return rendered.at_rest(scene, rng.choice(q[seen], n, replace=False))


def located(scene, folder):
    """What is found through the true cameras, with the truth."""
    truth = rendered.render(folder / "recording", scene)
    recording = read_recording(folder / "recording")
    return measure(recording, truth.rig, open_pairs(recording)), truth


def test_poses_at_rest_are_each_found_without_the_one_before(rng, tmp_path):
    tracking, _ = located(seen_by_both(4, rendered.scene_of(1, quick=True), rng), tmp_path)
    assert tracking.details["acquisitions"] == 4


@pytest.mark.parametrize(("bits", "read_noise"), [(8, 16.0), (12, 3.0), (16, 0.8)])
def test_noisy_sensors_and_more_bits_are_measured_from_the_first_pair_on(bits, read_noise, rng, tmp_path):
    """The noise is measured before dots are judged by it: what is large in grey values is not a misfit."""
    sensor = {"read_noise_dn": read_noise}
    scene = rendered.scene_of(2, quick=True).changed(cameras={"bit_depth": bits}, sensor=sensor)
    tracking, truth = located(seen_by_both(3, scene, rng), tmp_path)
    found = rendered.compare(part(tracking.trajectory, slice(None, None, 2)), truth.q)
    assert found.usable.all()
    # on 40 numbers chance allows 1 +- 0.33
    assert 0.3 < summary.noise_consistency(found)["value"] < 2.0
    grey = (2**bits - 1) / 255
    variance = NoiseModel(**tracking.details["noise"][0]).variance(100 * grey)
    assert variance == pytest.approx((read_noise**2 + 100 / 50) * grey**2, rel=0.35)  # 12 flat parts, 100 pixels each


@pytest.mark.slow
def test_height_and_tilt_in_an_imperfect_laboratory_and_what_is_stated_of_them():
    cases = [rendered.imperfect_case(rendered.scene_of(seed, quick=True), 60) for seed in (31, 32)]
    outcomes = [rendered.render_and_measure(case) for case in cases]
    assert summary.imperfect_validation(outcomes).markdown().count("+-") == 13
    pulls = []
    for outcome in outcomes:
        mean, sigma = outcome.own.mean()
        # cameras of a quarter of the pixels: noise and what is left of the lens field are 1.7 times the paper's
        assert abs(mean[2]) < 1.7 * GOAL_HEIGHT
        assert np.abs(mean[3:5]).max() < 1.7 * GOAL_TILT
        assert 0.7 < outcome.own.frame_to_frame() < 1.4
        assert max(outcome.systematic_px) > 0
        pulls.append(mean / sigma)
    assert np.abs(pulls).max() < 4
    # two recordings: chi-square of 2 degrees exceeds 12 once in 400
    assert np.mean(np.square(pulls), axis=0).max() < 6.0
