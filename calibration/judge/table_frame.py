"""The lab frame: the table under the board of one calibration view."""

import numpy as np

from calibration.cameras.camera import N_RIG, StereoRig
from calibration.fit.refinement import Refinement
from calibration.fit.stereo_model import N_STEREO
from calibration.kit.arrays import Array


def table_pose(R_left_board: Array, t_left_board: Array, board_thickness: float) -> tuple[Array, Array]:
    """(R_left_world, t_left_world): origin on the table below corner 0, i and j along the board's sides, k up.

    The printed face lies at z = board_thickness [m] above the table; board and world axes are parallel.
    """
    return R_left_board, t_left_board - board_thickness * R_left_board[:, 2]


def rig_with_covariance(
    refinement: Refinement,
    table_view: int | None,
    board_thickness: float,
    inflation: float,
    stereo: Array | None = None,
    origin: Array | None = None,
) -> StereoRig:
    """The rig at the minimum, its world on the table of one view, with the covariance of all RIG_PARAMETERS.

    inflation : factor on the covariance that follows from the points' noise
    origin : (3,) [m] that lies one thickness above the world's, in board axes; corner 0 without
    stereo : covariance of the free stereo parameters where it is known better, see `assessment.stereo_covariance`
    """
    model, normal = refinement.model, refinement.normal
    basis = refinement.problem.stereo_basis
    n_free = basis.shape[1]
    shared, poses, cross = normal.covariances()
    free, cross = inflation * shared[:n_free, :n_free], inflation * cross[:, :n_free, :6]
    poses = inflation * poses[:, :6, :6]  # at the left camera's exposure
    if stereo is not None:
        carried = np.swapaxes(np.linalg.solve(free, cross), 1, 2)  # how far a pose follows the stereo parameters
        poses = poses + carried @ (stereo - free) @ np.swapaxes(carried, 1, 2)
        free, cross = stereo, stereo @ np.swapaxes(carried, 1, 2)
    covariance = np.zeros((N_RIG, N_RIG))
    covariance[:N_STEREO, :N_STEREO] = basis @ free @ basis.T
    R_left_world, t_left_world = np.eye(3), np.zeros(3)
    if table_view is not None:
        R, t = model.R_left_board[table_view], model.t_left_board[table_view]
        t = t if origin is None else t + R @ origin
        R_left_world, t_left_world = table_pose(R, t, board_thickness)
        # t_world = t - h R k: turning R by v shifts it by -v x (h R k) = (h R k) x v
        M = np.eye(6)
        M[3:, :3] = np.cross(board_thickness * R[:, 2], np.eye(3)).T
        covariance[N_STEREO:, N_STEREO:] = M @ poses[table_view] @ M.T
        covariance[:N_STEREO, N_STEREO:] = basis @ cross[table_view] @ M.T
        covariance[N_STEREO:, :N_STEREO] = covariance[:N_STEREO, N_STEREO:].T
    place = (model.R_right_left, model.t_right_left, R_left_world, t_left_world)
    return StereoRig(*model.cameras, *place, 0.5 * (covariance + covariance.T), table_view is not None)
