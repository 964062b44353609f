"""A trajectory as a table for people, and for any program that reads numbers."""

import csv
import io
from pathlib import Path

import numpy as np

from calibration.kit.arguments import checked
from disctrack.files.whole import refuse_existing, write_whole
from disctrack.frames import CAMERAS, COORDINATES
from disctrack.trajectory import FrameStatus, Trajectory


@checked
def write_csv(path: str | Path, trajectory: Trajectory, overwrite: bool = False) -> None:
    """The trajectory as a table for people: millimetres and degrees, one row per frame, empty where unknown.

    Of every coordinate its value, the sigma of the frame's own noise, and the sigma that all frames share through the
    calibration. Coordinates have seven decimals however many turns the angles have counted, sigmas seven digits.

        >>> write_csv("table.csv", read_trajectory("clip"))
    """
    path = Path(path)
    refuse_existing(path, overwrite)
    scale = np.repeat([1e3, np.degrees(1.0)], 3)
    parts = ("", "sigma_", "sigma_calibration_")
    names = [f"{name}_{part}{unit}" for part in parts for name, unit in zip(COORDINATES, _UNITS, strict=True)]
    seen = [f"reprojection_rms_{camera}_px" for camera in CAMERAS]
    values = [trajectory.q * scale, trajectory.coordinate_sigma * scale, trajectory.calibration_sigma * scale]
    rows = np.column_stack([*values, trajectory.reprojection_rms_px])
    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow(["frame", "time_s", *names, *seen, "status"])
    for i, row in enumerate(rows):
        cells = ["" if np.isnan(v) else f"{v:.7f}" if column < 6 else f"{v:.7g}" for column, v in enumerate(row)]
        status = FrameStatus(trajectory.frame_status[i]).name.lower()
        writer.writerow([trajectory.frame[i], f"{trajectory.time[i]:.9g}", *cells, status])
    write_whole(path, text.getvalue().encode())


_UNITS = ("mm", "mm", "mm", "deg", "deg", "deg")
