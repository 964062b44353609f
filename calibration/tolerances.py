"""What no image can tell of a board: its true size, how flat it lies, how thick it is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.arrays import Array
from calibration.camera import N_RIG, StereoRig


@dataclass(frozen=True)
class BoardTolerances:
    """Standard deviations of what is declared of a board; by default those of a good print on a stiff plate."""

    square: float = 2e-4  # relative, of the side of a square, in the mean over the board
    flatness: float = 20e-6  # [m] of the printed face as it lies on the table, against the plane through it
    thickness: float = 20e-6  # [m]


def with_tolerances(
    rig: StereoRig, board_points: Array, table_view: int | None, board_thickness: float, tolerances: BoardTolerances
) -> StereoRig:
    """The rig with the tolerances in its covariance.

    A board whose squares are longer by s makes every length longer: t -> (1 + s) t, cameras and world alike. Half of
    the variance is that; the other half is a stretch along each side, which moves the board's corner 0. One that is
    bowed or thicker than declared lifts the table, or turns it about the board's middle by flatness / half its side.

    board_points : (n, 3) [m] corners in board axes, whose origin the world has, and whose x and y
    """
    directions = [np.zeros(N_RIG)]
    half_square = tolerances.square / np.sqrt(2.0)
    directions[0][21:24] = half_square * rig.t_right_left
    if table_view is not None:
        R = rig.R_left_world
        half, middle = 0.5 * np.ptp(board_points, axis=0)[:2], board_points.mean(0)
        directions[0][27:30] = half_square * (rig.t_left_world + board_thickness * R[:, 2])
        lift = np.zeros(N_RIG)
        lift[27:30] = np.hypot(tolerances.thickness, tolerances.flatness) * R[:, 2]
        directions.append(lift)
        for axis in (0, 1):
            # turned about the board's other side, so that z grows along this one; the middle stays where it is
            slope = tolerances.flatness / half[axis]
            turn = np.zeros(N_RIG)
            turn[24:27] = slope * R @ ([0.0, -1.0, 0.0] if axis == 0 else [1.0, 0.0, 0.0])
            turn[27:30] = -slope * middle[axis] * R[:, 2]
            stretch = np.zeros(N_RIG)
            stretch[27:30] = half_square * middle[axis] * R[:, axis]
            directions += [turn, stretch]
    D = np.stack(directions, axis=1)
    return StereoRig(**{**vars(rig), "covariance": rig.covariance + D @ D.T})
