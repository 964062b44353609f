"""Moments that resist pivoting about the vertical, and rolling of the contact: the paper's laws and alternatives."""

import numpy as np

from disctrack.rolling.effects.base import EffectParameter, effect, magnitude, rolling_rates, sign
from disctrack.rolling.records import Record


@effect(
    "pivoting friction, M_z = -k_z F_z sgn omega_z",
    "Ma et al. 2014, (5.2); Coulomb-Contensou: k_z = 2/3 mu a of a contact of radius a",
    EffectParameter("k_z", "m", 1e-5, "lever arm", lower=0.0),
    EffectParameter(
        "omega_s", "rad/s", 1e-2, "pivoting rate below which it is not full", lower=1e-4, upper=10.0, is_shape=True
    ),
)
def kz(p: Record, s: Record, w: Record) -> None:
    """M_z = -k_z F_z sgn(omega_z), the sign smoothed: at small rates the contact creeps and does not slide fully.

    The smoothing matters when the pivoting dies out: omega_s = 0.01 instead of 0.001 rad/s changes k_z by 0.2 %.
    """
    w.load_z -= p.k_z * sign(s.omega_z, p.omega_s)


@effect(
    "viscous pivoting friction, M_z = -k F_z omega_z",
    "Coulomb-Contensou friction linearised in the pivoting rate, Leine and Glocker 2003",
    EffectParameter("k", "m s", 1e-5, "lever arm per pivoting rate", lower=0.0),
)
def pivoting_viscous(p: Record, s: Record, w: Record) -> None:
    """M_z = -k F_z omega_z: pivoting superimposed on slip or creep."""
    w.load_z -= p.k * s.omega_z


@effect(
    "Coulomb-Contensou pivoting friction, M_z = -k F_z omega_z / sqrt(omega_z^2 + omega_s^2 + (v_A/a)^2)",
    "Leine and Glocker 2003, Eur. J. Mech. A 22:193 (smooth approximation of the Contensou coupling)",
    EffectParameter("k", "m", 1e-5, "lever arm of full pivoting", lower=0.0),
    EffectParameter("omega_s", "rad/s", 1.0, "pivoting rate below which creep dominates", lower=1e-2, is_shape=True),
    EffectParameter("a", "m", 75e-6, "radius of the contact", lower=1e-7, is_shape=True),
)
def pivoting_contensou(p: Record, s: Record, w: Record) -> None:
    """M_z = -k F_z omega_z / sqrt(omega_z^2 + omega_s^2 + (v_A/a)^2): at most k F_z, reduced by creep and slip."""
    slip2 = (s.slip_n * s.slip_n + s.slip_m * s.slip_m) / (p.a * p.a)
    w.load_z -= p.k * s.omega_z / np.sqrt(s.omega_z * s.omega_z + p.omega_s * p.omega_s + slip2)


@effect(
    "rolling friction on the precession, M_m = -k_m F_z psidot |psidot|",
    "Ma et al. 2014, (5.4); 0.381e-7 on steel, 0.28e-7 on glass",
    EffectParameter("k_m", "m s^2", 0.381e-7, "lever arm per squared precession rate", lower=0.0),
)
def km(p: Record, s: Record, w: Record) -> None:
    """M_m = -k_m F_z psidot |psidot|: rolling friction proportional to the square of the precession rate."""
    w.load_m -= p.k_m * s.psidot * magnitude(s.psidot)


@effect(
    "rolling friction along e2, M = -k F_z psidot |psidot| e2",
    "variant of Ma et al. 2014, (5.4): direction of the dissipative moment",
    EffectParameter("k", "m s^2", 0.381e-7, "lever arm per squared precession rate", lower=0.0),
)
def km_e2(p: Record, s: Record, w: Record) -> None:
    """The paper's moment, but along e2, perpendicular to the axis."""
    moment = p.k * s.psidot * magnitude(s.psidot)
    w.load_m -= moment * s.cos_theta  # e2 = cos(theta) m0 + sin(theta) k
    w.load_z -= moment * s.sin_theta


@effect(
    "rolling friction on the nutation, M_n = -k_n F_z thetadot |thetadot|",
    "Ma et al. 2014, (5.3)",
    EffectParameter("k_n", "m s^2", 0.381e-7, "lever arm per squared nutation rate", lower=0.0),
)
def kn(p: Record, s: Record, w: Record) -> None:
    """M_n = -k_n F_z thetadot |thetadot|."""
    w.load_n -= p.k_n * s.thetadot * magnitude(s.thetadot)


@effect(
    "rolling friction with a free exponent, M_m = -k F_z |psidot / (100 rad/s)|^p sgn psidot",
    "generalises Ma et al. 2014, (5.4): p = 2, k = 1e4 k_m",
    EffectParameter("k", "m", 1e-4, "lever arm at 100 rad/s", lower=0.0),
    EffectParameter("p", "1", 1.5, "exponent of the precession rate", lower=0.0, upper=4.0, is_shape=True),
)
def rolling_power(p: Record, s: Record, w: Record) -> None:
    """M_m = -k F_z (|psidot| / 100 rad/s)^p sgn(psidot): the paper's law with a free exponent."""
    rate = magnitude(s.psidot) / 100.0
    w.load_m -= p.k * np.exp(p.p * np.log(rate)) * (s.psidot / magnitude(s.psidot))


@effect(
    "dry contour friction, M_m = mu_c F_z r sgn(phidot) / sin theta",
    "Leine 2009, Arch. Appl. Mech. 79:1063; power as in Easwar et al. 2002",
    EffectParameter("mu_c", "1", 1.06e-3, "coefficient of contour friction", lower=0.0),
)
def contour_dry(p: Record, s: Record, w: Record) -> None:
    """Generalised force -mu_c F_z r sgn(phidot) on phi: dry friction along the contour."""
    w.load_m += p.mu_c * s.radius * sign(s.phidot, 1e-3) / s.sin_theta


@effect(
    "viscous contour friction, M_m = c r^2 phidot / sin theta",
    "Leine 2009, Arch. Appl. Mech. 79:1063; power as in McDonald and McDonald 2001",
    EffectParameter("c", "N s/m", 1e-5, "viscous coefficient along the contour", lower=0.0),
)
def contour_viscous(p: Record, s: Record, w: Record) -> None:
    """Generalised force -c r^2 phidot on phi, independent of the load."""
    w.M_m += p.c * s.radius * s.radius * s.phidot / s.sin_theta


@effect(
    "classical rolling friction, M = -delta F_z (thetadot n0 - phidot sin theta m0) / |...|",
    "Le Saux, Leine and Glocker 2005; Kessler and O'Reilly 2002",
    EffectParameter("delta", "m", 1e-5, "lever arm: half width of the contact", lower=0.0),
)
def rolling_classical(p: Record, s: Record, w: Record) -> None:
    """Moment delta F_z opposite to the horizontal angular velocity, independent of its magnitude."""
    n, m, rate = rolling_rates(s)
    w.load_n -= p.delta * n / rate
    w.load_m -= p.delta * m / rate


@effect(
    "viscous rolling friction, M = -c F_z (thetadot n0 - phidot sin theta m0)",
    "Borisov, Kilin and Karavaev 2017, Phys.-Usp. 60:931",
    EffectParameter("c", "m s", 1e-6, "lever arm per rolling rate", lower=0.0),
)
def rolling_viscous(p: Record, s: Record, w: Record) -> None:
    """Moment opposite to the horizontal angular velocity, and proportional to it."""
    w.load_n -= p.c * s.thetadot
    w.load_m += p.c * s.phidot * s.sin_theta


@effect(
    "rolling friction by adhesion, M = -a (thetadot n0 - phidot sin theta m0) / |...|, whatever the load",
    "Kendall 1975, Wear 33:351: rolling friction and adhesion between smooth solids",
    EffectParameter("a", "N m", 2e-5, "moment", lower=0.0),
)
def rolling_adhesive(p: Record, s: Record, w: Record) -> None:
    """Moment opposite to the horizontal angular velocity, whatever the load: the surfaces have to be separated."""
    n, m, rate = rolling_rates(s)
    w.M_n -= p.a * n / rate
    w.M_m -= p.a * m / rate
