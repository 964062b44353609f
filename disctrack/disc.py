"""The disc: its size, its inertia, the dots on its upper face, and its regular precession without losses.

Regular precession is row e1 of the equations at constant nutation, psidot = p and omega3 = q (Ma et al. 2014, (2.11),
corrected: I3 s + m r h c without the factor sin theta, I2 = J1 + m h^2 in place of J1):

    (I3 s + m r h c) p q - (I2 s c + m r h s^2) p^2 + m g (r c - h s) = 0
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from calibration.kit.brief import Brief
from calibration.kit.types import Array, Length, Mask, Mass, checked
from disctrack.errors import ModelError

AIR_DENSITY = 1.2  # [kg/m^3] default, at 1013.25 hPa and 20 degC
STANDARD_PRESSURE = 1013.25  # [hPa]


@checked
@dataclass(frozen=True, repr=False)
class Disc(Brief):
    """A homogeneous disc of radius r and thickness 2h with round dots on its upper face.

    Body frame: origin at the centre of mass, third axis e3 out of the upper face.

        >>> Disc(0.0375, 0.003, 0.2, [[0.026, 0, 0.003], [0, 0.026, 0.003], [-0.026, 0, 0.003]], 0.007)
        Disc(diameter 75 mm, thickness 6 mm, mass 200 g, dots 3)
    """

    held_as: ClassVar[str] = "disc"

    radius: Length  # r [m]
    half_thickness: Length  # h [m]
    mass: Mass  # m [kg]
    marker_centres_body: Array  # (n_markers, 3) [m]; third component +h for dots on the upper face
    marker_diameter: Length  # [m]
    # declared standard deviations of radius and thickness 2h [m]; None: not declared
    radius_tolerance: float | None = None
    thickness_tolerance: float | None = None

    def __post_init__(self) -> None:
        shape = np.shape(self.marker_centres_body)
        if len(shape) != 2 or shape[1] != 3:
            raise ModelError(f"marker_centres_body has the shape {shape}: expected (dots, 3), in metres")

    def facts(self) -> dict[str, str]:
        """Short summary (`Brief`)."""
        size = f"{2e3 * self.radius:g} mm, thickness {2e3 * self.half_thickness:g} mm"
        return {"diameter": size, "mass": f"{1e3 * self.mass:g} g", "dots": str(self.n_markers)}

    @property
    def moment_diametral(self) -> float:
        """J1 = J2 = m r^2 / 4 + m h^2 / 3  [kg m^2]  (Ma et al. 2014, below eq. 2.3)."""
        return self.mass * (self.radius**2 / 4 + self.half_thickness**2 / 3)

    @property
    def moment_axial(self) -> float:
        """J3 = m r^2 / 2  [kg m^2]."""
        return self.mass * self.radius**2 / 2

    def resting_height(self, theta: ArrayLike) -> Array:
        """Height of the centre [m] if the rim touches the table, r sin theta + h |cos theta|; theta (...) [rad]."""
        return self.radius * np.sin(theta) + self.half_thickness * np.abs(np.cos(theta))

    def arm_to_contact(self, e2: Array, e3: Array) -> Array:
        """r_OA = -r e2 - h e3 (..., 3) [m] from the centre to the contact, in the axes of e2 and e3 (..., 3)."""
        return -self.radius * e2 - self.half_thickness * e3

    def times_inertia(self, vector: Array, e3: Array) -> Array:
        """J v (..., 3) of vectors (..., 3) in the axes of e3 (..., 3)."""
        along = np.sum(vector * e3, axis=-1)[..., None] * e3
        return self.moment_diametral * vector + (self.moment_axial - self.moment_diametral) * along

    @property
    def n_markers(self) -> int:
        """Number of dots on the upper face."""
        return len(self.marker_centres_body)


def disc_from_mm(
    radius_mm: float,
    thickness_mm: float,
    mass_g: float,
    marker_centres_mm: ArrayLike,
    marker_diameter_mm: float,
    radius_tolerance_mm: float | None = None,
    thickness_tolerance_mm: float | None = None,
) -> Disc:
    """Disc from the millimetres and grams of a recording.toml; centres are (n, 2) on the upper face."""
    centres = np.asarray(marker_centres_mm, float).reshape(-1, 2) * 1e-3
    return Disc(
        radius=radius_mm * 1e-3,
        half_thickness=thickness_mm * 0.5e-3,
        mass=mass_g * 1e-3,
        marker_centres_body=np.insert(centres, 2, thickness_mm * 0.5e-3, axis=1),
        marker_diameter=marker_diameter_mm * 1e-3,
        radius_tolerance=None if radius_tolerance_mm is None else radius_tolerance_mm * 1e-3,
        thickness_tolerance=None if thickness_tolerance_mm is None else thickness_tolerance_mm * 1e-3,
    )


def _dots(disc: Disc) -> Array:
    """Centres of the dots (n,) as complex numbers x + i y [m]."""
    return np.asarray(disc.marker_centres_body[:, :2] @ (1, 1j))


def _onto_itself(disc: Disc, places: Array) -> Mask:
    """Whether all dots of layouts (..., n), x + i y [m], coincide with the disc's to a tenth of their diameter."""
    gaps = np.abs(places[..., None] - _dots(disc))
    return np.asarray(gaps.min(axis=-1).max(axis=-1) < 0.1 * disc.marker_diameter)


def symmetry_order(disc: Disc) -> int:
    """Order of the rotational symmetry of the layout of the dots about e3 (1: no symmetry).

    With an order n > 1 the spin angle phi is known only modulo 2 pi / n.
    """
    orders = range(2, 2 * disc.n_markers + 1)
    return max((n for n in orders if _onto_itself(disc, _dots(disc) * np.exp(2j * np.pi / n))), default=1)


def has_mirror_axis(disc: Disc) -> bool:
    """True if the layout of the dots is mirror-symmetric, so that it does not reveal a mirrored image."""
    z = _dots(disc)
    far = z[np.argmax(np.abs(z))]  # its mirror image is a dot, possibly itself
    mirrored = np.exp(1j * (np.angle(far) + np.angle(z)))[:, None] * np.conj(z)
    return bool(_onto_itself(disc, mirrored).any())


def precession_rate(
    theta: float, disc: Disc, gravity: float = 9.81, omega3: float | None = None
) -> tuple[float, float]:
    """(p, q) = (psidot, omega3) of regular precession at nutation theta [rad]; p > 0 [rad/s].

    omega3 : by default that of a centre at rest
    Of the two solutions at given omega3, the faster one is returned, which includes the centre at rest.
    Raises ModelError if there is no solution.
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
    """Angular frequency [rad/s] of small nutation oscillations about regular precession, without friction."""
    p, q = precession_rate(theta, disc, gravity, omega3)
    r, h, m, J1 = disc.radius, disc.half_thickness, disc.mass, disc.moment_diametral
    I1, I2, I3 = J1 + m * (r**2 + h**2), J1 + m * h**2, disc.moment_axial + m * r**2
    d_omega2, d_omega3 = followers(theta, p, q, disc)
    step = 1e-30j  # of theta, along the oscillation: the imaginary part carries the exact derivative
    s, c = np.sin(theta + step), np.cos(theta + step)
    a, b = p * np.sin(theta) + step * d_omega2, q + step * d_omega3
    # row e1 with a = omega2 = psidot s, b = omega3:  I1 theta'' =
    moment = I2 * a**2 * c / s - (I3 + m * r * h * c / s) * a * b + m * r * h * a**2 - m * gravity * (r * c - h * s)
    square = -float((moment / step).real) / I1
    if square <= 0:
        unstable = f"regular precession at {np.degrees(theta):.4g} deg is unstable"
        raise ModelError(f"{unstable}: there is no nutation oscillation")
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


_HEXAGON = np.radians(60.0 * np.arange(6))

# Radius, thickness and mass as in Ma et al. 2014, section 3a. The layout of the dots is not published; this one has
# no rotational symmetry (the sixth dot is at half the radius), so that the spin angle is determined.
MA_2014 = disc_from_mm(
    radius_mm=37.5,
    thickness_mm=6.0,
    mass_g=209.69,
    marker_centres_mm=np.column_stack([np.cos(_HEXAGON), np.sin(_HEXAGON)])
    * np.where(np.arange(6) == 5, 13.0, 26.0)[:, None],
    marker_diameter_mm=7.0,
)
