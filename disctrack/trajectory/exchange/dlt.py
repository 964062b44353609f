"""Direct linear transformation: DLTdv8's and easyWand's coefficients of a rig, and DLTdv8's points.

    u = (L1 X + L2 Y + L3 Z + L4) / (L9 X + L10 Y + L11 Z + 1),  v = (L5 X + L6 Y + L7 Z + L8) / (the same)

dltcoefs.csv has eleven rows and a column for each camera; X, Y, Z are in metres. Eleven coefficients describe a camera
without a lens, so xypts.csv holds points without the lens' distortion. Both count pixels from 1 at the top left.
"""

from pathlib import Path

import cv2
import numpy as np

from calibration.cameras.camera import StereoRig, normalise
from calibration.kit.arrays import Array
from disctrack.errors import RigFileError
from disctrack.files.whole import write_whole
from disctrack.trajectory import Trajectory
from disctrack.trajectory.exchange.rig_parts import camera_of, content_of, rig_of
from disctrack.trajectory.exchange.tables import point_columns, read_points, table

FROM_ONE = np.array([[1.0, 0.0, 1.0], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]])  # pixels from 0 -> pixels from 1


def write_dlt(path: Path, rig: StereoRig) -> None:
    """Coefficients of both cameras (11 rows, left and right). Raises OutputError."""
    columns = []
    for camera, (R, t) in zip(rig.cameras, rig.camera_poses(), strict=True):
        P = FROM_ONE @ camera.camera_matrix @ np.column_stack([R, t])
        columns.append((P / P[2, 3]).ravel()[:11])
    write_whole(path, "".join(f"{left:.17g},{right:.17g}\n" for left, right in zip(*columns, strict=True)).encode())


def read_dlt(
    path: Path, *, image_size: tuple[int, int] | None = None, unit: float = 1.0, world_is_table: bool = False
) -> StereoRig:
    """Two cameras without distortion from their coefficients; (width, height) [px] stands in no such file.

    unit : [m] length of the coefficients' unit
    world_is_table : True if their axes are the table's, z up
    Raises RigFileError, also where a camera is skewed: eleven free coefficients need not be a pinhole's.
    """
    try:
        L = np.array([[float(cell) for cell in line.split(",")] for line in content_of(path).split()])
    except ValueError as error:
        raise RigFileError(f"{path}: not a table of DLT coefficients ({error})") from error
    if L.shape != (11, 2) or not np.isfinite(L).all():
        raise RigFileError(f"{path}: {L.shape} numbers; coefficients of two cameras are 11 rows of 2 finite ones")
    if image_size is None:
        raise RigFileError(f"{path}: does not tell the image size; give width and height")
    parts = []
    for number, column in enumerate(L.T, start=1):
        P = np.linalg.inv(FROM_ONE) @ np.append(column, 1.0).reshape(3, 4)
        P *= np.sign(np.linalg.det(P[:, :3]))  # it is known up to its sign
        K, R, (*centre, scale) = cv2.decomposeProjectionMatrix(P)[:3]
        t = -R @ np.ravel(centre) / scale * unit
        parts.append((camera_of(K / K[2, 2], np.zeros(0), np.array(image_size), f"{path}, camera {number}"), R, t))
    return rig_of(parts, world_is_table)


def write_xypts(path: Path, trajectory: Trajectory) -> None:
    """A row for each frame of the recording: ptI_camJ_X, ptI_camJ_Y of every dot; NaN where it has no centre."""
    rig, seen = trajectory.rig, trajectory.markers_px
    straight = [
        normalise(seen[:, c], camera) * (camera.fx, camera.fy) + (camera.cx, camera.cy) + 1.0
        for c, camera in enumerate(rig.cameras)
    ]
    names = [f"pt{i}" for i in range(1, seen.shape[2] + 1)]
    write_whole(path, table(*point_columns(np.stack(straight, axis=1), names)))


def read_xypts(path: Path) -> Array:
    """Points (n, cameras, points, 2) [px], counted from 0. Raises RigFileError."""
    return read_points(path) - 1.0
