"""Rolling and slipping disc in world vectors: one linear system of Newton, Euler and constraint, quaternions, SciPy.

Independent of disctrack.rolling: no nodal frame, no Euler angles, no eliminated equations, another integrator, laws
written once more from their published form. Slow, and meant to be.

State: O (3), quaternion (4), velocity of O (3), omega (3), all in world axes; psi and phi by quadrature (2).
"""

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicHermiteSpline, make_interp_spline
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

K = np.array([0.0, 0.0, 1.0])
K_M = 0.381e-7  # the paper's friction
LEAD = 0.005  # [s] of motion before the first frame
SAMPLES = 8  # of the motion per frame; the cubic between them errs by 1e-4 of the noise


@dataclass
class Disc:
    """The body and what it rolls on; defaults are the paper's disc, homogeneous with a sharp edge, on a flat table."""

    r: float = 37.5e-3
    h: float = 3e-3
    m: float = 0.20969
    gravity: Sequence[float] = (0, 0, -9.81)
    J_body: NDArray | None = None
    com_body: Sequence[float] = (0, 0, 0)
    wanders: Callable | None = None  # t -> centre of mass in the body, in place of com_body
    edge: float = 0.0
    mu: float = np.inf
    friction: Callable | None = None  # speed of slip -> coefficient, in place of mu
    laws: Sequence[Callable] = ()
    bowl: tuple | None = None  # centre and radius of a sphere that it rolls in
    waves: tuple = ()  # of the rim: (number around, cosine, sine) of its support function
    dips: tuple = ()  # of the rim: (depth, angle in the body, width)
    table: Callable | None = None  # t -> displacement, velocity, acceleration in the axes of the world; None: at rest
    carries: tuple | None = None  # velocity (3,) of the table's surface at the origin, and its rate of turn
    gives_way: float = 0.0  # compliance of a table that `yielding` makes move [m/N]
    wears: float = 0.0  # [m/s] by which the radius shrinks; `r` is that of the instant
    rate_of_memory: Callable | None = None  # (disc, instant, memory) -> rate of one more number, which laws may read
    t: float = 0.0  # the instant that laws may ask for

    def __post_init__(self):
        J1 = self.m * self.r**2 / 4 + self.m * self.h**2 / 3
        self.J = np.diag([J1, J1, self.m * self.r**2 / 2]) if self.J_body is None else self.J_body
        self.g, self.com, self.unworn = np.array(self.gravity, float), np.array(self.com_body, float), self.r

    def at(self, t):
        """Itself, at an instant."""
        self.t, self.r = t, self.unworn - self.wears * t
        if self.wanders is not None:
            self.com = np.array(self.wanders(t))
        return self


def cross_matrix(v):
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


class Instant:
    """Geometry and rates at one state."""

    def __init__(self, disc, state):
        self.O, self.v, self.omega, self.phi, self.memory = state[:3], state[7:10], state[10:13], state[14], state[15:]
        self.R = Rotation.from_quat(state[3:7], scalar_first=True).as_matrix()
        d = self.R[:, 2]
        d_rate = np.cross(self.omega, d)
        up = K - d[2] * d  # towards the highest point of the face, length sin(theta)
        up_rate = -d_rate[2] * d - d[2] * d_rate
        sine = np.linalg.norm(up)
        e2 = up / sine
        e2_rate = up_rate / sine - up * (up @ up_rate) / sine**3
        self.d, self.sine, self.cosine = d, sine, d[2]
        rim, height = disc.r - disc.edge, disc.h - disc.edge
        self.arm = -rim * e2 - height * d - disc.edge * K
        self.arm_rate = -rim * e2_rate - height * d_rate + disc.wears * e2
        self.normal, self.normal_rate = K, np.zeros(3)
        if disc.bowl is not None:
            self.touch_the_bowl(disc, d, d_rate)
        if disc.waves or disc.dips:
            self.touch_with_the_rim(disc, d, d_rate, e2, e2_rate)
        self.n0 = np.cross(e2, d)  # e1 = e2 x e3
        self.m0 = np.cross(K, self.n0)
        self.psidot = (d[0] * d_rate[1] - d[1] * d_rate[0]) / sine**2
        self.phidot = self.omega @ d - self.psidot * d[2]
        self.thetadot = self.omega @ self.n0
        self.u, self.u_rate, self.u_acceleration = (np.zeros(3),) * 3 if disc.table is None else disc.table(disc.t)
        if disc.carries is not None:
            velocity, turn = disc.carries
            self.u_rate = self.u_rate + velocity + turn * np.cross(K, self.O + self.arm)
            self.u_acceleration = self.u_acceleration + turn * np.cross(K, self.v + self.arm_rate)
        self.v_contact = self.v + np.cross(self.omega, self.arm) - self.u_rate  # past the table

    def touch_the_bowl(self, disc, d, d_rate):
        """A sharp edge in a sphere seen from inside: the point of the rim that is farthest from its centre."""
        centre, radius = disc.bowl
        to_centre, to_centre_rate = centre - (self.O - disc.h * d), -(self.v - disc.h * d_rate)
        height = to_centre @ d
        inwards = to_centre - height * d
        inwards_rate = to_centre_rate - (to_centre_rate @ d + to_centre @ d_rate) * d - height * d_rate
        length = np.linalg.norm(inwards)
        out = -inwards / length
        out_rate = -inwards_rate / length + inwards * (inwards @ inwards_rate) / length**3
        self.arm = disc.r * out - disc.h * d
        self.arm_rate = disc.r * out_rate - disc.h * d_rate
        self.normal = (centre - self.O - self.arm) / radius
        self.normal_rate = -(self.v + self.arm_rate) / radius

    def touch_with_the_rim(self, disc, d, d_rate, e2, e2_rate):
        """A sharp edge on a flat table: the point of the rim with the lowest tangent; the body's axes by R."""
        e = -e2
        angle = np.arctan2(e @ self.R[:, 1], e @ self.R[:, 0])
        along = np.cross(d, e)
        along_rate = np.cross(d_rate, e) - np.cross(d, e2_rate)
        # the body turns under the contact
        angle_rate = -(e2_rate + np.cross(self.omega, e)) @ along
        p, slope, bend = disc.r, 0.0, 0.0
        for k, c, s in disc.waves:
            p += c * np.cos(k * angle) + s * np.sin(k * angle)
            slope += k * (s * np.cos(k * angle) - c * np.sin(k * angle))
            bend -= k * k * (c * np.cos(k * angle) + s * np.sin(k * angle))
        for depth, middle, width in disc.dips:
            off, k = angle - middle, width**-2
            dip = depth * np.exp(k * (np.cos(off) - 1))
            p, slope = p - dip, slope + k * np.sin(off) * dip
            bend += k * (np.cos(off) - k * np.sin(off) ** 2) * dip
        self.arm = p * e + slope * along - disc.h * d
        self.arm_rate = (slope * e + bend * along) * angle_rate - p * e2_rate + slope * along_rate - disc.h * d_rate


def accelerations(disc, state, regime):
    """(a_O, omegadot, F) from the balance of momentum, of angular momentum about O, and the constraint."""
    now = Instant(disc, state)
    rho = now.R @ disc.com
    J_G = now.R @ disc.J @ now.R.T
    J_O = J_G + disc.m * (rho @ rho * np.eye(3) - np.outer(rho, rho))
    w = now.omega
    M_fixed, M_load, X = np.zeros(3), np.zeros(3), np.zeros(3)
    for law in disc.laws:
        fixed, load, force = law(disc, now)
        M_fixed, M_load, X = M_fixed + fixed, M_load + load, X + force
    A, b = np.zeros((9, 9)), np.zeros(9)
    m, S = disc.m, cross_matrix
    # m (a + wd x rho) - F = m g + X - m w x (w x rho)
    A[0:3, 0:3], A[0:3, 3:6], A[0:3, 6:9] = m * np.eye(3), -m * S(rho), -np.eye(3)
    b[0:3] = m * disc.g + X - m * np.cross(w, np.cross(w, rho))
    # J_O wd + m rho x a - arm x F - M_load N = M_fixed + rho x m g - w x J_O w
    n = now.normal
    A[3:6, 0:3], A[3:6, 3:6], A[3:6, 6:9] = m * S(rho), J_O, -S(now.arm) - np.outer(M_load, n)
    b[3:6] = M_fixed + np.cross(rho, m * disc.g) - np.cross(w, J_O @ w)
    # a + wd x arm + w x arm_rate = the table's, all of it (rolling) or its vertical part (slipping), or F = 0
    constraint = np.hstack([np.eye(3), -S(now.arm), np.zeros((3, 3))])
    right = now.u_acceleration - np.cross(w, now.arm_rate)
    right = right - disc.wears * now.cosine * now.thetadot * K  # what touches sinks with the radius, by r' sin(theta)
    if regime == "rolling":
        A[6:9], b[6:9] = constraint, right
    elif regime == "slipping":
        A[6], b[6] = n @ constraint, n @ right - now.normal_rate @ now.v_contact
        speed = np.linalg.norm(now.v_contact)
        direction, mu = now.v_contact / speed, disc.mu if disc.friction is None else disc.friction(speed)
        # F + mu N direction has no part in the table's plane
        for row, axis in ((7, np.array([1.0, 0, 0])), (8, np.array([0, 1.0, 0]))):
            axis = axis - (axis @ n) * n
            A[row, 6:9] = axis + mu * (axis @ direction) * n
    else:
        A[6:9, 6:9] = np.eye(3)
    solution = np.linalg.solve(A, b)
    return solution[:3], solution[3:6], solution[6:], now


def state_from_angles(disc, coordinates, velocity=None):
    """State of a disc in contact at (x, y, psi, theta, phi, thetadot, omega2, omega3).

    velocity : horizontal one of O; None: the disc rolls
    """
    x, y, psi, theta, phi, thetadot, omega2, omega3 = coordinates
    attitude = Rotation.from_euler("ZXZ", [psi, theta, phi])
    R = attitude.as_matrix()
    e1 = np.array([np.cos(psi), np.sin(psi), 0])
    omega = thetadot * e1 + omega2 * np.cross(R[:, 2], e1) + omega3 * R[:, 2]
    state = np.zeros(15)
    state[3:7], state[10:13], state[13], state[14] = attitude.as_quat(scalar_first=True), omega, psi, phi
    now = Instant(disc, state)
    state[:3] = x, y, -now.arm[2]
    if disc.bowl is not None:  # lowered until the rim touches
        centre, radius = disc.bowl

        def gap(z):
            state[2] = z
            return np.linalg.norm(centre - state[:3] - Instant(disc, state).arm) - radius

        state[2] = brentq(gap, state[2] - 0.03, state[2] + 0.03, xtol=1e-16, rtol=1e-15)
        now = Instant(disc, state)
    if disc.carries is not None:
        now = Instant(disc, state)  # where it lies
    state[7:10] = -np.cross(omega, now.arm) + now.u_rate
    state[:3] += now.u
    if velocity is not None:
        n = now.normal
        state[7:9] = velocity + now.u_rate[:2]
        slip = state[7:10] + np.cross(omega, now.arm) - now.u_rate
        state[9] -= slip @ n / n[2]
    return state


def rate(disc, state, regime):
    a, omegadot, _, now = accelerations(disc, state, regime)
    w, v = state[3], state[4:7]  # of the quaternion
    spin = 0.5 * np.array([-now.omega @ v, *(w * now.omega + np.cross(now.omega, v))])
    memory = [disc.rate_of_memory(disc, now, now.memory[0])] if disc.rate_of_memory else []
    return np.concatenate([now.v, spin, a, omegadot, [now.psidot, now.phidot], memory])


def follow(disc, state, times, regime="rolling", **options):
    """solve_ivp over the times; returns its result."""
    options = {"method": "DOP853", "rtol": 1e-11, "atol": 1e-12} | options
    return solve_ivp(lambda t, s: rate(disc.at(t), s, regime), (times[0], times[-1]), state, t_eval=times, **options)


def coordinates(disc, states):
    """q (n, 6) of states (15, n): the nutation from the axis, psi and phi from quadrature."""
    q = np.zeros((states.shape[1], 6))
    for i, s in enumerate(states.T):
        now = Instant(disc, s)
        q[i] = *s[:3], s[13], np.arctan2(now.sine, now.cosine), s[14]
    return q


def course(disc, times, states):
    """Spline of q over the times, through states (15, n) with their own rates."""
    moving = [Instant(disc.at(t), s) for t, s in zip(times, states.T, strict=True)]
    speed = np.array([[*now.v, now.psidot, now.thetadot, now.phidot] for now in moving])
    return CubicHermiteSpline(times, coordinates(disc, states), speed)


def filmed_motion(disc, theta_deg, omega3, duration, rate, psi=0.7):
    """Spline of q over time, from LEAD before the first frame on; a start near steady precession is the nutation."""
    theta = np.radians(theta_deg)
    omega2 = np.sqrt(4 * 9.81 * np.sin(theta) / disc.r)  # thin disc, centre at rest
    start = (0.032, 0.02, psi, theta, -0.4, 0.0, omega2, omega3)
    state = state_from_angles(disc, start)
    times = np.arange(0.0, duration + 2 * LEAD, 1.0 / (SAMPLES * rate))
    if disc.gives_way:
        disc.table = yielding(disc, state, times)
        state = state_from_angles(disc.at(0.0), start)
    answer = follow(disc, state, times, rtol=1e-10, atol=1e-11, method="LSODA")
    assert answer.success
    return course(disc, times - LEAD, answer.y)


# Laws: functions of (disc, instant) -> moment independent of the load, moment per load, force at O; world axes.
ZERO = np.zeros(3)


def precession_friction(k_m):
    return lambda disc, now: (ZERO, -k_m * now.psidot * abs(now.psidot) * now.m0, ZERO)


def nutation_friction(k_n):
    return lambda disc, now: (ZERO, -k_n * now.thetadot * abs(now.thetadot) * now.n0, ZERO)


def pivoting_friction(k_z):
    return lambda disc, now: (ZERO, -k_z * np.sign(now.omega[2]) * K, ZERO)


def rolling(now):
    """Direction of the horizontal angular velocity."""
    horizontal = now.omega - now.omega[2] * K
    return horizontal / np.linalg.norm(horizontal)


def classical_rolling_friction(delta):
    return lambda disc, now: (ZERO, -delta * rolling(now), ZERO)


def adhesive_rolling_friction(a):
    return lambda disc, now: (-a * rolling(now), ZERO, ZERO)


def spring(k, point=(0.0, 0.0)):
    return lambda disc, now: (ZERO, ZERO, -k * np.array([now.O[0] - point[0], now.O[1] - point[1], 0.0]))


def vibration(cosine, sine, frequency):
    """Of a table, in its own axes; accelerations, so that the force is on the centre of mass."""
    course = lambda t: np.cos(2 * np.pi * frequency * t) * cosine + np.sin(2 * np.pi * frequency * t) * sine  # noqa: E731

    def law(disc, now):
        force = -disc.m * course(disc.t)
        return np.cross(now.R @ disc.com, force), ZERO, force

    return law


def swing(cosine, sine, frequency, start=0.0):
    """A table that swings under cameras at rest; displacements, with the phase that they have at `start`."""
    w = 2 * np.pi * frequency

    def course(t):
        c, s = np.cos(w * (t - start)), np.sin(w * (t - start))
        return c * cosine + s * sine, w * (c * sine - s * cosine), -w * w * (c * cosine + s * sine)

    return course


def settling(speed, acceleration):
    """A table that sinks or rises slowly under cameras at rest."""
    return lambda t: ((speed + 0.5 * acceleration * t) * t * K, (speed + acceleration * t) * K, acceleration * K)


def yielding(disc, start, times, regime="rolling", **integration):
    """The course of a table that has given way to the load of the motion on the rigid one, by a spline."""
    rigid = copy(disc)
    rigid.table = None
    solution = follow(rigid, start, times, regime, **integration)
    load = [accelerations(rigid.at(t), s, regime)[2][2] for t, s in zip(times, solution.y.T, strict=True)]
    sunk = make_interp_spline(times, -disc.gives_way * np.array(load), k=7)
    return lambda t: tuple(sunk(t, order) * K for order in range(3))


def bildsten(beta, density, viscosity=1.81e-5):
    def law(disc, now):
        size = beta * np.sqrt(density * viscosity) * disc.r**4 * abs(now.psidot) ** 1.5
        return -size * np.sign(now.psidot) / now.sine * now.m0, ZERO, ZERO

    return law


def quadratic_air(a, density):
    return lambda disc, now: (-a * density * disc.r**5 * np.linalg.norm(now.omega) * now.omega, ZERO, ZERO)


def linear_drag(c):
    return lambda disc, now: (ZERO, ZERO, -c * now.v)


def moffatt(viscosity):
    return lambda disc, now: (-np.pi * viscosity * disc.r**3 / 4 * now.psidot / now.sine**2 * now.m0, ZERO, ZERO)


def of_the_paper(*laws, **changes):
    """The paper's disc with its friction; laws on top of it, and whatever is changed in the disc."""
    return Disc(laws=(precession_friction(K_M), *laws), **changes)
