"""XMALab's tables: image points of the dots, and the rigid body's transformations.

Points are those of the images, with lens and all, counted from 0 at the top left (XMALab asks on import: "distorted",
no offset, not inverted). A transformation is a row of 16 numbers, the matrix (4, 4) column by column, in millimetres.
"""

from pathlib import Path

import numpy as np

from disctrack.files.whole import write_whole
from disctrack.trajectory import Trajectory
from disctrack.trajectory.exchange.motion import rotations
from disctrack.trajectory.exchange.tables import point_columns, table

_HEADS = ("R11", "R12", "R13", "01", "R21", "R22", "R23", "02", "R31", "R32", "R33", "03", "TX", "TY", "TZ", "1")


def write_points(path: Path, trajectory: Trajectory) -> None:
    """A row for each frame: DOT_i_camJ_X, DOT_i_camJ_Y [px]; NaN where a dot has no centre. Raises OutputError."""
    points, field = trajectory.markers_px, trajectory.rig.lens_field
    if field is not None:
        points = field.distorted(points)
    write_whole(path, table(*point_columns(points, [f"DOT_{i}" for i in range(points.shape[2])])))


def write_transformations(path: Path, trajectory: Trajectory) -> None:
    """A row for each frame, body to world; NaN without a pose. Raises OutputError."""
    T = np.zeros((len(trajectory), 4, 4))
    T[:, :3, :3], T[:, :3, 3], T[:, 3, 3] = rotations(trajectory), 1e3 * trajectory.q[:, :3], 1.0
    T[~trajectory.measured] = np.nan
    columns = np.swapaxes(T, 1, 2).reshape(-1, 16)
    write_whole(path, table([f"DISC_{head}" for head in _HEADS], columns))
