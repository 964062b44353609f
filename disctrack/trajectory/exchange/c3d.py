"""A trajectory for programs of motion capture: points and the rigid body in a C3D file."""

from pathlib import Path

import numpy as np

from disctrack.errors import OutputError
from disctrack.files.whole import whole_file
from disctrack.trajectory import Trajectory
from disctrack.trajectory.exchange.motion import body_points, place_sigma_mm


def write_c3d(path: Path, trajectory: Trajectory) -> None:
    """Dots, centre and the tips of the body axes as points in mm, world axes, z up; times at the frame rate.

    The body axes are points one radius from the centre (AXIS_1, AXIS_2 in the face, AXIS_3 out of it), from which any
    program builds the rigid body; a point's residual is its one-sigma in mm, -1 in frames without a pose. C3D keeps
    single precision: 1e-4 mm at 1 m. Raises OutputError, also where ezc3d is not installed.
    """
    try:
        import ezc3d
    except ImportError as error:
        raise OutputError(f"{path}: C3D needs ezc3d: pip install ezc3d") from error
    points, labels = body_points(trajectory)
    file = ezc3d.c3d()
    described = [_DESCRIPTIONS.get(label, "centre of a dot") for label in labels]
    told = {"UNITS": ["mm"], "RATE": [float(trajectory.frame_rate)], "LABELS": labels, "DESCRIPTIONS": described}
    for name, value in told.items():
        file["parameters"]["POINT"][name]["value"] = value
    data = np.ones((4, len(labels), len(trajectory)))
    data[:3] = np.where(trajectory.measured, 1e3 * np.moveaxis(points, 0, -1).swapaxes(0, 1), np.nan)
    file["data"]["points"] = data
    residuals = np.broadcast_to(place_sigma_mm(trajectory), (1, len(labels), len(trajectory)))
    file["data"]["meta_points"]["residuals"] = residuals.copy()
    file.add_parameter("DISC", "RADIUS", 1e3 * trajectory.disc.radius)
    file.add_parameter("DISC", "THICKNESS", 2e3 * trajectory.disc.half_thickness)
    file.add_parameter("DISC", "MASS", 1e3 * trajectory.disc.mass)
    with whole_file(path, suffix=".c3d") as part:
        file.write(str(part))


_DESCRIPTIONS = {
    "CENTRE": "centre of mass",
    "AXIS_1": "centre + radius * first body axis",
    "AXIS_2": "centre + radius * second body axis",
    "AXIS_3": "centre + radius * normal of the upper face",
}
