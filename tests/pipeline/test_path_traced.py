"""The whole instrument on recordings that a path tracer made: shadows, soft light and a lens that it has never seen."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from calibration.rig_file import read_rig
from disctrack.cli import main as disctrack_cli
from disctrack.trajectory import FrameStatus
from disctrack.trajectory.file import read_trajectory
from tests.oracles.point_laboratory import errors_and_variances, poses_of

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(importlib.util.find_spec("mitsuba") is None, reason="needs Mitsuba 3: pip install mitsuba"),
]


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    folder = tmp_path_factory.mktemp("traced") / "plain"
    command = [sys.executable, "-m", "tests.oracles.path_traced", str(folder)]
    # apart, so that neither LLVM nor the tracer's threads enter this process
    subprocess.run(command, check=True, cwd=Path(__file__).parents[2])
    return folder


def truth_of(folder):
    """The poses R (n, 3, 3), t (n, 3) of a rendered recording."""
    return poses_of(np.load(folder / "truth.npz")["q"])


def measured(folder, out):
    assert disctrack_cli(["run", str(folder), "-o", str(out), "--no-figures", "--no-video"]) == 0
    return read_trajectory(out / "trajectory.h5")


def test_a_path_traced_recording_is_measured_within_its_sigmas(recording, tmp_path):
    trajectory = measured(recording, tmp_path)
    assert np.all(trajectory.frame_status == FrameStatus.MEASURED)
    error, variance = errors_and_variances(trajectory, *truth_of(recording))
    shared = np.diagonal(trajectory.calibration_covariance, axis1=1, axis2=2).mean(0)
    noise = variance.mean(0) - shared
    assert np.all(np.abs(error.mean(0)) < 4 * np.sqrt(shared + noise / len(error)))
    # 24 frames of one recording: their scatter is known within 30 % (two sigma), the correlated part of the dots aside
    assert np.all(error.std(0) ** 2 < 2.0 * noise)
    assert np.all(error.std(0) ** 2 > 0.4 * noise)


def test_the_lenses_of_a_path_traced_rig_are_found_within_their_sigmas(recording, tmp_path):
    measured(recording, tmp_path)
    rig, truth = read_rig(tmp_path / "rig.h5"), np.load(recording / "truth.npz")
    for side, camera, i in (("left", rig.left, 0), ("right", rig.right, 9)):
        sigma = np.sqrt(np.diagonal(rig.covariance)[i : i + 4])  # fx, fy, cx, cy
        f, cx, cy = truth[f"{side}_intrinsics"]
        assert np.all(np.abs(np.array([camera.fx, camera.fy, camera.cx, camera.cy]) - [f, f, cx, cy]) < 4 * sigma)
        assert np.all(sigma < 3)  # px


def test_squares_declared_too_large_are_errors_beyond_the_sigmas_of_right_ones(recording, tmp_path):
    """Negative control: the same images with squares of 6.5325 mm for 6.5, known to 1 um.

    By the sigmas of the right run: those of the wrong one are larger, as the dots' distances contradict the squares.
    """
    truth = truth_of(recording)
    _, variance = errors_and_variances(measured(recording, tmp_path / "right"), *truth)
    declared = recording / "recording.toml"
    text = declared.read_text()
    try:
        declared.write_text(text.replace("square_mm = 6.5", "square_mm = 6.5325\nsquare_tolerance_mm = 0.001"))
        wrong = measured(recording, tmp_path / "wrong")
    finally:
        declared.write_text(text)
    error, larger = errors_and_variances(wrong, *truth)
    assert np.max(np.mean(error**2 / variance, axis=0)) > 9
    assert np.all(np.mean(larger, axis=0)[:2] > np.mean(variance, axis=0)[:2])
