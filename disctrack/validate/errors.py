"""Differences of measured and true poses, and their consistency with the stated covariance."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from calibration.kit.arrays import Array, Mask
from disctrack.frames import COORDINATES, rotation_from_euler, rotation_from_quaternion, vector_from_rotation
from disctrack.trajectory import Trajectory

GROSS = (0.5e-3, np.radians(1.0))  # [m, rad] of position and rotation, above which a pose is wrong, not inaccurate


@dataclass(frozen=True)
class PoseErrors:
    """Differences measured - true of n poses; NaN without a measured pose."""

    q: Array  # (n, 6) true
    error: Array  # (n, 6) POSE_COMPONENTS [m, rad]: position, rotation vector in world axes
    angles: Array  # (n, 3) psi, theta, phi [rad], in (-pi, pi]
    covariance: Array  # (n, 6, 6) reported, of the noise
    calibration_covariance: Array  # (n, 6, 6) reported, of the calibration

    @property
    def found(self) -> Mask:
        """(n,) True if a pose is reported."""
        return np.asarray(np.isfinite(self.error).all(axis=1))

    @property
    def usable(self) -> Mask:
        """(n,) True if a pose is reported that is not wrong."""
        sizes = np.linalg.norm(self.error.reshape(-1, 2, 3), axis=2)
        return np.asarray((sizes <= GROSS).all(axis=1))

    def of(self, quantity: str) -> Array:
        """Errors of a coordinate (n,), or of "position" or "rotation" about all axes (3 n,) [m, rad], of usable poses.

        rotation : the rotation vector between measured and true attitude
        """
        columns = dict(zip(COORDINATES, (*self.error.T[:3], *self.angles.T), strict=True))
        columns |= {"position": self.error[:, :3], "rotation": self.error[:, 3:]}
        return columns[quantity][self.usable].ravel()

    def mean(self) -> tuple[Array, Array]:
        """Mean error (6,) of the usable poses, and the stated uncertainty of their common error (6,)."""
        usable = self.part(self.usable)
        variance = np.median(np.diagonal(usable.calibration_covariance, axis1=1, axis2=2), axis=0)
        return usable.error.mean(axis=0), np.sqrt(variance)

    def frame_to_frame(self) -> float:
        """Variance of the errors from their second differences, over the stated variance of the noise of a frame."""
        usable = self.part(self.usable)
        variances = np.diff(usable.error, 2, axis=0) ** 2 / 6.0
        return float(np.mean(variances / np.diagonal(usable.covariance, axis1=1, axis2=2)[1:-1]))

    def part(self, rows: Mask) -> PoseErrors:
        """The poses of these rows (n,)."""
        return PoseErrors(*(values[rows] for values in vars(self).values()))


def compare(trajectory: Trajectory, q_true: Array) -> PoseErrors:
    """Comparison of a trajectory with the true poses (n, 6) of its frames."""
    R = rotation_from_euler(*q_true[:, 3:].T)
    turn = rotation_from_quaternion(trajectory.quaternion) @ np.swapaxes(R, 1, 2)
    error = np.concatenate([trajectory.q[:, :3] - q_true[:, :3], vector_from_rotation(turn)], axis=1)
    angles = np.angle(np.exp(1j * (trajectory.q[:, 3:] - q_true[:, 3:])))
    error[~trajectory.measured] = angles[~trajectory.measured] = np.nan
    return PoseErrors(q_true, error, angles, trajectory.pose_covariance, trajectory.calibration_covariance)


def joined(parts: Iterable[PoseErrors]) -> PoseErrors:
    """All poses of several comparisons."""
    return PoseErrors(*map(np.concatenate, zip(*(vars(part).values() for part in parts), strict=True)))


def squared(error: Array, covariance: Array) -> Array:
    """(n,) e^T C^-1 e / 6 of errors (n, 6), on average 1 with the correct covariance C (n, 6, 6)."""
    return np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[..., None])[..., 0]) / 6


def consistency(values: Sequence[float] | Array) -> dict[str, float]:
    """Mean of `squared` over poses or rigs, and its standard error if the reported covariance is correct."""
    n = len(values)
    value = float(np.mean(values)) if n else float("nan")
    return {"value": value, "standard error": float(np.sqrt(2 / (6 * max(n, 1)))), "poses or rigs": n}


def noise_consistency(errors: PoseErrors) -> dict[str, float]:
    """Squared error over the reported variance of the noise; the errors must be free of calibration errors."""
    return consistency(squared(errors.error, errors.covariance)[errors.usable])


def calibration_consistency(pairs: Iterable[tuple[PoseErrors, PoseErrors]]) -> dict[str, float]:
    """Squared calibration error over its reported variance, from the same images measured with two rigs.

    pairs : poses of each recording with its own calibration and with the true cameras. Both have the same image noise,
    so their difference is the calibration error alone. It is common to a recording, which therefore counts once, with
    the mean over its poses.
    """
    of_rigs = (squared(a.error - b.error, a.calibration_covariance)[a.usable & b.usable] for a, b in pairs)
    return consistency([float(values.mean()) for values in of_rigs if len(values)])
