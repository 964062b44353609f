"""From pixels to the missing effect: rendered, calibrated, tracked and diagnosed through the commands alone."""

import json
from dataclasses import replace

import pytest

from disctrack.cli import main
from disctrack.faults.keys import Faults
from disctrack.synthetic.description import CameraSettings, MotionSettings, RollingMotion, Scene
from disctrack.synthetic.recording import write_recording


def render_hidden(folder, effects, seed, n_frames=200, faults=None, **start):
    """A recording whose truth lies elsewhere: recording.toml knows nothing of the effects."""
    rolling = RollingMotion(effects={"km": {"k_m": 0.381e-7}} | effects, **start)
    scene = Scene(name="hidden", seed=seed, cameras=CameraSettings(n_frames=n_frames))
    scene = replace(scene, board=replace(scene.board, n_views=14))
    scene = replace(scene, motion=MotionSettings(kind="rolling", rolling=rolling), faults=faults or Faults())
    write_recording(folder / "recording", scene, truth_path=folder / "elsewhere" / "truth.h5")
    return folder / "recording"


def diagnosis_of(recording, model="paper"):
    out = recording.parent / "out"
    if not (out / "trajectory.h5").exists():
        assert main(["run", str(recording), "-o", str(out), "--no-figures", "--no-video"]) == 0
    arguments = ["diagnose", str(out / "trajectory.h5"), "-o", str(out / "diagnosis"), "--overwrite"]
    assert main([*arguments, "--model", str(model)]) == 0
    return json.loads((out / "diagnosis" / "diagnosis.json").read_text())


@pytest.mark.slow
def test_a_saved_model_rendered_and_measured_again_lacks_nothing_against_itself(tmp_path):
    """Paper 0.1 mm above the face and pivoting friction: found, saved, rendered from the file, known the next time."""
    effects, faults = {"kz": {"k_z": 6e-5}}, Faults(pattern_height_mm=0.1)
    recording = render_hidden(
        tmp_path / "first", effects, seed=24, n_frames=120, faults=faults, theta_deg=15.0, omega3_rad_s=1.5
    )
    first = diagnosis_of(recording)
    assert first["verdict"] == "found"
    (height, pivoting) = first["effects"]
    assert height["name"] == "pattern_height"
    # three sigmas, and what the images' own errors add at 1/800 px
    assert abs(height["parameters"][0]["value"] - 1e-4) < 3 * height["parameters"][0]["sigma"] + 5e-7
    assert "kz" in {pivoting["name"], *(c["name"] for c in pivoting["class"])}
    model = tmp_path / "first" / "out" / "diagnosis" / "model.toml"
    again = tmp_path / "second" / "recording"
    assert main(["render", str(model), "-o", str(again)]) == 0
    assert diagnosis_of(again)["verdict"] == "found"
    second = diagnosis_of(again, model=model)
    assert second["verdict"] == "nothing missing", second["sentence"]
