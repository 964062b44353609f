"""Measured recordings of a disc without images: poses fitted to projected dots of a true motion, with noise.

Planted effects use other formulas than the diagnosis: cameras, table and dots those of the renderer's `faults`; clocks
change the instants of the simulation; exposures are a mean over instants. The rig of the trajectory differs from the
true one by an error drawn from its covariance. The residual lens field of a laboratory is a sum of waves, as in the
renderer; glare displaces each dot independently; the table is determined from a bowed board.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.board.target import Board
from calibration.cameras.camera import N_RIG, StereoRig, by_turning
from calibration.kit.arrays import Array
from calibration.kit.least_squares import normal_of_rows
from disctrack.disc import Disc
from disctrack.faults.dots import cameras_with, ellipse_centre_shift, marker_pixels
from disctrack.faults.keys import Faults
from disctrack.frames import rotation_from_euler
from disctrack.rolling import simulate
from disctrack.synthetic.cameras import board_poses, rig_of
from disctrack.synthetic.description import Scene
from disctrack.synthetic.motion import rolling_model, rolling_start, true_frame_rate
from disctrack.synthetic.optics import smooth_field
from disctrack.synthetic.recording import true_disc_of
from disctrack.track.pose import DotsInFrames, fit_poses
from disctrack.track.refine.assembly import Taken, status_of, trajectory_of
from disctrack.trajectory import Trajectory

Motion = Callable[[Array], Array]  # times (k,) [s] -> coordinates q (k, 6)

SIGMA_PX = 0.006  # of the centre of a dot: 0.5 um and 1.3 mdeg per pose, as in the reference recordings
CORNER_SIGMA_PX = 0.01
STATION = 0.002  # [s] time of the first frame after the start of the motion


@dataclass(frozen=True)
class Laboratory:
    """Usual errors of a laboratory; all off by default."""

    lens_px: float = 0.0  # rms of each camera's smooth residual field, per coordinate
    glare_px: float = 0.0  # rms of an independent field for each dot and camera
    print_m: float = 0.0  # rms error of the dots' positions, per coordinate
    board_bow_m: float = 0.0  # standard deviation of the height of the table in the calibrated axes ...
    board_tilt: float = 0.0  # ... and of its tilt about x and y [rad]
    board_scale: float = 0.0  # relative error of the squares


# Lens of 0.02 px, board with a bow of 60 um and squares 0.02 % too long, printer, glare and gradients of light.
ORDINARY = Laboratory(0.02, 0.004, 3e-6, 40e-6, 1.2e-4, 1e-4)


def rig_covariance(rig: StereoRig, scene: Scene) -> Array:
    """(30, 30) from the corners of the scene's chessboard views, the first of which defines the world."""
    R, t = board_poses(scene, rig)
    arm = Board(scene.board.inner_corners, scene.board.square_mm * 1e-3).points @ np.swapaxes(R, 1, 2)
    _, by_point, by_rig = rig.project_with_jacobians(arm + t[:, None])
    rows = np.concatenate([by_point, by_turning(by_point, arm[:, None]), by_rig, 0.0 * by_rig[..., :1]], axis=-1)
    rows[0, ..., :6] = 0.0  # the pose of the first view is known
    return CORNER_SIGMA_PX**2 * normal_of_rows(rows.reshape(len(R), -1, N_RIG + 7), 6).covariances()[0]


def measured(
    scene: Scene,
    laboratory: Laboratory = Laboratory(),
    *,
    motion: Motion | None = None,
    sigma_px: float = SIGMA_PX,
    noise_seed: int | None = None,
) -> Trajectory:
    """Trajectory of the disc of a scene, with random initial psi and phi, as measured without knowledge of the faults.

    motion : by default that of the rolling model
    noise_seed : of initial angles and noise; errors of calibration and laboratory then depend on the seed of the scene
        only, so that recordings of one day share them
    """
    rng = np.random.default_rng([20261121, scene.seed if noise_seed is None else noise_seed])
    of_rig = rng if noise_seed is None else np.random.default_rng([20261122, scene.seed])
    n, declared_rate = scene.cameras.n_frames, scene.cameras.frame_rate_hz
    believed_rig = rig_of(scene)
    covariance = rig_covariance(believed_rig, scene)
    # drawn from the correlations: k3 has a sigma of 100, a rotation of 1e-4, and rounding errors must not mix them
    sigma = np.sqrt(np.diag(covariance))
    error = sigma * of_rig.multivariate_normal(np.zeros(N_RIG), covariance / np.outer(sigma, sigma), method="eigh")
    scene = _in_the_laboratory(scene, laboratory, of_rig)
    faults, disc, rate = scene.faults, true_disc_of(scene), true_frame_rate(scene)
    true_rig = cameras_with(faults, believed_rig.perturbed(error))
    believed_rig = replace(believed_rig, covariance=covariance, world_is_table=True)
    motion = motion or _rolling(scene, *rng.uniform(-3, 3, 2))
    times = faults.true_times(np.arange(n) / rate, rate) + STATION
    pixels = _exposed(motion, [times, times + faults.right_delay_s], faults, true_rig, disc)
    if laboratory != Laboratory():
        pixels = _shifted_dots(of_rig, pixels, scene.cameras.image_size, laboratory)
    pixels = pixels + sigma_px * rng.standard_normal(pixels.shape)
    dots = np.broadcast_to(sigma_px**2 * np.eye(2), (*pixels.shape, 2)).copy()
    q, declared = motion(times), scene.declared_disc
    seen = DotsInFrames(believed_rig, declared, pixels, dots, rotation_from_euler(*q[:, 3:].T), q[:, :3])
    fits = fit_poses(seen, reject_outliers=False)
    taken = Taken(range(n), declared_rate, scene.gravity_m_s2)
    good = np.zeros(pixels.shape[:-1], np.uint8)  # status of frames and dots
    found = trajectory_of(seen, fits, np.zeros((n, 6, 6)), status_of(good[:, 0, 0], fits), good, taken)
    # with a bowed board, tracking determines the displacement of the table from the rim
    return replace(found, table_moved=(laboratory.board_bow_m, laboratory.board_tilt, laboratory.board_tilt))


def _in_the_laboratory(scene: Scene, lab: Laboratory, rng: np.random.Generator) -> Scene:
    """The scene with errors of the board and of the positions of the dots as faults."""
    if lab == Laboratory():
        return scene
    height, scale, x, y = rng.standard_normal(4)
    f, tilt = scene.faults, np.degrees(lab.board_tilt)
    pattern_scale = f.pattern_scale + lab.board_scale * scale
    # misprints are errors of the final position: the scale of the pattern is divided out
    prints = 1e3 * lab.print_m * rng.standard_normal((scene.declared_disc.n_markers, 2)) / pattern_scale
    faults = replace(
        f,
        misprint_mm=tuple(map(tuple, prints + (f.misprint_mm or 0.0))),
        table_height_mm=f.table_height_mm + 1e3 * lab.board_bow_m * height,
        table_turn_deg=(f.table_turn_deg[0] + tilt * x, f.table_turn_deg[1] + tilt * y),
        pattern_scale=pattern_scale,
    )
    return replace(scene, faults=faults)


def _shifted_dots(rng: np.random.Generator, pixels: Array, size: tuple[int, int], laboratory: Laboratory) -> Array:
    """Centres (n, 2, m, 2) with the errors of lens and glare."""
    found = pixels.copy()
    for camera in range(2):
        found[:, camera] += smooth_field(rng, size, laboratory.lens_px)(pixels[:, camera])
        for dot in range(pixels.shape[2]):
            found[:, camera, dot] += smooth_field(rng, size, laboratory.glare_px)(pixels[:, camera, dot])
    return found


def _rolling(scene: Scene, psi: float, phi: float) -> Motion:
    model, start = rolling_model(scene), rolling_start(scene).moved(psi=psi, phi=phi)
    return lambda times: simulate(model, start, times=np.r_[0.0, times] - STATION).q[1:]  # t = 0 at first frame


def _exposed(motion: Motion, times: Sequence[Array], faults: Faults, rig: StereoRig, disc: Disc) -> Array:
    """Images of the dots (n, 2, m, 2), averaged over the exposure; times : (n,) of each camera."""
    exposure, share = faults.exposure_s, faults.ellipse_centre_share
    # exact for polynomials of degree seven in time
    nodes, weights = np.polynomial.legendre.leggauss(4) if exposure else (np.zeros(1), np.array([2.0]))
    images = 0.0
    for node, weight in zip(nodes, weights, strict=True):
        q = np.stack([motion(instants + 0.5 * node * exposure) for instants in times])
        R, t = rotation_from_euler(*np.moveaxis(q[..., 3:], -1, 0)), q[..., :3]
        seen, _ = marker_pixels(R, t, rig, disc.marker_centres_body)
        for camera in range(2 if share else 0):
            seen[:, camera] += share * ellipse_centre_shift(R[camera], t[camera], rig, disc)[:, camera]
        images = images + 0.5 * weight * seen
    return np.asarray(images)
