"""Laws on given motions, in plain NumPy: what an effect would supply there, and what the motion needs."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from disctrack.disc import Disc
from disctrack.frames import nodal_axes_world, rotation_from_euler
from disctrack.rolling.effects import Effect
from disctrack.rolling.model import Model, body_constants
from disctrack.rolling.records import KINEMATICS, WRENCH, record_dtype

Array = NDArray[np.float64]

_K = np.array([0.0, 0.0, 1.0])


def kinematics(q: Array, qdot: Array, disc: Disc, gravity: float = 9.81, time: ArrayLike = 0.0) -> np.recarray:
    """Kinematic quantities (...) of records.KINEMATICS from coordinates and rates (..., 6); a record array.

    The slip is that of the disc's material point at the contact, from the velocity of O given in qdot.
    """
    x, y, z, psi, theta, phi = np.moveaxis(np.asarray(q, float), -1, 0)
    v_x, v_y, v_z, psidot, thetadot, phidot = np.moveaxis(np.asarray(qdot, float), -1, 0)
    s, c, sp, cp = np.sin(theta), np.cos(theta), np.sin(psi), np.cos(psi)
    v_n, v_m = v_x * cp + v_y * sp, v_y * cp - v_x * sp
    omega2, omega3 = psidot * s, psidot * c + phidot
    r, h = disc.radius, disc.half_thickness
    quantities = {
        "time": time,
        **dict(x=x, y=y, z=z, psi=psi, theta=theta, phi=phi, sin_theta=s, cos_theta=c),
        **dict(
            thetadot=thetadot, psidot=psidot, phidot=phidot, omega2=omega2, omega3=omega3, v_n=v_n, v_m=v_m, v_z=v_z
        ),
        "omega_z": psidot + phidot * c,
        "slip_n": v_n - h * omega2 + r * omega3,
        "slip_m": v_m + (r * s + h * c) * thetadot,
        **dict(radius=r, half_thickness=h, mass=disc.mass, gravity=gravity),
    }
    result = np.empty(theta.shape, record_dtype(KINEMATICS, float))
    for name in KINEMATICS:
        result[name] = quantities[name]
    return result.view(np.recarray)


def effect_wrench(effect: Effect, motion: Any, load: ArrayLike) -> tuple[Array, Array]:
    """Contact moment and force on O of one effect, each (..., 3) in (n0, m0, k) [N m, N].

    motion : records.KINEMATICS by attribute, as `kinematics` gives them.   load : (...) normal force F_z [N]
    """
    load = np.asarray(load, float)
    shape = np.broadcast_shapes(np.shape(motion.theta), load.shape)
    w = SimpleNamespace(**{name: np.zeros(shape) for name in WRENCH})
    if effect.law is not None:
        effect.law(SimpleNamespace(**effect.values), motion, w)
    moment = [getattr(w, f"M_{a}") + load * getattr(w, f"load_{a}") for a in "nmz"]
    return np.stack(moment, axis=-1), np.stack([w.X_n, w.X_m, w.X_z], axis=-1)


def effect_power(effect: Effect, motion: Any, load: ArrayLike) -> Array:
    """Power of an effect's moment and force (...) [W]: never positive for a passive one."""
    moment, force = effect_wrench(effect, motion, load)
    rates = np.stack([motion.thetadot, -motion.phidot * motion.sin_theta, motion.omega_z], axis=-1)
    velocity = np.stack([motion.v_n, motion.v_m, motion.v_z], axis=-1)
    return np.sum(moment * rates, axis=-1) + np.sum(force * velocity, axis=-1)


def required_wrench(
    model: Model, q: Array, qdot: Array, acceleration_world: Array, angular_acceleration_world: Array
) -> tuple[Array, Array]:
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
