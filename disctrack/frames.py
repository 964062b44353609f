"""Conventions, and the rotations that follow from them.

This docstring defines the conventions of all files.

World frame I = (O, i, j, k): k up, the table is z = 0 (Ma et al. 2014, section 2a). The table view of the calibration
    defines origin and heading (`calibration.judge.tolerances`).
Body frame: fixed to the disc, origin at its centre O, third axis e3 out of the upper face.
Nodal frame R_O = (e1, e2, e3): follows precession and nutation, not spin. e1 = (cos psi, sin psi, 0) is horizontal,
    e2 = e3 x e1 points from the contact A towards B; r_OA = -r e2 - h e3, the thickness is 2h.
Contact frame R_A = (n0, m0, k): n0 = e1, m0 = k x n0.
Rotation body -> world: R_world_body = Rz(psi) Rx(theta) Rz(phi), points_world = points_body @ R_world_body.T + t.
    psi precession, theta nutation in [0, pi], phi spin. R_a_b maps components in b to components in a: adjacent
    names must match (R_left_body = R_left_world @ R_world_body).
Small rotations: a rotation vector in world axes that multiplies from the left, R = exp([v]x) R_estimate. Pose
    covariances are in (x, y, z, v_x, v_y, v_z): regular at theta = 0, where psi and phi are undetermined.
Generalized coordinates q = (x, y, z, psi, theta, phi), rates qdot = dq/dt; omega_world = thetadot e1 + psidot k +
    phidot e3.
Quaternions (w, x, y, z), body to world, scalar part not negative at the first frame, continuous afterwards.
Units: SI and radians inside. Other units have a suffix (radius_mm, theta_deg) and are converted when a file is read or
    a page is printed.
Pixels: (0, 0) is the centre of the top-left pixel, x right, y down; points are (x, y), images are [y, x].
Camera frame: x right, y down, z along the view: points_camera = R_camera_world @ points_world + t_camera_world.
Arrays: components on the last axis; image points are (n_frames, n_cameras, n_markers, 2) with
    camera 0 = left, 1 = right. A frame without a result is NaN with a status, never a missing row.
"""

import numpy as np
from numpy.typing import ArrayLike

from calibration.cameras.camera import converted_rotation
from calibration.cameras.camera import rotation_from_vector as rotation_from_vector
from calibration.cameras.camera import vector_from_rotation as vector_from_rotation
from calibration.kit.types import Array

POSE_COMPONENTS = ("x", "y", "z", "rotation_x", "rotation_y", "rotation_z")
COORDINATES = ("x", "y", "z", "psi", "theta", "phi")
CAMERAS = ("left", "right")


def rotation_from_euler(psi: ArrayLike, theta: ArrayLike, phi: ArrayLike) -> Array:
    """R_world_body = Rz(psi) Rx(theta) Rz(phi); angles (...) [rad], wrapped or not -> (..., 3, 3)."""
    e1, e2, e3 = nodal_axes_world(psi, theta)
    s, c = np.sin(phi)[..., None], np.cos(phi)[..., None]
    return np.stack(np.broadcast_arrays(c * e1 + s * e2, c * e2 - s * e1, e3), axis=-1)


def rotation_z(angle: ArrayLike) -> Array:
    """Rotation about the third axis; angle (...) [rad] -> (..., 3, 3)."""
    return rotation_from_euler(0.0, 0.0, angle)


def euler_from_rotation(R_world_body: Array) -> Array:
    """(psi, theta, phi) of R_world_body (..., 3, 3) -> (..., 3) [rad]; psi and phi in (-pi, pi], theta in [0, pi].

    At theta = 0 and pi only psi + phi or psi - phi is determined; then psi = 0 and phi is the whole rotation.
    """
    R = np.asarray(R_world_body, float)
    sine = np.hypot(R[..., 0, 2], R[..., 1, 2])
    theta = np.arctan2(sine, R[..., 2, 2])
    regular = sine > 1e-14
    psi = np.where(regular, np.arctan2(R[..., 0, 2], -R[..., 1, 2]), 0.0)
    phi = np.where(regular, np.arctan2(R[..., 2, 0], R[..., 2, 1]), np.arctan2(R[..., 1, 0], R[..., 0, 0]))
    return np.stack([psi, theta, phi], axis=-1)


def unwrap_euler(euler: Array) -> Array:
    """Angles continuous in time: (n, 3) psi, theta, phi [rad], also across NaN rows.

    psi + phi (the rotation of the body about the vertical for small theta) is well determined even if psi and phi are
    not: psi is unwrapped first, then the branch of phi is chosen so that psi + phi is continuous.
    """
    result = np.array(euler, float)
    good = np.flatnonzero(np.isfinite(result).all(axis=-1))
    psi, total = np.unwrap(result[good, 0]), np.unwrap(result[good, 0] + result[good, 2])
    result[good, 0], result[good, 2] = psi, total - psi
    return result


def nodal_axes_world(psi: ArrayLike, theta: ArrayLike) -> tuple[Array, Array, Array]:
    """e1, e2, e3 in world axes, each (..., 3), from precession and nutation (...) [rad]."""
    s, c = np.sin(theta), np.cos(theta)
    sp, cp = np.sin(psi), np.cos(psi)
    zero = np.zeros(np.broadcast(s, sp).shape)
    e1 = np.stack([cp + zero, sp + zero, zero], axis=-1)
    e2 = np.stack([-sp * c, cp * c, s + zero], axis=-1)
    e3 = np.stack([sp * s, -cp * s, c + zero], axis=-1)
    return e1, e2, e3


def euler_rate_axes_world(psi: ArrayLike, theta: ArrayLike) -> Array:
    """Matrix (..., 3, 3) with omega_world = matrix @ (psidot, thetadot, phidot); its columns are k, e1, e3."""
    e1, _, e3 = nodal_axes_world(psi, theta)
    return np.stack(np.broadcast_arrays((0.0, 0.0, 1.0), e1, e3), axis=-1)


def euler_jacobian(psi: ArrayLike, theta: ArrayLike) -> Array:
    """d(psi, theta, phi)/d(world rotation vector), (..., 3, 3); entries grow as 1/sin theta, NaN at theta = 0."""
    e1, e2, _ = nodal_axes_world(psi, theta)
    sine = np.sin(theta)[..., None]
    with np.errstate(divide="ignore", invalid="ignore"):
        J = np.stack([e2 / sine, e1, np.cross(e1, (0.0, 0.0, 1.0)) / sine], axis=-2)
    J[np.broadcast_to(sine[..., 0], J.shape[:-2]) == 0] = np.nan
    return J


def skew(v: ArrayLike) -> Array:
    """Matrix of the cross product, skew(v) @ w = v x w; v (..., 3) -> (..., 3, 3)."""
    return np.cross(np.eye(3), np.asarray(v, float)[..., None, :])


def quaternion_from_rotation(R: Array) -> Array:
    """Unit quaternion (w, x, y, z) of R (..., 3, 3) -> (..., 4); NaN in, NaN out."""
    return np.roll(converted_rotation(R, "as_quat"), 1, axis=-1)  # SciPy has the scalar part last


def rotation_from_quaternion(q: Array) -> Array:
    """R (..., 3, 3) of a unit quaternion (w, x, y, z) (..., 4)."""
    q = np.asarray(q, float)
    w, v = q[..., :1, None], q[..., 1:]
    S = skew(v)
    return np.eye(3) + 2 * w * S + 2 * (S @ S)


def continuous_quaternions(q: Array) -> Array:
    """(n, 4) with signs chosen so that successive quaternions have a positive product; NaN rows are skipped."""
    q = np.array(q, float)
    good = np.flatnonzero(np.isfinite(q).all(axis=-1))
    first, dots = q[good[:1], 0], np.sum(q[good[1:]] * q[good[:-1]], axis=-1)
    signs = np.where(np.concatenate([first, dots]) < 0, -1.0, 1.0)
    q[good] *= np.cumprod(signs)[:, None]
    return q
