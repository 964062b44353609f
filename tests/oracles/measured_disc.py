"""Measured trajectories of a disc without rendering: true motion, true cameras, noise on the dots, poses fitted.

What is planted goes through other formulas than those of the diagnosis: cameras through the renderer's `faults`, dots
through their true places, clocks through the instants at which the motion is simulated. The rig that the trajectory
carries differs from the true one by an error drawn from its covariance.
"""

from dataclasses import replace

import numpy as np

from calibration.camera import N_RIG, StereoRig
from disctrack.frames import (
    continuous_quaternions,
    euler_from_rotation,
    quaternion_from_rotation,
    rotation_from_euler,
    unwrap_euler,
)
from disctrack.pose import fit_poses
from disctrack.render import rig_of
from disctrack.render.cameras import board_poses, rig_after_faults
from disctrack.rolling import Model, simulate, steady_precession
from disctrack.scene import Faults, Scene
from disctrack.trajectory import Trajectory

SIGMA_PX = 0.006  # of a dot's centre: 0.5 um and 1.3 mdeg per pose, as in the reference recordings
CORNER_SIGMA_PX = 0.01
K_M = 0.381e-7


def rig_covariance(rig: StereoRig, scene: Scene) -> np.ndarray:
    """(30, 30) from the corners of the scene's chessboard views, the first of which defines the world."""
    board = scene.board
    nx, ny = board.inner_corners
    corners = np.stack(np.meshgrid(np.arange(nx), np.arange(ny)), -1).reshape(-1, 2) * board.square_mm * 1e-3
    corners = np.column_stack([corners, np.zeros(len(corners))])
    normal = np.zeros((N_RIG, N_RIG))
    for number, (R, t) in enumerate(zip(*board_poses(scene, rig), strict=True)):
        arm = corners @ R.T
        _, by_point, by_rig = rig.project_with_jacobians(arm + t)
        D = by_rig.reshape(-1, N_RIG)
        normal += D.T @ D
        if number:  # pose of this view is unknown
            by_pose = np.concatenate([by_point, np.cross(arm[:, None], by_point)], axis=-1).reshape(-1, 6)
            cross = by_pose.T @ D
            normal -= cross.T @ np.linalg.solve(by_pose.T @ by_pose, cross)
    scale = np.sqrt(np.diag(normal))
    return CORNER_SIGMA_PX**2 * np.linalg.inv(normal / np.outer(scale, scale)) / np.outer(scale, scale)


def measured(
    effects: dict[str, float] | None = None,
    *,
    faults: Faults | None = None,
    seed: int = 1,
    n: int = 500,
    theta_deg: float = 14.0,
    nutation_deg: float = 0.5,
    omega3: float = 1.0,
    declared_rate: float = 1000.0,
    sigma_px: float = SIGMA_PX,
    motion=None,
    base: dict[str, float] | None = None,
) -> Trajectory:
    """Trajectory of a disc that rolls down with these effects ("effect.parameter") besides the paper's k_m.

    faults : as of a scene: delay, frame rate, dots, pattern, cameras.   motion : times (k,) -> q (k, 6), in place of
    the rolling model's
    """
    rng = np.random.default_rng([20261121, seed])
    scene = Scene(seed=seed, faults=faults or Faults())
    f, disc = scene.faults, scene.declared_disc
    believed_rig = rig_of(scene)
    covariance = rig_covariance(believed_rig, scene)
    # drawn as correlations: k3 has a sigma of 100, a rotation one of 1e-4, and rounding must not mix them
    sigma = np.sqrt(np.diag(covariance))
    error = sigma * rng.multivariate_normal(np.zeros(N_RIG), covariance / np.outer(sigma, sigma), method="eigh")
    true_rig = rig_after_faults(believed_rig.perturbed(error), scene)
    believed_rig = replace(believed_rig, covariance=covariance, world_is_table=True)
    if motion is None:
        model = Model(disc).with_values(({"km.k_m": K_M} if base is None else base) | (effects or {}))
        start = steady_precession(
            np.radians(theta_deg),
            disc,
            omega3=omega3,
            nutation_amplitude=np.radians(nutation_deg),
            psi=rng.uniform(-3, 3),
            phi=rng.uniform(-3, 3),
            x=0.032,
            y=0.020,
        )

        def motion(times):
            return simulate(model, start, times=np.r_[0.0, times]).q[1:]

    declared = np.arange(n) / declared_rate
    true_times = np.arange(n) / (f.frame_rate_hz or declared_rate) + 0.002
    centres = disc.marker_centres_body.copy()
    centres[:, :2] += np.array(f.misprint_mm or np.zeros((disc.n_markers, 2))) * 1e-3
    centres[:, :2] += np.array(f.pattern_offset_mm) * 1e-3
    q = motion(true_times)
    views = []
    for camera, delay in enumerate((0.0, f.right_delay_s)):
        qc = motion(true_times + delay) if delay else q
        R = rotation_from_euler(*qc[:, 3:].T)
        views.append(true_rig.project(centres @ np.swapaxes(R, 1, 2) + qc[:, None, :3])[:, camera])
    pixels = np.stack(views, axis=1)
    pixels = pixels + sigma_px * rng.standard_normal(pixels.shape)
    dots = np.broadcast_to(sigma_px**2 * np.eye(2), (*pixels.shape, 2)).copy()
    fits = fit_poses(
        pixels,
        dots,
        believed_rig,
        disc.marker_centres_body,
        rotation_from_euler(*q[:, 3:].T),
        q[:, :3],
        reject_outliers=False,
    )
    angles = unwrap_euler(euler_from_rotation(fits.R_world_body))
    return Trajectory(
        time=declared,
        frame=np.arange(n),
        q=np.column_stack([fits.t_world_body, angles]),
        pose_covariance=fits.covariance,
        calibration_sensitivity=fits.sensitivity,
        quaternion=continuous_quaternions(quaternion_from_rotation(fits.R_world_body)),
        frame_status=np.zeros(n, np.uint8),
        reprojection_rms_px=np.sqrt(np.nanmean(fits.residuals_px**2, axis=(2, 3))),
        reduced_chi_square=fits.reduced_chi_square,
        markers_px=pixels,
        markers_covariance_px2=dots,
        markers_residual_px=fits.residuals_px,
        marker_status=np.zeros((n, 2, disc.n_markers), np.uint8),
        disc=disc,
        rig=believed_rig,
        frame_rate=declared_rate,
        gravity=9.81,
    )
