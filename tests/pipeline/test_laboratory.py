"""The whole instrument on recordings that the independent laboratory casts, with lenses that it has never seen."""

import numpy as np
import pytest

from calibration.rig_file import read_rig
from disctrack.cli import main
from disctrack.trajectory import FrameStatus
from disctrack.trajectory.file import read_trajectory
from tests.oracles import imperfect_laboratory as laboratory
from tests.oracles.point_laboratory import errors_and_variances, poses_of

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Frames of a quarter of the pixels by cameras and a board without faults."""
    room = {"size": 320, "mm_per_px": 0.4, "square": 6.5e-3, "n_views": 14, "imperfections": laboratory.IDEAL}
    return laboratory.write(tmp_path_factory.mktemp("cast") / "plain", laboratory.Plan(n_frames=24, **room))


@pytest.fixture(scope="module")
def measured(recording):
    """Trajectory and rig by the command; the recording measured with other squares if they are given."""

    def run(out, declared="square_mm = 6.5"):
        file = recording / "recording.toml"
        text = file.read_text()
        file.write_text(text.replace("square_mm = 6.5", declared))
        assert main(["run", str(recording), "-o", str(recording.parent / out), "--no-figures", "--no-video"]) == 0
        file.write_text(text)
        return read_trajectory(recording.parent / out / "trajectory.h5"), read_rig(recording.parent / out / "rig.h5")

    return run, run("right")


@pytest.fixture(scope="module")
def truth(recording):
    """The poses R (n, 3, 3), t (n, 3); and what else is kept of it."""
    kept = np.load(recording / "truth.npz")
    return poses_of(kept["q"]), kept


def test_a_cast_recording_is_measured_within_its_sigmas(measured, truth):
    trajectory, _ = measured[1]
    assert np.all(trajectory.frame_status == FrameStatus.MEASURED)
    error, variance = errors_and_variances(trajectory, *truth[0])
    shared = np.diagonal(trajectory.calibration_covariance, axis1=1, axis2=2).mean(0)
    noise = variance.mean(0) - shared
    assert np.all(np.abs(error.mean(0)) < 4 * np.sqrt(shared + noise / len(error)))
    # 24 frames of one recording: their scatter is known within 30 % (two sigma), the correlated part of the dots aside
    assert np.all(error.std(0) ** 2 < 2.0 * noise)
    assert np.all(error.std(0) ** 2 > 0.4 * noise)


def test_the_lenses_of_a_cast_rig_are_found_within_their_sigmas(measured, truth):
    rig = measured[1][1]
    for side, camera, i in (("left", rig.left, 0), ("right", rig.right, 9)):
        sigma = np.sqrt(np.diagonal(rig.covariance)[i : i + 4])  # fx, fy, cx, cy
        f, cx, cy = truth[1][f"{side}_intrinsics"]
        assert np.all(np.abs(np.array([camera.fx, camera.fy, camera.cx, camera.cy]) - [f, f, cx, cy]) < 4 * sigma)
        assert np.all(sigma < 3)  # px


def test_squares_declared_too_large_are_errors_beyond_the_sigmas_of_right_ones(measured, truth):
    """Negative control: the same images with squares of 6.5325 mm for 6.5, known to 1 um.

    By the sigmas of the right run: those of the wrong one are larger, as the dots' distances contradict the squares.
    """
    run, (right, _) = measured
    wrong, _ = run("wrong", "square_mm = 6.5325\nsquare_tolerance_mm = 0.001")
    _, variance = errors_and_variances(right, *truth[0])
    error, larger = errors_and_variances(wrong, *truth[0])
    assert np.max(np.mean(error**2 / variance, axis=0)) > 9
    assert np.all(np.mean(larger, axis=0)[:2] > np.mean(variance, axis=0)[:2])
