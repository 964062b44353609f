"""Measured trajectories of a disc without images: true motion, true cameras, noise on the dots, poses fitted.

What is planted goes through other formulas than those of the diagnosis: cameras through the renderer's `faults`, the
table's frame through the rig's, dots through their true places, clocks through the instants at which the motion is
simulated, exposures through a mean over instants. The rig that the trajectory carries differs from the true one by an
error drawn from its covariance.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from calibration.cameras.camera import N_RIG, StereoRig
from calibration.kit.arrays import Array
from disctrack.diagnosis.trials.imperfect import Laboratory, shifted_dots
from disctrack.disc import Disc
from disctrack.frames import (
    continuous_quaternions,
    euler_from_rotation,
    quaternion_from_rotation,
    rotation_from_euler,
    rotation_from_vector,
    unwrap_euler,
)
from disctrack.rolling import Effect, Model, simulate, steady_precession
from disctrack.synthetic.cameras import board_poses, rig_after_faults, rig_of
from disctrack.synthetic.description import Faults, Scene
from disctrack.track.pose import fit_poses
from disctrack.trajectory import Trajectory

Motion = Callable[[Array], Array]  # instants (k,) [s] -> coordinates q (k, 6)

SIGMA_PX = 0.006  # of a dot's centre: 0.5 um and 1.3 mdeg per pose, as in the reference recordings
CORNER_SIGMA_PX = 0.01
K_M = 0.381e-7
STATION = 0.002  # [s] after the motion's first instant at which the first frame is taken
_RADII, _ANGLES = 4, 16  # points of a dot over which the centre of its image is taken
_INSTANTS = 4  # of an exposure: Gauss-Legendre, exact to the seventh power of time


@dataclass(frozen=True)
class Unseen:
    """What goes wrong beside the faults that a scene knows."""

    pattern_turn: float = 0.0  # [rad] of all dots about e3
    pattern_scale: float = 0.0  # relative
    pattern_height: float = 0.0  # [m] of the dots above half the thickness
    table_turn: tuple[float, float] = (0.0, 0.0)  # [rad] rotation vector of the true table in the calibrated axes
    table_height: float = 0.0  # [m] of the true table in the calibrated axes
    clock: float = 0.0  # relative change of the frame rate
    exposure: float = 0.0  # [s] both cameras; a dot's image is averaged over it
    image_centres: bool = False  # the centre of a dot's image is taken for the image of its centre
    laboratory: Laboratory = field(default_factory=Laboratory)


def rig_covariance(rig: StereoRig, scene: Scene) -> Array:
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
    return np.asarray(CORNER_SIGMA_PX**2 * np.linalg.inv(normal / np.outer(scale, scale)) / np.outer(scale, scale))


def measured(
    effects: Mapping[str, float] | None = None,
    *,
    faults: Faults | None = None,
    unseen: Unseen | None = None,
    seed: int = 1,
    n: int = 500,
    theta_deg: float = 14.0,
    nutation_deg: float = 0.5,
    omega3: float = 1.0,
    declared_rate: float = 1000.0,
    sigma_px: float = SIGMA_PX,
    motion: Motion | None = None,
    base: Mapping[str, float] | None = None,
    laws: Sequence[type[Effect]] = (),
    rig_seed: int | None = None,
    disc: Disc | None = None,
) -> Trajectory:
    """Trajectory of a disc that rolls down with these effects ("effect.parameter") besides the paper's k_m.

    faults, unseen : delay, frame rate, dots, pattern, cameras, table; the trajectory does not tell of them
    motion         : in place of the rolling model's
    base           : laws that every diagnosis knows of, in place of k_m = 0.381e-7
    laws           : by formula, that `effects` may name
    rig_seed       : of the errors of calibration and laboratory, equal for recordings of one day; else their own
    disc           : in place of the scene's
    """
    rng = np.random.default_rng([20261121, seed])
    scene = Scene(seed=seed if rig_seed is None else rig_seed, faults=faults or Faults())
    f, u = scene.faults, unseen or Unseen()
    disc = disc or scene.declared_disc
    u = replace(u, exposure=u.exposure or f.exposure_s)
    believed_rig = rig_of(scene)
    covariance = rig_covariance(believed_rig, scene)
    # drawn as correlations: k3 has a sigma of 100, a rotation one of 1e-4, and rounding must not mix them
    sigma = np.sqrt(np.diag(covariance))
    of_rig = rng if rig_seed is None else np.random.default_rng([20261122, rig_seed])
    error = sigma * of_rig.multivariate_normal(np.zeros(N_RIG), covariance / np.outer(sigma, sigma), method="eigh")
    u, prints = _of_the_laboratory(u, disc, of_rig)
    true_rig = _on_the_true_table(rig_after_faults(believed_rig.perturbed(error), scene), u)
    believed_rig = replace(believed_rig, covariance=covariance, world_is_table=True)
    if motion is None:
        amounts = dict({"km.k_m": K_M} if base is None else base) | dict(effects or {})
        motion = _rolling(Model(disc, laws=tuple(laws)).with_values(amounts), theta_deg, nutation_deg, omega3, rng)
    true_times = np.arange(n) / ((f.frame_rate_hz or declared_rate) * (1.0 + u.clock)) + STATION
    centres = _true_centres(disc, f, u) + prints
    views = [
        _exposed(motion, true_times + delay, u, true_rig, centres, disc)[:, camera]
        for camera, delay in enumerate((0.0, f.right_delay_s))
    ]
    pixels = np.stack(views, axis=1)
    if u.laboratory != Laboratory():
        pixels = shifted_dots(of_rig, pixels, scene.cameras.image_size[0], u.laboratory)
    pixels = pixels + sigma_px * rng.standard_normal(pixels.shape)
    dots = np.broadcast_to(sigma_px**2 * np.eye(2), (*pixels.shape, 2)).copy()
    return _tracked(pixels, dots, motion(true_times), believed_rig, disc, declared_rate)


def _of_the_laboratory(u: Unseen, disc: Disc, rng: np.random.Generator) -> tuple[Unseen, Array]:
    """With the board's errors among the others, and the errors (m, 3) of the dots' places [m]."""
    lab, shift = u.laboratory, np.zeros((disc.n_markers, 3))
    if lab == Laboratory():
        return u, shift
    height, scale, x, y = rng.standard_normal(4)
    shift[:, :2] = lab.print_m * rng.standard_normal((disc.n_markers, 2))
    u = replace(
        u,
        table_height=u.table_height + lab.board_bow_m * height,
        table_turn=(u.table_turn[0] + lab.board_tilt * x, u.table_turn[1] + lab.board_tilt * y),
        pattern_scale=u.pattern_scale + lab.board_scale * scale,
    )
    return u, shift


def _rolling(model: Model, theta_deg: float, nutation_deg: float, omega3: float, rng: np.random.Generator) -> Motion:
    start = steady_precession(
        np.radians(theta_deg),
        model.disc,
        omega3=omega3,
        nutation_amplitude=np.radians(nutation_deg),
        psi=rng.uniform(-3, 3),
        phi=rng.uniform(-3, 3),
        x=0.032,
        y=0.020,
    )
    return lambda times: simulate(model, start, times=np.r_[0.0, times]).q[1:]


def _on_the_true_table(rig: StereoRig, u: Unseen) -> StereoRig:
    """The rig seen from axes of the true table, in which the disc moves."""
    R = rotation_from_vector(np.array([*u.table_turn, 0.0]))
    t = np.array([0.0, 0.0, u.table_height])
    return replace(rig, R_left_world=rig.R_left_world @ R, t_left_world=rig.t_left_world + rig.R_left_world @ t)


def _true_centres(disc: Disc, f: Faults, u: Unseen) -> Array:
    centres = disc.marker_centres_body.copy()
    centres[:, :2] += np.array(f.misprint_mm or np.zeros((disc.n_markers, 2))) * 1e-3
    turn = u.pattern_turn + np.radians(f.pattern_turn_deg)
    centres = (f.pattern_scale + u.pattern_scale) * centres @ rotation_from_vector(np.array([0.0, 0.0, turn])).T
    centres[:, :2] += np.array(f.pattern_offset_mm) * 1e-3
    centres[:, 2] = disc.marker_centres_body[:, 2] + u.pattern_height + f.pattern_height_mm * 1e-3
    return centres


def _exposed(motion: Motion, times: Array, u: Unseen, rig: StereoRig, centres: Array, disc: Disc) -> Array:
    """Images of the dots (n, 2, m, 2), averaged over the exposure."""
    nodes, weights = np.polynomial.legendre.leggauss(_INSTANTS) if u.exposure else (np.zeros(1), np.array([2.0]))
    images = 0.0
    for node, weight in zip(nodes, weights, strict=True):
        q = motion(times + 0.5 * node * u.exposure)
        R, t = rotation_from_euler(*q[:, 3:].T), q[:, :3]
        seen = _image_centres(R, t, rig, centres, disc) if u.image_centres else _images(R, t, rig, centres)
        images = images + 0.5 * weight * seen
    return np.asarray(images)


def _images(R: Array, t: Array, rig: StereoRig, centres: Array) -> Array:
    return np.moveaxis(rig.project(centres @ np.swapaxes(R, 1, 2) + t[:, None]), -3, 1)


def _image_centres(R: Array, t: Array, rig: StereoRig, centres: Array, disc: Disc) -> Array:
    """Centres of the areas that the dots' images cover (n, 2, m, 2), by quadrature over the dots."""
    nodes, weights = np.polynomial.legendre.leggauss(_RADII)
    radii, angles = 0.25 * disc.marker_diameter * (1 + nodes), 2 * np.pi * np.arange(_ANGLES) / _ANGLES
    r, a = (grid.ravel() for grid in np.meshgrid(radii, angles, indexing="ij"))
    weight = np.repeat(weights * radii, _ANGLES)
    found = []
    for centre in centres:
        body = centre + np.stack([r * np.cos(a), r * np.sin(a), np.zeros(r.size)], axis=-1)
        pixels, by_point, _ = rig.project_with_jacobians(body @ np.swapaxes(R, 1, 2) + t[:, None])
        area = np.abs(np.linalg.det(by_point @ R[:, None, None, :, :2])) * weight  # (n, 2, points)
        found.append(np.sum(pixels * area[..., None], axis=2) / np.sum(area, axis=2)[..., None])
    return np.stack(found, axis=2)


def _tracked(pixels: Array, dots: Array, q: Array, rig: StereoRig, disc: Disc, rate: float) -> Trajectory:
    n = len(pixels)
    fits = fit_poses(
        pixels,
        dots,
        rig,
        disc.marker_centres_body,
        rotation_from_euler(*q[:, 3:].T),
        q[:, :3],
        reject_outliers=False,
    )
    angles = unwrap_euler(euler_from_rotation(fits.R_world_body))
    return Trajectory(
        time=np.arange(n) / rate,
        frame=np.arange(n),
        q=np.column_stack([fits.t_world_body, angles]),
        pose_covariance=fits.covariance,
        calibration_sensitivity=fits.sensitivity,
        systematic_covariance=np.zeros((len(fits.covariance), 6, 6)),
        quaternion=continuous_quaternions(quaternion_from_rotation(fits.R_world_body)),
        frame_status=np.zeros(n, np.uint8),
        reprojection_rms_px=np.sqrt(np.nanmean(fits.residuals_px**2, axis=(2, 3))),
        reduced_chi_square=fits.reduced_chi_square,
        markers_px=pixels,
        markers_covariance_px2=dots,
        markers_residual_px=fits.residuals_px,
        marker_status=np.zeros((n, 2, disc.n_markers), np.uint8),
        disc=disc,
        rig=rig,
        frame_rate=rate,
        gravity=9.81,
    )
