"""A trajectory as Qualisys Track Manager exports a rigid body: a 6DOF TSV file.

Millimetres and degrees; R = Rx(roll) Ry(pitch) Rz(yaw), and Rot[0...8] is R column by column. Frames count from 1.
"""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from disctrack.files.whole import write_whole
from disctrack.trajectory import Trajectory
from disctrack.trajectory.exchange.motion import place_sigma_mm, rotations
from disctrack.trajectory.exchange.tables import table

_HEAD = """NO_OF_FRAMES\t{n}
NO_OF_CAMERAS\t2
NO_OF_BODIES\t1
FREQUENCY\t{rate:g}
NO_OF_ANALOG\t0
ANALOG_FREQUENCY\t0
DESCRIPTION\t--
DATA_INCLUDED\t6D
BODY_NAMES\tDISC
"""
_COLUMNS = ("Frame", "Time", "DISC X", "Y", "Z", "Roll", "Pitch", "Yaw", "Residual", *(f"Rot[{i}]" for i in range(9)))


def write_qtm(path: Path, trajectory: Trajectory) -> None:
    """One body, DISC; its residual is one sigma of the place [mm]. A frame without a pose has zeros and residual -1.

    Raises OutputError.
    """
    known, R = trajectory.measured, rotations(trajectory)
    values = np.zeros((len(known), 18))
    values[:, 0], values[:, 1] = np.arange(1, len(known) + 1), trajectory.time
    values[known, 2:5] = 1e3 * trajectory.q[known, :3]
    values[known, 5:8] = Rotation.from_matrix(R[known]).as_euler("XYZ", degrees=True)
    values[:, 8] = place_sigma_mm(trajectory)
    values[known, 9:] = np.swapaxes(R[known], 1, 2).reshape(-1, 9)
    head = _HEAD.format(n=len(known), rate=trajectory.frame_rate)
    write_whole(path, head.encode() + table(_COLUMNS, values, "\t"))
