"""Exposures as long as the frame interval: what is measured refers to the middle of the exposure."""

from dataclasses import replace

import numpy as np
import pytest

from disctrack import frames, measure_pairs, read_recording, rolling
from disctrack.errors import RecordingError
from disctrack.render import render_disc
from disctrack.track.exposure import shift_by_exposure
from disctrack.track.tracking import TrackingSettings
from disctrack.trajectory import FrameStatus

RATE, EXPOSURE = 1000.0, 1e-3  # Hz, s
N = 40


@pytest.fixture(scope="module")
def motion(rendered_pairs):
    """A disc rolling at 10 deg of nutation: its poses at nine instants of the exposure of each frame, (N, 9, 6)."""
    disc = rendered_pairs.disc
    start = rolling.steady_precession(np.radians(10), disc, 9.81)
    solution = rolling.simulate(rolling.Model(disc, 9.81), start, times=np.arange(8 * N + 1) / (8 * RATE))
    q = solution.q[8 * np.arange(N)[:, None] + np.arange(9)]
    q[..., :2] += np.array([0.032, 0.02]) - q[..., :2].mean(axis=(0, 1))
    return q, solution.qdot[4::8]


@pytest.fixture(scope="module")
def measured(rendered_pairs, motion):
    """The same images measured without and with their exposure, and the poses at mid exposure."""
    q, qdot = motion
    cameras = replace(rendered_pairs.scene.cameras, exposure_s=EXPOSURE)
    scene = replace(rendered_pairs.scene, cameras=cameras)
    images = render_disc(
        q[:, 4], rendered_pairs.rig, rendered_pairs.disc, scene, np.random.default_rng(3), qdot=qdot[:N]
    )
    told = [TrackingSettings(), TrackingSettings(exposure=(EXPOSURE, EXPOSURE))]
    runs = [measure_pairs(images, rendered_pairs.rig, rendered_pairs.disc, RATE, settings=each) for each in told]
    return q[:, 4], [run.trajectory for run in runs]


def test_the_shift_is_the_mean_over_the_exposure(motion, measured, rendered_pairs):
    """Against the quadrature (Simpson) of the dots' images along the simulated motion, gap and ends included."""
    q, (trajectory, _) = motion[0], measured[1]
    R = frames.rotation_from_euler(*np.moveaxis(q[..., 3:], -1, 0))
    points = rendered_pairs.disc.marker_centres_body @ np.swapaxes(R, -1, -2) + q[..., None, :3]
    pixels = rendered_pairs.rig.project(points.reshape(-1, *points.shape[2:])).reshape(*q.shape[:2], 2, -1, 2)
    weights = np.array([1, 4, 2, 4, 2, 4, 2, 4, 1]) / 24
    expected = np.einsum("nkcmi,k->ncmi", pixels, weights) - pixels[:, 4]
    status = trajectory.frame_status.copy()
    status[20] = FrameStatus.CONTRADICTED
    exact = replace(
        trajectory,
        q=q[:, 4],
        quaternion=frames.quaternion_from_rotation(R[:, 4]),
        frame_status=status,
        rig=rendered_pairs.rig,
        disc=rendered_pairs.disc,
    )
    found = shift_by_exposure(exact, (EXPOSURE, EXPOSURE))
    assert not found[20].any()
    inner = np.setdiff1d(np.arange(1, N - 1), [19, 20, 21])
    size = np.abs(expected).max()
    assert size > 0.002  # px: g (2 T)^2 / 24 of the outermost dots, at some 4 px/mm
    # differences over three frames and the fourth order of the exposure: (psidot / rate)^2 (1/12 + 1/80) of the shift
    assert np.abs(found - expected)[inner].max() < 0.01 * size
    assert np.abs(found - expected)[[0, 19, 21, N - 1]].max() < 0.25 * size  # a neighbour's, turned by psidot dt


def test_an_exposure_longer_than_a_frame_is_refused(tmp_path, sample_clip):
    text = (sample_clip / "recording.toml").read_text()
    declared = tmp_path / "recording.toml"
    declared.write_text(text.replace("[cameras]", "[cameras]\nexposure_us = 200", 1))
    assert read_recording(tmp_path).exposure == pytest.approx(200e-6)
    declared.write_text(text.replace("[cameras]", "[cameras]\nexposure_us = 1200", 1))
    with pytest.raises(RecordingError, match="exposure_us is 1200, longer than a frame: 1000 us"):
        read_recording(tmp_path)


def test_theta_is_that_of_mid_exposure(measured, rendered_pairs):
    q, runs = measured
    expected = -9.81 * EXPOSURE**2 / (6 * rendered_pairs.disc.radius)  # steady precession, exposure.py
    errors = [run.q[:, 4] - q[:, 4] for run in runs]
    sigma = np.sqrt(np.mean(runs[0].pose_covariance[:, 3, 3] + runs[0].pose_covariance[:, 4, 4]) / 2 / N)
    assert abs(expected) > 8 * sigma
    assert np.mean(errors[0]) == pytest.approx(expected, abs=4 * sigma)  # the fault is there when nobody tells
    assert np.mean(errors[1]) == pytest.approx(0.0, abs=4 * sigma)


def test_noise_hardly_grows(measured):
    _, (without, corrected) = measured
    scatter = [np.std(np.diff(run.markers_px, n=3, axis=0)) for run in (without, corrected)]
    assert scatter[1] == pytest.approx(scatter[0], rel=0.05)
    assert (corrected.frame_status == FrameStatus.MEASURED).all()
