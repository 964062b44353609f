"""Initial states of a simulation: arbitrary, regular precession, a disc hit by a ball."""

from dataclasses import astuple, dataclass, replace

import numpy as np

from calibration.kit.types import Array, checked
from disctrack.disc import Disc, followers, nutation_frequency, precession_rate
from disctrack.errors import ModelError


@checked
@dataclass(frozen=True)
class State:
    """State of the disc: eight numbers in pure rolling; in slip and flight also the velocity and height of O.

    Without v_x, v_y the disc rolls. With them it slips at the contact (or sticks, if they agree with rolling). With z
    and v_z in addition it is in the air.

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
        """Components that are not None: (8,), (10,) or (12,)."""
        return np.array([value for value in astuple(self) if value is not None], float)

    @property
    def psidot(self) -> float:
        """Precession rate [rad/s]."""
        return float(self.omega2 / np.sin(self.theta))

    def moved(self, **changes: float) -> "State":
        """Copy with some components replaced."""
        return replace(self, **changes)


@checked
def steady_precession(
    theta: float,
    disc: Disc,
    gravity: float = 9.81,
    *,
    omega3: float | None = None,
    nutation_amplitude: float = 0.0,
    nutation_phase: float = 0.0,
) -> State:
    """Rolling state of regular precession at nutation `theta` [rad], psidot > 0, at the origin; see `moved`.

    omega3 : spin q [rad/s]; by default that of a centre at rest, q = h p sin(theta) / r.
    nutation_amplitude, nutation_phase : to first order theta(t) = theta + amplitude cos(w t + phase), w from
        `nutation_frequency`; omega2 and omega3 change with it as in the linearised motion.
    Raises ModelError if no regular precession exists.

        >>> float(steady_precession(0.1, read_recording("clip").disc).theta)
        0.1
    """
    p, q = precession_rate(theta, disc, gravity, omega3)
    offset = nutation_amplitude * np.cos(nutation_phase)
    thetadot = -nutation_amplitude * nutation_frequency(theta, disc, gravity, omega3) * np.sin(nutation_phase)
    d_omega2, d_omega3 = followers(theta, p, q, disc)
    omega2, omega3 = p * np.sin(theta) + d_omega2 * offset, q + d_omega3 * offset
    return State(theta=theta + offset, thetadot=thetadot, omega2=omega2, omega3=omega3)


def struck_disc(
    disc: Disc, lateral: float, vertical: float, impulse: float, *, friction: float = 0.0, psi: float = 0.0
) -> State:
    """State just after an impulse on the upper face of the upright disc (Ma et al. 2014, figure 3 and table 1).

    lateral, vertical : the point of impact, a along e1 and b upwards from the centre of the face [m].
    impulse : of the ball on the disc [N s], along -e3 (the disc falls with the hit face up).
    friction : coefficient for the impulse of the table, whose normal impulse prevents the lower rim from sinking.

    Returns a state with the velocity of O, slipping in general. Raises ModelError if the impulse does not tip the disc
    over, the point lies outside the face or the friction is negative.
    """
    if not friction >= 0:
        raise ModelError(f"a coefficient of friction of {friction:.4g}; it is 0 or above")
    if np.hypot(lateral, vertical) > disc.radius:
        raise ModelError(
            f"the point ({lateral * 1e3:.4g}, {vertical * 1e3:.4g}) mm lies outside the face of radius "
            f"{disc.radius * 1e3:.4g} mm"
        )
    # Nodal axes at theta = 90 deg: e2 is vertical; the contact is on the edge of the face that will be the lower one.
    arm = np.array([0.0, -disc.radius, -disc.half_thickness])
    hit = np.array([lateral, vertical, disc.half_thickness])
    J = np.array([disc.moment_diametral, disc.moment_diametral, disc.moment_axial])
    ball = np.array([0.0, 0.0, -impulse])
    v0, omega0 = ball / disc.mass, np.cross(hit, ball) / J
    v, omega, normal = v0, omega0, 0.0
    for _ in range(30):  # fixed-point iteration for the direction of friction; the error falls by about (h/r)^2 each
        slip = (v + np.cross(omega, arm)) * [1.0, 0.0, 1.0]
        impulse_per_normal = np.array([0.0, 1.0, 0.0]) - friction * slip / max(float(np.linalg.norm(slip)), 1e-12)
        dv, domega = impulse_per_normal / disc.mass, np.cross(arm, impulse_per_normal) / J
        # the table's normal impulse N >= 0 just prevents the edge from moving down
        down = (v0 + np.cross(omega0, arm))[1]
        normal = max(0.0, float(-down / (dv + np.cross(domega, arm))[1]))
        v, omega = v0 + normal * dv, omega0 + normal * domega
    if omega[0] >= 0:
        raise ModelError(
            f"an impulse of {impulse:.4g} N s at b = {vertical * 1e3:.4g} mm does not tip the disc over: hit it higher"
        )
    sp, cp = np.sin(psi), np.cos(psi)
    # at theta = 90 deg: e1 = (cos psi, sin psi, 0), e3 = (sin psi, -cos psi, 0)
    v_x, v_y = float(v[0] * cp + v[2] * sp), float(v[0] * sp - v[2] * cp)
    w1, w2, w3 = (float(w) for w in omega)
    state = State(psi=psi, theta=np.pi / 2, thetadot=w1, omega2=w2, omega3=w3, v_x=v_x, v_y=v_y)
    return state if normal > 0 else state.moved(z=disc.radius, v_z=float(v[1]))
