"""The disc, the table and gravity differ from what was declared."""

from typing import Any

import numpy as np

from disctrack.rolling.effects.base import Effect, EffectParameter


class TableTilt(Effect):
    """Gravity is not along k: the table descends towards (i, j) with these slopes."""

    name = "table_tilt"
    title = "tilted table: horizontal part of gravity g (tilt_x, tilt_y)"
    source = "geometry; k stays the normal of the table"
    belongs_to = ("rig", "surface")
    parameters = (
        EffectParameter("tilt_x", "rad", 1e-3, "direction cosine of gravity along i", lower=-0.5, upper=0.5),
        EffectParameter("tilt_y", "rad", 1e-3, "direction cosine of gravity along j", lower=-0.5, upper=0.5),
    )
    passive = False

    @staticmethod
    def adjust(body: Any, p: Any) -> None:
        g = -body.g_z
        body.g_x = g * p.tilt_x
        body.g_y = g * p.tilt_y
        body.g_z = -g * np.sqrt(1.0 - p.tilt_x * p.tilt_x - p.tilt_y * p.tilt_y)


class Gravity(Effect):
    """Gravity differs from the declared value; indistinguishable from a wrong frame rate."""

    name = "gravity"
    title = "gravity differs by g_error"
    source = "local value of g"
    belongs_to = ("rig",)
    parameters = (EffectParameter("g_error", "m/s^2", 0.01, "gravity minus the declared one", lower=-5.0, upper=5.0),)
    passive = False

    @staticmethod
    def adjust(body: Any, p: Any) -> None:
        g = np.sqrt(body.g_x * body.g_x + body.g_y * body.g_y + body.g_z * body.g_z)
        factor = 1.0 + p.g_error / g
        body.g_x, body.g_y, body.g_z = factor * body.g_x, factor * body.g_y, factor * body.g_z


class CentreOfMass(Effect):
    """The centre of mass is not the geometric centre; inertia is that about the centre of mass."""

    name = "centre_of_mass"
    title = "centre of mass at (c_1, c_2, c_3) from the geometric centre, body axes"
    source = "rigid-body mechanics; c_3 along e3"
    belongs_to = ("disc",)
    parameters = (
        EffectParameter("c_1", "m", 1e-4, "along the first body axis"),
        EffectParameter("c_2", "m", 1e-4, "along the second body axis"),
        EffectParameter("c_3", "m", 1e-4, "along the axis of the disc, towards the upper face"),
    )
    passive = False

    @staticmethod
    def adjust(body: Any, p: Any) -> None:
        body.com_1 = body.com_1 + p.c_1
        body.com_2 = body.com_2 + p.c_2
        body.com_3 = body.com_3 + p.c_3


class ContactRadius(Effect):
    """The circle of contact has another radius; mass and inertia stay."""

    name = "contact_radius"
    title = "radius of the contact circle differs by r_error"
    source = "geometry (chamfer, burr, micrometer error)"
    belongs_to = ("disc",)
    parameters = (
        EffectParameter("r_error", "m", 1e-5, "contact radius minus the declared one", lower=-5e-3, upper=5e-3),
    )
    passive = False

    @staticmethod
    def adjust(body: Any, p: Any) -> None:
        body.radius = body.radius + p.r_error


class ContactHeight(Effect):
    """The contact circle lies at another distance below the centre; mass and inertia stay."""

    name = "contact_height"
    title = "half thickness at the contact differs by h_error"
    source = "geometry (paper, chamfer, micrometer error)"
    belongs_to = ("disc",)
    parameters = (
        EffectParameter("h_error", "m", 1e-5, "half thickness minus the declared one", lower=-2e-3, upper=5e-3),
    )
    passive = False

    @staticmethod
    def adjust(body: Any, p: Any) -> None:
        body.half_thickness = body.half_thickness + p.h_error


class RoundedEdge(Effect):
    """The edge is a quarter of a torus: the contact wanders over it with the nutation."""

    name = "edge_radius"
    title = "edge rounded with radius rho"
    source = "geometry: r_OA = -(r - rho) e2 - (h - rho) e3 - rho k"
    belongs_to = ("disc",)
    parameters = (EffectParameter("rho", "m", 1e-4, "radius of the edge", lower=0.0, upper=3e-3),)
    passive = False

    @staticmethod
    def adjust(body: Any, p: Any) -> None:
        body.edge_radius = body.edge_radius + p.rho


class CurvedTable(Effect):
    """The table is a sphere: a hollow (positive curvature) or a dome, with any slope at the origin."""

    name = "table_curved"
    title = "table of curvature kappa = 1 / radius, z = kappa (x^2 + y^2) / 2 - slope_x x - slope_y y"
    source = "geometry; the base of the toy is a shallow hollow (Moffatt 2000; Petrie, Hunt and Gray 2002)"
    belongs_to = ("surface",)
    parameters = (
        EffectParameter("kappa", "1/m", 0.1, "curvature, positive in a hollow", lower=-10.0, upper=10.0),
        EffectParameter("slope_x", "rad", 1e-3, "kappa times the x of the lowest point", lower=-0.3, upper=0.3),
        EffectParameter("slope_y", "rad", 1e-3, "kappa times the y of the lowest point", lower=-0.3, upper=0.3),
    )
    passive = False

    @staticmethod
    def adjust(body: Any, p: Any) -> None:
        body.curvature = body.curvature + p.kappa
        body.slope_x, body.slope_y = body.slope_x + p.slope_x, body.slope_y + p.slope_y


class RimShape(Effect):
    """The rim is no circle: its distance from the axis, tangent by tangent, has two and three waves around."""

    name = "rim"
    title = "rim out of round, p = r + oval_c cos 2 beta + oval_s sin 2 beta + lobes_c cos 3 beta + lobes_s sin 3 beta"
    source = "support function of a convex curve; a disc that is no circle: Baranyai and Varkonyi 2017"
    belongs_to = ("disc",)
    parameters = (
        EffectParameter("oval_c", "m", 1e-5, "two waves, cosine of the angle in the body", lower=-2e-3, upper=2e-3),
        EffectParameter("oval_s", "m", 1e-5, "two waves, sine", lower=-2e-3, upper=2e-3),
        EffectParameter("lobes_c", "m", 1e-5, "three waves, cosine", lower=-1e-3, upper=1e-3),
        EffectParameter("lobes_s", "m", 1e-5, "three waves, sine", lower=-1e-3, upper=1e-3),
    )
    passive = False

    @staticmethod
    def adjust(body: Any, p: Any) -> None:
        body.oval_c, body.oval_s = body.oval_c + p.oval_c, body.oval_s + p.oval_s
        body.lobes_c, body.lobes_s = body.lobes_c + p.lobes_c, body.lobes_s + p.lobes_s


class DiametralInertia(Effect):
    """J1 = J2 differ from the homogeneous disc's."""

    name = "inertia_diametral"
    title = "J1 and J2 multiplied by 1 + e"
    source = "holes, rims, inhomogeneous material"
    belongs_to = ("disc",)
    parameters = (EffectParameter("e", "1", 0.01, "relative change of J1 and J2", lower=-0.5, upper=1.0),)
    passive = False

    @staticmethod
    def adjust(body: Any, p: Any) -> None:
        body.J_11 = body.J_11 * (1.0 + p.e)
        body.J_22 = body.J_22 * (1.0 + p.e)


class AxialInertia(Effect):
    """J3 differs from the homogeneous disc's."""

    name = "inertia_axial"
    title = "J3 multiplied by 1 + e"
    source = "holes, rims, inhomogeneous material"
    belongs_to = ("disc",)
    parameters = (EffectParameter("e", "1", 0.01, "relative change of J3", lower=-0.5, upper=1.0),)
    passive = False

    @staticmethod
    def adjust(body: Any, p: Any) -> None:
        body.J_33 = body.J_33 * (1.0 + p.e)


class InertiaProduct(Effect):
    """Products of inertia with the axis: dynamic imbalance of a wedge-shaped disc."""

    name = "inertia_product"
    title = "products of inertia J_13, J_23"
    source = "wedge, dynamic imbalance"
    belongs_to = ("disc",)
    parameters = (
        EffectParameter("J_13", "kg m^2", 1e-8, "moment of deviation between the first body axis and e3"),
        EffectParameter("J_23", "kg m^2", 1e-8, "moment of deviation between the second body axis and e3"),
    )
    passive = False

    @staticmethod
    def adjust(body: Any, p: Any) -> None:
        body.J_13 = body.J_13 + p.J_13
        body.J_23 = body.J_23 + p.J_23


class Slip(Effect):
    """Coulomb friction of finite coefficient: the disc slips where rolling would need more."""

    name = "slip"
    title = "Coulomb friction, |F_t| <= mu F_z, F_t = -mu F_z v_A / |v_A| in slip"
    source = "Coulomb's law at the contact"
    parameters = (
        EffectParameter("mu", "1", 0.2, "coefficient of friction; infinite = never slips", null=np.inf, lower=1e-3),
    )
    passive = False  # acts through the constraint force, not through the wrench of a law

    @staticmethod
    def adjust(body: Any, p: Any) -> None:
        body.inverse_friction = 1.0 / p.mu
