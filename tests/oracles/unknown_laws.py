"""Recordings with effects that no catalogue names, and what the diagnosis makes of them.

    python -m tests.oracles.unknown_table                        # all of them, one line each
    python -m tests.oracles.unknown_table bump groove --seeds 1 2

The motion is that of world vectors and quaternions (newton_euler), so that no line of the equations is the product's.
Beside the answer stands the true moment about the contact, of all laws together, against that of the fitted model: the
numbers of which a rolling disc takes notice, for a force X at its centre and a moment M act as M - r_OA x X.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from disctrack.synthetic.description import Scene
from tests.oracles import newton_euler
from tests.oracles.measured_disc import K_M, measured
from tests.oracles.newton_euler import ZERO, K, rolling

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
    rate_of_memory: Callable | None = None  # (disc, instant, memory) -> rate of one more number, which the law reads
    remembered: Callable = lambda now: 0.0  # (instant) -> that number at the start; nothing, if not given
    wears: float = 0.0  # [m/s] by which the radius shrinks
    com: Callable | None = None  # instant -> centre of mass in the body
    friction: Callable | None = None  # slip speed -> coefficient: the disc slips, and there is no true moment
    shift: Callable | None = None  # times -> (n, 6) by which the coordinates are seen beside the motion


def smooth(x):
    return 0.5 * (1.0 + np.tanh(x))


def level(angle):
    return np.array([np.cos(angle), np.sin(angle), 0.0])


def contact(now):
    return now.O + now.arm


def at_the_place(now, width):
    """1 where the contact is at PLACE, and little farther from it than the width."""
    return np.exp(-np.sum((contact(now)[:2] - PLACE) ** 2) / width**2)


def force(of):
    """A force at the centre."""
    return lambda disc, now: (ZERO, ZERO, of(disc, now))


def by_load(of):
    """A moment in proportion to the load [m]."""
    return lambda disc, now: (ZERO, of(disc, now), ZERO)


def moment(of):
    return lambda disc, now: (of(disc, now), ZERO, ZERO)


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


def across(angle, offset, slope):
    """A table that differs along one direction alone, by its slope there."""
    normal = level(angle)[:2]
    return lambda A: slope(A[:2] @ normal - offset) * normal


def groove(angle, offset, depth, width):
    return across(angle, offset, lambda s: 2 * s / width**2 * depth * np.exp(-((s / width) ** 2)))


def magnets(*places):
    def of(disc, now):
        total = np.zeros(3)
        for x, y, strength, reach in places:
            d = now.O - (x, y, now.O[2])
            total -= strength * d / (1 + d @ d / reach**2) ** 2
        return total

    return force(of)


def kicks(every, impulse, angle, width=1.5e-3):
    def of(disc, now):
        since = (disc.t + 0.5 * every) % every - 0.5 * every
        return impulse / (width * np.sqrt(2 * np.pi)) * np.exp(-0.5 * (since / width) ** 2) * level(angle)

    return force(of)


def sticker(mass, arm, size, frequency):
    """A mass on the face, `arm` from the centre, that flaps along the axis."""

    def law(disc, now):
        push = mass * size * (2 * np.pi * frequency) ** 2 * np.cos(2 * np.pi * frequency * disc.t) * now.d
        return np.cross(arm * now.R[:, 0], push), ZERO, push

    return law


def over_iron(strength):
    """A magnet along the axis above an iron table, with its image: U = -C (1 + cos^2 theta) / z^3."""

    def law(disc, now):
        z = now.O[2]
        torque = -2 * strength * now.cosine * now.sine / z**3 * now.n0
        return torque, ZERO, -3 * strength * (1 + now.cosine**2) / z**4 * K

    return law


def seam(angle, offset, height, width):
    """Two halves of a table, one higher than the other."""
    return across(angle, offset, lambda s: height / (width * np.sqrt(np.pi)) * np.exp(-((s / width) ** 2)))


def nail(strength, place):
    """A magnet in the face, 25 mm from its centre, pulled towards a nail below the table: U = -C / d^3."""

    def law(disc, now):
        lever = 0.025 * now.R[:, 0]
        d = now.O + lever - np.array(place)
        pull = -3 * strength * d / np.linalg.norm(d) ** 5
        return np.cross(lever, pull), ZERO, pull

    return law


def both(*laws):
    """Two laws at once."""

    def law(disc, now):
        parts = [one(disc, now) for one in laws]
        return tuple(sum(part[i] for part in parts) for i in range(3))

    return law


def dipole(strength, place):
    """A magnet along the axis in the field of an upright one below the table; its force by differences of energy."""

    def field(r):
        away = r / np.linalg.norm(r)
        return strength * (3 * away * away[2] - K) / np.linalg.norm(r) ** 3

    def law(disc, now):
        r, step = now.O - np.array(place), 1e-6
        by_place = [field(r + step * axis) - field(r - step * axis) for axis in np.eye(3)]
        return np.cross(now.d, field(r)), ZERO, np.array(by_place) @ now.d / (2 * step)

    return law


def jet(size, speed, width, middle, angle):
    """Air blown along a direction in a beam, by the square of the speed past it and the area that stands in its way."""
    towards, aside = level(angle), level(angle + 0.5 * np.pi)

    def of(disc, now):
        off = (now.O @ aside - middle) / width
        past = speed * np.exp(-off * off) - now.v @ towards
        return size * (abs(now.d @ towards) + 0.1) * past * abs(past) * towards

    return force(of)


def azimuth(now):
    return np.arctan2(now.n0[1], now.n0[0])


def stribeck(static, dynamic, speed):
    return lambda w: dynamic + (static - dynamic) * np.exp(-((w / speed) ** 2))


KZ = stribeck(2e-4, 5e-5, 0.8)
CONTOUR = stribeck(2.5e-4, 5e-5, 25.0)
SLIDING = stribeck(0.30, 0.08, 0.02)

UNKNOWN: dict[str, Unknown] = {
    "stribeck_pivoting": Unknown(by_load(lambda d, n: -KZ(n.omega[2]) * np.tanh(n.omega[2] / 0.05) * K), omega3=1.5),
    "stribeck_contour": Unknown(by_load(lambda d, n: -CONTOUR(n.psidot) * np.sign(n.psidot) * n.m0)),
    "stribeck_slip": Unknown(None, 14.0, 1.0, 0.5, friction=lambda v: SLIDING(v) * v / np.sqrt(v * v + 2e-4**2)),
    "low_friction": Unknown(None, 14.0, 1.0, 0.5, friction=lambda v: 0.02 * v / np.sqrt(v * v + 2e-4**2)),
    "viscous_contact": Unknown(None, 14.0, 1.0, 0.5, friction=lambda v: 30.0 * v),
    "sticky_patch": Unknown(moment(lambda d, n: -6e-4 * at_the_place(n, 0.012) * rolling(n))),
    "dying_force": Unknown(force(lambda d, n: 4e-3 * np.exp(-d.t / 0.15) * level(0.8))),
    "growing_force": Unknown(force(lambda d, n: d.t * np.array([1.2e-3, -3.8e-3, 0.0]))),
    "drag_one_way": Unknown(force(lambda d, n: -0.012 * (n.v @ level(0.5)) * level(0.5))),
    "two_magnets": Unknown(magnets((0.06, 0.02, 0.6, 0.03), (-0.01, 0.05, 0.4, 0.02))),
    "rough_sector": Unknown(
        by_load(lambda d, n: -2.5e-4 * smooth((np.cos(azimuth(n) - 1.0) - 0.3) / 0.1) * rolling(n))
    ),
    "friction_steps": Unknown(by_load(lambda d, n: -1.5e-4 * smooth((d.t - 0.35) / 0.005) * rolling(n))),
    "torque_by_attitude": Unknown(moment(lambda d, n: 6e-4 * np.cross(n.d, level(0.4)))),
    "quadratic_spring": Unknown(force(lambda d, n: -40.0 * np.linalg.norm(n.O[:2]) * np.array([*n.O[:2], 0.0]))),
    "hysteresis": Unknown(
        lambda d, n: (ZERO, -4e-8 * n.memory[0] * n.m0, ZERO),
        rate_of_memory=lambda d, n, z: (n.psidot**2 - z) / 0.05,
        remembered=lambda n: n.psidot**2,
    ),
    "periodic_kicks": Unknown(kicks(0.06, 2e-5, 0.9)),
    "eddy_half": Unknown(force(lambda d, n: -0.02 * smooth((n.O[0] - 0.032) / 1e-4) * n.v * (1, 1, 0))),
    "bump": Unknown(uneven(hill(*PLACE, 30e-6, 8e-3))),
    "groove": Unknown(uneven(groove(0.6, 0.05, 20e-6, 3e-3))),
    "swirl": Unknown(force(lambda d, n: -0.01 * (n.v - 3.0 * np.cross(K, n.O - (0.02, 0.0, 0.0))) * (1, 1, 0))),
    "adhesion_by_rest": Unknown(moment(lambda d, n: -2e-4 * (1 + 30.0 / np.abs(n.psidot)) * rolling(n))),
    "pivoting_by_root": Unknown(
        by_load(lambda d, n: -8e-5 * n.omega[2] / (n.omega[2] ** 2 + 0.01) ** 0.25 * K), omega3=1.5
    ),
    "mass_shifts": Unknown(None, com=lambda t: (40e-6 * smooth((t - 0.3) / 0.003), 0.0, 0.0)),
    "sticker_flaps": Unknown(sticker(2e-5, 0.025, 2e-4, 37.0)),
    "table_sinks": Unknown(None, shift=lambda t: np.outer(-40e-6 * (t / 0.7) ** 2, [0, 0, 1, 0, 0, 0])),
    "table_slides": Unknown(None, shift=lambda t: np.outer(60e-6 * np.sin(2 * np.pi * 3 * t), [1, 0.5, 0, 0, 0, 0])),
    "wind_gusts": Unknown(force(lambda d, n: 1.5e-3 * (np.sin(19 * d.t) + np.sin(31 * d.t + 1)) * level(2.0))),
    "magnus_by_height": Unknown(force(lambda d, n: 0.05 * n.sine * np.cross(n.omega, n.v) * (1, 1, 0))),
    "soft_start": Unknown(by_load(lambda d, n: -2e-4 * np.exp(-d.t / 0.1) * rolling(n))),
    "brake_by_tilt": Unknown(by_load(lambda d, n: -3e-3 * n.sine**2 * rolling(n))),
    "tilt_by_azimuth": Unknown(by_load(lambda d, n: -6e-4 * n.sine * np.cos(2 * azimuth(n) - 0.5) * rolling(n))),
    "wear": Unknown(None, wears=20e-6),
    "magnet_over_iron": Unknown(over_iron(3e-11)),
    "seam": Unknown(uneven(seam(0.9, 0.045, 6e-6, 4e-3))),
    "rough_rim": Unknown(by_load(lambda d, n: -2e-4 * smooth((np.cos(n.phi - 1.0) - 0.5) / 0.1) * rolling(n))),
    "puddle": Unknown(moment(lambda d, n: -1.5e-5 * n.psidot * at_the_place(n, 0.015) * n.m0)),
    "hinged_frame": Unknown(
        force(lambda d, n: d.m * 9.81 * n.memory[0] * np.array([1.0, 0.0, 0.0])),
        rate_of_memory=lambda d, n, z: (5e-3 * (contact(n)[0] + 0.1) - z) / 0.04,
        remembered=lambda n: 5e-3 * (contact(n)[0] + 0.1),
    ),
    "fan": Unknown(force(lambda d, n: -0.01 * (n.v - 0.5 * smooth((d.t - 0.3) / 0.02) * level(1.3)) * (1, 1, 0))),
    "liquid": Unknown(
        lambda d, n: (-4e-6 * (n.omega @ n.d - n.memory[0]) * n.d, ZERO, ZERO),
        omega3=1.5,
        rate_of_memory=lambda d, n, z: (n.omega @ n.d - z) / 0.1,
    ),
    "thrust": Unknown(force(lambda d, n: 3e-3 * n.d)),
    "twisted_thread": Unknown(
        moment(lambda d, n: -3e-6 * n.memory[0] * K), rate_of_memory=lambda d, n, z: n.omega[2], omega3=1.5
    ),
    "worn_in": Unknown(  # friction that falls with the distance rolled
        by_load(lambda d, n: -1.5e-4 * np.exp(-n.memory[0] / 0.4) * rolling(n)),
        rate_of_memory=lambda d, n, z: d.r * np.linalg.norm(n.omega - n.omega[2] * K),
    ),
    "cross_drag": Unknown(force(lambda d, n: 6e-4 * n.psidot * n.sine * n.n0)),
    "nail": Unknown(nail(3e-10, (0.05, 0.01, -0.02))),
    "warming": Unknown(  # friction that falls with the heat of what it has dissipated, which cools
        by_load(lambda d, n: -2e-4 / (1 + n.memory[0] / 2e-4) * rolling(n)),
        rate_of_memory=lambda d, n, z: (
            2e-4 * d.m * 9.81 / (1 + z / 2e-4) * np.linalg.norm(n.omega - n.omega[2] * K) - z / 0.3
        ),
    ),
    "slipping_thread": Unknown(  # which holds up to a moment, and slips
        moment(lambda d, n: -6e-5 * n.memory[0] * K),
        omega3=1.5,
        rate_of_memory=lambda d, n, z: n.omega[2] - abs(n.omega[2]) * z / 0.25,
    ),
    "presliding": Unknown(  # friction that builds up over a way, by Dahl
        by_load(lambda d, n: -1.5e-4 * n.memory[0] * n.m0),
        rate_of_memory=lambda d, n, z: n.psidot * n.sine * (1 - z * np.sign(n.psidot) * abs(z)) / 0.3,
        remembered=lambda n: -0.5,
    ),
    "loose_ball": Unknown(  # in a tube of the face, in oil
        lambda d, n: (np.cross(n.memory[0] * n.R[:, 0], -0.0981 * K), ZERO, ZERO),
        rate_of_memory=lambda d, n, z: (-3e-3 * n.R[2, 0] - z) / 0.02,
    ),
    "two_materials": Unknown(
        both(
            uneven(seam(0.9, 0.045, 6e-6, 4e-3)),
            by_load(lambda d, n: -1e-4 * smooth((contact(n) @ level(0.9) - 0.045) / 1e-3) * rolling(n)),
        )
    ),
    "dipole_below": Unknown(dipole(4e-9, (0.06, 0.05, -0.05))),
    "jet": Unknown(jet(2e-2, 1.0, 0.01, 0.02, 0.3)),
    "pad": Unknown(  # a table that leans, as far as it gives way, to where the contact is
        force(lambda d, n: d.m * 9.81 * 2e-3 * np.tanh((contact(n)[0] - 0.03) / 0.02) * np.array([1.0, 0.0, 0.0]))
    ),
}
UNKNOWN["force_and_rim"] = Unknown(both(UNKNOWN["growing_force"].law, UNKNOWN["rough_rim"].law))
UNKNOWN["drag_and_steps"] = Unknown(both(UNKNOWN["drag_one_way"].law, UNKNOWN["friction_steps"].law))


def motion(unknown: Unknown):
    """Times (n,), spline of q over them, true moment (n, 3) along n0, m0, k; NaN where there is none."""
    laws = [newton_euler.precession_friction(K_M), *([unknown.law] if unknown.law else [])]
    sizes = DISC.radius, DISC.half_thickness, DISC.mass
    how = {"friction": unknown.friction, "wanders": unknown.com, "wears": unknown.wears}
    body = newton_euler.Disc(*sizes, laws=laws, **how, rate_of_memory=unknown.rate_of_memory)
    regime = "rolling" if unknown.friction is None else "slipping"
    theta = np.radians(unknown.theta_deg)
    omega2 = np.sqrt(4 * 9.81 * np.sin(theta) / body.r)
    start = (0.032, 0.02, 0.7, theta, -0.4, 0.0, omega2, unknown.omega3)
    state = newton_euler.state_from_angles(body, start)
    state[9] -= unknown.wears * np.sin(theta)  # the centre sinks with the radius
    if regime == "slipping":
        state[7:9] += (5e-3, -3e-3)
    if unknown.rate_of_memory is not None:
        state = np.append(state, unknown.remembered(newton_euler.Instant(body, state)))

    def low(t, s):
        return newton_euler.Instant(body, s).sine - np.sin(np.radians(1.2))

    low.terminal = True
    times = np.arange(0.0, unknown.duration, 1 / SAMPLES)
    method = {"method": "DOP853" if regime == "rolling" else "LSODA"}
    found = newton_euler.follow(body, state, times, regime, rtol=1e-10, atol=1e-11, max_step=1e-3, events=low, **method)
    assert found.success, found.message
    wrench = np.full((len(found.t), 3), np.nan)
    if regime == "rolling" and unknown.com is None and unknown.shift is None and not unknown.wears:
        for i in range(0, len(wrench), 6):
            wrench[i] = moment_of(body.at(found.t[i]), found.y[:, i])
    return found.t, newton_euler.course(body, found.t, found.y), wrench


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
    unknown = UNKNOWN[unknown] if isinstance(unknown, str) else unknown
    times, q, wrench = motion(unknown)
    seen = q if unknown.shift is None else lambda t: q(t) + unknown.shift(t)
    n = int((times[-1] - 0.01) * RATE)
    trajectory = measured(seed=seed, n=n, declared_rate=RATE, motion=seen)
    known = np.isfinite(wrench).all(axis=1)
    return Recording(trajectory, times[known] - STATION, wrench[known])
