"""Named quantities shared by the equations of motion and the effects.

They are NumPy records, so that compiled code and plain Python access them in the same way: `s.psidot`, `w.M_m`.

State vector y (SI, radians); the regimes integrate its first 8, 10 or 12 entries:
    rolling   x, y, psi, theta, phi, omega1 = thetadot, omega2 = psidot sin(theta), omega3 = psidot cos(theta) + phidot
    slipping  the same, and v_x, v_y: the horizontal velocity of the geometric centre O in world axes
    flying    the same, and z, v_z of O
    x, y are the position of O. omega is in the nodal frame (frames.py); omega2 stays small and smooth when psidot grows
    without bound. In contact z follows from theta, and in rolling the velocity of O from omega: they cannot drift.
"""

from enum import IntEnum
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from disctrack.frames import COORDINATES

Record: TypeAlias = "np.recarray[Any, Any]"  # the numbers of one kind below, read and written by name
Records: TypeAlias = NDArray[np.void]  # an array of them


class Regime(IntEnum):
    """State of the contact."""

    ROLLING = 0
    SLIPPING = 1
    FLYING = 2


ROLLING_COMPONENTS = ("x", "y", "psi", "theta", "phi", "thetadot", "omega2", "omega3")
STATE_COMPONENTS = (*ROLLING_COMPONENTS, "v_x", "v_y", "z", "v_z")

# Input of the laws of the effects. Vectors are in the contact frame (n0, m0, k), n0 = e1, m0 = k x n0.
KINEMATICS = (
    "time",
    *COORDINATES,  # O in world axes [m]; precession, nutation, spin [rad]
    "sin_theta",
    "cos_theta",
    "thetadot",  # [rad/s]
    "psidot",
    "phidot",
    "omega2",  # psidot sin(theta)
    "omega3",  # psidot cos(theta) + phidot
    "omega_z",  # psidot + phidot cos(theta)
    *(f"v_{a}" for a in "nmz"),  # velocity of O [m/s]
    *(f"slip_{a}" for a in "nm"),  # velocity of the disc's material point at the contact [m/s]; zero in pure rolling
    "radius",  # of the contact circle [m]
    "half_thickness",
    "mass",
    "gravity",  # magnitude [m/s^2]
    "air_density",  # [kg/m^3]
    *(f"normal_{a}" for a in "nmz"),  # of the table at the contact
)

# Output of the laws: contact moment M + F_z * load, external force X at O; (n0, m0, k).
LAW_COMPONENTS = (
    *(f"M_{a}" for a in "nmz"),  # moments that do not depend on the load [N m]
    *(f"load_{a}" for a in "nmz"),  # moments per unit of normal force: lever arms [m]
    *(f"X_{a}" for a in "nmz"),  # force on the centre O [N]
)
WRENCH = (
    *LAW_COMPONENTS,
    *(f"table_{a}" for a in "xyz"),  # displacement of the table in axes of the cameras [m]; q is relative to the table
    *(f"table_v{a}" for a in "xyz"),  # its velocity [m/s]
    *(f"table_a{a}" for a in "xyz"),  # and acceleration [m/s^2]
    *(f"field_{a}" for a in "xyz"),  # uniform field besides gravity, world axes [m/s^2]; acts at the centre of mass
)

# Solved from the equations of motion.
SOLUTION = (
    *(f"F_{a}" for a in "nmz"),  # contact force on the disc [N]
    "N",  # its component along the normal of the table at the contact: F_z on a flat table
    "F_t",  # magnitude of its tangential component, which friction has to supply
    *(f"a_{a}" for a in "nmz"),  # acceleration of O relative to the table [m/s^2]
    *(f"alpha_{i}" for i in "123"),  # angular acceleration along e1, e2, e3 [rad/s^2]
)

ANGLES = ("sin_psi", "cos_psi", "sin_phi", "cos_phi")  # for the equations only: laws have to use psi, which is detected

INSTANT = KINEMATICS + WRENCH + SOLUTION + ANGLES  # all quantities of the equations of motion at one instant

# Constants of one body on one table. Inertia about the centre of mass in body axes.
BODY = (
    "mass",
    "radius",  # r of the contact circle ...
    "half_thickness",  # ... and its distance from O along -e3
    "edge_radius",  # of the rounded edge; 0 = sharp
    *(f"oval_{a}" for a in "cs"),  # rim's support function r + oval_c cos 2 beta + oval_s sin 2 beta + ...
    *(f"lobes_{a}" for a in "cs"),  # ... + lobes_c cos 3 beta + lobes_s sin 3 beta, by the angle beta in the body [m]
    "flat_depth",  # of a flat of the rim: support function minus depth exp(sharpness (cos(beta - angle) - 1)) [m]
    "flat_cos",  # cosine and sine of its angle in the body
    "flat_sin",
    "flat_sharpness",  # 1 / width^2 [1/rad^2]
    "compliance",  # of the table [m/N]
    "creep",  # of the contact: velocity over F_t / F_z [m/s]
    *(f"surface_v{a}" for a in "xy"),  # velocity of the table's surface at the origin [m/s] ...
    "surface_turn",  # ... and its angular velocity about the vertical [rad/s]
    "curvature",  # of the table, a sphere through the origin: positive in a hollow [1/m]
    *(f"slope_{a}" for a in "xy"),  # of the table at the origin, descending towards i, and j
    *(f"com_{i}" for i in "123"),  # centre of mass from O in body axes [m]
    *(f"J_{i}{i}" for i in "123"),
    *(f"J_{ij}" for ij in ("12", "13", "23")),
    *(f"g_{a}" for a in "xyz"),  # gravity in world axes [m/s^2]
    "air_density",  # [kg/m^3]
    "inverse_friction",  # 1/mu of Coulomb's law; 0 = never slips
    "theta_end",  # the motion ends here [rad]
    "uneven",  # 1 if any of UNEVEN is not 0, otherwise 0: a round rim on a level, flat table
)
UNEVEN = ("curvature", "slope_x", "slope_y", "oval_c", "oval_s", "lobes_c", "lobes_s", "flat_depth")


def record_dtype(names: tuple[str, ...], scalar: type) -> np.dtype:
    """Aligned record of equal scalars (float or complex)."""
    return np.dtype([(name, scalar) for name in names], align=True)
