"""The disc as an object: its size, its inertia and the dots on its upper face."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from calibration.arrays import Array

AIR_DENSITY = 1.2  # [kg/m^3] where no other is declared: at 1013.25 hPa and 20 degC
STANDARD_PRESSURE = 1013.25  # [hPa]


@dataclass(frozen=True)
class Disc:
    """A homogeneous disc of radius r and thickness 2h with round dots on its upper face.

    Body frame: origin at the centre of mass, third axis e3 out of the upper face.
    """

    radius: float  # r [m]
    half_thickness: float  # h [m]
    mass: float  # m [kg]
    marker_centres_body: Array  # (n_markers, 3) [m]; third component +h for dots on the upper face
    marker_diameter: float  # [m]
    # Standard deviations of radius and thickness 2h as declared [m]; None: not declared
    radius_tolerance: float | None = None
    thickness_tolerance: float | None = None

    @property
    def moment_diametral(self) -> float:
        """J1 = J2 = m r^2 / 4 + m h^2 / 3  [kg m^2]  (Ma et al. 2014, below eq. 2.3)."""
        return self.mass * (self.radius**2 / 4 + self.half_thickness**2 / 3)

    @property
    def moment_axial(self) -> float:
        """J3 = m r^2 / 2  [kg m^2]."""
        return self.mass * self.radius**2 / 2

    def resting_height(self, theta: ArrayLike) -> Array:
        """Height of the centre [m] when the rim touches the table, r sin theta + h |cos theta|; theta (...) [rad]."""
        return self.radius * np.sin(theta) + self.half_thickness * np.abs(np.cos(theta))

    def arm_to_contact(self, e2: Array, e3: Array) -> Array:
        """r_OA = -r e2 - h e3 (..., 3) [m] from the centre to the contact, in the axes of e2 and e3 (..., 3)."""
        return -self.radius * e2 - self.half_thickness * e3

    @property
    def n_markers(self) -> int:
        """Number of dots on the upper face."""
        return len(self.marker_centres_body)


def disc_from_mm(
    radius_mm: float,
    thickness_mm: float,
    mass_g: float,
    marker_centres_mm: list[list[float]] | Array,
    marker_diameter_mm: float,
    radius_tolerance_mm: float | None = None,
    thickness_tolerance_mm: float | None = None,
) -> Disc:
    """Disc from the millimetres and grams of a recording.toml; centres are (n, 2) on the upper face."""
    centres = np.asarray(marker_centres_mm, float).reshape(-1, 2) * 1e-3
    height = np.full(len(centres), thickness_mm * 0.5e-3)
    return Disc(
        radius=radius_mm * 1e-3,
        half_thickness=thickness_mm * 0.5e-3,
        mass=mass_g * 1e-3,
        marker_centres_body=np.column_stack([centres, height]),
        marker_diameter=marker_diameter_mm * 1e-3,
        radius_tolerance=None if radius_tolerance_mm is None else radius_tolerance_mm * 1e-3,
        thickness_tolerance=None if thickness_tolerance_mm is None else thickness_tolerance_mm * 1e-3,
    )


def symmetry_order(disc: Disc, tolerance: float = 0.1) -> int:
    """Number of turns about e3 that map the layout of the dots onto itself (1: none but the full turn).

    With an order n > 1 the spin angle phi is known only modulo 2 pi / n. tolerance: part of a dot's diameter.
    """
    centres = disc.marker_centres_body[:, :2]
    reach = tolerance * disc.marker_diameter
    order = 1
    for n in range(2, 2 * disc.n_markers + 1):
        angle = 2 * np.pi / n
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        distance = np.linalg.norm((centres @ turn.T)[:, None] - centres[None], axis=-1)
        if np.all(distance.min(axis=1) < reach):
            order = n
    return order


def has_mirror_axis(disc: Disc, tolerance: float = 0.1) -> bool:
    """True where the layout of the dots looks the same in a mirror, so that the dots do not tell left from right.

    tolerance : part of a dot's diameter
    """
    z = disc.marker_centres_body[:, 0] + 1j * disc.marker_centres_body[:, 1]
    far = z[np.argmax(np.abs(z))]  # goes to a dot as far out, or stays
    twice = np.angle(far) + np.angle(z[np.abs(np.abs(z) - np.abs(far)) < tolerance * disc.marker_diameter])
    mirrored = np.exp(1j * twice)[:, None] * np.conj(z)
    gap = np.abs(mirrored[:, :, None] - z).min(axis=2).max(axis=1)
    return bool(np.any(gap < tolerance * disc.marker_diameter))


_HEXAGON = np.radians(60.0 * np.arange(6))

# Radius, thickness and mass as in Ma et al. 2014, section 3a. The layout of the dots is not published; this one has
# no rotational symmetry (the sixth dot sits at half radius), so that the spin angle is determined.
MA_2014 = disc_from_mm(
    radius_mm=37.5,
    thickness_mm=6.0,
    mass_g=209.69,
    marker_centres_mm=np.column_stack([np.cos(_HEXAGON), np.sin(_HEXAGON)])
    * np.where(np.arange(6) == 5, 13.0, 26.0)[:, None],
    marker_diameter_mm=7.0,
)
