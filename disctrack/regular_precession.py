"""Regular precession of a rolling disc, and small nutations about it: closed forms, no model of losses.

Row e1 of the equations at constant nutation, psidot = p and omega3 = q (Ma et al. 2014, (2.11), corrected:
I3 s + m r h c without the factor sin theta, I2 = J1 + m h^2 in place of J1):

    (I3 s + m r h c) p q - (I2 s c + m r h s^2) p^2 + m g (r c - h s) = 0
"""

from __future__ import annotations

import numpy as np

from disctrack.disc import Disc
from disctrack.errors import ModelError


def precession_rate(
    theta: float, disc: Disc, gravity: float = 9.81, omega3: float | None = None
) -> tuple[float, float]:
    """(p, q) = (psidot, omega3) of regular precession at nutation theta [rad]; p > 0 [rad/s].

    Of the two solutions at given omega3 the faster is returned: the one that goes over into the centre at rest.
    """
    s, c, r, h, m = np.sin(theta), np.cos(theta), disc.radius, disc.half_thickness, disc.mass
    I2, I3 = disc.moment_diametral + m * h**2, disc.moment_axial + m * r**2
    cross, square = I3 * s + m * r * h * c, I2 * s * c + m * r * h * s**2
    weight = m * gravity * (r * c - h * s)
    if omega3 is None:
        rest = square - cross * h * s / r
        if not (0 < theta < np.pi / 2 and weight > 0 and rest > 0):
            raise ModelError(
                f"no regular precession with the centre at rest at a nutation of {np.degrees(theta):.4g} deg: "
                f"expected between 0 and {np.degrees(np.arctan2(r, h)):.4g} deg"
            )
        p = float(np.sqrt(weight / rest))
        return p, float(h * p * s / r)
    discriminant = (cross * omega3) ** 2 + 4 * square * weight
    if not (0 < theta < np.pi / 2 and discriminant >= 0):
        raise ModelError(
            f"no regular precession at a nutation of {np.degrees(theta):.4g} deg with omega3 = {omega3:.4g} rad/s: "
            "choose a larger spin or a smaller nutation"
        )
    return float((cross * omega3 + np.sqrt(discriminant)) / (2 * square)), float(omega3)


def nutation_frequency(theta: float, disc: Disc, gravity: float = 9.81, omega3: float | None = None) -> float:
    """Circular frequency [rad/s] of small nutation oscillations about regular precession, no friction."""
    p, q = precession_rate(theta, disc, gravity, omega3)
    r, h, m, J1 = disc.radius, disc.half_thickness, disc.mass, disc.moment_diametral
    I1, I2, I3 = J1 + m * (r**2 + h**2), J1 + m * h**2, disc.moment_axial + m * r**2
    s, c = np.sin(theta), np.cos(theta)
    d_omega2, d_omega3 = followers(theta, p, q, disc)
    # row e1 with a = omega2 = psidot s, b = omega3:
    # I1 theta'' = I2 a^2 c/s - (I3 + m r h c/s) a b + m r h a^2 - m g L1
    a, b = p * s, q
    by_theta = -I2 * a**2 / s**2 + m * r * h * a * b / s**2 + m * gravity * (r * s + h * c)
    by_a = 2 * I2 * a * c / s - (I3 + m * r * h * c / s) * b + 2 * m * r * h * a
    by_b = -(I3 + m * r * h * c / s) * a
    square = -(by_theta + by_a * d_omega2 + by_b * d_omega3) / I1
    if square <= 0:
        raise ModelError(
            f"regular precession at {np.degrees(theta):.4g} deg is unstable: there is no nutation oscillation"
        )
    return float(np.sqrt(square))


def followers(theta: float, p: float, q: float, disc: Disc) -> tuple[float, float]:
    """Derivatives of omega2 and omega3 by theta in a small oscillation: rows e2 and e3 are proportional to thetadot."""
    r, h, m, J1, J3 = disc.radius, disc.half_thickness, disc.mass, disc.moment_diametral, disc.moment_axial
    s, c = np.sin(theta), np.cos(theta)
    L2 = r * s + h * c
    matrix = np.array([[J1 + m * h**2, -m * h * r], [-m * h * r, J3 + m * r**2]])
    right = np.array([J3 * q - J1 * p * c - m * h * p * L2, m * r * p * L2])
    d_omega2, d_omega3 = np.linalg.solve(matrix, right)
    return float(d_omega2), float(d_omega3)
