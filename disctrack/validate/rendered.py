"""Rendered recordings, measured and compared with their truth, each with its own rig and chessboards.

A case is a named scene, with its faults, imperfections and light in all images. Reading, calibration and tracking of
the recording are those of any user's recording. A comparison uses only the truth and the reported numbers.
"""

import tempfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from calibration.cameras.camera import StereoRig
from calibration.kit.types import AnyArray, Array, Mask
from disctrack.calibrate.stage import calibrate_recording
from disctrack.disc import Disc
from disctrack.errors import SceneError
from disctrack.findings import Kind
from disctrack.frames import CAMERAS, COORDINATES, rotation_from_euler, rotation_from_quaternion, vector_from_rotation
from disctrack.recording.declaration import read_recording
from disctrack.synthetic.cameras import all_inside, rig_of
from disctrack.synthetic.description import GlareSettings, Scene
from disctrack.synthetic.recording import Truth, run_render
from disctrack.track.measurement import measure, open_pairs
from disctrack.track.pose import MIN_DOTS, dots_at
from disctrack.trajectory import Trajectory, part
from disctrack.validate.points import LABORATORY

STATIC = "static poses"
ROLLING = "rolling at 8 to 12 deg"
FINAL = "rolling to rest at 0.5 deg"
IMPERFECT = "rolling in an imperfect laboratory"
EXPOSURE = 0.5e-3  # [s] half the time between frames: rolling at 10 deg blurs the outer dots over 0.6 px
# With the friction coefficient k_m of Ma et al. 2014, equation (5.3), alone the disc comes to rest according to
TO_REST = (7.93, 1.5)  # (5.11): theta [deg] this time [s] before the end; theta is proportional to time^(2/3)
# Nutation [deg]: the error of psi and phi is proportional to 1/sin(theta), so strata are about equal in log(theta).
STRATA_DEG = ((0.5, 1.0), (1.0, 2.0), (2.0, 5.0), (5.0, 10.0), (10.0, 20.0), (20.0, 40.0), (40.0, 60.0), (60.0, 85.0))
FIELD_RADIUS = 25e-3  # [m] largest distance of the disc from the middle of the field, with all dots in both images
BORDER_PX = 14  # for the window around a dot
SMALLEST_SEMI_MINOR_PX = 3.2  # below, the blurred centre of a dot is not black
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
        usable = part(self, self.usable)
        variance = np.median(np.diagonal(usable.calibration_covariance, axis1=1, axis2=2), axis=0)
        return usable.error.mean(axis=0), np.sqrt(variance)

    def frame_to_frame(self) -> float:
        """Variance of the errors from their second differences, over the stated variance of the noise of a frame."""
        usable = part(self, self.usable)
        variances = np.diff(usable.error, 2, axis=0) ** 2 / 6.0
        return float(np.mean(variances / np.diagonal(usable.covariance, axis1=1, axis2=2)[1:-1]))


def compare(trajectory: Trajectory, q_true: Array) -> PoseErrors:
    """Comparison of a trajectory with the true poses (n, 6) of its frames."""
    R = rotation_from_euler(*q_true[:, 3:].T)
    turn = rotation_from_quaternion(trajectory.quaternion) @ np.swapaxes(R, 1, 2)
    error = np.concatenate([trajectory.q[:, :3] - q_true[:, :3], vector_from_rotation(turn)], axis=1)
    angles = np.angle(np.exp(1j * (trajectory.q[:, 3:] - q_true[:, 3:])))
    return PoseErrors(q_true, error, angles, trajectory.pose_covariance, trajectory.calibration_covariance)


@dataclass(frozen=True)
class RenderedOutcome:
    """Errors of one recording, measured with its own calibration and with the true cameras."""

    name: str
    seed: int
    own: PoseErrors
    true: PoseErrors
    cameras: AnyArray  # (n,) whole numbers: how many see the upper face
    systematic_px: tuple[float, float]  # of each camera, common to all frames
    warnings: tuple[str, ...]

    @property
    def seen_by_both(self) -> tuple[PoseErrors, PoseErrors]:
        """Errors with the own calibration and with the true cameras, of poses in which both cameras see the face."""
        return part(self.own, self.cameras == 2), part(self.true, self.cameras == 2)


def scene_of(seed: int, quick: bool = False) -> Scene:
    """The scene of one recording in the paper's format; quick: a quarter of the pixels and fewer chessboard views."""
    scene = Scene(name=f"validation {seed}", seed=seed)
    if not quick:
        return scene
    board = {"n_views": 12, "square_mm": 6.0, "shift_mm": 15.0}
    return scene.changed(cameras={"image_size": (272, 272)}, rig={"mm_per_px": 0.42}, board=board)


def rendered_cases(n: int | None, seed: int, quick: bool = False, imperfect: bool = False) -> list[Scene]:
    """Scenes of n sets of recordings (None: enough) with consecutive seeds; quick: small images, few frames.

    A set has one recording of an imperfect laboratory, or three of an ideal one.
    """
    n = n or (1 if quick else 3)
    scenes = [scene_of(seed + k, quick) for k in range(n)]
    if imperfect:
        return [imperfect_case(scene, 60 if quick else 200) for scene in scenes]
    # static poses and frames of each rolling recording: distributed over the sets, with at least a dozen in each
    totals = (40, 24) if quick else (96, 90)
    counts = [max(12, -(-total // n)) for total in totals]
    return [case for scene in scenes for case in ideal_cases(scene, *counts)]


def ideal_cases(scene: Scene, n_static: int, n_rolling: int) -> list[Scene]:
    """Static poses of all attitudes, and two rolling recordings."""
    rng = np.random.default_rng([scene.seed, 8])
    q = static_poses(n_static, scene, rng)
    start = rng.uniform(8, 12)
    theta, time = TO_REST
    left = time * (0.5 / theta) ** 1.5 + n_rolling / scene.cameras.frame_rate_hz
    return [
        at_rest(scene, q),
        rolling_scene(scene, ROLLING, start, n_rolling, rng),
        rolling_scene(scene, FINAL, theta * (left / time) ** (2 / 3), n_rolling, rng),
    ]


def at_rest(scene: Scene, q: Array) -> Scene:
    """The scene with static poses q (n, 6), one frame each."""
    poses = tuple(map(tuple, q * np.r_[np.full(3, 1e3), np.full(3, 180 / np.pi)]))
    return scene.changed(name=STATIC, motion={"kind": "static", "poses": poses})


def imperfect_case(scene: Scene, frames: int) -> Scene:
    """Rolling in a laboratory with the usual imperfections; every second board is bowed downwards."""
    rng = np.random.default_rng([scene.seed, 11])
    width, height = scene.cameras.image_size
    spots = tuple(
        GlareSettings(name, (rng.uniform(0.3, 0.7) * width, rng.uniform(0.3, 0.7) * height), 0.18 * width, 12.0)
        for name in CAMERAS
    )
    usual = LABORATORY["imperfections"]
    sensor = {"pixel_gain": 0.01, "column_offset_dn": 0.3, "response_curve": 0.03}
    flaws = {**usual, **sensor, "board_bow_mm": usual["board_bow_mm"] * (1 if scene.seed % 2 else -1)}
    scene = scene.changed(imperfections=flaws, optics={"vignetting": 0.15}, light={"glare": spots})
    return rolling_scene(scene, IMPERFECT, rng.uniform(8, 16), frames, rng)


def rolling_scene(scene: Scene, name: str, theta_deg: float, n: int, rng: np.random.Generator) -> Scene:
    """The scene with n frames of rolling from nutation `theta_deg` and random psi and phi."""
    start = {
        "theta_deg": theta_deg,
        "psi_deg": rng.uniform(-180, 180),
        "phi_deg": rng.uniform(-180, 180),
        "centre_mm": scene.rig.target_mm[:2],
        "effects": {"km": {}},  # with the published coefficient
    }
    cameras = {"n_frames": n, "exposure_s": EXPOSURE}
    return scene.changed(name=name, cameras=cameras, motion={"kind": "rolling", "rolling": start})


def render_and_measure(scene: Scene) -> RenderedOutcome:
    """Render the recording, calibrate with its own chessboards, measure it twice; all files are removed."""
    with tempfile.TemporaryDirectory(prefix="disctrack-validate-") as folder:
        truth = render(Path(folder) / "recording", scene)
        recording = read_recording(Path(folder) / "recording")
        calibration, _ = calibrate_recording(recording)
        found = [measure(recording, rig, open_pairs(recording)) for rig in (calibration.rig, truth.rig)]
    rows = slice(None, None, 2 if scene.motion.kind == "static" else 1)
    own, true = (compare(part(tracking.trajectory, rows), truth.q) for tracking in found)
    cameras = cameras_in_sight(truth.q, truth.rig, recording.disc)
    systematic_px = tuple(found[0].details["systematic_px"])
    # the empty pairs are no warning
    warnings = tuple(f.sentence for f in found[0].trajectory.findings if f.kind != Kind.UNREADABLE)
    return RenderedOutcome(scene.name, scene.seed, own, true, cameras, systematic_px, warnings)


def render(folder: Path, scene: Scene) -> Truth:
    """Write a recording; an empty pair follows each static pose, so that it is found without a prediction."""
    truth = run_render(scene, folder)
    if scene.motion.kind == "static":
        for camera in CAMERAS:
            reordered(folder / camera, lambda files: [content for file in files for content in (file, b"")])
    return truth


def reordered(folder: Path, change: Callable[[list[bytes]], Iterable[bytes | AnyArray]]) -> None:
    """Reorder, remove, repeat or change the files of a folder, and renumber them; images are encoded as before."""
    files = sorted(folder.iterdir())
    contents = [*change([file.read_bytes() for file in files])]
    for file in files:
        file.unlink()  # it may be a link to a file of another recording
    for number, content in enumerate(contents):
        encoded = content if isinstance(content, bytes) else cv2.imencode(files[0].suffix, content)[1].tobytes()
        (folder / f"{number:06d}{files[0].suffix}").write_bytes(encoded)


def static_poses(n: int, scene: Scene, rng: np.random.Generator) -> Array:
    """(n, 6) poses q on the table in order of nutation, evenly from all strata, with random psi, phi and position.

    Positions with a dot outside an image are drawn again. At large nutation the disc faces away from the cameras for
    half of all psi; such poses are included. Raises SceneError if the disc does not fit into the field.
    """
    rig, disc, middle = rig_of(scene), scene.declared_disc, 1e-3 * np.array(scene.rig.target_mm[:2])
    poses = [_pose(np.radians(STRATA_DEG[i % len(STRATA_DEG)]), rig, disc, middle, rng) for i in range(n)]
    return np.array(sorted(poses, key=lambda q: q[4]))


def _pose(stratum: Array, rig: StereoRig, disc: Disc, middle: Array, rng: np.random.Generator) -> Array:
    for attempt in range(400):
        psi, phi, direction = rng.uniform(-np.pi, np.pi, 3)
        theta = np.exp(rng.uniform(*np.log(stratum)))
        # the field shrinks slowly with the attempts, for small images and large nutation
        reach = FIELD_RADIUS * np.sqrt(rng.uniform()) * (1 - attempt / 500)
        x, y = middle + reach * np.array([np.cos(direction), np.sin(direction)])
        q = np.array([x, y, disc.resting_height(theta), psi, theta, phi])
        if all_inside(disc.marker_centres_body @ rotation_from_euler(*q[3:]).T + q[:3], rig, BORDER_PX):
            return q
    raise SceneError("no place found where all dots lie in both images; widen the field (rig.mm_per_px, image_size)")


def cameras_in_sight(q: Array, rig: StereoRig, disc: Disc) -> AnyArray:
    """(n,) number of cameras that see enough dots for a pose, 0 to 2, in the poses q (n, 6).

    The upper face must face the camera, and the semi-minor axis of the image of a dot, which is an ellipse, must be
    above SMALLEST_SEMI_MINOR_PX.
    """
    R = rotation_from_euler(*q[:, 3:].T)
    half_axes = 0.5 * disc.marker_diameter * dots_at(R, q[:, :3], rig, disc)[1]  # of the ellipses, conjugate
    facing = np.linalg.det(half_axes) < 0  # y of the image points down
    semi_minor = facing * np.linalg.svd(half_axes, compute_uv=False)[..., 1]
    return np.sum(np.sum(semi_minor > SMALLEST_SEMI_MINOR_PX, axis=2) >= MIN_DOTS, axis=1)
