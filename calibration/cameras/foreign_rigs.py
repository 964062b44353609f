"""Rigs from and to Caliscope's (Anipose's) TOML and mrcal's .cameramodel, where the lens model is Brown's.

Both store each camera's pose as x_camera = R x_reference + t with R as a rotation vector, metres, and pixels that count
from the centre of the top-left one: as here. Their lens terms k1 k2 p1 p2 k3 are OpenCV's, and so are ours. None of the
formats has a place for the covariance: a rig that comes back has none, and poses measured with it lack the
calibration's part of the sigma.
"""

import ast
import os
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from calibration.cameras.camera import Camera, StereoRig, placed_at
from calibration.kit.arrays import Array
from calibration.kit.errors import RigFileError

MRCAL_MODELS = {"LENSMODEL_PINHOLE": 0, "LENSMODEL_OPENCV4": 4, "LENSMODEL_OPENCV5": 5}
MAX_BYTES = 50_000_000  # mrcal keeps the whole calibration in a camera's file
MAX_SIDE = 1_000_000  # [px]


def export_caliscope(path: str | os.PathLike[str], rig: StereoRig) -> None:
    """Write camera_array.toml as Caliscope reads it; cameras 0 (left) and 1 (right). Raises RigFileError."""
    lines = []
    for number, (camera, pose) in enumerate(zip(rig.cameras, rig.camera_poses(), strict=True)):
        r, t = _rotation_vector(pose[0]), pose[1]
        lines += [
            f"[cameras.{number}]",
            f"cam_id = {number}",
            f"size = {_listed(camera.image_size)}",
            "rotation_count = 0",
            f"matrix = [{', '.join(_listed(row) for row in camera.camera_matrix)}]",
            f"distortions = {_listed(camera.distortion)}",
            f"translation = {_listed(t)}",
            f"rotation = {_listed(r)}",
            "fisheye = false",
            "",
        ]
    _write(Path(path), "\n".join(lines))


def import_caliscope(
    path: str | os.PathLike[str], cameras: tuple[str, str] | None = None, *, world_is_table: bool = False
) -> StereoRig:
    """Two cameras of Caliscope's camera_array.toml or of Anipose's calibration.toml.

    cameras : their names ("0", "1"; "cam_0", ...) where the file has more than two; left first
    world_is_table : True if the file's reference is the table, k up; otherwise the heights mean nothing
    Raises RigFileError that names what the file holds.
    """
    path = Path(path)
    try:
        content = tomllib.loads(_content(path))
    except ValueError as error:
        raise RigFileError(f"{path}: not TOML: {error}") from error
    tables = content.get("cameras", content)
    found = {name: table for name, table in tables.items() if isinstance(table, dict) and "matrix" in table}
    names = cameras or tuple(found)
    if len(names) != 2 or not all(name in found for name in names):
        raise RigFileError(f"{path}: holds the cameras {', '.join(found) or 'none'}; name two of them, left first")
    parts = []
    for name in names:
        table, where = found[name], f"{path}, camera {name}"
        if table.get("fisheye"):
            raise RigFileError(f"{where}: a fisheye lens; only Brown's distortion can be read")
        K, size = _array(table, "matrix", (3, 3), where), _array(table, "size", (2,), where)
        D = _array(table, "distortions", (-1,), where) if "distortions" in table else np.zeros(0)
        if not table.get("rotation"):
            raise RigFileError(f"{where}: has no rotation: its place was not calibrated")
        R = rotation_of(_array(table, "rotation", (-1,), where), where)
        parts.append((camera_of(K, D, size, where), R, _array(table, "translation", (3,), where)))
    return _rig(parts, world_is_table)


def export_mrcal(paths: tuple[str | os.PathLike[str], str | os.PathLike[str]], rig: StereoRig) -> None:
    """Write left and right .cameramodel; the reference is the rig's world. Raises RigFileError."""
    for path, camera, (R, t) in zip(paths, rig.cameras, rig.camera_poses(), strict=True):
        text = (
            "{\n"
            "    'lensmodel':  'LENSMODEL_OPENCV5',\n"
            "    # fx, fy, cx, cy, k1, k2, p1, p2, k3\n"
            f"    'intrinsics': {_listed(camera.parameters)},\n"
            "    # rotation vector and translation [m]: reference to camera\n"
            f"    'extrinsics': {_listed(np.concatenate([_rotation_vector(R), t]))},\n"
            f"    'imagersize': {_listed(camera.image_size)}\n"
            "}\n"
        )
        _write(Path(path), text)


def import_mrcal(
    left: str | os.PathLike[str], right: str | os.PathLike[str], *, world_is_table: bool = False
) -> StereoRig:
    """A rig from two .cameramodel files with one reference. Raises RigFileError, also for richer lens models.

    world_is_table : True if their reference is the table, k up
    """
    parts = []
    for path in map(Path, (left, right)):
        try:
            model = ast.literal_eval(_content(path).strip())
        except (ValueError, SyntaxError, MemoryError, RecursionError) as error:
            raise RigFileError(f"{path}: not a .cameramodel of mrcal ({type(error).__name__})") from error
        if not isinstance(model, dict):
            raise RigFileError(f"{path}: not a .cameramodel of mrcal: no dictionary")
        name = str(model.get("lensmodel", model.get("lens_model", "none")))
        if name not in MRCAL_MODELS:
            raise RigFileError(
                f"{path}: lens model {name}; {', '.join(MRCAL_MODELS)} can be read. mrcal-convert-lensmodel fits one"
            )
        values = _array(model, "intrinsics", (4 + MRCAL_MODELS[name],), str(path))
        fx, fy, cx, cy, *distortion = (float(value) for value in values)
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        size = _array(model, "imagersize", (2,), str(path))
        key = next((k for k in ("extrinsics", "rt_cam_ref") if k in model), "extrinsics")
        rt = _array(model, key, (6,), str(path))
        camera = camera_of(K, np.array(distortion), size, str(path))
        parts.append((camera, rotation_of(rt[:3], str(path)), rt[3:]))
    return _rig(parts, world_is_table)


def _rig(parts: list[tuple[Camera, Array, Array]], world_is_table: bool) -> StereoRig:
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


def _array(table: Mapping[str, Any], key: str, shape: tuple[int, ...], where: str) -> Array:
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


def _rotation_vector(R: Array) -> Array:
    return np.asarray(cv2.Rodrigues(R)[0], float).ravel()


def _listed(values: Any) -> str:
    return "[" + ", ".join(repr(v.item() if hasattr(v, "item") else v) for v in values) + "]"


def _content(path: Path) -> str:
    try:
        if path.stat().st_size > MAX_BYTES:
            raise RigFileError(f"{path}: {path.stat().st_size} bytes are too many for a rig")
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise RigFileError(f"{path}: cannot be read ({error})") from error


def _write(path: Path, text: str) -> None:
    part = path.with_name(f"{path.name}.part")
    try:
        part.write_text(text, encoding="utf-8")
        os.replace(part, path)
    except OSError as error:
        raise RigFileError(f"{path}: the rig cannot be written ({error.strerror})") from error
