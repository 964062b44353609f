"""Deviations of the disc, the table and gravity from their declaration."""

import numpy as np

from disctrack.rolling.effects.base import EffectParameter, effect
from disctrack.rolling.records import Record


@effect(
    "tilted table: horizontal part of gravity g (tilt_x, tilt_y)",
    "geometry; k stays the normal of the table",
    EffectParameter("tilt_x", "rad", 1e-3, "direction cosine of gravity along i", lower=-0.5, upper=0.5),
    EffectParameter("tilt_y", "rad", 1e-3, "direction cosine of gravity along j", lower=-0.5, upper=0.5),
    belongs_to=("rig", "surface"),
)
def table_tilt(body: Record, p: Record) -> None:
    """Gravity is not along -k: the table descends along i and j with these slopes."""
    g = -body.g_z
    body.g_x = g * p.tilt_x
    body.g_y = g * p.tilt_y
    body.g_z = -g * np.sqrt(1.0 - p.tilt_x * p.tilt_x - p.tilt_y * p.tilt_y)


@effect(
    "gravity differs by g_error",
    "local value of g",
    EffectParameter("g_error", "m/s^2", 0.01, "gravity minus the declared one", lower=-5.0, upper=5.0),
    belongs_to=("rig",),
)
def gravity(body: Record, p: Record) -> None:
    """Gravity differs from the declared value; indistinguishable from a wrong frame rate."""
    g = np.sqrt(body.g_x * body.g_x + body.g_y * body.g_y + body.g_z * body.g_z)
    factor = 1.0 + p.g_error / g
    body.g_x, body.g_y, body.g_z = factor * body.g_x, factor * body.g_y, factor * body.g_z


@effect(
    "centre of mass at (c_1, c_2, c_3) from the geometric centre, body axes",
    "rigid-body mechanics; c_3 along e3",
    EffectParameter("c_1", "m", 1e-4, "along the first body axis"),
    EffectParameter("c_2", "m", 1e-4, "along the second body axis"),
    EffectParameter("c_3", "m", 1e-4, "along the axis of the disc, towards the upper face"),
)
def centre_of_mass(body: Record, p: Record) -> None:
    """The centre of mass is not the geometric centre; inertia is that about the centre of mass."""
    body.com_1 = body.com_1 + p.c_1
    body.com_2 = body.com_2 + p.c_2
    body.com_3 = body.com_3 + p.c_3


@effect(
    "radius of the contact circle differs by r_error",
    "geometry (chamfer, burr, micrometer error)",
    EffectParameter("r_error", "m", 1e-5, "contact radius minus the declared one", lower=-5e-3, upper=5e-3),
)
def contact_radius(body: Record, p: Record) -> None:
    """The radius of the contact circle differs from the declared one; mass and inertia are unchanged."""
    body.radius = body.radius + p.r_error


@effect(
    "half thickness at the contact differs by h_error",
    "geometry (paper, chamfer, micrometer error)",
    EffectParameter("h_error", "m", 1e-5, "half thickness minus the declared one", lower=-2e-3, upper=5e-3),
)
def contact_height(body: Record, p: Record) -> None:
    """The distance of the contact circle below the centre differs; mass and inertia are unchanged."""
    body.half_thickness = body.half_thickness + p.h_error


@effect(
    "edge rounded with radius rho",
    "geometry: r_OA = -(r - rho) e2 - (h - rho) e3 - rho k",
    EffectParameter("rho", "m", 1e-4, "radius of the edge", lower=0.0, upper=3e-3),
)
def edge_radius(body: Record, p: Record) -> None:
    """The edge is a quarter of a torus; the contact moves along it as the nutation changes."""
    body.edge_radius = body.edge_radius + p.rho


@effect(
    "table of curvature kappa = 1 / radius, z = kappa (x^2 + y^2) / 2 - slope_x x - slope_y y",
    "geometry; the base of the toy is a shallow hollow (Moffatt 2000; Petrie, Hunt and Gray 2002)",
    EffectParameter("kappa", "1/m", 0.1, "curvature, positive in a hollow", lower=-10.0, upper=10.0),
    EffectParameter("slope_x", "rad", 1e-3, "kappa times the x of the lowest point", lower=-0.3, upper=0.3),
    EffectParameter("slope_y", "rad", 1e-3, "kappa times the y of the lowest point", lower=-0.3, upper=0.3),
    belongs_to=("surface",),
)
def table_curved(body: Record, p: Record) -> None:
    """The table is a sphere: a hollow (positive curvature) or a dome, with any slope at the origin."""
    body.curvature = body.curvature + p.kappa
    body.slope_x, body.slope_y = body.slope_x + p.slope_x, body.slope_y + p.slope_y


@effect(
    "rim out of round, p = r + oval_c cos 2 beta + oval_s sin 2 beta + lobes_c cos 3 beta + lobes_s sin 3 beta",
    "support function of a convex curve; a disc that is no circle: Baranyai and Varkonyi 2017",
    EffectParameter("oval_c", "m", 1e-5, "two waves, cosine of the angle in the body", lower=-2e-3, upper=2e-3),
    EffectParameter("oval_s", "m", 1e-5, "two waves, sine", lower=-2e-3, upper=2e-3),
    EffectParameter("lobes_c", "m", 1e-5, "three waves, cosine", lower=-1e-3, upper=1e-3),
    EffectParameter("lobes_s", "m", 1e-5, "three waves, sine", lower=-1e-3, upper=1e-3),
)
def rim(body: Record, p: Record) -> None:
    """The rim is not a circle: its support function has harmonics of order two and three."""
    body.oval_c, body.oval_s = body.oval_c + p.oval_c, body.oval_s + p.oval_s
    body.lobes_c, body.lobes_s = body.lobes_c + p.lobes_c, body.lobes_s + p.lobes_s


@effect(
    "flat of the rim, p = r - depth exp((cos(beta - angle) - 1) / width^2)",
    "support function of a convex curve with a flat worn smooth; Baranyai and Varkonyi 2017",
    EffectParameter("depth", "m", 1e-5, "by which the rim is nearer to the axis there", lower=0.0, upper=5e-4),
    EffectParameter("angle", "rad", 0.0, "of its middle, in the body", lower=-1.0, upper=7.3, is_shape=True),
    EffectParameter("width", "rad", 0.15, "standard deviation of the dip", lower=0.05, upper=0.5, is_shape=True),
    sought=True,
)
def rim_flat(body: Record, p: Record) -> None:
    """The rim has a flat, where the contact is nearer to the axis: the disc descends there once per turn."""
    body.flat_depth = body.flat_depth + p.depth
    body.flat_cos, body.flat_sin = np.cos(p.angle), np.sin(p.angle)
    body.flat_sharpness = 1.0 / (p.width * p.width)


@effect(
    "table that gives way, by c F_z downwards",
    "Hooke's law, inertia of the table neglected (Johnson 1985, Contact Mechanics, ch. 4); to first order in c",
    EffectParameter("c", "m/N", 1e-6, "compliance", lower=0.0, upper=1e-3),
    belongs_to=("surface",),
)
def table_yielding(body: Record, p: Record) -> None:
    """The table, or a mat on it, sinks in proportion to the instantaneous load."""
    body.compliance = body.compliance + p.c


@effect(
    "contact that creeps, v_A = -c F_t / F_z",
    "a film or skin that is sheared (Newton's law); creep of rolling contacts (Johnson 1985, Contact Mechanics, ch. 8)",
    EffectParameter("c", "m/s", 1e-5, "velocity of the contact over F_t / F_z", lower=0.0, upper=0.1),
    belongs_to=("disc", "surface"),
)
def creep(body: Record, p: Record) -> None:
    """The contact moves along the table with a velocity proportional to friction over load."""
    body.creep = body.creep + p.c


@effect(
    "surface that moves under the disc, v_A = v + rate k x r_A",
    "kinematics: rolling on a turntable, on a belt",
    EffectParameter("v_x", "m/s", 1e-3, "velocity of the surface at the origin along i"),
    EffectParameter("v_y", "m/s", 1e-3, "along j"),
    EffectParameter("rate", "rad/s", 0.1, "of its turn about the vertical"),
    belongs_to=("rig", "surface"),
)
def surface_moves(body: Record, p: Record) -> None:
    """The contact moves with the surface of the table, which turns or slides relative to the cameras."""
    body.surface_vx, body.surface_vy = body.surface_vx + p.v_x, body.surface_vy + p.v_y
    body.surface_turn = body.surface_turn + p.rate


@effect(
    "J1 and J2 multiplied by 1 + e",
    "holes, rims, inhomogeneous material",
    EffectParameter("e", "1", 0.01, "relative change of J1 and J2", lower=-0.5, upper=1.0),
)
def inertia_diametral(body: Record, p: Record) -> None:
    """J1 = J2 differ from the homogeneous disc's."""
    body.J_11 = body.J_11 * (1.0 + p.e)
    body.J_22 = body.J_22 * (1.0 + p.e)


@effect(
    "J3 multiplied by 1 + e",
    "holes, rims, inhomogeneous material",
    EffectParameter("e", "1", 0.01, "relative change of J3", lower=-0.5, upper=1.0),
)
def inertia_axial(body: Record, p: Record) -> None:
    """J3 differs from the homogeneous disc's."""
    body.J_33 = body.J_33 * (1.0 + p.e)


@effect(
    "products of inertia J_13, J_23",
    "wedge, dynamic imbalance",
    EffectParameter("J_13", "kg m^2", 1e-8, "moment of deviation between the first body axis and e3"),
    EffectParameter("J_23", "kg m^2", 1e-8, "moment of deviation between the second body axis and e3"),
)
def inertia_product(body: Record, p: Record) -> None:
    """Products of inertia with the axis: dynamic imbalance of a wedge-shaped disc."""
    body.J_13 = body.J_13 + p.J_13
    body.J_23 = body.J_23 + p.J_23


@effect(
    "Coulomb friction, |F_t| <= mu F_z, F_t = -mu F_z v_A / |v_A| in slip",
    "Coulomb's law at the contact",
    EffectParameter("mu", "1", 0.2, "coefficient of friction; infinite = never slips", null=np.inf, lower=1e-3),
    belongs_to=("disc", "surface"),
)
def slip(body: Record, p: Record) -> None:
    """Coulomb friction with a finite coefficient: the disc slips if rolling needs a larger one."""
    body.inverse_friction = 1.0 / p.mu  # acts through the constraint force, not through the wrench of a law
