"""Faults that gave a result that looked good and was not: each is told, flagged or refused (docs/faults.md)."""

import shutil

import numpy as np
import pytest

from disctrack.cli import main
from disctrack.files.trajectory_file import read_findings, read_trajectory
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
