"""Tables as text: a row for each frame, points of several cameras in columns NAME_camJ_X, NAME_camJ_Y."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from calibration.kit.arrays import Array
from disctrack.errors import RigFileError
from disctrack.trajectory.exchange.rig_parts import content_of


def table(names: Sequence[str], columns: ArrayLike, separator: str = ",") -> bytes:
    """Heading and numbers (n, names), NaN where there is none; ten digits."""
    rows = [separator.join(names), *(separator.join(f"{v:.10g}" for v in row) for row in np.asarray(columns, float))]
    return ("\n".join(rows) + "\n").replace("nan", "NaN").encode()


def point_columns(points: Array, names: Sequence[str]) -> tuple[list[str], Array]:
    """Headings and columns of points (n, cameras, m, 2) with m names."""
    cameras = range(1, points.shape[1] + 1)
    headings = [f"{name}_cam{c}_{axis}" for name in names for c in cameras for axis in "XY"]
    return headings, points.swapaxes(1, 2).reshape(len(points), -1)


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
