"""Diagnosis of recordings whose motion comes from another formulation of the dynamics, through pixels and calibration.

Nothing of the product's equations has a part in the motion: a wrong term that simulation and diagnosis share cannot
hide here. The diagnosis sees the folder of the recording alone.
"""

import json
from dataclasses import replace

import numpy as np
import pytest

from disctrack.cli import main
from disctrack.synthetic import description
from disctrack.synthetic.recording import run_render
from disctrack.validate.rendered import scene_of
from tests.oracles import newton_euler
from tests.oracles.newton_euler import LEAD, of_the_paper
from tests.pipeline.conftest import QUICK


def small_scene(seed, n_frames, frame_rate):
    """A quarter of the pixels and few chessboard views."""
    return scene_of(seed, quick=True).changed(cameras={"frame_rate_hz": frame_rate, "n_frames": n_frames})


def hide(folder, scene, body):
    """Render the motion of a body into folder/recording, its truth elsewhere. Returns the recording's folder."""
    rate, n = scene.cameras.frame_rate_hz, scene.cameras.n_frames
    spline = newton_euler.filmed_motion(body, 14.0, 1.5, n / rate, rate)
    np.save(folder / "motion.npy", np.column_stack([spline.x, spline(spline.x)]))
    motion = description.MotionSettings("table", table="motion.npy")
    scene = replace(scene, motion=motion, folder=folder)
    run_render(scene, folder / "recording", truth_path=folder / "elsewhere" / "truth.h5")
    return folder / "recording"


def diagnosis_of(recording):
    out = recording.parent / "out"
    assert main(["run", str(recording), "-o", str(out), *QUICK]) in (0, 3)
    # a hollow table is a doubt about the thickness of the disc to the tracking: diagnosed anyway, and told again
    asked = ["-o", str(out / "diagnosis"), "--anyway"]
    assert main(["diagnose", str(out / "trajectory.h5"), *asked]) in (0, 3)
    return json.loads((out / "diagnosis" / "diagnosis.json").read_text())


def sizes(document, name):
    """{parameter: (value, sigma)} of the effect as it is claimed, or as it would be in the place of a twin."""
    (account,) = [a for e in document["effects"] for a in (e, *e["class"]) if a["name"] == name]
    return {p["name"]: (p["value"], p["sigma"]) for p in account["parameters"]}


def assert_found(document, hidden):
    """Each hidden effect {name: {parameter: value}}, no other, at its size, and noise is left."""
    assert document["verdict"] == "found", document["sentence"]
    assert len(document["effects"]) == len(hidden), document["sentence"]
    for name, truth in hidden.items():
        for parameter, (value, sigma) in sizes(document, name).items():
            assert abs(value - truth[parameter]) < 3 * sigma, parameter
    assert document["after"]["reduced_chi_square"] < 1.1
    assert document["after"]["held_out"]["ratio_to_noise_floor"] < 1.2


@pytest.mark.statistical
def test_a_tilted_table_in_images_of_an_independent_motion_is_found_and_sized(tmp_path):
    x, y = 0.0061 * np.cos(2.0), 0.0061 * np.sin(2.0)  # by which the table descends
    body = of_the_paper(gravity=(9.81 * x, 9.81 * y, -9.81 * np.sqrt(1 - x**2 - y**2)))
    document = diagnosis_of(hide(tmp_path, small_scene(41, 70, 300.0), body))
    assert_found(document, {"table_tilt": {"tilt_x": x, "tilt_y": y}})
    assert document["before"]["reduced_chi_square"] > 10


@pytest.mark.slow
def test_nothing_is_found_in_images_of_an_independent_motion_without_an_effect(tmp_path):
    cameras = description.CameraSettings(frame_rate_hz=400.0, n_frames=150)  # the paper's format
    scene = description.Scene(name="hidden", seed=42, cameras=cameras)
    document = diagnosis_of(hide(tmp_path, scene, of_the_paper()))
    assert document["verdict"] == "nothing missing", document["sentence"]
    assert document["effects"] == []
    assert document["after"]["reduced_chi_square"] < 1.1


SHAKEN = np.array([8e-6, -5e-6, 6e-6]), np.array([4e-6, 7e-6, -9e-6])  # [m] at the first frame, and a quarter later
SHAKEN_NAMES = [f"u_{phase}_{axis}" for phase in ("cos", "sin") for axis in "xyz"]
TABLES_AND_RIMS = {  # what is hidden, and how
    "spring": ({"spring": {"k": 0.8, "F_x": 0.0, "F_y": 0.0}}, of_the_paper(newton_euler.spring(0.8))),
    "adhesion": ({"rolling_adhesive": {"a": 1e-4}}, of_the_paper(newton_euler.adhesive_rolling_friction(1e-4))),
    "hollow": (
        {"table_curved": {"kappa": 0.5, "slope_x": 0.0, "slope_y": 0.0}}, of_the_paper(bowl=((0.0, 0.0, 2.0), 2.0))
    ),
    "oval rim": ({"rim": {"oval_c": 1.5e-4, "oval_s": -1e-4}}, of_the_paper(waves=((2, 1.5e-4, -1e-4),))),
    "flat of the rim": (
        {"rim_flat": {"depth": 4e-4, "angle": 2.3, "width": 0.15}}, of_the_paper(dips=((4e-4, 2.3, 0.15),))
    ),
    "yielding table": ({"table_yielding": {"c": 5e-6}}, of_the_paper(gives_way=5e-6)),
    "shaken table": (
        {"table_shaken": dict(zip(SHAKEN_NAMES, np.ravel(SHAKEN), strict=True)) | {"frequency": 63.7}},
        of_the_paper(table=newton_euler.swing(*SHAKEN, 63.7, start=LEAD)),
    ),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", TABLES_AND_RIMS)
def test_what_a_table_or_a_rim_does_is_found_in_images(name, tmp_path):
    truth, body = TABLES_AND_RIMS[name]
    document = diagnosis_of(hide(tmp_path, small_scene(80 + len(name), 250, 500.0), body))
    assert [e["name"] for e in document["effects"]] == list(truth), document["sentence"]
    assert_found(document, truth)


@pytest.mark.slow
def test_a_table_that_vibrates_with_its_cameras_is_found_in_images(tmp_path):
    """30 um at 60 Hz: in the axes of both a force that swings, of which the diagnosis learns the frequency."""
    acceleration = 3e-5 * (2 * np.pi * 60) ** 2 * np.array([0.6, 0.3, 0.7])
    body = of_the_paper(newton_euler.vibration(acceleration, 0 * acceleration, 60.0))
    document = diagnosis_of(hide(tmp_path, small_scene(79, 250, 500.0), body))
    assert document["verdict"] == "unexplained", document["sentence"]
    numbers = {p["name"]: (p["value"], p["sigma"]) for p in document["effects"][0]["parameters"]}
    rate, sigma = numbers["rate_0"]
    assert abs(rate - 2 * np.pi * 60) < 3 * sigma
    assert document["after"]["reduced_chi_square"] < 1.1
    for axis, true in enumerate(body.m * acceleration):
        (c, c_sigma), (s, s_sigma) = numbers[f"c_0_{2 * axis}"], numbers[f"c_0_{2 * axis + 1}"]
        assert abs(np.hypot(c, s) - true) < 3 * max(c_sigma, s_sigma)
