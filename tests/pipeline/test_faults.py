"""Faults that gave a result that looked good and was not: each is told, flagged or refused (docs/faults.md)."""

import errno
import os
import shutil

import numpy as np
import pytest

from disctrack.cli import main
from disctrack.errors import OutputError
from disctrack.files.trajectory_file import read_findings, read_trajectory
from disctrack.render import recording as render_recording
from disctrack.scene.description import Scene
from disctrack.trajectory import FrameStatus

QUICK = ["--no-figures", "--no-video"]


def measured(recording, code: int = 0):
    """Trajectory and findings of a run that ends with this exit code."""
    assert main(["run", str(recording), *QUICK]) == code
    file = recording / "results" / "trajectory.h5"
    return read_trajectory(file), read_findings(file)


@pytest.fixture(scope="session")
def untouched(short_recording, rig_file, tmp_path_factory):
    """Trajectory of the recording without any fault."""
    file = tmp_path_factory.mktemp("untouched") / "trajectory.h5"
    assert main(["track", str(short_recording), "--rig", str(rig_file), "-o", str(file), *QUICK]) == 0
    return read_trajectory(file)


def test_frames_missing_in_one_piece_are_lost_and_time_goes_on(recording, untouched):
    for camera in ("left", "right"):
        for i in (8, 9, 10):
            (recording / camera / f"{i:06d}.png").unlink()
    trajectory, findings = measured(recording, code=3)
    assert len(trajectory) == len(untouched)
    lost = np.flatnonzero(trajectory.frame_status == FrameStatus.UNREADABLE)
    assert list(lost) == [8, 9, 10]
    after = slice(11, None)
    apart = np.abs(trajectory.q[after] - untouched.q[after]) / untouched.coordinate_sigma[after]
    assert apart.max() < 1  # the shared refinement has three frames less; time itself must not move
    assert len(findings["unreadable"]) == 6


@pytest.mark.parametrize("stray", ["Copy of 000010.png", "000010 (1).png", "background.png"])
def test_a_stray_image_stops_the_run_by_name(recording, capsys, stray):
    for camera in ("left", "right"):
        shutil.copy(recording / camera / "000010.png", recording / camera / stray)
    assert main(["run", str(recording), *QUICK]) == 1
    assert stray in capsys.readouterr().err


def contents(folder) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


@pytest.mark.parametrize(
    ("command", "target"),
    [
        ("track", "left/000003.png"),
        ("track", "recording.toml"),
        ("track", "rig.h5"),
        ("track", "link.h5"),
        ("track", "hard.h5"),
        ("track", "views/../right/000001.png"),
        ("calibrate", "left/000003.png"),  # of a recording that this command does not read
        ("calibrate", "recording.toml"),
        ("calibrate", "rig.h5"),
    ],
)
def test_no_output_replaces_an_input(recording, rig_file, short_recording, capsys, command, target):
    shutil.copy(rig_file, recording / "rig.h5")
    (recording / "views").mkdir()
    (recording / "link.h5").symlink_to(recording / "rig.h5")
    os.link(recording / "rig.h5", recording / "hard.h5")
    text = (recording / "recording.toml").read_text()
    (recording / "recording.toml").write_text(text.replace(rig_file.as_posix(), "rig.h5"))
    before = contents(recording)
    source = recording if command == "track" else short_recording
    words = [command, str(source), "-o", str(recording / target), "--overwrite", "--no-figures"]
    assert main(words + (["--no-video"] if command == "track" else [])) == 1
    assert "no output replaces an input" in capsys.readouterr().err
    assert contents(recording) == before


def test_a_scene_or_a_model_is_not_replaced_by_what_is_made_of_it(tmp_path, capsys):
    scene = tmp_path / "scene.toml"
    assert main(["render", "--defaults"]) == 0
    scene.write_text(capsys.readouterr().out.replace('kind = "steady"', 'kind = "rolling"'))
    before = scene.read_bytes()
    assert main(["simulate", str(scene), "-o", str(scene), "--overwrite", "--duration", "0.01"]) == 1
    assert "no output replaces an input" in capsys.readouterr().err
    assert scene.read_bytes() == before


def test_rendering_leaves_a_folder_alone_that_looks_like_a_remainder(tmp_path, monkeypatch):
    mine = tmp_path / "take.part"
    mine.mkdir()
    (mine / "notes.txt").write_text("mine")

    def full(scene):
        raise OSError(errno.ENOSPC, "disk full")

    monkeypatch.setattr(render_recording, "recording_toml", full)
    with pytest.raises(OutputError, match="disk full"):
        render_recording.write_recording(tmp_path / "take", Scene())
    assert contents(tmp_path) == {"take.part/notes.txt": b"mine"}
