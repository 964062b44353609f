"""Recordings with effects that no catalogue names.

The motion is that of world vectors and quaternions (newton_euler), so that no line of the equations is the product's.
Beside it stands the true moment about the contact, of all laws together, of which a rolling disc takes notice: a force
X at its centre and a moment M act as M - r_OA x X.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicHermiteSpline

from disctrack.synthetic.description import Scene
from tests.oracles import newton_euler
from tests.oracles.measured_disc import K_M, measured
from tests.oracles.newton_euler import ZERO, K

DISC = Scene().declared_disc
RATE = 500.0
SAMPLES = 6000.0  # of the motion [1/s]; the cubic between them errs by less than a hundredth of the noise
STATION = 0.002  # [s] of motion before the first frame
PLACE = np.array([0.059, -0.003])  # that the contact comes by: its circle is about (32, 20) mm with a radius of 36 mm


@dataclass(frozen=True)
class Unknown:
    """A law outside the catalogue, and the motion in which it acts."""

    law: Callable | None
    theta_deg: float = 11.0
    omega3: float = 0.6
    duration: float = 0.7
    rate_of_memory: Callable | None = (
        None  # (disc, instant, memory) -> rate of one more number, 0 at first, which the law reads
    )
    wears: float = 0.0  # [m/s] by which the radius shrinks
    friction: Callable | None = None  # slip speed -> coefficient: the disc slips, and there is no true moment
    shift: Callable | None = None  # times -> (n, 6) by which the coordinates are seen beside the motion


def smooth(x):
    return 0.5 * (1.0 + np.tanh(x))


def level(angle):
    return np.array([np.cos(angle), np.sin(angle), 0.0])


def contact(now):
    return now.O + now.arm


def force(of):
    """A force at the centre."""
    return lambda disc, now: (ZERO, ZERO, of(disc, now))


def moment(of):
    return lambda disc, now: (of(disc, now), ZERO, ZERO)


def rolling(now):
    """Direction of the horizontal angular velocity."""
    horizontal = now.omega - now.omega[2] * K
    return horizontal / np.linalg.norm(horizontal)


def uneven(gradient):
    """A table that is not flat: the weight times the slope under the contact, as a moment by the motion of the contact.

    The place of touch moves by v_O + d(r_OA)/dt, linear in omega; what that climbs, the load pays for.
    """

    def law(disc, now):
        slope = gradient(contact(now))
        if np.abs(slope).max() < 1e-12:
            return ZERO, ZERO, ZERO
        up = K - now.cosine * now.d
        total = np.zeros(3)
        for axis in np.eye(3):
            d_rate = np.cross(axis, now.d)
            up_rate = -d_rate[2] * now.d - now.d[2] * d_rate
            e2_rate = up_rate / now.sine - up * (up @ up_rate) / now.sine**3
            moved = -np.cross(axis, now.arm) - disc.r * e2_rate - disc.h * d_rate
            total -= (slope @ moved[:2]) * axis
        return ZERO, total, ZERO

    return law


def hill(x, y, height, width):
    def gradient(A):
        d = A[:2] - (x, y)
        return -2 * d / width**2 * height * np.exp(-(d @ d) / width**2)

    return gradient


def groove(angle, offset, depth, width):
    normal = level(angle)[:2]

    def gradient(A):
        s = A[:2] @ normal - offset
        return 2 * s / width**2 * depth * np.exp(-((s / width) ** 2)) * normal

    return gradient


def seam(angle, offset, height, width):
    """Two halves of a table, one higher than the other."""
    normal = level(angle)[:2]

    def gradient(A):
        s = (A[:2] @ normal - offset) / width
        return height / (width * np.sqrt(np.pi)) * np.exp(-s * s) * normal

    return gradient


def stribeck(speed):
    return 0.08 + (0.30 - 0.08) * np.exp(-((speed / 0.02) ** 2))


UNKNOWN: dict[str, Unknown] = {
    "stribeck_slip": Unknown(None, 14.0, 1.0, 0.5, friction=lambda v: stribeck(v) * v / np.sqrt(v * v + 2e-4**2)),
    "viscous_contact": Unknown(None, 14.0, 1.0, 0.5, friction=lambda v: 30.0 * v),
    "drag_one_way": Unknown(force(lambda d, n: -0.012 * (n.v @ level(0.5)) * level(0.5))),
    "quadratic_spring": Unknown(force(lambda d, n: -40.0 * np.linalg.norm(n.O[:2]) * np.array([*n.O[:2], 0.0]))),
    "eddy_half": Unknown(force(lambda d, n: -0.02 * smooth((n.O[0] - 0.032) / 1e-4) * n.v * (1, 1, 0))),
    "bump": Unknown(uneven(hill(*PLACE, 30e-6, 8e-3))),
    "groove": Unknown(uneven(groove(0.6, 0.05, 20e-6, 3e-3))),
    "table_sinks": Unknown(None, shift=lambda t: np.outer(-40e-6 * (t / 0.7) ** 2, [0, 0, 1, 0, 0, 0])),
    "wear": Unknown(None, wears=20e-6),
    "seam": Unknown(uneven(seam(0.9, 0.045, 6e-6, 4e-3))),
    "twisted_thread": Unknown(
        moment(lambda d, n: -3e-6 * d.memory * K),
        rate_of_memory=lambda d, n, z: n.omega[2],
        omega3=1.5,
    ),
    "loose_ball": Unknown(  # in a tube of the face, in oil
        lambda d, n: (np.cross(d.memory * n.R[:, 0], -0.0981 * K), ZERO, ZERO),
        rate_of_memory=lambda d, n, z: (-3e-3 * n.R[2, 0] - z) / 0.02,
    ),
    "pad": Unknown(  # a table that leans, as far as it gives way, to where the contact is
        force(lambda d, n: d.m * 9.81 * 2e-3 * np.tanh((contact(n)[0] - 0.03) / 0.02) * np.array([1.0, 0.0, 0.0]))
    ),
}


class _Body(newton_euler.Disc):
    """A disc with a number that its laws remember, a radius that wears, or friction by the speed of slip."""

    memory = 0.0

    def __init__(self, unknown: Unknown) -> None:
        laws = [newton_euler.precession_friction(K_M)]
        if unknown.law is not None:
            laws.append(unknown.law)
        self._unknown = unknown
        super().__init__(DISC.radius, DISC.half_thickness, DISC.mass, laws=tuple(laws))

    def moved(self, t, state):
        """At an instant and a state."""
        self.t, self.memory = t, state[15] if len(state) > 15 else 0.0
        self.r, self.wears = DISC.radius - self._unknown.wears * t, self._unknown.wears
        if self._unknown.friction is not None:
            now = newton_euler.Instant(self, state[:15])
            self.mu = float(self._unknown.friction(np.linalg.norm(now.v_contact)))
        return self


def motion(unknown: Unknown):
    """(times, q (n, 6), speeds (n, 6), true moment (n, 3) along n0, m0, k; NaN where there is none)."""
    body = _Body(unknown)
    regime = "rolling" if unknown.friction is None else "slipping"
    theta = np.radians(unknown.theta_deg)
    omega2 = np.sqrt(4 * 9.81 * np.sin(theta) / body.r)
    state = newton_euler.state_from_angles(body, 0.032, 0.02, 0.7, theta, -0.4, 0.0, omega2, unknown.omega3)
    state[9] -= unknown.wears * np.sin(theta)  # the centre sinks with the radius
    if regime == "slipping":
        state[7:9] += (5e-3, -3e-3)
    if unknown.rate_of_memory is not None:
        state = np.append(state, 0.0)

    def rate(t, s):
        ydot = newton_euler.rate(body.moved(t, s), s[:15], regime)
        if unknown.rate_of_memory is None:
            return ydot
        return np.append(ydot, unknown.rate_of_memory(body, newton_euler.Instant(body, s[:15]), s[15]))

    def low(t, s):
        return newton_euler.Instant(body, s[:15]).sine - np.sin(np.radians(1.2))

    low.terminal = True
    times = np.arange(0.0, unknown.duration, 1 / SAMPLES)
    method = "DOP853" if regime == "rolling" else "LSODA"
    found = solve_ivp(rate, (0, times[-1]), state, method, times, rtol=1e-10, atol=1e-11, max_step=1e-3, events=low)
    assert found.success, found.message
    states = found.y.T
    q = newton_euler.coordinates(body, found.y[:15])
    speed, wrench = np.zeros_like(q), np.full((len(q), 3), np.nan)
    for i, (t, s) in enumerate(zip(found.t, states, strict=True)):
        now = newton_euler.Instant(body.moved(t, s), s[:15])
        speed[i] = *now.v, now.psidot, now.thetadot, now.phidot
    if regime == "rolling" and unknown.shift is None and not unknown.wears:
        for i in range(0, len(q), 6):
            body.moved(found.t[i], states[i])
            wrench[i] = moment_of(body, states[i][:15])
    if unknown.shift is not None:
        q, later = q + unknown.shift(found.t), unknown.shift(found.t + 1e-5)
        speed += (later - unknown.shift(found.t)) / 1e-5
    return found.t, q, speed, wrench


def moment_of(body, state):
    """All laws' moment about the contact along n0, m0, k [N m]."""
    _, _, F, now = newton_euler.accelerations(body, state, "rolling")
    total = np.zeros(3)
    for law in body.laws:
        fixed, load, X = law(body, now)
        total += fixed + load * F[2] - np.cross(now.arm, X)
    return np.array([total @ now.n0, total @ now.m0, total @ K])


@dataclass(frozen=True)
class Recording:
    """A measured trajectory with the truth beside it."""

    trajectory: object
    time: np.ndarray  # (k,) [s] in the trajectory's clock
    moment: np.ndarray  # (k, 3)


def recording(unknown: Unknown | str, seed: int = 1) -> Recording:
    """Dots of the motion with this law, or that of this name, until 1.2 deg."""
    times, q, speed, wrench = motion(UNKNOWN[unknown] if isinstance(unknown, str) else unknown)
    n = int((times[-1] - 0.01) * RATE)
    trajectory = measured(seed=seed, n=n, declared_rate=RATE, motion=CubicHermiteSpline(times, q, speed))
    known = np.isfinite(wrench).all(axis=1)
    return Recording(trajectory, times[known] - STATION, wrench[known])
