"""The contact force and moment that a motion needs, from the balances of momentum in the world: Newton and Euler."""

import numpy as np

from disctrack.frames import nodal_axes_world
from disctrack.rolling import Model

_K = np.array([0.0, 0.0, 1.0])


def required_wrench(model: Model, q, qdot, acceleration_world, angular_acceleration_world):
    """Contact force and contact moment that a motion needs, each (..., 3) in (n0, m0, k) [N, N m].

    q, qdot : (..., 6).   acceleration_world of the centre O, angular_acceleration_world : (..., 3)
    From the balances of momentum and of angular momentum of a homogeneous disc with a sharp edge on a level table;
    whatever of the moment its contact laws do not supply is what the model lacks.
    """
    disc = model.disc
    e1, e2, e3 = nodal_axes_world(q[..., 3], q[..., 4])
    omega = qdot[..., 4:5] * e1 + qdot[..., 3:4] * _K + qdot[..., 5:6] * e3

    def momentum(turning):
        along = np.sum(turning * e3, axis=-1, keepdims=True)
        return disc.moment_diametral * turning + (disc.moment_axial - disc.moment_diametral) * along * e3

    force = disc.mass * (acceleration_world + model.gravity * _K)
    rate = momentum(angular_acceleration_world) + np.cross(omega, momentum(omega))
    moment = rate - np.cross(disc.arm_to_contact(e2, e3), force)
    to_contact = np.stack([e1, np.cross(_K, e1), np.broadcast_to(_K, e1.shape)], axis=-2)
    return np.einsum("...ij,...j->...i", to_contact, force), np.einsum("...ij,...j->...i", to_contact, moment)
