"""Rigs from and to Caliscope's camera_array.toml and Pose2Sim's Calib.toml; Anipose's calibration.toml is read, too.

Of each camera size, matrix, distortions in OpenCV's order, and rotation (a vector) and translation from the reference.
Caliscope numbers its cameras in [cameras]; Pose2Sim and Anipose name them at the top, Pose2Sim with k1 k2 p1 p2 only.
"""

import tomllib
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from calibration.cameras.camera import StereoRig
from disctrack.errors import RigFileError
from disctrack.files.whole import write_whole
from disctrack.trajectory.exchange.rig_parts import (
    array_of,
    camera_of,
    content_of,
    listed,
    rig_of,
    rotation_of,
    rotation_vector,
)


def write_caliscope(path: Path, rig: StereoRig) -> None:
    """Cameras 0 (left) and 1 (right), lengths in metres. Raises OutputError."""
    own = [f"cam_id = {number}\nrotation_count = 0" for number in (0, 1)]
    _write(path, rig, ("cameras.0", "cameras.1"), own, 5)


def write_pose2sim(path: Path, rig: StereoRig) -> None:
    """Cameras cam_01 (left) and cam_02 (right), lengths in metres, without k3. Raises OutputError."""
    names = ("cam_01", "cam_02")
    _write(path, rig, names, [f'name = "{name}"' for name in names], 4, "[metadata]\nadjusted = false\nerror = 0.0\n")


def _write(path: Path, rig: StereoRig, tables: Sequence[str], own: Sequence[str], terms: int, end: str = "") -> None:
    text = ""
    for table, more, camera, (R, t) in zip(tables, own, rig.cameras, rig.camera_poses(), strict=True):
        text += (
            f"[{table}]\n{more}\n"
            f"size = {listed(camera.image_size)}\n"
            f"matrix = {listed(camera.camera_matrix)}\n"
            f"distortions = {listed(camera.distortion[:terms])}\n"
            f"translation = {listed(t)}\n"
            f"rotation = {listed(rotation_vector(R))}\n"
            "fisheye = false\n\n"
        )
    write_whole(path, (text + end).encode())


def read_caliscope(path: Path, *, cameras: tuple[str, str] | None = None, world_is_table: bool = False) -> StereoRig:
    """Two cameras of such a file.

    cameras : their names ("0", "1"; "cam_0", ...) where the file has more than two; left first
    world_is_table : True if the file's reference is the table, k up; otherwise the heights mean nothing
    Raises RigFileError that names what the file holds.
    """
    try:
        content = tomllib.loads(content_of(path))
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
        K, size = array_of(table, "matrix", (3, 3), where), array_of(table, "size", (2,), where)
        D = array_of(table, "distortions", (-1,), where) if "distortions" in table else np.zeros(0)
        if not table.get("rotation"):
            raise RigFileError(f"{where}: has no rotation: its place was not calibrated")
        R = rotation_of(array_of(table, "rotation", (-1,), where), where)
        parts.append((camera_of(K, D, size, where), R, array_of(table, "translation", (3,), where)))
    return rig_of(parts, world_is_table)
