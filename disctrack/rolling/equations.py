"""Newton-Euler equations of a rigid disc on a plane: pure rolling, slipping with Coulomb friction, free flight.

Vectors are nodal components (frames.py). With G the centre of mass, O the geometric centre, A the contact,
D = r_GA = r_OA - r_OG, omega the angular velocity of the body, Omega that of the nodal frame, X a force at O:

    m a_G = F + m g + X,      J omegadot + omega x J omega = D x F + M - r_OG x X,      M = M_0 + F_z L
    r_OA = a - rho k,         a = -(r - rho) e2 - (h - rho) e3          (rho: radius of the rounded edge, 0 = sharp)

In contact A stays at the height of the table; in rolling it is at rest: v_O = -omega x r_OA. As k is constant,
d(r_OA)/dt = Omega x a. Hence  F = f0 - m omegadot x D  with  f0 = m (omega x (omega x r_OG) - omega x (Omega x a)) -
m g - X,  and

    rolling    [J + m (|D|^2 - D D') + m L (D x k)'] omegadot = -omega x J omega + D x f0 + M_0 + L f0_z - r_OG x X
    slipping   F = F_z d,  d = k - mu v_A / |v_A|,   F_z = f0_z - m (D x k) . omegadot
               [J + m (D x d + L) (D x k)'] omegadot = -omega x J omega + (D x d + L) f0_z + M_0 - r_OG x X
    flying     F = 0, M = M_0

Curved table: a sphere of curvature kappa about C = n_0 / kappa through the origin, where its normal is n_0. The contact
is the point of the rim farthest from C. Let W = kappa (C - P), P the centre of the rim's circle, and W_f the projection
of W on the face. Then the contact is in the direction e = -W_f / |W_f|, the normal n = W - kappa r e replaces k, and
|n| = 1 determines the height of O. None of these is singular at kappa = 0. Omega x a becomes the rate of r_OA; in
slip, n . v_A = 0 is differentiated with the rate of n. A rim with the support function p(beta), beta the angle of e in
the body, has its contact at p e + p' e3 x e (with a curved table: to first order in kappa p'). F_z means n . F.

Moving table, displacement u(t): in its own axes gravity is g - u''. Compliant table, which sinks by c F_z: to first
order in c the load is that of a rigid table. Its derivatives F_z', F_z'' along the motion are differences over
LOAD_STEP, in which slip that friction would turn within that time keeps its direction relative to n0.
Creep, v_A = -c F_t / F_z, is equivalent to a table that slides with v_A under a rolling disc. v_A follows the force
with a time constant of c / (3 g) to c / g, and is expanded in the ratio of this time to that of the motion, with the
same differences. If this time is not short (c above FILM), v_A is part of the state, as in slip: a sheared film.
Moving surface (belt, turntable), v = v_0 + Omega k x A: equivalent to a table that slides with the velocity of the
surface at the contact A, which moves as the disc rolls.

F_z contains omegadot, so laws proportional to the load are solved together with it. For a homogeneous disc with a sharp
edge this is Ma et al. (2014), (2.6), (2.8) and (2.9), with (2.3) corrected to zdot = (r cos theta - h sin theta)
thetadot, and (2.7) with Omega, the rate of the frame, instead of omega, that of the body.

The functions accept float and complex numbers: an imaginary part of 1e-30 carries an exact derivative.
"""

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np

from calibration.kit.compiled import exact_part
from calibration.kit.types import Numbers
from disctrack.rolling._compiled import Addresses, call
from disctrack.rolling.records import Record, Regime

Vector: TypeAlias = tuple[complex, complex, complex]  # all numbers may be real
State: TypeAlias = Sequence[complex]
# r_OA, the normal, the height of O; and, for an uneven rim or table only: W, its unit projection on the face (-e), the
# length of the projection, and the support function with its derivatives
Contact: TypeAlias = tuple[Vector, Vector, complex, tuple[Vector, Vector, complex, Vector]]
Forced: TypeAlias = tuple[complex, complex, complex, complex, complex, complex, complex]

ROLLING, SLIPPING, FLYING = map(int, Regime)
EVENTS = ("theta_end", "load", "grip", "upright")
STICK_SPEED = 1e-7  # [m/s]; 1e-4 of the resolution of the tracking, and 1e-8 of the disc's speeds
LOAD_STEP = 1e-4  # [s]; errors: (200 rad/s times it)^2 / 12 = 3e-5 of F_z'', and rounding 1e-8 N/s^2
FAST_CREEP = 3e-4  # [m/s] of creep, from which on (c / g times rates of 100 rad/s)^2 is 1e-5 of v_A
FILM = 2e-3  # [m/s] of creep: (c / g times rates of 100 rad/s)^3 is 1e-5 of v_A, and steps of 0.1 ms are stable
NEAR_CONTACT = 1e-10  # [m] step at which Newton's method stops; the error is its square over the radius
LIFT_OFF_GAP = 1e-12  # [m] below which the disc has landed; not zero, which is the gap at the start of a flight

# table: integers shared by all functions: regime, number of laws, address of the record `now` (records.INSTANT), then
# the addresses of each law and of its parameters.


@exact_part
def _cross(a: Vector, b: Vector) -> Vector:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@exact_part
def _dot(a: Vector, b: Vector) -> complex:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@exact_part
def _add(a: Vector, b: Vector) -> Vector:
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


@exact_part
def _scale(f: complex, a: Vector) -> Vector:
    return (f * a[0], f * a[1], f * a[2])


@exact_part
def _nodal(n: complex, m: complex, z: complex, s: complex, c: complex) -> Vector:
    """(n0, m0, k) -> (e1, e2, e3): n0 = e1, m0 = c e2 - s e3, k = s e2 + c e3."""
    return (n, m * c + z * s, z * c - m * s)


@exact_part
def _solve(rows: tuple[Vector, Vector, Vector], b: Vector) -> Vector:
    """3 x 3 system by Cramer's rule."""
    r0, r1, r2 = rows
    c0, c1, c2 = _cross(r1, r2), _cross(r2, r0), _cross(r0, r1)
    x = _add(_scale(b[0], c0), _add(_scale(b[1], c1), _scale(b[2], c2)))
    return _scale(1.0 / _dot(r0, c0), x)


@exact_part
def _support(body: Record, cb: complex, sb: complex) -> Vector:
    """Support function of the rim minus the edge radius, and two derivatives, from cosine and sine of the angle."""
    c2, s2 = cb * cb - sb * sb, 2.0 * sb * cb
    c3, s3 = c2 * cb - s2 * sb, s2 * cb + c2 * sb
    two, three = body.oval_c * c2 + body.oval_s * s2, body.lobes_c * c3 + body.lobes_s * s3
    slope = 2.0 * (body.oval_s * c2 - body.oval_c * s2) + 3.0 * (body.lobes_s * c3 - body.lobes_c * s3)
    p, bend = body.radius - body.edge_radius + two + three, -4.0 * two - 9.0 * three
    if body.flat_depth != 0.0:
        k = body.flat_sharpness
        along, across = cb * body.flat_cos + sb * body.flat_sin, sb * body.flat_cos - cb * body.flat_sin
        dip = -body.flat_depth * np.exp(k * (along - 1.0))
        p, slope, bend = p + dip, slope - k * across * dip, bend + k * (k * across * across - along) * dip
    return p, slope, bend


@exact_part
def _contact(body: Record, now: Record) -> Contact:
    """Contact geometry from the position and the angles in the record."""
    s, c = now.sin_theta, now.cos_theta
    zero, kappa, rho = 0.0 * s, body.curvature, body.edge_radius
    if body.uneven == 0.0:
        arm, normal = (zero, rho - body.radius - rho * s, rho - body.half_thickness - rho * c), (zero, s, c)
        return arm, normal, -(s * arm[1] + c * arm[2]), (normal, normal, zero, normal)
    cf, sf, sp, cp = now.cos_phi, now.sin_phi, now.sin_psi, now.cos_psi
    arm3 = body.half_thickness - rho
    upright = np.sqrt(1.0 - body.slope_x * body.slope_x - body.slope_y * body.slope_y)
    n0 = _nodal(body.slope_x * cp + body.slope_y * sp, body.slope_y * cp - body.slope_x * sp, upright, s, c)
    level = _nodal(-(now.x * cp + now.y * sp), now.x * sp - now.y * cp, zero, s, c)
    z = (body.radius - rho) * s + arm3 * c + rho
    W, across, w, p = n0, n0, 1.0 + zero, (z, z, z)
    for _ in range(6):  # Newton's method; the relative error of the initial guess is of the order of the table's slope
        D = (level[0], level[1] - z * s, level[2] - z * c + arm3)
        W = _add(n0, _scale(kappa, D))
        w = np.sqrt(W[0] * W[0] + W[1] * W[1])
        across = (W[0] / w, W[1] / w, zero)  # -e
        # e in body axes: nodal axes rotated by minus the spin
        p = _support(body, -(cf * across[0] + sf * across[1]), -(cf * across[1] - sf * across[0]))
        gap = 2.0 * _dot(n0, D) + kappa * _dot(D, D) + 2.0 * p[0] * w + kappa * p[0] * p[0] + (2.0 - kappa * rho) * rho
        by_z = -2.0 * upright - 2.0 * kappa * (s * D[1] + c * D[2]) - 2.0 * kappa * p[0] * s * across[1]
        step = gap / by_z
        z = z - step
        if abs(step.real) < NEAR_CONTACT:
            break
    n = _scale(1.0 / (1.0 - kappa * rho), _add(W, _scale(kappa * p[0], across)))
    along = (across[1], -across[0], zero)  # e3 x e
    rim = _add(_scale(-p[0], across), _scale(p[1], along))
    arm = _add(_add(rim, (zero, zero, -arm3)), _scale(-rho, n))
    return arm, n, z, (W, across, w, p)


@exact_part
def _contact_rates(body: Record, now: Record, y: State, at: Contact) -> tuple[Vector, Vector]:
    """Rates of the vectors r_OA and normal, in nodal components."""
    s, c, rho, kappa = now.sin_theta, now.cos_theta, body.edge_radius, body.curvature
    arm, normal, _, (W, across, w, p) = at
    if body.uneven == 0.0:
        a = _add(arm, _scale(rho, normal))
        return _cross((y[5], y[6], y[6] * c / s), a), (0.0 * s, 0.0 * s, 0.0 * s)
    arm3, omega, v = rho - body.half_thickness, (y[5], y[6], y[7]), _nodal(now.v_n, now.v_m, now.v_z, s, c)
    e3 = (0.0 * s, 0.0 * s, 1.0 + 0.0 * s)
    e3_rate = _cross(omega, e3)
    W_rate = _scale(-kappa, _add(v, _scale(arm3, e3_rate)))
    in_face = _add(W_rate, _scale(-W[2], e3_rate))  # rate of the projection, apart from a part along e3
    e = _scale(-1.0, across)
    along = _cross(e3, e)
    e_rate = _scale(-1.0 / w, _add(in_face, _scale(-_dot(across, in_face), across)))
    # e stays perpendicular to e3
    e_rate = _add((e_rate[0], e_rate[1], 0.0 * s), _scale(-_dot(e, e3_rate), e3))
    along_rate = _add(_cross(e3_rate, e), _cross(e3, e_rate))
    turn = _dot(_add(e_rate, _scale(-1.0, _cross(omega, e))), along)
    rim_rate = _add(_scale(p[1] * turn, e), _scale(p[0], e_rate))
    rim_rate = _add(rim_rate, _add(_scale(p[2] * turn, along), _scale(p[1], along_rate)))
    n_rate = _add(W_rate, _scale(-kappa, _add(_scale(p[0], e_rate), _scale(p[1] * turn, e))))
    n_rate = _scale(1.0 / (1.0 - kappa * rho), n_rate)
    return _add(_add(rim_rate, _scale(arm3, e3_rate)), _scale(-rho, n_rate)), n_rate


@exact_part
def _kinematics(regime: int, t: complex, y: State, body: Record, k: Record) -> Contact:
    """Fills the record of kinematic quantities from the state."""
    k.time, k.x, k.y, k.psi, k.theta, k.phi = t, y[0], y[1], y[2], y[3], y[4]
    s, c, sp, cp = np.sin(k.theta), np.cos(k.theta), np.sin(k.psi), np.cos(k.psi)
    k.sin_psi, k.cos_psi, k.sin_phi, k.cos_phi = sp, cp, np.sin(k.phi), np.cos(k.phi)
    w1, w2, w3 = y[5], y[6], y[7]
    k.sin_theta, k.cos_theta, k.thetadot, k.omega2, k.omega3 = s, c, w1, w2, w3
    at = _contact(body, k)
    arm, normal, k.z, _ = at
    turn = _cross((w1, w2, w3), arm)  # omega x r_OA
    turn_n, turn_m, turn_z = turn[0], c * turn[1] - s * turn[2], s * turn[1] + c * turn[2]
    k.normal_n, k.normal_m, k.normal_z = normal[0], c * normal[1] - s * normal[2], s * normal[1] + c * normal[2]
    k.psidot = w2 / s
    k.phidot = w3 - w2 * c / s
    k.omega_z = w2 * s + w3 * c
    k.v_n, k.v_m, k.v_z = -turn_n, -turn_m, -turn_z
    if regime != ROLLING:
        k.v_n, k.v_m = y[8] * cp + y[9] * sp, y[9] * cp - y[8] * sp
        rise = (k.v_n + turn_n) * k.normal_n + (k.v_m + turn_m) * k.normal_m
        k.v_z = -turn_z - rise / k.normal_z  # the material point at the contact moves along the table
    if regime == FLYING:
        k.z, k.v_z = y[10], y[11]
    k.slip_n, k.slip_m = k.v_n + turn_n, k.v_m + turn_m
    k.radius, k.half_thickness, k.mass = body.radius, body.half_thickness, body.mass
    k.air_density = body.air_density
    k.gravity = np.sqrt(body.g_x * body.g_x + body.g_y * body.g_y + body.g_z * body.g_z)
    return at


@exact_part
def _apply_laws(table: Addresses, now: Record) -> None:
    now.M_n = now.M_m = now.M_z = 0.0
    now.load_n = now.load_m = now.load_z = 0.0
    now.X_n = now.X_m = now.X_z = 0.0
    now.table_x = now.table_y = now.table_z = 0.0
    now.table_vx = now.table_vy = now.table_vz = 0.0
    now.table_ax = now.table_ay = now.table_az = 0.0
    now.field_x = now.field_y = now.field_z = 0.0
    for i in range(3, 3 + 2 * table[1], 2):
        call(table[i], (table[i + 1], table[2], table[2]))


@exact_part
def _inertia_rows(body: Record, s: complex, c: complex) -> tuple[Vector, Vector, Vector]:
    """Inertia about G in nodal axes; s, c : sine and cosine of the spin."""
    J11 = c * c * body.J_11 - 2 * c * s * body.J_12 + s * s * body.J_22
    J22 = s * s * body.J_11 + 2 * c * s * body.J_12 + c * c * body.J_22
    J12 = c * s * (body.J_11 - body.J_22) + (c * c - s * s) * body.J_12
    J13, J23 = c * body.J_13 - s * body.J_23, s * body.J_13 + c * body.J_23
    return (J11, J12, J13), (J12, J22, J23), (J13, J23, body.J_33)


@exact_part
def _accelerations(regime: int, y: State, body: Record, now: Record, at: Contact) -> None:
    """Writes contact force, acceleration of O and angular acceleration into the record."""
    s, c, m = now.sin_theta, now.cos_theta, body.mass
    omega = (y[5], y[6], y[7])
    arm, k, _, _ = at
    arm_rate, k_rate = _contact_rates(body, now, y, at)
    cf, sf, sp, cp = now.cos_phi, now.sin_phi, now.sin_psi, now.cos_psi
    com = (body.com_1 * cf - body.com_2 * sf, body.com_1 * sf + body.com_2 * cf, body.com_3)
    D = _add(arm, _scale(-1.0, com))
    g_x, g_y = body.g_x + now.field_x - now.table_ax, body.g_y + now.field_y - now.table_ay
    g = _nodal(g_x * cp + g_y * sp, g_y * cp - g_x * sp, body.g_z + now.field_z - now.table_az, s, c)
    X = _nodal(now.X_n, now.X_m, now.X_z, s, c)
    M0 = _nodal(now.M_n, now.M_m, now.M_z, s, c)
    L = _nodal(now.load_n, now.load_m, now.load_z, s, c)
    centripetal_G = _cross(omega, _cross(omega, com))
    centripetal_A = _cross(omega, arm_rate)
    weight = _add(_scale(m, g), X)
    f0 = _add(_scale(m, _add(centripetal_G, _scale(-1.0, centripetal_A))), _scale(-1.0, weight))
    f0_z = _dot(k, f0)
    J0, J1, J2 = _inertia_rows(body, sf, cf)
    H = (_dot(J0, omega), _dot(J1, omega), _dot(J2, omega))
    b = _add(_add(M0, _scale(-1.0, _cross(omega, H))), _scale(-1.0, _cross(com, X)))
    Dk = _scale(m, _cross(D, k))
    if regime == ROLLING:
        DD = m * _dot(D, D)
        J0 = _add(_add(J0, (DD, 0.0 * DD, 0.0 * DD)), _add(_scale(-m * D[0], D), _scale(L[0], Dk)))
        J1 = _add(_add(J1, (0.0 * DD, DD, 0.0 * DD)), _add(_scale(-m * D[1], D), _scale(L[1], Dk)))
        J2 = _add(_add(J2, (0.0 * DD, 0.0 * DD, DD)), _add(_scale(-m * D[2], D), _scale(L[2], Dk)))
        b = _add(b, _add(_cross(D, f0), _scale(f0_z, L)))
        omegadot = _solve((J0, J1, J2), b)
        F = _add(f0, _scale(-m, _cross(omegadot, D)))
        a_O = _scale(-1.0, _add(_cross(omegadot, arm), centripetal_A))
    else:
        d = k
        if regime == SLIPPING:
            slip_z = -(now.slip_n * now.normal_n + now.slip_m * now.normal_m) / now.normal_z
            slip = _nodal(now.slip_n, now.slip_m, slip_z, s, c)
            speed = body.creep  # |v_A| over F_t / F_z: of the film, or from Coulomb's law
            if body.inverse_friction != 0.0:
                speed = body.inverse_friction * np.sqrt(_dot(slip, slip))
            d = _add(k, _scale(-1.0 / speed, slip))
            f0_z = f0_z - m * _dot(k_rate, slip)
            B = _add(_cross(D, d), L)
            J0, J1, J2 = _add(J0, _scale(B[0], Dk)), _add(J1, _scale(B[1], Dk)), _add(J2, _scale(B[2], Dk))
            b = _add(b, _scale(f0_z, B))
        omegadot = _solve((J0, J1, J2), b)
        load = f0_z - _dot(Dk, omegadot)
        if regime == FLYING:
            load = 0.0 * load
        F = _scale(load, d)
        a_G = _scale(1.0 / m, _add(F, weight))
        a_O = _add(a_G, _scale(-1.0, _add(_cross(omegadot, com), centripetal_G)))
    now.F_n, now.F_m, now.F_z = F[0], c * F[1] - s * F[2], s * F[1] + c * F[2]
    now.a_n, now.a_m, now.a_z = a_O[0], c * a_O[1] - s * a_O[2], s * a_O[1] + c * a_O[2]
    now.alpha_1, now.alpha_2, now.alpha_3 = omegadot
    normal_force = _dot(F, k)
    tangential = _add(F, _scale(-normal_force, k))
    now.N, now.F_t = normal_force, np.sqrt(_dot(tangential, tangential))


@exact_part
def _state(regime: int, y: Numbers) -> State:
    """All twelve components, zeros for those that the regime lacks, so that the functions below are compiled once."""
    zero = 0.0 * y[0]
    v_x, v_y = (y[8], y[9]) if regime != ROLLING else (zero, zero)
    z, v_z = (y[10], y[11]) if regime == FLYING else (zero, zero)
    return (y[0], y[1], y[2], y[3], y[4], y[5], y[6], y[7], v_x, v_y, z, v_z)


@exact_part
def _rates_of(y: State, now: Record) -> State:
    """Rates of all twelve components, on a table at rest."""
    c, sp, cp = now.cos_theta, now.sin_psi, now.cos_psi
    # rotating frame: rate of the components = (rate of the vector) - Omega x vector
    relative = _cross((y[5], y[6], now.psidot * c), (y[5], y[6], y[7]))
    return (
        now.v_n * cp - now.v_m * sp, now.v_n * sp + now.v_m * cp, now.psidot, now.thetadot, now.phidot,
        now.alpha_1 - relative[0], now.alpha_2 - relative[1], now.alpha_3 - relative[2],
        now.a_n * cp - now.a_m * sp, now.a_n * sp + now.a_m * cp, now.v_z, now.a_z,
    )  # fmt: skip


@exact_part
def _euler_step(y: State, h: float, rate: State) -> State:
    """The state after an Euler step h with these rates."""
    return (
        y[0] + h * rate[0], y[1] + h * rate[1], y[2] + h * rate[2], y[3] + h * rate[3], y[4] + h * rate[4],
        y[5] + h * rate[5], y[6] + h * rate[6], y[7] + h * rate[7], y[8] + h * rate[8], y[9] + h * rate[9],
        y[10] + h * rate[10], y[11] + h * rate[11],
    )  # fmt: skip


@exact_part
def _rigid_table_rates(t: complex, y: State, forced: Forced, table: Addresses, body: Record, now: Record) -> State:
    """Rates of the state on a rigid table; also fills the record.

    forced : acceleration of the contact along i and j, and its rate; then a slip along n0 and m0 that replaces the slip
        of the state, and the weight with which it does
    """
    at = _kinematics(table[0], t, y, body, now)
    slip_n, slip_m, share = forced[4:]
    now.slip_n, now.slip_m = now.slip_n + share * (slip_n - now.slip_n), now.slip_m + share * (slip_m - now.slip_m)
    _apply_laws(table, now)
    now.table_ax, now.table_ay = now.table_ax + forced[0], now.table_ay + forced[1]
    _accelerations(table[0], y, body, now, at)
    return _rates_of(y, now)


@exact_part
def _load_and_friction(now: Record) -> Vector:
    """F_z, and friction along i and j over N, without the horizontal part of the normal force."""
    sp, cp = now.sin_psi, now.cos_psi
    F_n, F_m = now.F_n - now.N * now.normal_n, now.F_m - now.N * now.normal_m
    return now.F_z, (F_n * cp - F_m * sp) / now.N, (F_n * sp + F_m * cp) / now.N


@exact_part
def _rates_after(
    h: float, rate: State, t: complex, y: State, forced: Forced, table: Addresses, body: Record, now: Record
) -> State:
    """Rates on a rigid table after an Euler step; also fills the record."""
    a_x, a_y, j_x, j_y, slip_n, slip_m, share = forced
    later = (a_x + h * j_x, a_y + h * j_y, j_x, j_y, slip_n, slip_m, share)
    return _rigid_table_rates(t + h, _euler_step(y, h, rate), later, table, body, now)


@exact_part
def _load_derivatives(
    twice: bool, t: complex, y: State, forced: Forced, table: Addresses, body: Record, now: Record
) -> tuple[Vector, Vector, Vector]:
    """`_load_and_friction` along the motion and its time derivative; the second one, too, or zero if not `twice`."""
    h = LOAD_STEP
    rate = _rigid_table_rates(t, y, forced, table, body, now)
    at_once = _load_and_friction(now)
    rate_after = _rates_after(h, rate, t, y, forced, table, body, now)
    after = _load_and_friction(now)
    rate_before = _rates_after(-h, rate, t, y, forced, table, body, now)
    before = _load_and_friction(now)
    first = _scale(0.5 / h, _add(after, _scale(-1.0, before)))
    if not twice:
        return at_once, first, _scale(0.0, first)
    # the motion bends by h^2 / 2 times the rate of the rates away from either step
    bent = _euler_step(_euler_step(y, 0.5 * h, rate_after), -0.5 * h, rate_before)
    _rigid_table_rates(t, bent, forced, table, body, now)
    sum_ = _add(_add(after, before), _load_and_friction(now))
    return at_once, first, _scale(1.0 / (h * h), _add(sum_, _scale(-3.0, at_once)))


@exact_part
def _creeping(creep: complex, first: Vector, second: Vector) -> Forced:
    """Acceleration of the contact and its rate, from derivatives of `_load_and_friction`."""
    zero = 0.0 * creep
    return -creep * first[1], -creep * first[2], -creep * second[1], -creep * second[2], zero, zero, zero


@exact_part
def _table_motion(t: complex, y: State, table: Addresses, body: Record, now: Record) -> tuple[complex, Vector, Vector]:
    """Motion of the table by its compliance and the creep of the contact; zeros if there is neither, and in flight.

    Its height, then its velocity and its acceleration along i, j and upwards.
    """
    regime, compliance, zero = table[0], body.compliance, 0.0 * y[0]
    creep = body.creep if regime == ROLLING else zero
    forced = (zero, zero, zero, zero, zero, zero, zero)
    if regime == FLYING or (compliance == 0.0 and creep == 0.0):
        return zero, (zero, zero, zero), (zero, zero, zero)
    if regime == SLIPPING and body.inverse_friction != 0.0:
        # slow slip follows its force at once and may turn by any angle within LOAD_STEP: its direction is kept
        _kinematics(regime, t, y, body, now)
        slow = 3.0 * LOAD_STEP * now.gravity / body.inverse_friction
        speed2, slow2 = now.slip_n * now.slip_n + now.slip_m * now.slip_m, slow * slow
        share = slow2 * slow2 / (slow2 * slow2 + speed2 * speed2)
        forced = (zero, zero, zero, zero, now.slip_n, now.slip_m, share)
    force, first, second = _load_derivatives(True, t, y, forced, table, body, now)
    # the force that accelerates the creeping disc is part of the force that causes the creep
    if creep.real > FAST_CREEP:
        force, first, second = _load_derivatives(True, t, y, _creeping(creep, first, second), table, body, now)
    if creep.real > 0.0:
        force, first, _ = _load_derivatives(False, t, y, _creeping(creep, first, second), table, body, now)
    velocity = (-creep * force[1], -creep * force[2], -compliance * first[0])
    return -compliance * force[0], velocity, (-creep * first[1], -creep * first[2], -compliance * second[0])


@exact_part
def _surface_velocity(y: State, body: Record, now: Record, at: Contact) -> tuple[complex, complex, complex, complex]:
    """Velocity along i and j of the surface at the moving contact, and its rate; it does not depend on the laws."""
    zero, turn = 0.0 * y[0], body.surface_turn
    if turn == 0.0:
        return zero + body.surface_vx, zero + body.surface_vy, zero, zero
    s, c, sp, cp, arm = now.sin_theta, now.cos_theta, now.sin_psi, now.cos_psi, at[0]
    arm_rate, _ = _contact_rates(body, now, y, at)
    at_n, at_m = arm[0], c * arm[1] - s * arm[2]
    to_n, to_m = now.v_n + arm_rate[0], now.v_m + c * arm_rate[1] - s * arm_rate[2]
    v_x = body.surface_vx - turn * (now.y + at_n * sp + at_m * cp)
    v_y = body.surface_vy + turn * (now.x + at_n * cp - at_m * sp)
    return v_x, v_y, -turn * (v_y + to_n * sp + to_m * cp), turn * (v_x + to_n * cp - to_m * sp)


@exact_part
def _margins(regime: int, body: Record, now: Record, at: Contact) -> tuple[complex, complex, complex, complex]:
    """Margins (EVENTS) that are positive while the regime lasts.

    theta_end: nutation minus its end value. load: N, or in flight the gap. grip: in rolling N - |F_t|/mu, in slip the
    slip speed. upright: pi/2 - theta; beyond pi/2 the other rim touches.
    """
    load, grip = now.N, 1.0 + 0.0 * now.theta
    if regime == ROLLING:
        grip = now.N - body.inverse_friction * now.F_t
    if regime == SLIPPING and body.inverse_friction != 0.0:  # on a film the disc never sticks
        grip = np.sqrt(now.slip_n * now.slip_n + now.slip_m * now.slip_m) - STICK_SPEED
    if regime == FLYING:
        load = now.z - at[2] + LIFT_OFF_GAP
    return now.theta - body.theta_end, load, grip, 0.5 * np.pi - now.theta


def rates(t: Numbers, y: Numbers, out: Numbers, table: Addresses, body: Record, now: Record) -> None:
    """Time derivative of the state, then the margins; also fills the record."""
    regime, state = table[0], _state(table[0], y)
    sinking, (v_x, v_y, v_z), (a_x, a_y, a_z) = _table_motion(t[0], state, table, body, now)
    at = _kinematics(regime, t[0], state, body, now)
    _apply_laws(table, now)
    surface = _surface_velocity(state, body, now, at)
    v_x, v_y, a_x, a_y = v_x + surface[0], v_y + surface[1], a_x + surface[2], a_y + surface[3]
    now.table_z = now.table_z + sinking
    now.table_vx, now.table_vy, now.table_vz = now.table_vx + v_x, now.table_vy + v_y, now.table_vz + v_z
    now.table_ax, now.table_ay, now.table_az = now.table_ax + a_x, now.table_ay + a_y, now.table_az + a_z
    _accelerations(regime, state, body, now, at)
    rate, margins, n = _rates_of(state, now), _margins(regime, body, now, at), 8 + 2 * regime
    for i in range(n):
        out[i] = rate[i]
    out[0], out[1] = out[0] + v_x, out[1] + v_y
    for i in range(len(margins)):
        out[n + i] = margins[i]
