"""Moments that resist the rolling of the contact: the paper's laws and their rivals."""

from typing import Any

import numpy as np

from disctrack.rolling.effects.base import Effect, EffectParameter, magnitude, sign

SLOWEST_ROLLING = 1e-3  # [rad/s] rolling rate below which the classical law is smoothed; the disc's is above 1


class PrecessionFriction(Effect):
    """M_m = -k_m F_z psidot |psidot|: rolling friction growing with the square of the precession rate."""

    name = "km"
    title = "rolling friction on the precession, M_m = -k_m F_z psidot |psidot|"
    source = "Ma et al. 2014, (5.4); 0.381e-7 on steel, 0.28e-7 on glass"
    parameters = (EffectParameter("k_m", "m s^2", 0.381e-7, "lever arm per squared precession rate", lower=0.0),)
    counter_rotating = True  # reads psidot, works on phidot

    @staticmethod
    def law(p: Any, s: Any, w: Any) -> None:
        w.load_m -= p.k_m * s.psidot * magnitude(s.psidot)


class AxisFriction(Effect):
    """The paper's moment turned into the direction of e2, perpendicular to the axis."""

    name = "km_e2"
    title = "rolling friction along e2, M = -k F_z psidot |psidot| e2"
    source = "variant of Ma et al. 2014, (5.4): direction of the dissipative moment"
    parameters = (EffectParameter("k", "m s^2", 0.381e-7, "lever arm per squared precession rate", lower=0.0),)

    @staticmethod
    def law(p: Any, s: Any, w: Any) -> None:
        moment = p.k * s.psidot * magnitude(s.psidot)
        w.load_m -= moment * s.cos_theta  # e2 = cos(theta) m0 + sin(theta) k
        w.load_z -= moment * s.sin_theta


class NutationFriction(Effect):
    """M_n = -k_n F_z thetadot |thetadot|."""

    name = "kn"
    title = "rolling friction on the nutation, M_n = -k_n F_z thetadot |thetadot|"
    source = "Ma et al. 2014, (5.3)"
    parameters = (EffectParameter("k_n", "m s^2", 0.381e-7, "lever arm per squared nutation rate", lower=0.0),)

    @staticmethod
    def law(p: Any, s: Any, w: Any) -> None:
        w.load_n -= p.k_n * s.thetadot * magnitude(s.thetadot)


class PowerFriction(Effect):
    """M_m = -k F_z (|psidot| / 100 rad/s)^p sgn(psidot): the paper's law with a free exponent."""

    name = "rolling_power"
    title = "rolling friction with a free exponent, M_m = -k F_z |psidot / (100 rad/s)|^p sgn psidot"
    source = "generalises Ma et al. 2014, (5.4): p = 2, k = 1e4 k_m"
    parameters = (
        EffectParameter("k", "m", 1e-4, "lever arm at 100 rad/s", lower=0.0),
        EffectParameter("p", "1", 1.5, "exponent of the precession rate", lower=0.0, upper=4.0, is_shape=True),
    )
    counter_rotating = True

    @staticmethod
    def law(p: Any, s: Any, w: Any) -> None:
        rate = magnitude(s.psidot) / 100.0
        w.load_m -= p.k * np.exp(p.p * np.log(rate)) * (s.psidot / magnitude(s.psidot))


class DryContourFriction(Effect):
    """Generalised force -mu_c F_z r sgn(phidot) on phi: the contour slides dry past the contact."""

    name = "contour_dry"
    title = "dry contour friction, M_m = mu_c F_z r sgn(phidot) / sin theta"
    source = "Leine 2009, Arch. Appl. Mech. 79:1063; power as in Easwar et al. 2002"
    parameters = (EffectParameter("mu_c", "1", 1.06e-3, "coefficient of contour friction", lower=0.0),)

    @staticmethod
    def law(p: Any, s: Any, w: Any) -> None:
        w.load_m += p.mu_c * s.radius * sign(s.phidot, 1e-3) / s.sin_theta


class ViscousContourFriction(Effect):
    """Generalised force -c r^2 phidot on phi, independent of the load."""

    name = "contour_viscous"
    title = "viscous contour friction, M_m = c r^2 phidot / sin theta"
    source = "Leine 2009, Arch. Appl. Mech. 79:1063; power as in McDonald and McDonald 2001"
    parameters = (EffectParameter("c", "N s/m", 1e-5, "viscous coefficient along the contour", lower=0.0),)

    @staticmethod
    def law(p: Any, s: Any, w: Any) -> None:
        w.M_m += p.c * s.radius * s.radius * s.phidot / s.sin_theta


class ClassicalRollingFriction(Effect):
    """Moment delta F_z against the horizontal angular velocity, independent of its size."""

    name = "rolling_classical"
    title = "classical rolling friction, M = -delta F_z (thetadot n0 - phidot sin theta m0) / |...|"
    source = "Le Saux, Leine and Glocker 2005; Kessler and O'Reilly 2002"
    parameters = (EffectParameter("delta", "m", 1e-5, "lever arm: half width of the contact", lower=0.0),)

    @staticmethod
    def law(p: Any, s: Any, w: Any) -> None:
        roll_n, roll_m = s.thetadot, -s.phidot * s.sin_theta
        rate = np.sqrt(roll_n * roll_n + roll_m * roll_m + SLOWEST_ROLLING * SLOWEST_ROLLING)
        w.load_n -= p.delta * roll_n / rate
        w.load_m -= p.delta * roll_m / rate


class ViscousRollingFriction(Effect):
    """Moment against the horizontal angular velocity, proportional to it."""

    name = "rolling_viscous"
    title = "viscous rolling friction, M = -c F_z (thetadot n0 - phidot sin theta m0)"
    source = "Borisov, Kilin and Karavaev 2017, Phys.-Usp. 60:931"
    parameters = (EffectParameter("c", "m s", 1e-6, "lever arm per rolling rate", lower=0.0),)

    @staticmethod
    def law(p: Any, s: Any, w: Any) -> None:
        w.load_n -= p.c * s.thetadot
        w.load_m += p.c * s.phidot * s.sin_theta


class AdhesiveRollingFriction(Effect):
    """Moment against the horizontal angular velocity that no load changes: what it costs to part the surfaces again."""

    name = "rolling_adhesive"
    title = "rolling friction by adhesion, M = -a (thetadot n0 - phidot sin theta m0) / |...|, whatever the load"
    source = "Kendall 1975, Wear 33:351: rolling friction and adhesion between smooth solids"
    parameters = (EffectParameter("a", "N m", 2e-5, "moment", lower=0.0),)

    @staticmethod
    def law(p: Any, s: Any, w: Any) -> None:
        roll_n, roll_m = s.thetadot, -s.phidot * s.sin_theta
        rate = np.sqrt(roll_n * roll_n + roll_m * roll_m + SLOWEST_ROLLING * SLOWEST_ROLLING)
        w.M_n -= p.a * roll_n / rate
        w.M_m -= p.a * roll_m / rate
