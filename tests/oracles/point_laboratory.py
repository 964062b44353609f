"""Recordings of the imperfect laboratory as points instead of images: hundreds where one could be rendered.

The independent laboratory's lenses, its bowed and stretched board and its rolling disc give the pixels of corners and
dots, with noise; whatever follows (calibration, what the dots share, poses, table) is the product's own.
"""

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


def calibration_of(plan, cameras, target, rng, settings=None):
    """The rig from views of the board, which is bowed along its long side, and longer there than declared."""
    board = Board(plan.inner_corners, plan.square)
    x, y, _ = board.points.T
    points = np.stack([x * (1 + plan.imperfections.stretch), y, laboratory.board_height(x, plan)], -1)
    views = ([], [])
    for view in range(plan.n_views):
        R, t = laboratory.board_pose(view, plan, target, rng)
        for side, camera in zip(views, cameras, strict=True):
            side.append(corner_view(camera, points @ R.T + t, rng))
    if settings is None:
        settings = CalibrationSettings(*TERMS[plan.imperfections != laboratory.IDEAL])
    return calibrate_from_corners(*views, board, settings, 0, laboratory.BOARD_THICKNESS)


def recorded(plan):
    """Tracking of a recording by points, and its true poses R (n, 3, 3), t (n, 3)."""
    rng = np.random.default_rng([plan.seed, 11])
    cameras, target = laboratory.cameras_of(plan, rng)
    rig = calibration_of(plan, cameras, target, rng).rig
    times = np.arange(plan.n_frames) / plan.frame_rate
    spline = laboratory.motion(plan)
    body = np.column_stack([laboratory.DOTS, np.full(len(laboratory.DOTS), laboratory.HALF_THICKNESS)])
    body[:, :2] += plan.imperfections.misprint * rng.normal(size=laboratory.DOTS.shape)
    px = 0.0
    for node, weight in laboratory.GAUSS:
        R, t = laboratory.pose_of(spline(times + 0.5 * plan.imperfections.exposure * node))
        points = body @ np.swapaxes(R, 1, 2) + t[:, None]
        px = px + weight * np.stack([camera.project(points) for camera in cameras], 1)
    px = px + DOT_PX * rng.normal(size=px.shape)
    R, t = laboratory.pose_of(spline(times))
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
