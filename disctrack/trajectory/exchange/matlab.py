"""A trajectory for MATLAB and Octave: one struct `disctrack` in a MAT file of version 5."""

import io
from pathlib import Path

import numpy as np
from scipy.io import savemat

from disctrack.files.whole import refuse_existing, write_whole
from disctrack.frames import COORDINATES
from disctrack.trajectory import FrameStatus, Trajectory
from disctrack.trajectory.file import labelled


def write_mat(path: Path, trajectory: Trajectory, overwrite: bool = False) -> Path:
    """Every variable of the trajectory file's root and the dots, in SI and radians; NaN where there is no answer.

    disctrack.q (n, 6) with disctrack.q_names, q_sigma (this frame's noise), q_sigma_calibration (common to all frames);
    disctrack.units tells the unit of every field. Raises OutputError.
    """
    refuse_existing(path, overwrite)
    root, markers, _ = labelled(trajectory)
    fields = {name: np.asarray(item.data) for name, item in root.items()}
    fields |= {f"marker_{name}": np.asarray(item.data) for name, item in markers.items()}
    units = {name: item.units for name, item in root.items()}
    units |= {f"marker_{name}": item.units for name, item in markers.items()}
    disc = trajectory.disc
    content = {
        "time": trajectory.time,
        "q": trajectory.q,
        "q_sigma": trajectory.coordinate_sigma,
        "q_sigma_calibration": trajectory.calibration_sigma,
        "q_names": np.array(COORDINATES, dtype=object),
        **fields,
        "status_names": np.array([status.name.lower() for status in FrameStatus], dtype=object),
        "frame_rate_hz": trajectory.frame_rate,
        "gravity_m_s2": trajectory.gravity,
        "air_density_kg_m3": trajectory.air_density,
        "disc": {
            "radius_m": disc.radius,
            "half_thickness_m": disc.half_thickness,
            "mass_kg": disc.mass,
            "marker_diameter_m": disc.marker_diameter,
            "marker_centres_body_m": disc.marker_centres_body,
        },
        "units": {"time": "s", "q": "m, m, m, rad, rad, rad", **units},
    }
    buffer = io.BytesIO()
    savemat(buffer, {"disctrack": content}, oned_as="column", long_field_names=True)
    write_whole(path, buffer.getbuffer())
    return path
