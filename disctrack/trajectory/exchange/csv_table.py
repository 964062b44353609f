"""A trajectory as a table for people, and for any program that reads numbers."""

import csv
import io
from pathlib import Path

import numpy as np

from disctrack.files.whole import refuse_existing, write_whole
from disctrack.frames import CAMERAS, COORDINATES
from disctrack.trajectory import FrameStatus, Trajectory


def write_csv(path: str | Path, trajectory: Trajectory, overwrite: bool = False) -> None:
    """The trajectory as a table for people: millimetres and degrees, one row per frame, empty where unknown.

    Of every coordinate its value, the sigma of the frame's own noise, and the sigma that all frames share through the
    calibration. Coordinates have seven decimals however many turns the angles have counted, sigmas seven digits.

    >>> write_csv("table.csv", read_trajectory("clip"))
    """
    path = Path(path)
    refuse_existing(path, overwrite)
    scale = np.array([1e3, 1e3, 1e3, *np.degrees([1.0, 1.0, 1.0])])
    units = ["mm"] * 3 + ["deg"] * 3
    names = [f"{name}_{unit}" for name, unit in zip(COORDINATES, units, strict=True)]
    header = ["frame", "time_s", *names, *(n.replace("_", "_sigma_") for n in names)]
    header += [n.replace("_", "_sigma_calibration_") for n in names]
    header += [*(f"reprojection_rms_{camera}_px" for camera in CAMERAS), "status"]
    table = np.column_stack(
        [
            trajectory.q * scale,
            trajectory.coordinate_sigma * scale,
            trajectory.calibration_sigma * scale,
            trajectory.reprojection_rms_px,
        ]
    )
    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow(header)
    for frame, time, values, status in zip(
        trajectory.frame, trajectory.time, table, trajectory.frame_status, strict=True
    ):
        cells = ["" if np.isnan(v) else f"{v:.7f}" if i < 6 else f"{v:.7g}" for i, v in enumerate(values)]
        writer.writerow([frame, f"{time:.9g}", *cells, FrameStatus(status).name.lower()])
    write_whole(path, text.getvalue().encode())
