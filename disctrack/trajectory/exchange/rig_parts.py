"""What the formats of rigs have in common: numbers that are checked, and cameras made of them.

All keep x_camera = R x_reference + t and pixels that count from the centre of the top-left one, as here, unless their
module says otherwise. None has a place for the covariance: a rig that comes back has none, and poses measured with it
lack the calibration's part of the sigma.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from calibration.cameras.camera import Camera, StereoRig, placed_at
from calibration.kit.arrays import Array
from disctrack.errors import RigFileError
from disctrack.files.inputs import read_regular

MAX_BYTES = 50_000_000  # mrcal keeps the whole calibration in a camera's file
MAX_SIDE = 1_000_000  # [px]


def rig_of(parts: Sequence[tuple[Camera, Array, Array]], world_is_table: bool) -> StereoRig:
    """From each camera with R (3, 3), t (3,) [m] from the reference to its axes, left first."""
    (left, *_), (right, *_) = parts
    return StereoRig(left, right, **placed_at([(R, t) for _, R, t in parts]), world_is_table=world_is_table)


def camera_of(K: Array, D: Array, size: Array, where: str) -> Camera:
    """From another program's camera matrix, up to 14 lens terms of OpenCV's order, and image size (width, height).

    Raises RigFileError; `where` begins what it says.
    """
    if K.shape != (3, 3) or not np.isfinite(K).all() or not (K[0, 0] > 0 and K[1, 1] > 0):
        raise RigFileError(f"{where}: {K.tolist()} is not a camera matrix")
    if not np.abs(K - [[K[0, 0], 0, K[0, 2]], [0, K[1, 1], K[1, 2]], [0, 0, 1]]).max() < 1e-9:
        raise RigFileError(
            f"{where}: the camera matrix is {K.tolist()}; expected fx, 0, cx; 0, fy, cy; 0, 0, 1: without skew "
            "(MATLAB keeps it transposed, and R, too)"
        )
    if not (size >= 1).all() or not (size < MAX_SIDE).all():
        raise RigFileError(f"{where}: no image size")
    if len(D) > 14 or not np.isfinite(D).all() or np.any(D[5:] != 0):
        raise RigFileError(f"{where}: the lens terms are {D.tolist()}; k1 k2 p1 p2 k3 can be read, and no further")
    terms = np.append(D, np.zeros(5))[:5]
    return Camera.from_parameters(np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *terms]), (int(size[0]), int(size[1])))


def array_of(table: Mapping[str, Any], key: str, shape: tuple[int, ...], where: str) -> Array:
    """The finite numbers under a key, in that shape. Raises RigFileError."""
    try:
        value = np.asarray(table[key], float).reshape(shape)
    except (KeyError, TypeError, ValueError) as error:
        raise RigFileError(f"{where}: '{key}' is missing, or not numbers of shape {shape}") from error
    if not np.isfinite(value).all():
        raise RigFileError(f"{where}: '{key}' holds numbers that are not finite")
    return value


def rotation_of(rotation: Array, where: str) -> Array:
    """(3, 3) from a matrix or a rotation vector. Raises RigFileError; `where` begins what it says."""
    R = np.asarray(cv2.Rodrigues(rotation.reshape(3))[0] if rotation.size == 3 else rotation, float)
    whole = R.size == 9 and np.abs(R).max() < 2  # not above: numbers may be of any size in a file
    R = R.reshape(3, 3) if whole else np.zeros((3, 3))
    if not np.abs(R @ R.T - np.eye(3)).max() < 1e-6 or np.linalg.det(R) < 0:
        raise RigFileError(f"{where}: {rotation.tolist()} is not a rotation")
    return R


def content_of(path: Path) -> str:
    """The file's text. Raises RigFileError."""
    try:
        return read_regular(path, MAX_BYTES).decode()
    except (OSError, UnicodeDecodeError) as error:
        raise RigFileError(f"{path}: cannot be read ({error})") from error


def the_one(paths: Sequence[Path]) -> Path:
    """Of a format that keeps everything in one file. Raises RigFileError."""
    if len(paths) != 1:
        raise RigFileError(f"{len(paths)} files given ({', '.join(map(str, paths))}); one is converted at a time")
    return paths[0]
