"""Moments about the vertical that resist the pivoting of the contact."""

import numpy as np

from disctrack.rolling.effects.base import EffectParameter, effect, sign
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
