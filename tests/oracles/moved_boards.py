"""Corners of a chessboard that two cameras photograph one after the other, by NumPy and `cv2.projectPoints` alone.

Webcams of 640 x 480 px, 8 to 15 cm apart, before a board of 9 x 6 inner corners of 25 mm that is tilted up to some
40 deg, 0.4 to 0.75 m away. Between the left and the right exposure the board moves by `shift` [m] and turns about its
middle by `turn` [rad], normal, per axis.
"""

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration import Camera, StereoRig

INNER_CORNERS, SQUARE, IMAGE_SIZE = (9, 6), 0.025, (640, 480)
EDGE = 8.0  # [px] that corners keep from the image's rim


def make_rig(seed: int) -> StereoRig:
    """A rig of its own for every seed."""
    rng = np.random.default_rng(seed)
    cameras = []
    for _ in range(2):
        f = rng.uniform(700.0, 1000.0)
        cx, cy = np.array([320.0, 240.0]) + 8.0 * rng.normal(size=2)
        fy, (p1, p2) = f * (1 + 3e-4 * rng.normal()), 5e-4 * rng.normal(size=2)
        bends = rng.uniform(-0.2, 0.1), rng.uniform(-0.1, 0.2), p1, p2, 0.0
        cameras.append(Camera(f, fy, cx, cy, bends, IMAGE_SIZE))
    R = cv2.Rodrigues(np.array([0.02 * rng.normal(), rng.uniform(0.1, 0.3), 0.02 * rng.normal()]))[0]
    centre = np.array([rng.uniform(0.08, 0.15), *(3e-3 * rng.normal(size=2))])
    return StereoRig(*cameras, R, -R @ centre)


def board() -> NDArray:
    """(54, 3) [m] corners, along the first side first."""
    across, down = INNER_CORNERS
    return np.concatenate([np.mgrid[:across, :down].T.reshape(-1, 2) * SQUARE, np.zeros((across * down, 1))], axis=1)


def pairs(
    rig, n, seed, shift=0.0, turn=0.0, correlation=0.0, points=None, places=((-0.12, 0.2), (-0.1, 0.1), (0.4, 0.75))
) -> tuple[NDArray, NDArray]:
    """Left and right corners (n, 54, 2) [px] with noise of 0.1 px; neighbours' errors correlate by `correlation`.

    points : (54, 3) [m] of a board that is not as declared; places : of its middle [m], least and most of x, y, z
    """
    rng = np.random.default_rng(1000 + seed)
    points = board() if points is None else points
    arms = points - points.mean(0)
    apart = np.linalg.norm(board()[:, None] - board()[None], axis=-1) / SQUARE
    root = np.linalg.cholesky(np.eye(len(points)) if correlation == 0 else correlation**apart)
    seen: list[tuple[NDArray, NDArray]] = []
    while len(seen) < n:
        R = cv2.Rodrigues(rng.normal(size=3) * [0.35, 0.35, 0.15])[0]
        place = np.array([rng.uniform(*between) for between in places])
        R_later, later = cv2.Rodrigues(turn * rng.normal(size=3))[0] @ R, place + shift * rng.normal(size=3)
        left = _image(arms @ R.T + place, rig.left)
        right = _image((arms @ R_later.T + later) @ rig.R_right_left.T + rig.t_right_left, rig.right)
        errors = [root @ rng.normal(size=(len(points), 2)) * 0.1 for _ in range(2)]
        both, farthest = np.concatenate([left, right]), np.array(rig.left.image_size) - 1 - EDGE
        if np.all(both > EDGE) and np.all(both < farthest) and np.all((arms @ R.T + place)[:, 2] > 0.05):
            seen.append((left + errors[0], right + errors[1]))
    left, right = (np.stack(side) for side in zip(*seen, strict=True))
    return left, right


def _image(points: NDArray, camera: Camera) -> NDArray:
    lens = camera.camera_matrix, np.array(camera.distortion)
    return cv2.projectPoints(points, np.zeros(3), np.zeros(3), *lens)[0].reshape(-1, 2)


def turned(rig: StereoRig, turn: NDArray, shift: NDArray) -> StereoRig:
    """The rig after its right camera was turned by a rotation vector [rad] about its centre, and shifted [m]."""
    R = cv2.Rodrigues(np.asarray(turn, float))[0]
    t = R @ rig.t_right_left - R @ rig.R_right_left @ np.asarray(shift, float)
    return replace(rig, R_right_left=R @ rig.R_right_left, t_right_left=t)
