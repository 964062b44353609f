"""Initial guess for the refinement: each camera by OpenCV, then the relative pose on which most views agree.

Lenses too wide for the model are detected here: Brown's polynomial is compared with OpenCV's rational model.
"""

from collections.abc import Sequence

import cv2
import numpy as np

from calibration.board.target import LEAST_POINTS, Target
from calibration.cameras.camera import CAMERA_NAMES, Camera, StereoRig, rotation_from_vector
from calibration.fit.pairing import FLOOR, GOOD_VIEWS, MOST_TRIED, Names, Pairs, board_turns, paired, poses_of
from calibration.fit.stereo_model import Observations, StereoModel
from calibration.kit.errors import CalibrationError
from calibration.kit.types import Array, Array32, Indices, evenly

MOST_K1 = 10.0  # larger than in any real lens: above, the views do not determine it
WIDE = 0.8  # half the image diagonal in focal lengths, 77 deg: the polynomial describes ordinary lenses below
# Ratio of misfits below which a richer model is believed. Rational over polynomial, in the median view: 0.25 to 0.73
# for a 150 deg lens, 0.98 to 1.00 for eight ordinary cameras with 8 to 20 views. Two focal lengths over one: 0.98 for
# an unchanged lens.
CLEARLY = 0.85
TooWide = tuple[tuple[str, str], ...]  # warnings about lenses, each with its evidence


def for_opencv(mine: Observations, nominal: Array) -> tuple[list[int], list[Array32], list[Array32]]:
    """Views with enough points in one camera, and for each the target's points and their images in OpenCV's format.

    mine : observations of this camera
    """
    seen = [(int(v), mine[mine.view == v]) for v in np.unique(mine.view)]
    seen = [(v, o) for v, o in seen if len(o) >= LEAST_POINTS]
    objects = [nominal[o.point].astype(np.float32) for _, o in seen]
    return [v for v, _ in seen], objects, [o.pixels.astype(np.float32) for _, o in seen]


def start_camera(
    observations: Observations, index: int, nominal: Array, image_size: tuple[int, int]
) -> tuple[Camera, dict[int, tuple[Array, Array]], float]:
    """One camera, {view: (R, t) of the board in it} and the squared misfit [px^2], by OpenCV with k1 alone."""
    name = CAMERA_NAMES[index]
    views, objects, images = for_opencv(observations[observations.camera == index], nominal)
    flags = cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
    w, h = image_size
    guess = np.array([[float(max(w, h)), 0, 0.5 * (w - 1)], [0, float(max(w, h)), 0.5 * (h - 1)], [0, 0, 1]])
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)  # the order of sums over threads is not reproducible: last digits would vary
    try:
        # views that do not determine k1 still determine a camera without it, and the refinement has priors
        for plainer in (0, cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_FIX_ASPECT_RATIO):
            rms, K, distortion, turns, shifts = cv2.calibrateCamera(
                objects, images, image_size, guess.copy(), np.zeros(5), flags=flags | plainer
            )
            k1 = float(np.ravel(distortion)[0])
            if np.isfinite(K).all() and K[0, 0] > 0 and K[1, 1] > 0 and abs(k1) < MOST_K1:
                break
        else:
            raise CalibrationError(f"{name} camera: the views do not determine the focal length; tilt the board more")
    except cv2.error as error:
        raise CalibrationError(f"{name} camera: no start for the calibration, OpenCV says: {error.err}") from error
    finally:
        cv2.setNumThreads(threads)
    camera = Camera(K[0, 0], K[1, 1], K[0, 2], K[1, 2], (k1, 0.0, 0.0, 0.0, 0.0), image_size)
    taken = zip(views, turns, shifts, strict=True)
    poses = {v: (rotation_from_vector(np.ravel(turn)), np.ravel(shift).astype(float)) for v, turn, shift in taken}
    return camera, poses, rms**2 * sum(map(len, images))


def start_stereo(
    observations: Observations, target: Target, image_sizes: Sequence[tuple[int, int]], names: Names
) -> tuple[Pairs, dict[int, Indices], list[str]]:
    """Rough cameras, their relative pose, and which images are pairs.

    image_sizes : of the left and of the right camera; names : (left, right) of all views
    returns also : order of the target's points in the right image of each pair; and notes about the pairs
    Raises CalibrationError if the images do not determine a camera, or are no pairs; see `pairing`.
    """
    nominal, orders, n_views = target.points, target.orders, len(names)
    begun = [start_camera(observations, index, nominal, size) for index, size in enumerate(image_sizes)]
    cameras, poses, _ = zip(*begun, strict=True)
    sides = [observations[observations.camera == index] for index in (0, 1)]
    places = [poses_of(seen.items(), o, nominal, camera) for o, (camera, seen, _) in zip(sides, begun, strict=True)]
    floor = FLOOR * max(max(size) for size in image_sizes)
    pairs, notes = paired((places[0], places[1]), nominal, len(orders), floor, names)
    both = [v for v in poses[0] if v in poses[1]]
    R_pair, t_pair = pairs.R_right_left, pairs.t_right_left
    between, distance = (float(np.median(np.linalg.norm(t, axis=-1))) for t in (t_pair, [poses[0][v][1] for v in both]))
    if between < FLOOR * distance:  # rays with a convergence of 0.06 deg determine no distance
        raise CalibrationError(
            f"the left and the right images show the board from one place (the cameras would stand {1e3 * between:.2g} "
            f"mm apart, the board {1e3 * distance:.3g} mm away): do both patterns name the images of one camera?"
        )
    turns, middle = board_turns(len(orders)), nominal.mean(0)
    by_right = {}
    for v, (R, t) in poses[1].items():
        turn = turns[pairs.order[both.index(v)]] if v in both else np.eye(3)
        by_right[v] = R_pair.T @ R @ turn, R_pair.T @ (t + R @ (middle - turn @ middle) - t_pair)
    R_board, t_board = np.tile(np.eye(3), (n_views, 2, 1, 1)), np.tile([0.0, 0.0, 1.0], (n_views, 2, 1))
    for image, alone in enumerate((by_right | poses[0], poses[0] | by_right)):
        for view, (R, t) in alone.items():
            R_board[view, image], t_board[view, image] = R, t
    model = StereoModel(StereoRig(cameras[0], cameras[1], R_pair, t_pair), R_board, t_board, nominal.copy())
    return Pairs(model, np.array(both)), {v: orders[k] for v, k in zip(both, pairs.order, strict=True)}, notes


def too_wide(observations: Observations, nominal: Array, cameras: tuple[Camera, Camera]) -> TooWide:
    """Warnings, with their evidence, about lenses that the rational model describes far better than the polynomial.

    nominal : (n, 3) [m] the declared points of the target; cameras : initial guess of the refinement
    """
    found = []
    for index, camera in enumerate(cameras):
        if 0.5 * float(np.hypot(*camera.image_size)) < WIDE * min(camera.fx, camera.fy):
            continue
        _, *seen = for_opencv(observations[observations.camera == index], nominal)
        objects, images = ([of_views[i] for i in evenly(len(of_views), MOST_TRIED)] for of_views in seen)
        if len(objects) < GOOD_VIEWS:
            continue
        begun = objects, images, camera.image_size, camera.camera_matrix, np.zeros(5)
        try:
            polynomial, rational = (
                float(np.median(cv2.calibrateCameraExtended(*begun, flags=flags | cv2.CALIB_USE_INTRINSIC_GUESS)[-1]))
                for flags in (0, cv2.CALIB_RATIONAL_MODEL)
            )
        except cv2.error:
            continue
        if rational < CLEARLY * polynomial:
            by_what = (
                f"a polynomial in the radius leaves {polynomial:.2f} px in the median view, a rational function "
                f"{rational:.2f} px, and that is not supported. Results are wrong by as much: take a lens below some "
                "90 deg, or crop the images to the middle"
            )
            found.append((f"the {CAMERA_NAMES[index]} lens is wider than the model", by_what))
    return tuple(found)
