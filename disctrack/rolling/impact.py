"""The start of the experiment: a disc at rest on its edge is hit on its upper face by a ball."""

import numpy as np

from disctrack.disc import Disc
from disctrack.rolling.effects import ModelError
from disctrack.rolling.state import State

_FRICTION_ITERATIONS = 30  # fixed point for the direction of friction; each gains a factor of about (h/r)^2


def struck_disc(
    disc: Disc,
    lateral: float,
    vertical: float,
    impulse: float,
    *,
    friction: float = 0.0,
    psi: float = 0.0,
    phi: float = 0.0,
    x: float = 0.0,
    y: float = 0.0,
) -> State:
    """State just after an impulse on the upper face of the upright disc (Ma et al. 2014, figure 3 and table 1).

    lateral, vertical : the point hit, a along e1 and b upwards from the middle of the face [m].
    impulse : of the ball on the disc [N s], along -e3 (it falls so that the hit face looks up).
    friction : coefficient for the impulse of the table; the table's normal impulse keeps the lower rim from going down.

    Returns a state with the velocity of O, slipping in general. Raises ModelError where the impulse would not tip the
    disc over, the point lies outside the face or the friction is below 0.
    """
    if not friction >= 0:
        raise ModelError(f"a coefficient of friction of {friction:.4g}; it is 0 or above")
    if np.hypot(lateral, vertical) > disc.radius:
        raise ModelError(
            f"the point ({lateral * 1e3:.4g}, {vertical * 1e3:.4g}) mm lies outside the face of radius "
            f"{disc.radius * 1e3:.4g} mm"
        )
    # Nodal axes at theta = 90 deg: e2 is vertical; the contact is the lower edge of the face that will look down.
    arm = np.array([0.0, -disc.radius, -disc.half_thickness])
    hit = np.array([lateral, vertical, disc.half_thickness])
    J = np.array([disc.moment_diametral, disc.moment_diametral, disc.moment_axial])
    ball = np.array([0.0, 0.0, -impulse])
    v0, omega0 = ball / disc.mass, np.cross(hit, ball) / J
    v, omega, normal = v0, omega0, 0.0
    for _ in range(_FRICTION_ITERATIONS):
        slip = (v + np.cross(omega, arm)) * [1.0, 0.0, 1.0]
        push = np.array([0.0, 1.0, 0.0]) - friction * slip / max(float(np.linalg.norm(slip)), 1e-12)
        dv, domega = push / disc.mass, np.cross(arm, push) / J
        # the table's normal impulse N >= 0 is just large enough that the edge does not go down
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
    state = State(x, y, psi, np.pi / 2, phi, w1, w2, w3, v_x, v_y)
    return state if normal > 0 else state.moved(z=disc.radius, v_z=float(v[1]))
