"""A trajectory as points and rotations of the body, for programs of motion capture."""

import numpy as np

from calibration.kit.arrays import Array
from disctrack.frames import rotation_from_quaternion
from disctrack.trajectory import Trajectory


def body_points(trajectory: Trajectory) -> tuple[Array, list[str]]:
    """World places (n, k, 3) [m] of centre, tips of body axes of one radius, and dots; their names."""
    disc = trajectory.disc
    body = np.concatenate([np.zeros((1, 3)), disc.radius * np.eye(3), disc.marker_centres_body])
    labels = ["CENTRE", "AXIS_1", "AXIS_2", "AXIS_3", *(f"DOT_{i}" for i in range(disc.n_markers))]
    return body @ np.swapaxes(rotations(trajectory), 1, 2) + trajectory.q[:, None, :3], labels


def rotations(trajectory: Trajectory) -> Array:
    """R_world_body (n, 3, 3); NaN in frames without a pose."""
    R = rotation_from_quaternion(trajectory.quaternion)
    return np.where(trajectory.measured[:, None, None], R, np.nan)


def place_sigma_mm(trajectory: Trajectory) -> Array:
    """(n,) one sigma of the place; -1 in frames without a pose, as programs mark what was not seen."""
    sigma = np.sqrt(np.einsum("nii->n", trajectory.pose_covariance[:, :3, :3]))
    return np.where(trajectory.measured, 1e3 * sigma, -1.0)
