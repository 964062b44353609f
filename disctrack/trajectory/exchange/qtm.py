"""A trajectory as Qualisys Track Manager exports a rigid body: a 6DOF TSV file.

Millimetres and degrees; R = Rx(roll) Ry(pitch) Rz(yaw), and Rot[0...8] is R column by column. Frames count from 1.
"""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from disctrack.files.whole import write_whole
from disctrack.trajectory import Trajectory
from disctrack.trajectory.exchange.motion import rotations
from disctrack.trajectory.exchange.tables import table


def write_qtm(path: Path, trajectory: Trajectory) -> None:
    """One body, DISC; its residual is one sigma of the place [mm]. A frame without a pose has zeros and residual -1.

    Raises OutputError.
    """
    known, R = trajectory.measured, rotations(trajectory)
    values = np.zeros((len(known), 16))
    values[known, :3] = 1e3 * trajectory.q[known, :3]
    values[known, 3:6] = Rotation.from_matrix(R[known]).as_euler("XYZ", degrees=True)
    sigma = np.sqrt(np.einsum("nii->n", trajectory.pose_covariance[:, :3, :3]))
    values[:, 6] = np.where(known, 1e3 * sigma, -1.0)
    values[known, 7:] = np.swapaxes(R[known], 1, 2).reshape(-1, 9)
    heads = {
        "NO_OF_FRAMES": len(known),
        "NO_OF_CAMERAS": 2,
        "NO_OF_BODIES": 1,
        "FREQUENCY": f"{trajectory.frame_rate:g}",
        "NO_OF_ANALOG": 0,
        "ANALOG_FREQUENCY": 0,
        "DESCRIPTION": "--",
        "DATA_INCLUDED": "6D",
        "BODY_NAMES": "DISC",
    }
    names = [
        "Frame",
        "Time",
        "DISC X",
        "Y",
        "Z",
        "Roll",
        "Pitch",
        "Yaw",
        "Residual",
        *(f"Rot[{i}]" for i in range(9)),
    ]
    columns = np.column_stack([np.arange(1, len(known) + 1), trajectory.time, values])
    text = "".join(f"{key}\t{value}\n" for key, value in heads.items())
    write_whole(path, text.encode() + table(names, columns, "\t"))
