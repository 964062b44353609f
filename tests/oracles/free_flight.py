"""Closed forms of a body without contact: a parabola, and the regular precession of a symmetric free top."""

import numpy as np
from scipy.spatial.transform import Rotation


def centre(x0, v0, gravity, t):
    """(n, 3) centre of mass."""
    t = np.asarray(t)[:, None]
    return x0 + v0 * t + 0.5 * gravity * t**2


def symmetric_top(R0, omega0_world, J1, J3, t):
    """R(t) (n, 3, 3): the axis turns about the constant angular momentum G at |G|/J1, the body about its axis.

    omega = G/J1 + s e3 with s = (1 - J3/J1) omega3, so R(t) = exp(t [G/J1]) R0 exp(t s [e3 in the body]).
    """
    axis = R0[:, 2]
    omega3 = omega0_world @ axis
    G = J1 * (omega0_world - omega3 * axis) + J3 * omega3 * axis
    spin = (1 - J3 / J1) * omega3
    t = np.asarray(t)[:, None]
    about_G, about_axis = (Rotation.from_rotvec(t * rate).as_matrix() for rate in (G / J1, np.array([0, 0, spin])))
    return about_G @ R0 @ about_axis
