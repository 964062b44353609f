"""The contact force and moment that a motion needs, from the balances of momentum in the world: Newton and Euler."""

from types import SimpleNamespace

import numpy as np

from disctrack.frames import nodal_axes_world, rotation_from_euler
from disctrack.rolling import Model
from disctrack.rolling.evaluate import effect_wrench, kinematics
from disctrack.rolling.model import body_constants

_K = np.array([0.0, 0.0, 1.0])


def required_wrench(
    model: Model,
    q: np.ndarray,
    qdot: np.ndarray,
    acceleration_world: np.ndarray,
    angular_acceleration_world: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Contact force and contact moment that a motion needs, each (..., 3) in (n0, m0, k) [N, N m].

    q, qdot : (..., 6).   acceleration_world of the centre O, angular_acceleration_world : (..., 3)
    From the balances of momentum and of angular momentum about the centre of mass, with the body, the gravity and the
    external forces of the model; whatever of the moment its contact laws do not supply is what the model lacks.
    """
    body = SimpleNamespace(**body_constants(model, 0.0))
    q, qdot = np.asarray(q, float), np.asarray(qdot, float)
    e1, e2, e3 = nodal_axes_world(q[..., 3], q[..., 4])
    omega = qdot[..., 4:5] * e1 + qdot[..., 3:4] * _K + qdot[..., 5:6] * e3
    R = rotation_from_euler(q[..., 3], q[..., 4], q[..., 5])
    com = R @ np.array([body.com_1, body.com_2, body.com_3])
    J = np.array(
        [[body.J_11, body.J_12, body.J_13], [body.J_12, body.J_22, body.J_23], [body.J_13, body.J_23, body.J_33]]
    )
    J_world = R @ J @ np.swapaxes(R, -1, -2)
    rho = body.edge_radius
    arm = -(body.radius - rho) * e2 - (body.half_thickness - rho) * e3 - rho * _K
    contact_axes = np.stack([e1, np.cross(_K, e1), np.broadcast_to(_K, e1.shape)], axis=-1)
    motion = kinematics(q, qdot, model.disc, model.gravity)
    X = sum((effect_wrench(e, motion, 0.0)[1] for e in model.effects), np.zeros(e1.shape))
    X_world = np.einsum("...ij,...j->...i", contact_axes, X)
    centripetal = np.cross(omega, np.cross(omega, com))
    a_G = acceleration_world + np.cross(angular_acceleration_world, com) + centripetal
    force = body.mass * (a_G - np.array([body.g_x, body.g_y, body.g_z])) - X_world
    momentum = np.einsum("...ij,...j->...i", J_world, omega)
    rate = np.einsum("...ij,...j->...i", J_world, angular_acceleration_world) + np.cross(omega, momentum)
    moment = rate - np.cross(arm - com, force) + np.cross(com, X_world)
    to_contact = np.swapaxes(contact_axes, -1, -2)
    return np.einsum("...ij,...j->...i", to_contact, force), np.einsum("...ij,...j->...i", to_contact, moment)
