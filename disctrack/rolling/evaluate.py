"""Laws on given motions, in plain NumPy: what an effect would supply there."""

from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from calibration.kit.arrays import Array
from disctrack.disc import AIR_DENSITY, Disc
from disctrack.rolling.effects.base import Effect
from disctrack.rolling.equations import FLYING
from disctrack.rolling.model import Model
from disctrack.rolling.motion import moment_power
from disctrack.rolling.records import KINEMATICS, WRENCH
from disctrack.rolling.simulate import Assembly


def kinematics(
    q: Array,
    qdot: Array,
    disc: Disc,
    gravity: float = 9.81,
    time: ArrayLike = 0.0,
    air_density: float = AIR_DENSITY,
) -> np.recarray:
    """Kinematic quantities (...) of records.KINEMATICS from coordinates and rates (..., 6); a record array.

    The slip is that of the disc's material point at the contact, from the velocity of O given in qdot.
    """
    x, y, z, psi, theta, phi = np.moveaxis(np.asarray(q, float), -1, 0)
    v_x, v_y, v_z, psidot, thetadot, phidot = np.moveaxis(np.asarray(qdot, float), -1, 0)
    omega2, omega3 = psidot * np.sin(theta), psidot * np.cos(theta) + phidot
    states = np.stack([x, y, psi, theta, phi, thetadot, omega2, omega3, v_x, v_y, z, v_z], axis=-1)
    times = np.broadcast_to(time, theta.shape).ravel()
    in_air = Assembly(Model(disc, gravity, air_density=air_density), 0.0)  # where any velocity of O may be
    found = in_air.at(FLYING, times, states.reshape(-1, 12))[2].reshape(theta.shape)
    return found[list(KINEMATICS)].view(np.recarray)


def effect_wrench(effect: Effect, motion: Any, load: ArrayLike) -> tuple[Array, Array]:
    """Contact moment and force of one effect, each (..., 3) in (n0, m0, k) [N m, N].

    motion : records.KINEMATICS by attribute, as `kinematics` gives them.   load : (...) normal force F_z [N]
    """
    load = np.asarray(load, float)
    shape = np.broadcast_shapes(np.shape(motion.theta), load.shape)
    w = SimpleNamespace(**{name: np.zeros(shape) for name in WRENCH})
    if effect.law is not None:
        effect.law(SimpleNamespace(**effect.values), motion, w)
    moment = [getattr(w, f"M_{a}") + load * getattr(w, f"load_{a}") for a in "nmz"]
    c, s, m = np.cos(motion.psi), np.sin(motion.psi), motion.mass
    field_n, field_m = w.field_x * c + w.field_y * s, w.field_y * c - w.field_x * s
    force = [w.X_n + m * field_n, w.X_m + m * field_m, w.X_z + m * w.field_z]
    return np.stack(moment, axis=-1), np.stack(force, axis=-1)


def effect_power(effect: Effect, motion: Any, load: ArrayLike) -> Array:
    """Power of an effect's moment, and of its force at O (...) [W]: never positive for a passive one."""
    moment, force = effect_wrench(effect, motion, load)
    velocity = np.stack([motion.v_n, motion.v_m, motion.v_z], axis=-1)
    return moment_power(motion, moment) + np.sum(force * velocity, axis=-1)
