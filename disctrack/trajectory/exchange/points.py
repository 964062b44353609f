"""Image points as tables of text: a row for each frame, columns NAME_camJ_X, NAME_camJ_Y of every point and camera."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from calibration.cameras.camera import normalise
from calibration.kit.arrays import Array
from disctrack.errors import RigFileError
from disctrack.files.whole import write_whole
from disctrack.trajectory import Trajectory
from disctrack.trajectory.exchange.rig_parts import content_of


def table(names: Sequence[str], columns: ArrayLike, separator: str = ",") -> bytes:
    """Heading and numbers (n, names), NaN where there is none; ten digits."""
    rows = [separator.join(names), *(separator.join(f"{v:.10g}" for v in row) for row in np.asarray(columns, float))]
    return ("\n".join(rows) + "\n").replace("nan", "NaN").encode()


def _write(path: Path, points: Array, names: Sequence[str]) -> None:
    """Points (n, cameras, m, 2) with m names; NaN where a dot has no centre."""
    headings = [f"{name}_cam{c}_{axis}" for name in names for c in range(1, points.shape[1] + 1) for axis in "XY"]
    write_whole(path, table(headings, points.swapaxes(1, 2).reshape(len(points), -1)))


def write_points(path: Path, trajectory: Trajectory) -> None:
    """XMALab's DOT_i_camJ_X, DOT_i_camJ_Y [px]: dots as the images show them, lens and all, from 0 at the top left.

    XMALab asks on import: "distorted", no offset, not inverted. Raises OutputError.
    """
    points, field = trajectory.markers_px, trajectory.rig.lens_field
    if field is not None:
        points = field.distorted(points)
    _write(path, points, [f"DOT_{i}" for i in range(points.shape[2])])


def write_xypts(path: Path, trajectory: Trajectory) -> None:
    """DLTdv8's ptI_camJ_X, ptI_camJ_Y [px], from 1 at the top left, without the lens' distortion. Raises OutputError.

    They belong to coefficients of the direct linear transformation, which describe a camera without a lens.
    """
    rig, seen = trajectory.rig, trajectory.markers_px
    straight = [
        normalise(seen[:, c], camera) * (camera.fx, camera.fy) + (camera.cx, camera.cy) + 1.0
        for c, camera in enumerate(rig.cameras)
    ]
    _write(path, np.stack(straight, axis=1), [f"pt{i}" for i in range(1, seen.shape[2] + 1)])


def read_points(path: Path) -> Array:
    """Points (n, cameras, m, 2) of a table with such headings; NaN where there is none. Raises RigFileError."""
    first, *lines = content_of(path).splitlines() or [""]
    found = [re.fullmatch(r"\s*(.+)_cam(\d+)_([XY])\s*", name) for name in first.split(",")]
    names, cameras = dict.fromkeys(m[1] for m in found if m), {m[2] for m in found if m}
    if not found or not all(found) or len(found) != 2 * len(names) * len(cameras):
        raise RigFileError(
            f"{path}: the first line is '{first[:60]}'; expected NAME_cam1_X,NAME_cam1_Y,NAME_cam2_X,..."
        )
    try:
        values = np.array([[float(cell or "nan") for cell in line.split(",")] for line in lines if line.strip()])
        return values.reshape(len(values), len(names), len(cameras), 2).swapaxes(1, 2)
    except ValueError as error:
        raise RigFileError(f"{path}: not a table of numbers with {len(found)} columns ({error})") from error


def read_xypts(path: Path) -> Array:
    """Points (n, cameras, points, 2) [px], counted from 0. Raises RigFileError."""
    return read_points(path) - 1.0
