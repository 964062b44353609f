"""Measured recordings of a disc without images: poses fitted to projected dots of a true motion, with noise.

Planted effects use other formulas than the diagnosis: cameras, table and dots those of the renderer's `faults`; clocks
change the instants of the simulation; exposures are a mean over instants. The rig of the trajectory differs from the
true one by an error drawn from its covariance. With imperfections of the laboratory, the residual lens field is a sum
of waves, as in the renderer; glare displaces each dot independently; the table is determined from a bent board.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from calibration.board.target import Board
from calibration.cameras.camera import N_RIG, StereoRig, by_turning
from calibration.kit.least_squares import normal_of_rows
from calibration.kit.types import Array
from disctrack.disc import Disc
from disctrack.errors import DiscTrackError
from disctrack.faults.catalogue import scene_faults
from disctrack.faults.dots import cameras_with, ellipse_centre_shift, marker_pixels
from disctrack.faults.keys import Faults
from disctrack.frames import rotation_from_euler
from disctrack.rolling import CATALOGUE, Model, simulate
from disctrack.synthetic.cameras import board_poses, rig_of
from disctrack.synthetic.description import CameraSettings, ImperfectionSettings, Scene
from disctrack.synthetic.motion import rolling_model, rolling_start, true_frame_rate
from disctrack.synthetic.optics import smooth_field
from disctrack.synthetic.recording import true_disc_of
from disctrack.track.pose import DotsInFrames, fit_poses
from disctrack.track.refine.assembly import Taken, status_of, trajectory_of
from disctrack.trajectory import Trajectory

Motion = Callable[[Array], Array]  # times (k,) [s] -> coordinates q (k, 6)

SIGMA_PX = 0.006  # of the centre of a dot: 0.5 um and 1.3 mdeg per pose, as in the reference recordings
CORNER_SIGMA_PX = 0.01
DURATION = (0.4, 0.9)  # [s]
FLATTEST_DEG = 0.9  # smallest nutation of the last frame: below, the disc touches its paper
RATE = CameraSettings().frame_rate_hz
STATION = 0.002  # [s] time of the first frame after the start of the motion


# Changes of a scene: an ordinary laboratory, with the paper of an ordinary printer
LABORATORY = {
    "imperfections": {"lens_field_px": 0.02, "board_bow_mm": 0.06, "board_stretch": 2e-4},
    "faults": {"misprint_sigma_mm": 3e-3},
}
TABLE_BY_BOW = np.array([2 / 3, 2.0, 2.0])  # [m, rad, rad] error of the table's height and tilts per metre of bow


def drawn(seed: int, planted: Mapping[str, float], rate: float = RATE) -> Scene:
    """A scene with a random motion that, with the planted effects and faults, lasts for the whole recording."""
    rng = np.random.default_rng([seed, 31])
    disc = Scene().declared_disc
    scene = Scene(seed=seed, faults=scene_faults(disc, planted, rate))
    of_motion = {name: value for name, value in planted.items() if name.partition(".")[0] in CATALOGUE}
    for _ in range(200):
        theta = rng.uniform(3.0, 15.0)
        n = int(rate * rng.uniform(*DURATION))
        start = {
            "theta_deg": theta,
            "nutation_deg": theta * rng.uniform(0.02, 0.1),
            "omega3_rad_s": rng.uniform(-2.0, 3.0),
        }
        model = Model(disc).with_values({"km.k_m": rng.uniform(0.2e-7, 0.5e-7)} | of_motion)
        effects = {effect.name: dict(effect.values) for effect in model.effects}
        cameras = {"frame_rate_hz": rate, "n_frames": n}
        scene = scene.changed(cameras=cameras, motion={"kind": "rolling", "rolling": start | {"effects": effects}})
        try:
            motion = simulate(model, rolling_start(scene), duration=1.03 * n / rate + 0.01, rate=rate)
        except DiscTrackError:  # no regular precession exists
            continue
        if len(motion) > 1.02 * n and motion.q[-1, 4] > np.radians(FLATTEST_DEG):
            return scene
    raise DiscTrackError(f"no motion of {DURATION[0]} s among those drawn: what is planted stops the disc at once")


def rig_covariance(rig: StereoRig, scene: Scene) -> Array:
    """(30, 30) from the corners of the scene's chessboard views, the first of which defines the world."""
    R, t = board_poses(scene, rig)
    arm = Board(scene.board.inner_corners, scene.board.square_mm * 1e-3).points @ np.swapaxes(R, 1, 2)
    _, by_point, by_rig = rig.project_with_jacobians(arm + t[:, None])
    rows = np.concatenate([by_point, by_turning(by_point, arm[:, None]), by_rig, 0.0 * by_rig[..., :1]], axis=-1)
    rows[0, ..., :6] = 0.0  # the pose of the first view is known
    return CORNER_SIGMA_PX**2 * normal_of_rows(rows.reshape(len(R), -1, N_RIG + 7), 6).covariances()[0]


def measured(
    scene: Scene, *, motion: Motion | None = None, sigma_px: float = SIGMA_PX, noise_seed: int | None = None
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
    imperfect = scene.imperfections != ImperfectionSettings()
    scene = _with_bent_board(scene, of_rig) if imperfect else scene
    faults, disc, rate = scene.faults, true_disc_of(scene), true_frame_rate(scene)
    true_rig = cameras_with(faults, believed_rig.perturbed(error))
    believed_rig = replace(believed_rig, covariance=covariance, world_is_table=True)
    motion = motion or _rolling(scene, *rng.uniform(-3, 3, 2))
    times = faults.true_times(np.arange(n) / rate, rate) + STATION
    pixels = _exposed(motion, [times, times + faults.right_delay_s], faults, true_rig, disc)
    if imperfect:
        pixels = _shifted_dots(of_rig, pixels, scene)
    pixels = pixels + sigma_px * rng.standard_normal(pixels.shape)
    dots = np.broadcast_to(sigma_px**2 * np.eye(2), (*pixels.shape, 2)).copy()
    q, declared = motion(times), scene.declared_disc
    seen = DotsInFrames(believed_rig, declared, pixels, dots, rotation_from_euler(*q[:, 3:].T), q[:, :3])
    fits = fit_poses(seen, reject_outliers=False)
    taken = Taken(range(n), declared_rate, scene.gravity_m_s2)
    good = np.zeros(pixels.shape[:-1], np.uint8)  # status of frames and dots
    found = trajectory_of(seen, fits, np.zeros((n, 6, 6)), status_of(good[:, 0, 0], seen, fits), good, taken)
    # with a bent board, tracking determines the displacement of the table from the rim
    height, *tilts = (1e-3 * scene.imperfections.board_bow_mm * TABLE_BY_BOW).tolist()
    return replace(found, table_moved=(height, *tilts))


def _with_bent_board(scene: Scene, rng: np.random.Generator) -> Scene:
    """The scene with random errors of table and scale as faults, as large as bow and stretch of its board allow."""
    height, scale, *tilts = rng.standard_normal(4)
    settings, f = scene.imperfections, scene.faults
    lifted, *turned = settings.board_bow_mm * TABLE_BY_BOW * [height, *tilts]
    return scene.changed(faults={
        "table_height_mm": f.table_height_mm + lifted,
        "table_turn_deg": tuple(f.table_turn_deg + np.degrees(1e-3 * np.array(turned))),
        "pattern_scale": f.pattern_scale + settings.board_stretch / 2 * scale,  # of two sides one is stretched
    })  # fmt: skip


def _shifted_dots(rng: np.random.Generator, pixels: Array, scene: Scene) -> Array:
    """Centres (n, 2, m, 2) with a field of each lens, and a smaller one of each dot: glare, gradients of light."""
    found, size, lens_px = pixels.copy(), scene.cameras.image_size, scene.imperfections.lens_field_px
    for camera in range(2):
        found[:, camera] += smooth_field(rng, size, lens_px)(pixels[:, camera])
        for dot in range(pixels.shape[2]):
            found[:, camera, dot] += smooth_field(rng, size, lens_px / 5)(pixels[:, camera, dot])
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
