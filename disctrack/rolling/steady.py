"""States of regular precession, with a nutation oscillation on top if wanted."""

import numpy as np

from calibration.kit.arguments import checked
from disctrack.disc import Disc, followers, nutation_frequency, precession_rate
from disctrack.rolling.state import State


@checked
def steady_precession(
    theta: float,
    disc: Disc,
    gravity: float = 9.81,
    *,
    omega3: float | None = None,
    nutation_amplitude: float = 0.0,
    nutation_phase: float = 0.0,
    psi: float = 0.0,
    phi: float = 0.0,
    x: float = 0.0,
    y: float = 0.0,
) -> State:
    """Rolling state of regular precession at nutation `theta` [rad], psidot > 0.

    omega3 : spin q [rad/s]; without it the centre stays at rest, q = h p sin(theta) / r.
    nutation_amplitude, nutation_phase : to first order theta(t) = theta + amplitude cos(w t + phase), where w is
        `nutation_frequency`; omega2 and omega3 are changed along with it, as the linear motion requires.
    Raises ModelError where no regular precession exists.

        >>> float(steady_precession(0.1, read_recording("clip").disc).theta)
        0.1
    """
    p, q = precession_rate(theta, disc, gravity, omega3)
    offset = nutation_amplitude * np.cos(nutation_phase)
    thetadot = -nutation_amplitude * nutation_frequency(theta, disc, gravity, omega3) * np.sin(nutation_phase)
    d_omega2, d_omega3 = followers(theta, p, q, disc)
    return State(
        x=x,
        y=y,
        psi=psi,
        theta=theta + offset,
        phi=phi,
        thetadot=thetadot,
        omega2=p * np.sin(theta) + d_omega2 * offset,
        omega3=q + d_omega3 * offset,
    )
