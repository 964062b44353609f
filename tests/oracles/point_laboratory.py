"""Recordings of the imperfect laboratory as points instead of images: hundreds where one could be rendered.

The independent laboratory's lenses, its bowed and stretched board and its rolling disc give the pixels of corners and
dots, with noise; whatever follows (calibration, what the dots share, poses, table) is the product's own.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from calibration import Board, CalibrationSettings, CornerView, calibrate_from_corners
from disctrack.disc import MA_2014
from disctrack.frames import rotation_from_quaternion, vector_from_rotation
from disctrack.track.dots._kernels import DOT
from disctrack.track.dots.template import NoiseModel
from disctrack.track.dots.template_response import Edge
from disctrack.track.follow.following import Follower, Law, Tables, TrackingSetup
from disctrack.track.refine.assembly import Taken, TrackingSettings, assemble
from disctrack.trajectory import FrameStatus, MarkerStatus
from tests.oracles import imperfect_laboratory as laboratory

CORNER_PX, DOT_PX = 0.0024, 0.0045  # noise per axis of corners and dots in that laboratory's images
TERMS = {True: ("k1 k2 p1 p2 k3", "free"), False: ("k1 k2", "flat")}  # as chosen there by views left out


@dataclass(frozen=True)
class Geometry:
    """Where the cameras stand, and the board they are shown."""

    azimuths: tuple[float, float] = (-122.0, -53.0)  # [deg]
    inner_corners: tuple[int, int] = (9, 6)
    square: float = 8e-3  # [m]
    views: int = 20

    @property
    def board(self):
        """As declared."""
        return Board(self.inner_corners, self.square)


def cameras_of(plan, geometry=None):
    """The two cameras of a plan's seed, whose images nobody casts, and the place that they look at."""
    geometry = geometry or Geometry()
    rng = np.random.default_rng([plan.seed, 11])
    target = np.array([0.032, 0.02, 0.004]) + rng.normal(0, 5e-4, 3)
    return [laboratory.Camera(rng, plan, azimuth, target) for azimuth in geometry.azimuths], target, rng


def true_corners(plan, board):
    """(n, 3) [m] of the board as made: bowed along its long side, and longer there."""
    x, y, _ = board.points.T
    half = 0.5 * x.max()
    along = (x - half) / (half + board.square)
    bow = plan.imperfections.bow
    height = bow * (1 - along**2) if plan.seed % 2 else bow * along**2
    return np.stack([x * (1 + plan.imperfections.stretch), y, height], -1)


def corner_view(camera, points, rng):
    """Corners (n, 3) [m] in the world as a finder would state them."""
    n = len(points)
    return CornerView(
        (camera.size, camera.size),
        camera.project(points) + CORNER_PX * rng.normal(size=(n, 2)),
        np.tile(CORNER_PX**2 * np.eye(2), (n, 1, 1)),
        np.ones(n, bool),
        ("",) * n,
    )


def calibration_of(plan, cameras, target, rng, geometry=None, settings=None):
    """The rig from views of the board, the first of which lies on the table."""
    geometry = geometry or Geometry()
    board, thickness = geometry.board, 3e-3
    points = true_corners(plan, board)
    middle = 0.5 * board.points.max(axis=0)
    views = ([], [])
    for view in range(geometry.views):
        R, t = np.eye(3), np.array([0, 0, thickness + plan.imperfections.thickness])
        if view:
            azimuth = rng.uniform(0, 2 * np.pi)
            axis = np.array([np.cos(azimuth), np.sin(azimuth), 0])
            R = cv2.Rodrigues(rng.uniform(0, np.radians(38)) * axis)[0]
            R = R @ cv2.Rodrigues(np.array([0, 0, rng.uniform(-1, 1) * np.radians(35)]))[0]
            t = target + np.array([*rng.uniform(-0.022, 0.022, 2), rng.uniform(5e-3, 40e-3)]) - R @ middle
        for side, camera in zip(views, cameras, strict=True):
            side.append(corner_view(camera, points @ R.T + t, rng))
    if settings is None:
        settings = CalibrationSettings(*TERMS[plan.imperfections != laboratory.IDEAL])
    return calibrate_from_corners(*views, board, settings, 0, thickness)


def recorded(plan, geometry=None, settings=None, frames=None):
    """Tracking of a recording by points, and its true poses R (n, 3, 3), t (n, 3).

    frames : numbers of those that are there, if not all
    """
    cameras, target, rng = cameras_of(plan, geometry)
    rig = calibration_of(plan, cameras, target, rng, geometry, settings).rig
    times = np.arange(plan.n_frames) / plan.frame_rate
    spline = laboratory.motion(plan)
    body = np.column_stack([laboratory.DOTS, np.full(len(laboratory.DOTS), laboratory.HALF_THICKNESS)])
    body[:, :2] += plan.imperfections.misprint * rng.normal(size=laboratory.DOTS.shape)
    px = 0.0
    for node, weight in laboratory.GAUSS:
        R, t = poses_at(spline, times + 0.5 * plan.imperfections.exposure * node)
        points = body @ np.swapaxes(R, 1, 2) + t[:, None]
        px = px + weight * np.stack([camera.project(points) for camera in cameras], 1)
    px = px + DOT_PX * rng.normal(size=px.shape)
    R, t = poses_at(spline, times)
    rows = np.arange(plan.n_frames) if frames is None else np.asarray(frames)
    return tracked(px[rows], R[rows], t[rows], times[rows], rig, plan.frame_rate), R[rows], t[rows]


def poses_at(spline, times):
    """R (n, 3, 3), t (n, 3) of the disc."""
    return tuple(np.stack(part) for part in zip(*(laboratory.pose_at(spline, time) for time in times), strict=True))


def tables_of(px, R, t, sigma):
    """What following leaves of dots (n, 2, m, 2), of white noise sigma [px], and of poses."""
    n, _, m, _ = px.shape
    results = np.full((n, 2, m), np.nan, DOT)
    results["u"], results["v"] = np.moveaxis(px, -1, 0)
    results["var_u"] = results["var_v"] = sigma**2
    results["cov_uv"], results["chi_square"], results["n_pixels"] = 0.0, 1.0, 300.0
    measured = np.full((n, 2, m), MarkerStatus.MEASURED, np.uint8), np.full(n, FrameStatus.MEASURED, np.uint8)
    return Tables(results, measured[0], R.copy(), t.copy(), measured[1], np.zeros((n, 2), np.uint64))


def tracked(px, R, t, times, rig, frame_rate, settings=None, workers=1):
    """What tracking makes of located dots (n, 2, m, 2), followed near poses R, t."""
    setup = TrackingSetup(rig, MA_2014, None)  # no image is looked at
    follower = Follower(setup, Law((Edge(noise=NoiseModel(0.64, 0.02)),) * 2), measured=True)
    taken = Taken(range(len(px)), times, frame_rate, laboratory.G)
    return assemble([follower], tables_of(px, R, t, DOT_PX), settings or TrackingSettings(), taken, workers)


def errors_and_variances(trajectory, R, t):
    """(n, 6) error of every measured pose in the lab frame, and its stated variance, calibration and table included."""
    turn = vector_from_rotation(rotation_from_quaternion(trajectory.quaternion) @ np.swapaxes(R, 1, 2))
    error = np.concatenate([trajectory.q[:, :3] - t, turn], 1)[trajectory.measured]
    whole = trajectory.pose_covariance + trajectory.calibration_covariance
    return error, np.diagonal(whole, axis1=1, axis2=2)[trajectory.measured]
