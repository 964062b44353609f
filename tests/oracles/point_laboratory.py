"""Recordings of an ordinary laboratory as points instead of images: hundreds where one could be rendered.

Lenses with a smooth residual field beyond any radial polynomial, a chessboard that is bowed and stretched along one
side, misprinted dots and a disc that rolls as in `newton_euler` give the pixels of corners and dots, with noise;
whatever follows (calibration, what the dots share, poses, table) is the product's own.
"""

from dataclasses import dataclass, field

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from calibration import Board, calibrate_from_corners
from disctrack.disc import MA_2014
from disctrack.frames import rotation_from_quaternion, vector_from_rotation
from disctrack.track.dots._kernels import DOT
from disctrack.track.dots.template import Edge, NoiseModel
from disctrack.track.follow.following import Follower, Tables
from disctrack.track.refine.assembly import Taken, assemble
from disctrack.trajectory import FrameStatus, MarkerStatus
from tests.oracles import newton_euler
from tests.oracles.drawn_boards import corner_view

G = 9.81
BOARD_THICKNESS = 3e-3
CORNER_PX, DOT_PX = 0.0024, 0.0045  # noise per axis of corners and dots in good images
GAUSS = ((-0.7745966692414834, 5 / 18), (0.0, 8 / 18), (0.7745966692414834, 5 / 18))


@dataclass(frozen=True)
class Plan:
    """A recording; of its imperfections 0 switches each off."""

    seed: int = 1
    n_frames: int = 300
    size: int = 512
    mm_per_px: float = 0.25
    n_views: int = 20
    azimuths: tuple[float, float] = (-122.0, -53.0)  # [deg] of the cameras
    inner_corners: tuple[int, int] = (9, 6)
    square: float = 8e-3
    frame_rate: float = 1000.0
    disc: newton_euler.Disc = field(default_factory=newton_euler.of_the_paper)
    lens_field: float = 0.02  # [px] rms per axis
    bow: float = 60e-6  # [m] of the board, middle against short sides
    stretch: float = 2e-4  # squares longer along the long side
    misprint: float = 0.0  # [m] rms of the dots' places, per axis
    exposure: float = 2e-4  # [s]

    @property
    def board_size(self):
        """[m] of the board from the first to the last corner, along both sides."""
        return self.square * (np.array(self.inner_corners) - 1)


IDEAL = {"lens_field": 0.0, "bow": 0.0, "stretch": 0.0, "exposure": 0.0}


class Camera:
    """Pinhole, two radial terms and the residual field."""

    def __init__(self, rng, plan, azimuth, target):
        size = self.size = plan.size
        off, azimuth = np.radians(42 + rng.normal(0, 2)), np.radians(azimuth + rng.normal(0, 2))
        distance = 0.42 + rng.normal(0, 0.01)
        self.focal = distance / (plan.mm_per_px * 1e-3) * (1 + rng.normal(0, 0.005))
        self.middle = (size - 1) / 2 + rng.normal(0, 4, 2)
        self.k1, self.k2 = -0.11 + rng.normal(0, 0.01), 0.22
        back = np.array([np.sin(off) * np.cos(azimuth), np.sin(off) * np.sin(azimuth), np.cos(off)])
        z = -back
        x = np.cross(z, [0, 0, 1.0])
        x /= np.linalg.norm(x)
        roll = np.radians(rng.normal(0, 2))
        y = np.cross(z, x)
        self.R = np.array([np.cos(roll) * x + np.sin(roll) * y, np.cos(roll) * y - np.sin(roll) * x, z])
        self.place = target + distance * back
        self.waves = rng.normal(size=(6, 2)) * 2 * np.pi / (0.9 * size)  # wavelengths of about the image's side
        self.phases = rng.uniform(0, 2 * np.pi, (6, 2))
        raw = self._raw_field(np.stack(np.meshgrid(np.arange(0, size, 8.0), np.arange(0, size, 8.0)), -1))
        self.field_mean, self.field_scale = raw.mean((0, 1)), plan.lens_field / raw.std((0, 1))

    def _raw_field(self, pixels):
        turns = np.einsum("...j,kj->...k", pixels, self.waves)
        return np.stack([np.sin(turns + self.phases[:, axis]).sum(-1) for axis in (0, 1)], -1)

    def project(self, points):
        """Pixels (..., 2) of world points (..., 3): where the polynomial has them, and the field there."""
        inside = (points - self.place) @ self.R.T
        ray = inside[..., :2] / inside[..., 2:]
        r2 = np.sum(ray * ray, -1, keepdims=True)
        smooth = found = self.middle + self.focal * ray * (1 + r2 * (self.k1 + r2 * self.k2))
        for _ in range(4):
            found = smooth + (self._raw_field(found) - self.field_mean) * self.field_scale
        return found


def cameras_of(plan, rng):
    """The two cameras, and the place that they look at."""
    target = np.array([0.032, 0.02, 0.004]) + rng.normal(0, 5e-4, 3)
    return [Camera(rng, plan, azimuth, target) for azimuth in plan.azimuths], target


def board_height(x, plan):
    """Height [m] of the printed face above its lowest part, at x [m] along the long side."""
    half = 0.5 * plan.board_size[0]
    along = (x - half) / (half + plan.square)
    return plan.bow * (1 - along**2) if plan.seed % 2 else plan.bow * along**2


def board_pose(view, plan, target, rng):
    """R, t of the printed face; the first view is that of the board on the table."""
    if not view:
        return np.eye(3), np.array([0.0, 0.0, BOARD_THICKNESS])
    azimuth = rng.uniform(0, 2 * np.pi)
    R = cv2.Rodrigues(rng.uniform(0, np.radians(38)) * np.array([np.cos(azimuth), np.sin(azimuth), 0]))[0]
    R = R @ cv2.Rodrigues(np.array([0, 0, rng.uniform(-1, 1) * np.radians(35)]))[0]
    place = target + np.array([*rng.uniform(-0.022, 0.022, 2), rng.uniform(5e-3, 40e-3)])
    return R, place - R @ np.array([*(0.5 * plan.board_size), 0.0])


def calibration_of(plan, cameras, target, rng):
    """The rig from views of the board, which is bowed along its long side, and longer there than declared."""
    board = Board(plan.inner_corners, plan.square)
    x, y, _ = board.points.T
    points = np.stack([x * (1 + plan.stretch), y, board_height(x, plan)], -1)
    views = ([], [])
    for view in range(plan.n_views):
        R, t = board_pose(view, plan, target, rng)
        for side, camera in zip(views, cameras, strict=True):
            seen = camera.project(points @ R.T + t) + CORNER_PX * rng.normal(size=(len(points), 2))
            side.append(corner_view(seen, CORNER_PX, (camera.size, camera.size)))
    return calibrate_from_corners(*views, board, None, 0, BOARD_THICKNESS)


def pose_of(q):
    """R (..., 3, 3), t (..., 3) of the disc at q (..., 6)."""
    return Rotation.from_euler("ZXZ", q[..., 3:]).as_matrix(), q[..., :3]


def recorded(plan):
    """Tracking of a recording by points, and its true poses R (n, 3, 3), t (n, 3)."""
    rng = np.random.default_rng([plan.seed, 11])
    cameras, target = cameras_of(plan, rng)
    rig = calibration_of(plan, cameras, target, rng).rig
    times = np.arange(plan.n_frames) / plan.frame_rate
    duration, psi = plan.n_frames / plan.frame_rate, 0.7 + 1.9 * plan.seed
    spline = newton_euler.filmed_motion(plan.disc, 12.0, 1.5, duration, plan.frame_rate, psi)
    body = MA_2014.marker_centres_body.copy()
    body[:, :2] += plan.misprint * rng.normal(size=(len(body), 2))
    px = 0.0
    for node, weight in GAUSS:
        R, t = pose_of(spline(times + 0.5 * plan.exposure * node))
        points = body @ np.swapaxes(R, 1, 2) + t[:, None]
        px = px + weight * np.stack([camera.project(points) for camera in cameras], 1)
    px = px + DOT_PX * rng.normal(size=px.shape)
    R, t = pose_of(spline(times))
    return tracked(px, R, t, times, rig, plan.frame_rate), R, t


def tables_of(px, R, t, sigma):
    """What following leaves of dots (n, 2, m, 2), of white noise sigma [px], and of poses."""
    n, _, m, _ = px.shape
    results = np.full((n, 2, m), np.nan, DOT)
    results["u"], results["v"] = np.moveaxis(px, -1, 0)
    results["var_u"] = results["var_v"] = sigma**2
    results["cov_uv"], results["chi_square"], results["n_pixels"] = 0.0, 1.0, 300.0
    measured = np.full((n, 2, m), MarkerStatus.MEASURED, np.uint8), np.full(n, FrameStatus.MEASURED, np.uint8)
    return Tables(results, measured[0], R.copy(), t.copy(), measured[1], np.zeros((n, 2), np.uint64))


def tracked(px, R, t, times, rig, frame_rate):
    """What tracking makes of located dots (n, 2, m, 2), followed near poses R, t."""
    # no image is looked at
    follower = Follower(rig, MA_2014, None, (Edge(noise=NoiseModel(0.64, 0.02)),) * 2, measured=True)
    taken = Taken(range(len(px)), frame_rate, G, times)
    return assemble([follower], tables_of(px, R, t, DOT_PX), taken, 1)


def errors_and_variances(trajectory, R, t):
    """(n, 6) error of every measured pose in the lab frame, and its stated variance, calibration and table included."""
    turn = vector_from_rotation(rotation_from_quaternion(trajectory.quaternion) @ np.swapaxes(R, 1, 2))
    error = np.concatenate([trajectory.q[:, :3] - t, turn], 1)[trajectory.measured]
    whole = trajectory.pose_covariance + trajectory.calibration_covariance
    return error, np.diagonal(whole, axis1=1, axis2=2)[trajectory.measured]
