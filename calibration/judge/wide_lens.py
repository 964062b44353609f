"""Lenses that are wider than the model: Brown's polynomial against OpenCV's rational one, on views left out."""

import cv2
import numpy as np

from calibration.cameras.camera import CAMERA_NAMES, Camera
from calibration.fit.start import GOOD_VIEWS, for_opencv
from calibration.fit.stereo_model import Observations
from calibration.kit.arrays import Array, Array32

WIDE = 0.8  # half the image's diagonal in focal lengths, 77 deg across: below, the polynomial describes ordinary lenses
# Misfit of views left out, rational over polynomial. A 150 deg lens had 0.42 and 0.47, the 34 cameras of seventeen
# other foreign sets 0.95 to 1.09 but for one of seven views (0.76).
CLEARLY = 0.7
MOST_VIEWS = 30  # OpenCV's time grows with the cube of them


def too_wide(observations: Observations, nominal: Array, cameras: tuple[Camera, Camera]) -> tuple[str, ...]:
    """A sentence about every lens that the rational model describes far better than any polynomial here could.

    nominal : (n, 3) [m] the target's points as declared; cameras : as they start the refinement
    """
    found = []
    for index, camera in enumerate(cameras):
        if 0.5 * float(np.hypot(*camera.image_size)) < WIDE * min(camera.fx, camera.fy):
            continue
        _, *seen = for_opencv(observations, index, nominal)
        objects, images = (of_views[:: len(of_views) // MOST_VIEWS + 1] for of_views in seen)
        if len(objects) < GOOD_VIEWS:
            continue
        try:
            polynomial, rational = (
                _left_out(objects, images, camera, flags) for flags in (0, cv2.CALIB_RATIONAL_MODEL)
            )
        except cv2.error:
            continue
        if rational < CLEARLY * polynomial:
            found.append(
                f"the {CAMERA_NAMES[index]} lens is wider than the model: a polynomial in the radius leaves "
                f"{polynomial:.2f} px in views left out, a rational function {rational:.2f} px, and that is not "
                "supported. Results are wrong by as much: take a lens below some 90 deg, or crop the images to the "
                "middle"
            )
    return tuple(found)


def _left_out(objects: list[Array32], images: list[Array32], camera: Camera, flags: int) -> float:
    """Misfit [px] of the median view, even views by the odd ones' camera and the reverse."""
    squares = []
    for half in (0, 1):
        _, K, distortion, _, _ = cv2.calibrateCamera(
            objects[half::2], images[half::2], camera.image_size, camera.camera_matrix, np.zeros(5),
            flags=flags | cv2.CALIB_USE_INTRINSIC_GUESS,
        )  # fmt: skip
        for board, seen in zip(objects[1 - half :: 2], images[1 - half :: 2], strict=True):
            _, turn, shift = cv2.solvePnP(board, seen, K, distortion)
            expected = cv2.projectPoints(board, turn, shift, K, distortion)[0].reshape(-1, 2)
            squares.append(np.mean(np.sum((expected - seen) ** 2, axis=1)))
    return float(np.sqrt(np.median(squares)))
