"""A state of motion from which a simulation starts."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calibration.kit.arguments import checked
from calibration.kit.arrays import Array


@checked
@dataclass(frozen=True)
class State:
    """State of the disc: eight numbers in pure rolling, and the velocity and height of O where it is not rolling.

    Without v_x, v_y the disc rolls; with them it slides at the contact (or sticks, if they agree with rolling); with z
    and v_z too it is in the air.

        >>> State(theta=0.1).theta
        0.1
    """

    x: float = 0.0  # geometric centre O in world axes [m]
    y: float = 0.0
    psi: float = 0.0  # precession, nutation, spin [rad]
    theta: float = 0.5
    phi: float = 0.0
    thetadot: float = 0.0  # [rad/s]
    omega2: float = 0.0  # psidot sin(theta)
    omega3: float = 0.0  # psidot cos(theta) + phidot
    v_x: float | None = None  # horizontal velocity of O, world axes [m/s]
    v_y: float | None = None
    z: float | None = None
    v_z: float | None = None

    @property
    def array(self) -> Array:
        """Components that are given: (8,), (10,) or (12,)."""
        full = [self.x, self.y, self.psi, self.theta, self.phi, self.thetadot, self.omega2, self.omega3]
        for a, b in ((self.v_x, self.v_y), (self.z, self.v_z)):
            if a is None or b is None:
                break
            full += [a, b]
        return np.array(full, float)

    @property
    def psidot(self) -> float:
        """Precession rate [rad/s]."""
        return float(self.omega2 / np.sin(self.theta))

    @property
    def phidot(self) -> float:
        """Spin rate [rad/s]."""
        return float(self.omega3 - self.omega2 / np.tan(self.theta))

    def moved(self, **changes: float) -> State:
        """Copy with some components replaced."""
        return replace(self, **changes)
