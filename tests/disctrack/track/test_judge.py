"""A camera that moves while the disc is filmed, or loses images, is told from what the dots of each frame say."""

from dataclasses import replace

import numpy as np
import pytest

from disctrack.faults.keys import CameraFault, Faults
from disctrack.findings import Kind
from disctrack.frames import rotation_from_vector
from disctrack.track.judge.cameras import camera_motion, frames_ahead
from disctrack.track.refine.assembly import fit_all
from tests.oracles.measured_disc import dots_of, measured

N = 200
SHARE = np.linspace(0.0, 1.0, N)


def judged(trajectory):
    """Poses of the dots, and what a camera's course makes of them."""
    seen = dots_of(trajectory)
    fits = fit_all(seen)
    seen = replace(seen, R=fits.R_world_body, t=fits.t_world_body)
    return fits, camera_motion(seen, fits, range(N))


@pytest.mark.parametrize("camera", [0, 1])
@pytest.mark.parametrize(
    "course", [0.02 * (SHARE > 0.5), 0.02 * (SHARE > 0.9), 0.03 * SHARE], ids=["knock", "late", "drift"]
)
def test_a_camera_that_moves_a_little_is_named_and_within_the_sigmas(camera, course):
    still = measured(n=N)
    pixels = still.markers_px.copy()
    pixels[:, camera] += course[:, None, None]  # px, along both axes of the image
    moved, (by_course, told) = judged(replace(still, markers_px=pixels))
    assert [finding.kind for finding in told] == [Kind.CAMERA_MOVED]
    if np.ptp(np.diff(course)) > 0.01:
        assert abs(told[0].subject.frames[0][0] - np.argmax(course > 0)) <= N / 20
    error = moved.t_world_body - fit_all(dots_of(still)).t_world_body
    variance = np.diagonal(still.pose_covariance + still.calibration_covariance, axis1=1, axis2=2)[:, :3]
    assert (np.abs(error) / np.sqrt(variance)).max() > 4  # or it would not matter
    variance = variance + np.diagonal(by_course, axis1=1, axis2=2)[:, :3]
    assert (np.abs(error) / np.sqrt(variance)).max() < 3.5


@pytest.mark.parametrize(
    "faults",
    [
        Faults(),
        Faults(right=CameraFault(rotation_deg=(0.02, -0.01, 0.015))),
        Faults(left=CameraFault(focal_scale=1.004, k1_change=0.01)),
        Faults(right_delay_s=2e-4),
    ],
    ids=["none", "turned", "zoomed", "late"],
)
def test_what_is_wrong_throughout_is_no_course(faults):
    """Negative controls: the misfit of a wrong camera changes with the disc's place."""
    for seed in range(3):
        _, (by_course, told) = judged(measured(n=N, faults=faults, seed=seed))
        assert told == ()
        assert not by_course.any()


@pytest.mark.parametrize(("lost", "turn_deg", "told"), [(20, 0.0, 20), (-37, 0.0, -37), (0, 0.0, 0), (0, 0.5, 0)])
def test_images_lost_by_one_camera_are_counted_by_what_each_sees_alone(lost, turn_deg, told, rng):
    """As sure of an attitude as one camera is; a camera that turned is no camera that lost images."""
    R = dots_of(measured(n=97)).R
    alone = np.einsum("cnij,njk->cnik", rotation_from_vector(np.radians(0.05) * rng.normal(size=(2, 97, 3))), R)
    turned = rotation_from_vector(np.radians(turn_deg) * np.array([0.6, 0.0, 0.8]))
    left, right = alone[0, max(-lost, 0) :][:60], turned @ alone[1, max(lost, 0) :][:60]
    assert frames_ahead(left, right) == told
