"""Rough cameras and poses to start the refinement from: OpenCV per camera, then the pair that most views agree on."""

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.board.target import mirror_symmetries
from calibration.cameras.camera import Camera, rotation_from_vector
from calibration.fit.stereo_model import Observations, StereoModel
from calibration.kit.arrays import Array, Mask
from calibration.kit.errors import CalibrationError

MIN_POINTS = 8  # of one view in one camera, to start its pose
MOST_K1 = 10.0  # of a lens that exists; beyond, the views do not tell of it
ONE_PLACE = 1e-3  # of the board's distance: rays that meet at 0.06 deg tell no distance
MIN_VIEWS = 3  # Zhang: fewer do not determine a camera


def start_camera(
    observations: Observations, index: int, nominal: Array, image_size: tuple[int, int]
) -> tuple[Camera, dict[int, tuple[Array, Array]]]:
    """One camera and {view: (R, t) of the board in it} by OpenCV's calibrateCamera with k1 alone."""
    objects, images, views = [], [], []
    for view in np.unique(observations.view):
        use = (observations.view == view) & (observations.camera == index)
        if use.sum() >= MIN_POINTS:
            objects.append(nominal[observations.point[use]].astype(np.float32))
            images.append(observations.pixels[use].astype(np.float32))
            views.append(int(view))
    name = ("left", "right")[index]
    if len(views) < MIN_VIEWS:
        raise CalibrationError(
            f"{name} camera: the target is found in {len(views)} views, at least {MIN_VIEWS} are needed "
            "(10 to 20, tilted in several directions, are good)"
        )
    flags = cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
    w, h = image_size
    guess = np.array([[float(max(w, h)), 0, 0.5 * (w - 1)], [0, float(max(w, h)), 0.5 * (h - 1)], [0, 0, 1]])
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)  # its threads add up their views as they end: the last digits would be others in every run
    try:
        # views that leave k1 open still tell of a plain camera, and the refinement knows what cameras are like
        for plainer in (0, cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_FIX_ASPECT_RATIO):
            _, K, distortion, turns, shifts = cv2.calibrateCamera(
                objects, images, image_size, guess.copy(), np.zeros(5), flags=flags | plainer
            )
            k1 = float(np.ravel(distortion)[0])
            if np.isfinite(K).all() and abs(k1) < MOST_K1:
                break
        else:
            raise CalibrationError(f"{name} camera: the views do not determine the focal length; tilt the board more")
    except cv2.error as error:
        raise CalibrationError(f"{name} camera: no start for the calibration, OpenCV says: {error.err}") from error
    finally:
        cv2.setNumThreads(threads)
    camera = Camera(
        float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]), (k1, 0.0, 0.0, 0.0, 0.0), image_size
    )
    poses = {
        view: (rotation_from_vector(np.ravel(turn)), np.ravel(shift).astype(float))
        for view, turn, shift in zip(views, turns, shifts, strict=True)
    }
    return camera, poses


def rotation_angle(R: Array) -> Array:
    """Angle [rad] of rotations (..., 3, 3)."""
    return np.arccos(np.clip(0.5 * (np.trace(R, axis1=-2, axis2=-1) - 1), -1, 1))


def common_pair(rotations: Array, translations: Array) -> tuple[int, Mask]:
    """Index of the stereo pose that most others agree with, and who agrees: within 5 deg and 10 % of the baseline."""
    angle = rotation_angle(np.swapaxes(rotations, 1, 2)[:, None] @ rotations[None])
    shift = np.linalg.norm(translations[:, None] - translations[None], axis=-1)
    length = np.linalg.norm(translations, axis=-1)
    agree = (angle < np.radians(5)) & (shift < 0.1 * length[:, None] + 1e-9)
    cost = np.sum(np.minimum(angle / np.radians(5), 1) + np.minimum(shift / (0.1 * length[:, None] + 1e-9), 1), axis=1)
    best = int(np.argmin(cost))
    return best, agree[best]


def pairs_by_order(
    poses: Sequence[Mapping[int, tuple[Array, Array]]],
    nominal: Array,
    orders: Sequence[NDArray[np.intp]],
    mirrored: bool = False,
) -> tuple[Array, Array]:
    """Stereo pose by each of n views that both see, with the right points in each of k orders: (n, k, 3, 3), (n, k, 3).

    poses : of the left and of the right camera, by view; orders : point orders[k][i] takes place i
    mirrored : the right images show the world in a mirror, and the orders mirror the points
    """
    views, middle = sorted(poses[0].keys() & poses[1].keys()), nominal.mean(0)
    left, right = ((np.stack([side[v][0] for v in views]), np.stack([side[v][1] for v in views])) for side in poses)
    d, image = nominal - middle, np.diag([-1.0 if mirrored else 1.0, 1.0, 1.0])
    rotations, translations = [], []
    for order in orders:
        U, _, Vt = np.linalg.svd((d[order].T @ d)[:2, :2])
        turn = np.eye(3)
        turn[:2, :2] = U @ Vt  # the order turns the points by this about their middle
        R = right[0] @ turn
        t = right[1] + right[0] @ middle - R @ middle
        rotations.append(image @ R @ np.swapaxes(left[0], 1, 2))
        translations.append(t @ image - np.einsum("nij,nj->ni", rotations[-1], left[1]))
    return np.stack(rotations, axis=1), np.stack(translations, axis=1)


def agreeing(rotations: Array, translations: Array) -> Mask:
    """Which stereo poses (n, k) agree with the one that most do; see `common_pair`."""
    agree = common_pair(rotations.reshape(-1, 3, 3), translations.reshape(-1, 3))[1]
    return agree.reshape(rotations.shape[:2])


def _refuse_mirrored(poses: Sequence[Mapping[int, tuple[Array, Array]]], nominal: Array, agree: Mask) -> None:
    """Raise CalibrationError where the pairs agree if one camera sees in a mirror, and else do not."""
    orders = mirror_symmetries(nominal[:, :2])
    if 2 * agree.sum() >= len(agree) or not orders:
        return
    n = int(agreeing(*pairs_by_order(poses, nominal, orders, mirrored=True)).any(axis=1).sum())
    if n >= max(MIN_VIEWS, 0.5 * len(agree), 2 * agree.sum()):
        raise CalibrationError(
            f"the images of one of the two cameras are mirrored: if they are, {n} of {len(agree)} pairs tell of one "
            f"place of the cameras, as stored {agree.sum()}. Switch the mirroring off where that camera's images are "
            "exported, or flip all of them, those of the motion too; so, too, if it looks through a mirror"
        )


def _refuse_one_place(t_pair: Array, boards: Sequence[Array]) -> None:
    """Raise CalibrationError where both cameras stand in one place: then no distance can be told."""
    apart, distance = float(np.linalg.norm(t_pair)), float(np.median(np.linalg.norm(boards, axis=-1)))
    if apart < ONE_PLACE * distance:
        raise CalibrationError(
            f"the left and the right images show the board from one place (the cameras would stand {1e3 * apart:.2g} "
            f"mm apart, the board {1e3 * distance:.3g} mm away): do both patterns name the images of one camera?"
        )


def start_stereo(
    observations: Observations, nominal: Array, image_sizes: tuple[tuple[int, int], tuple[int, int]], n_views: int
) -> tuple[StereoModel, Mask, dict[int, tuple[Array, Array]]]:
    """Start model, which views (n_views,) agree with it or were seen by one camera only, and {view: (R, t)} of pairs.

    The latter are poses of the board in the left camera's axes by the right image alone.
    """
    left, left_poses = start_camera(observations, 0, nominal, image_sizes[0])
    right, right_poses = start_camera(observations, 1, nominal, image_sizes[1])
    both = sorted(left_poses.keys() & right_poses.keys())
    if not both:
        raise CalibrationError("no view shows the target to both cameras: the pair cannot be calibrated")
    as_stored = pairs_by_order((left_poses, right_poses), nominal, [np.arange(len(nominal))])
    rotations, translations = as_stored[0][:, 0], as_stored[1][:, 0]
    best, agree = common_pair(rotations, translations)
    _refuse_mirrored((left_poses, right_poses), nominal, agree)
    R_pair, t_pair = rotations[best], np.median(translations[agree], axis=0)
    _refuse_one_place(t_pair, [left_poses[v][1] for v in both])
    usable = np.ones(n_views, bool)
    usable[[v for v, ok in zip(both, agree, strict=True) if not ok]] = False
    by_right = {v: (R_pair.T @ right_poses[v][0], R_pair.T @ (right_poses[v][1] - t_pair)) for v in both}
    R_board, t_board = np.tile(np.eye(3), (n_views, 1, 1)), np.tile([0.0, 0.0, 1.0], (n_views, 1))
    for view in range(n_views):
        if view in left_poses:
            R_board[view], t_board[view] = left_poses[view]
        elif view in right_poses:
            R, t = right_poses[view]
            R_board[view], t_board[view] = R_pair.T @ R, R_pair.T @ (t - t_pair)
        else:
            usable[view] = False
    return StereoModel((left, right), R_pair, t_pair, R_board, t_board, nominal.copy()), usable, by_right
