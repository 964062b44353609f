"""The quantities that the equations of motion and the effects share, by name.

They travel as NumPy records, so that compiled code and plain Python read them alike: `s.psidot`, `w.M_m`.

State vector y (SI, radians), of which each regime integrates the first 8, 10 or 12 entries:
    rolling   x, y, psi, theta, phi, omega1 = thetadot, omega2 = psidot sin(theta), omega3 = psidot cos(theta) + phidot
    slipping  the same, and v_x, v_y: the horizontal velocity of the geometric centre O in world axes
    flying    the same, and z, v_z of O
    x, y belong to O. omega is in the nodal frame (frames.py); omega2 stays small and smooth where psidot grows without
    bound. In contact z follows from theta, and in rolling the velocity of O from omega, so they cannot drift.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Record: TypeAlias = "np.recarray[Any, Any]"  # the numbers of one kind below, read and written by name
Records: TypeAlias = NDArray[np.void]  # many of them


class Regime(IntEnum):
    """State of the contact."""

    ROLLING = 0
    SLIPPING = 1
    FLYING = 2


ROLLING_COMPONENTS = ("x", "y", "psi", "theta", "phi", "thetadot", "omega2", "omega3")
STATE_COMPONENTS = (*ROLLING_COMPONENTS, "v_x", "v_y", "z", "v_z")

# Read by the laws of the effects. Vectors are in the contact frame (n0, m0, k), n0 = e1, m0 = k x n0.
KINEMATICS = (
    "time",
    "x",  # O in world axes [m]
    "y",
    "z",
    "psi",  # precession, nutation, spin [rad]
    "theta",
    "phi",
    "sin_theta",
    "cos_theta",
    "thetadot",  # [rad/s]
    "psidot",
    "phidot",
    "omega2",  # psidot sin(theta)
    "omega3",  # psidot cos(theta) + phidot
    "omega_z",  # psidot + phidot cos(theta)
    "v_n",  # velocity of O [m/s]
    "v_m",
    "v_z",
    "slip_n",  # velocity of the disc's material point at the contact [m/s]; zero in pure rolling
    "slip_m",
    "radius",  # of the contact circle [m]
    "half_thickness",
    "mass",
    "gravity",  # magnitude [m/s^2]
    "air_density",  # [kg/m^3]
    "normal_n",  # of the table at the contact
    "normal_m",
    "normal_z",
)

# Written by the laws: contact moment M + F_z * load, external force X at O; (n0, m0, k).
LAW_COMPONENTS = (
    "M_n",  # moments that do not depend on the load [N m]
    "M_m",
    "M_z",
    "load_n",  # moments per unit of normal force: lever arms [m]
    "load_m",
    "load_z",
    "X_n",  # force on the centre O [N]
    "X_m",
    "X_z",
)
WRENCH = (
    *LAW_COMPONENTS,
    *(f"table_{a}" for a in "xyz"),  # where the table is, in the axes of cameras at rest [m]; q is relative to it
    *(f"table_v{a}" for a in "xyz"),  # its velocity [m/s]
    *(f"table_a{a}" for a in "xyz"),  # and acceleration [m/s^2]
    *(f"field_{a}" for a in "xyz"),  # uniform field beside gravity, world axes [m/s^2]: it pulls at the centre of mass
)

# Solved from the equations of motion.
ANSWERS = (
    "F_n",  # contact force on the disc [N]
    "F_m",
    "F_z",
    "N",  # its part along the normal of the table at the contact: F_z on a flat one
    "F_t",  # and the size of the rest, which friction has to supply
    "a_n",  # acceleration of O relative to the table [m/s^2]
    "a_m",
    "a_z",
    "alpha_1",  # angular acceleration along e1, e2, e3 [rad/s^2]
    "alpha_2",
    "alpha_3",
)

ANGLES = ("sin_psi", "cos_psi", "sin_phi", "cos_phi")  # read by the equations alone: laws that turn with psi say so

INSTANT = KINEMATICS + WRENCH + ANSWERS + ANGLES  # all that the equations of motion know at one instant: one record

# Constants of one body on one table. Inertia about the centre of mass in body axes.
BODY = (
    "mass",
    "radius",  # r: the contact runs on the circle of this radius ...
    "half_thickness",  # ... this far below O along -e3
    "edge_radius",  # of the rounded edge; 0 = sharp
    "oval_c",  # rim's support function r + oval_c cos 2 beta + oval_s sin 2 beta + lobes_c cos 3 beta + ..., by the
    "oval_s",  # angle beta in the body [m]
    "lobes_c",
    "lobes_s",
    "flat_depth",  # of a flat of the rim: support function less depth exp(sharpness (cos(beta - angle) - 1)) [m]
    "flat_cos",  # of its angle in the body
    "flat_sin",
    "flat_sharpness",  # 1 / width^2 [1/rad^2]
    "compliance",  # of the table: it sinks by so much per load [m/N]
    "creep",  # of the contact: velocity over F_t / F_z [m/s]
    "surface_vx",  # velocity of the table's surface at the origin [m/s] ...
    "surface_vy",
    "surface_turn",  # ... and its rate of turn about the vertical [rad/s]
    "curvature",  # of the table, a sphere through the origin: positive in a hollow [1/m]
    "slope_x",  # of the table at the origin, descending towards i, and j
    "slope_y",
    "com_1",  # centre of mass from O in body axes [m]
    "com_2",
    "com_3",
    "J_11",
    "J_22",
    "J_33",
    "J_12",
    "J_13",
    "J_23",
    "g_x",  # gravity in world axes [m/s^2]
    "g_y",
    "g_z",
    "air_density",  # [kg/m^3]
    "inverse_friction",  # 1/mu of Coulomb's law; 0 = never slips
    "theta_end",  # the motion ends here [rad]
    "uneven",  # 1 unless a round rim rolls on a level, flat table: all of these are 0 then
)
UNEVEN = ("curvature", "slope_x", "slope_y", "oval_c", "oval_s", "lobes_c", "lobes_s", "flat_depth")


def record_dtype(names: tuple[str, ...], scalar: type) -> np.dtype:
    """Aligned record of equal scalars (float or complex)."""
    return np.dtype([(name, scalar) for name in names], align=True)
