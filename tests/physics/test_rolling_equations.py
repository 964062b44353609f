"""The equations of motion against two derivations by computer algebra and against world-vector formulations."""

import numpy as np
import pytest
import sympy as sp
from numpy.testing import assert_allclose
from scipy.integrate import simpson, solve_ivp

from disctrack import rolling
from disctrack.disc import MA_2014
from disctrack.rolling import CATALOGUE, Model, State, _assembly
from disctrack.rolling._assembly import Assembly
from tests.oracles import free_flight, newton_euler

t = sp.symbols("t")
r, h, m, g, J1, J3 = sp.symbols("r h m g J1 J3", positive=True)
x, y, z, psi, theta, phi = (sp.Function(n)(t) for n in ("x", "y", "z", "psi", "theta", "phi"))
q = sp.Matrix([x, y, z, psi, theta, phi])
s, c, sp_, cp = sp.sin(theta), sp.cos(theta), sp.sin(psi), sp.cos(psi)
e1, e2, e3, k = (sp.Matrix(v) for v in ((cp, sp_, 0), (-sp_ * c, cp * c, s), (sp_ * s, -cp * s, c), (0, 0, 1)))
m0 = k.cross(e1)
r_OA = -r * e2 - h * e3
omega = theta.diff(t) * e1 + psi.diff(t) * k + phi.diff(t) * e3
I1, I2, I3 = J1 + m * (r**2 + h**2), J1 + m * h**2, J3 + m * r**2
L1, L2 = r * c - h * s, r * s + h * c
psid, thetad, phid = psi.diff(t), theta.diff(t), phi.diff(t)
omega2, omega3 = psid * s, psid * c + phid
M_n, M_m, M_z, X_n, X_m, X_z = sp.symbols("M_n M_m M_z X_n X_m X_z")
M = M_n * e1 + M_m * m0 + M_z * k
X = X_n * e1 + X_m * m0 + X_z * k

ROWS = sp.Matrix(
    [
        I1 * thetad.diff(t)
        - I2 * psid**2 * s * c
        + (I3 * s + m * r * h * c) * psid * omega3
        - m * r * h * psid**2 * s**2
        + m * g * L1
        - (M_n + L1 * X_z - L2 * X_m),
        I2 * omega2.diff(t)
        + J1 * thetad * psid * c
        - J3 * thetad * omega3
        - m * h * r * omega3.diff(t)
        + m * h * psid * thetad * L2
        - (c * M_m + s * M_z + h * X_n),
        I3 * omega3.diff(t) - m * r * h * omega2.diff(t) - m * r * psid * thetad * L2 - (-s * M_m + c * M_z - r * X_n),
    ]
)


def rolling_velocity(printed=False):
    """Velocity of O in pure rolling; `printed`: with the third line of (2.3) as printed."""
    v = (-omega.cross(r_OA)).as_mutable()
    if printed:
        v[2] = -h * thetad * s + r * thetad * s
    return v


def lagrange_rows(printed_constraint=False):
    """Lagrange's equations, multipliers removed by the velocities that the constraint allows."""
    v = rolling_velocity(printed_constraint)
    omega_nodal = sp.Matrix([thetad, omega2, omega3])
    xd, yd, zd = x.diff(t), y.diff(t), z.diff(t)
    T = (
        m * (xd**2 + yd**2 + zd**2) / 2
        + (J1 * (omega_nodal[0] ** 2 + omega_nodal[1] ** 2) + J3 * omega_nodal[2] ** 2) / 2
    )
    L = T - m * g * z
    qd = q.diff(t)
    euler_lagrange = sp.Matrix([L.diff(qd[i]).diff(t) - L.diff(q[i]) for i in range(6)])
    external = [X[0], X[1], X[2], M_z, M_n, -s * M_m + c * M_z]  # generalised forces on x, y, z, psi, theta, phi
    allowed = sp.Matrix([v, sp.Matrix([psid, thetad, phid])]).jacobian([thetad, psid, phid])
    on_constraint = {component.diff(t, 2): v[i].diff(t) for i, component in enumerate((x, y, z))}
    balance = (euler_lagrange - sp.Matrix(external)).subs(on_constraint)
    return (allowed.T * balance).applyfunc(sp.expand)


def newton_euler_rows(frame_rate):
    """dG/dt = M + r_OA x F in nodal components, F from the motion of O; frame_rate multiplies G."""
    a_O = rolling_velocity().diff(t)
    F = m * a_O + m * g * k - X
    axes = sp.Matrix.hstack(e1, e2, e3)
    G = sp.Matrix([J1 * thetad, J1 * omega2, J3 * omega3])
    rate = G.diff(t) + (axes.T * frame_rate).cross(G)
    return (rate - axes.T * (M + r_OA.cross(F))).applyfunc(sp.expand)


def zero(expression):
    """True for an expression that vanishes with sin^2 + cos^2 = 1: the remainder of polynomial division."""
    S, C, S_psi, C_psi = sp.symbols("S C S_psi C_psi")
    rates = {f.diff(t, n): sp.Symbol(f"{f.func}{n}") for f in (psi, theta, phi) for n in (2, 1)}
    polynomial = sp.expand(expression.subs(rates).subs({s: S, c: C, sp_: S_psi, cp: C_psi}))
    return sp.rem(sp.rem(polynomial, S**2 + C**2 - 1, S), S_psi**2 + C_psi**2 - 1, S_psi) == 0


@pytest.mark.statistical
def test_lagrange_gives_the_corrected_equations():
    theta_row, psi_row, phi_row = lagrange_rows()
    assert zero(theta_row - ROWS[0])
    assert zero(psi_row - (s * ROWS[1] + c * ROWS[2]))  # the psi equation is the e2 and e3 rows along k
    assert zero(phi_row - ROWS[2])


def test_newton_and_euler_give_the_corrected_equations():
    Omega = thetad * e1 + psid * k  # of the frame, not of the body
    for derived, row in zip(newton_euler_rows(Omega), ROWS, strict=True):
        assert zero(derived - row)


def test_printed_constraint_is_noticed():
    rows = lagrange_rows(printed_constraint=True)
    assert not zero(rows[0] - ROWS[0])


@pytest.mark.statistical
def test_printed_angular_momentum_balance_is_noticed():
    rows = newton_euler_rows(omega)  # literal (2.7): rate of the body in place of the frame's
    assert zero(rows[0] - ROWS[0] + J1 * s * phid * psid)
    assert zero(rows[1] - ROWS[1] - J1 * phid * thetad)
    assert not zero(rows[0] - ROWS[0])


@pytest.mark.parametrize(("theta_deg", "low_by"), [(2, 0.0075), (8, 0.0265), (25, 0.058), (40, 0.066)])
def test_printed_steady_state_is_off_by_what_the_errata_say(theta_deg, low_by):
    a = np.radians(theta_deg)
    r_, h_, m_ = MA_2014.radius, MA_2014.half_thickness, MA_2014.mass
    I3_, J1_ = MA_2014.moment_axial + m_ * r_**2, MA_2014.moment_diametral
    sa, ca = np.sin(a), np.cos(a)
    weight = m_ * 9.81 * (r_ * ca - h_ * sa)
    q_over_p = h_ * sa / r_
    printed = (J1_ * sa * ca + m_ * r_ * h_ * sa**2) - (I3_ * sa**2 + m_ * r_ * h_ * ca * sa) * q_over_p
    p, _ = rolling.precession_rate(a, MA_2014)
    state = rolling.steady_precession(a, MA_2014)
    assert_allclose(1 - np.sqrt(weight / printed) / p, low_by, atol=0.0006)
    assert abs(product_rates(Model(MA_2014), state)[5]) < 1e-10  # the corrected one has no nutation acceleration
    off = state.moved(omega2=np.sqrt(weight / printed) * sa, omega3=q_over_p * np.sqrt(weight / printed))
    assert abs(product_rates(Model(MA_2014), off)[5]) > 1.0


def product_rates(model, state):
    return Assembly(model, 1e-3).at({8: 0, 10: 1, 12: 2}[len(state.array)], 0.0, state.array)[0][0]


def random_state(rng, theta=None):
    theta = np.radians(rng.uniform(0.5, 85)) if theta is None else theta
    v = rng.normal(size=8)
    psidot = rng.normal() * 12 / np.sqrt(np.sin(theta))
    return State(v[0], v[1], *rng.uniform(-7, 7, 1), theta, v[4] * 3, v[5] * 3, psidot * np.sin(theta), v[7] * 5)


def test_compiled_rates_satisfy_the_derived_rows_on_random_states(rng):
    symbols = sp.symbols("th ps_d th_d ph_d th_dd ps_dd ph_dd")
    first = {psid: symbols[1], thetad: symbols[2], phid: symbols[3]}
    second = {thetad.diff(t): symbols[4], psid.diff(t): symbols[5], phid.diff(t): symbols[6]}
    rows = ROWS.subs(second).subs(first).subs({theta: symbols[0]})
    wrench = (M_n, M_m, M_z, X_n, X_m, X_z)
    f = sp.lambdify((symbols, (r, h, m, g, J1, J3), wrench), rows)
    disc = MA_2014
    numbers = (disc.radius, disc.half_thickness, disc.mass, 9.81, disc.moment_diametral, disc.moment_axial)
    model = Model(disc, effects=tuple(CATALOGUE[n]() for n in ("km", "kn", "kz", "drag_linear", "air_moffatt")))
    for _ in range(50):
        state = random_state(rng)
        assembly = Assembly(model, 1e-3)
        (rates,), _, (w,) = assembly.at(0, 0.0, state.array)
        sa, ca = np.sin(state.theta), np.cos(state.theta)
        psidd = (rates[6] - state.psidot * ca * state.thetadot) / sa
        phidd = rates[7] - psidd * ca + state.psidot * sa * state.thetadot
        moments = [w[f"M_{a}"] + w["F_z"] * w[f"load_{a}"] for a in "nmz"]
        forces = [w[f"X_{a}"] for a in "nmz"]
        motion = (state.theta, state.psidot, state.thetadot, state.phidot, rates[5], psidd, phidd)
        residual = np.ravel(f(motion, numbers, (*moments, *forces)))
        assert_allclose(residual, 0, atol=1e-12)  # N m; the terms are of order 1, rounding 1e-14


STANDING_FORCES = (
    newton_euler.spring(0.8, (0.05, -0.03)),
    newton_euler.vibration(np.array([0.3, -0.2, 0.5]), np.array([0.7, 0.4, -0.1]), 60.0),
)
EFFECTS = {
    "ideal": ({}, {}),
    "friction": (
        {
            "km": {"k_m": 4e-8},
            "kn": {"k_n": 1e-6},
            "kz": {"k_z": 1e-4},
            "rolling_classical": {"delta": 1e-4},
            "rolling_adhesive": {"a": 1e-4},
        },
        {
            "laws": [
                newton_euler.precession_friction(4e-8),
                newton_euler.nutation_friction(1e-6),
                newton_euler.pivoting_friction(1e-4),
                newton_euler.classical_rolling_friction(1e-4),
                newton_euler.adhesive_rolling_friction(1e-4),
            ]
        },
    ),
    "forces": (
        {
            "drag_linear": {"c": 0.02},
            "table_tilt": {"tilt_x": 0.03, "tilt_y": -0.02},
            "air_moffatt": {"f": 3.0},
            "spring": {"k": 0.8, "F_x": 0.04, "F_y": -0.024},
            "table_vibration": {
                **{"a_cos_x": 0.3, "a_cos_y": -0.2, "a_cos_z": 0.5, "a_sin_x": 0.7, "a_sin_y": 0.4, "a_sin_z": -0.1},
                "frequency": 60.0,
            },
        },
        {
            "laws": [
                newton_euler.linear_drag(0.02),
                newton_euler.moffatt(3 * 1.81e-5),
                *STANDING_FORCES,
            ],
            "gravity": 9.81 * np.array([0.03, -0.02, -np.sqrt(1 - 0.03**2 - 0.02**2)]),
        },
    ),
    "vibrating with its cameras": (
        {
            "table_vibration": {
                **{"a_cos_x": 0.3, "a_cos_y": -0.2, "a_cos_z": 0.5, "a_sin_x": 0.7, "a_sin_y": 0.4, "a_sin_z": -0.1},
                "frequency": 60.0,
            },
            "centre_of_mass": {"c_1": 1e-3, "c_2": -5e-4, "c_3": 3e-4},
        },
        {
            "laws": STANDING_FORCES[1:],
            "com_body": (1e-3, -5e-4, 3e-4),
        },
    ),
    "hollow": (
        {
            "table_curved": {"kappa": 0.8, "slope_x": 0.03, "slope_y": -0.02},
            "centre_of_mass": {"c_1": 1e-3, "c_2": -5e-4, "c_3": 3e-4},
            "km": {"k_m": 4e-8},
        },
        {
            "laws": [newton_euler.precession_friction(4e-8)],
            "com_body": (1e-3, -5e-4, 3e-4),
            "bowl": (np.array([0.03, -0.02, np.sqrt(1 - 0.03**2 - 0.02**2)]) / 0.8, 1 / 0.8),
        },
    ),
    "out of round": (
        {"rim": {"oval_c": 3e-4, "oval_s": -2e-4, "lobes_c": 1e-4, "lobes_s": 1.5e-4}, "km": {"k_m": 4e-8}},
        {"laws": [newton_euler.precession_friction(4e-8)], "waves": ((2, 3e-4, -2e-4), (3, 1e-4, 1.5e-4))},
    ),
    "thin air": (
        {"air": {"density": 0.1}, "air_bildsten": {"beta": 3.0}, "air_quadratic": {"a": 5.0}},
        {"laws": [newton_euler.bildsten(3.0, 0.12), newton_euler.quadratic_air(5.0, 0.12)]},
    ),
    "flat": (
        {"rim_flat": {"depth": 2e-4, "angle": 0.7, "width": 0.15}, "km": {"k_m": 4e-8}},
        {"laws": [newton_euler.precession_friction(4e-8)], "dips": ((2e-4, 0.7, 0.15),)},
    ),
    "shaken": (
        {
            "table_shaken": {
                **{"u_cos_x": 3e-6, "u_cos_y": -2e-6, "u_cos_z": 5e-6, "u_sin_x": 7e-6, "u_sin_y": 4e-6},
                **{"u_sin_z": -1e-6, "frequency": 60.0},
            },
            "centre_of_mass": {"c_1": 1e-3, "c_2": -5e-4, "c_3": 3e-4},
        },
        {
            "table": newton_euler.swing(np.array([3e-6, -2e-6, 5e-6]), np.array([7e-6, 4e-6, -1e-6]), 60.0),
            "com_body": (1e-3, -5e-4, 3e-4),
        },
    ),
    "settles": (
        {"table_settles": {"v_z": -2e-3, "a_z": 5e-2}, "centre_of_mass": {"c_1": 1e-3, "c_2": -5e-4, "c_3": 3e-4}},
        {"table": newton_euler.settling(-2e-3, 5e-2), "com_body": (1e-3, -5e-4, 3e-4)},
    ),
    "turntable": (
        {
            "surface_moves": {"v_x": 0.02, "v_y": -0.01, "rate": 0.8},
            "centre_of_mass": {"c_1": 1e-3, "c_2": -5e-4, "c_3": 3e-4},
        },
        {"carries": (np.array([0.02, -0.01, 0.0]), 0.8), "com_body": (1e-3, -5e-4, 3e-4)},
    ),
    "body": (
        {
            "centre_of_mass": {"c_1": 1e-3, "c_2": -5e-4, "c_3": 3e-4},
            "inertia_product": {"J_13": 1.5e-6, "J_23": -3e-6},
            "edge_radius": {"rho": 5e-4},
            "inertia_axial": {"e": 0.05},
            "inertia_diametral": {"e": -0.03},
            "contact_radius": {"r_error": 1e-3},
            "contact_height": {"h_error": -2e-4},
            "gravity": {"g_error": 0.5},
        },
        {"body": True},
    ),
}


def pair(name):
    """The same physics in the product and in the oracle."""
    effects, options = EFFECTS[name]
    options = dict(options)
    d = MA_2014
    radius, height = d.radius, d.half_thickness
    if options.pop("body", False):
        J = np.diag([d.moment_diametral * 0.97, d.moment_diametral * 0.97, d.moment_axial * 1.05])
        J[0, 2] = J[2, 0] = 1.5e-6
        J[1, 2] = J[2, 1] = -3e-6
        options |= {"J_body": J, "com_body": (1e-3, -5e-4, 3e-4), "edge": 5e-4, "gravity": (0, 0, -10.31)}
        radius, height = radius + 1e-3, height - 2e-4
    model = Model(d, effects=tuple(CATALOGUE[n](**v) for n, v in effects.items()))
    return model, newton_euler.Disc(radius, height, d.mass, **options)


@pytest.mark.parametrize("name", EFFECTS)
@pytest.mark.parametrize("regime", ["rolling", "slipping", "flying"])
def test_accelerations_and_forces_agree_with_the_world_vector_system(name, regime, rng):
    model, oracle = pair(name)
    model = model.with_effects(CATALOGUE["slip"](mu=0.3))
    oracle.mu = 0.3
    if regime == "flying":  # contact laws do nothing in the air; drag, spring and vibration act there too
        in_air = {
            "forces": [newton_euler.linear_drag(0.02), *STANDING_FORCES],
            "thin air": oracle.laws[1:],
            "vibrating with its cameras": oracle.laws,
        }
        oracle.laws = in_air.get(name, [])
    for _ in range(20):
        state = random_state(rng)
        if name == "hollow":  # within it, and steeper than its sides
            state = random_state(rng, np.radians(rng.uniform(12, 85)))
            state = state.moved(x=0.05 * state.x, y=0.05 * state.y)
        velocity = None if regime == "rolling" else rng.normal(size=2)
        start = newton_euler.state_from_angles(oracle, *state.array, velocity)
        if regime != "rolling":
            state = state.moved(v_x=velocity[0], v_y=velocity[1])
        if regime == "flying":
            start[2], start[9] = 0.1, 0.3
            state = state.moved(z=0.1, v_z=0.3)
        a, omegadot, F, now = newton_euler.accelerations(oracle, start, regime)
        assembly = Assembly(model, 1e-3)
        (rates,), _, (w,) = assembly.at({"rolling": 0, "slipping": 1, "flying": 2}[regime], 0.0, state.array)
        contact = np.array([w["F_n"], w["F_m"], w["F_z"]])
        expected = np.array([F @ now.n0, F @ now.m0, F[2]])
        scale = 1 + np.abs(expected).max()
        # smoothing of the signs: 1e-2 rad/s of pivoting rates of order 1, 1e-3 of rolling rates of order 1
        tolerance = 3e-3 if name == "friction" else 1e-11
        assert_allclose(contact, expected, atol=tolerance * scale)
        frame = now.thetadot * now.n0 + now.psidot * np.array([0, 0, 1.0])
        axes = np.stack([now.n0, np.cross(now.d, now.n0), now.d])
        components = axes @ (omegadot - np.cross(frame, now.omega))
        assert_allclose(rates[5:8], components, atol=tolerance * (1 + np.abs(components).max()))
        if regime != "rolling":
            a = a - now.u_acceleration  # past the table
            assert_allclose(rates[8:10], a[:2], atol=tolerance * (1 + np.abs(a).max()))


@pytest.mark.parametrize(
    ("name", "tolerance"),
    [(name, 1e-6 if name == "friction" else 2e-9) for name in EFFECTS],
)
def test_motion_agrees_with_the_world_vector_integration(name, tolerance):
    """Tolerances: accumulated errors of two integrators at 1e-11; with k_z, its sign smoothed over 0.01 rad/s."""
    model, oracle = pair(name)
    state = rolling.steady_precession(np.radians(18), MA_2014, omega3=1.5, nutation_amplitude=np.radians(2), psi=0.3)
    times = np.linspace(0, 0.25, 26)
    motion = rolling.simulate(model, state, times=times)
    solution = newton_euler.follow(oracle, newton_euler.state_from_angles(oracle, *state.array), times)
    expected = newton_euler.coordinates(oracle, solution.y)
    assert_allclose(motion.q[:, :3], expected[:, :3], atol=tolerance)
    assert_allclose(motion.q[:, 3:], expected[:, 3:], atol=tolerance * 30)


@pytest.mark.statistical
def test_a_table_that_gives_way_follows_the_load_of_the_rigid_one():
    """The oracle's table moves as the load on a rigid one would let it sink: the same to first order in c."""
    effects = (CATALOGUE["km"](k_m=4e-8), CATALOGUE["centre_of_mass"](c_1=1e-3, c_2=-5e-4, c_3=3e-4))
    rigid = Model(MA_2014, effects=effects)
    start = rolling.steady_precession(np.radians(18), MA_2014, omega3=1.5, nutation_amplitude=np.radians(2), psi=0.3)
    options = {"laws": [newton_euler.precession_friction(4e-8)], "com_body": (1e-3, -5e-4, 3e-4)}
    oracle = newton_euler.Disc(MA_2014.radius, MA_2014.half_thickness, MA_2014.mass, **options)
    fine = np.linspace(0, 0.25, 1001)
    state = newton_euler.state_from_angles(oracle, *start.array)
    q = lambda d, s: newton_euler.coordinates(d, newton_euler.follow(d, s, fine[::40]).y)  # noqa: E731
    of_rigid = q(oracle, state)
    for c in (1e-7, 1e-6):
        oracle.gives_way = c
        oracle.table = newton_euler.yielding(oracle, state, fine)
        sunk = newton_euler.state_from_angles(oracle.at(0.0), *start.array)
        expected = q(oracle, sunk) - of_rigid
        model = rigid.with_effects(CATALOGUE["table_yielding"](c=c))
        found = rolling.simulate(model, start, times=fine[::40]).q - rolling.simulate(rigid, start, times=fine[::40]).q
        size = np.abs(expected).max(axis=0)
        assert (size[:3] > c).all()
        assert (np.abs(found - expected).max(axis=0) < 1500 * c * size).all()  # second order: 9e-5 and 9e-4
    derivative = rolling.sensitivities(rigid, start, fine[::40], ["table_yielding.c"], components=[])
    assert (np.abs(derivative.dq[..., 0] * c - expected).max(axis=0) < 1500 * c * size).all()


class _Creeping(newton_euler.Disc):
    """A disc that slips all the time, on a film: friction in proportion to the speed of slip."""

    c = 1.0

    def moved(self, state):
        self.mu = np.linalg.norm(newton_euler.Instant(self, state).v_contact) / self.c
        return self


@pytest.mark.statistical
@pytest.mark.parametrize(
    ("c", "film", "least", "most"), [(1e-3, 2e-3, 0.0, 1e-4), (0.02, 1.0, 0.01, 0.025), (0.02, 2e-3, 0.0, 1e-3)]
)
def test_a_contact_that_creeps_is_one_that_slips_on_a_film(c, film, least, most, monkeypatch):
    """The oracle slips with its inertia; ours follows the force by a series, for which c beyond `film` is too fast."""
    monkeypatch.setattr(_assembly, "FILM", film)
    effects = (CATALOGUE["km"](k_m=4e-8), CATALOGUE["centre_of_mass"](c_1=1e-3, c_2=-5e-4, c_3=3e-4))
    rigid = Model(MA_2014, effects=effects)
    start = rolling.steady_precession(np.radians(16), MA_2014, omega3=1.5, nutation_amplitude=np.radians(1), psi=0.3)
    options = {"laws": [newton_euler.precession_friction(4e-8)], "com_body": (1e-3, -5e-4, 3e-4)}
    oracle = _Creeping(MA_2014.radius, MA_2014.half_thickness, MA_2014.mass, **options)
    oracle.c = c
    state = newton_euler.state_from_angles(oracle, *start.array)
    force = newton_euler.accelerations(oracle, state, "rolling")[2]
    state[7:9] -= c * force[:2] / force[2]
    times = np.linspace(0.0, 0.3, 301)
    slips = lambda t, s: newton_euler.rate(oracle.moved(s), s, "slipping")  # noqa: E731
    solution = solve_ivp(slips, (0.0, times[-1]), state, "LSODA", times, rtol=1e-10, atol=1e-12)
    expected = newton_euler.coordinates(oracle, solution.y)
    settled = 20  # ms, after which the slip follows its force
    now = newton_euler.Instant(oracle, solution.y[:, settled])
    along = (now.omega @ now.n0, now.omega @ np.cross(now.d, now.n0), now.omega @ now.d)
    begin = State(*expected[settled, [0, 1, 3, 4, 5]], *along)
    model = rigid.with_effects(CATALOGUE["creep"](c=c))
    found, without = (rolling.simulate(m, begin, times=times[settled:]) for m in (model, rigid))
    size = np.abs(without.q - expected[settled:]).max(axis=0)
    assert (size[:3] > 2e-4 * c).all()
    error = (np.abs(found.q - expected[settled:]).max(axis=0) / size).max()
    assert least < error < most
    assert_allclose(found.qdot[0, :3], solution.y[7:10, settled], atol=2e-3 * np.linalg.norm(now.v_contact))
    lost = found.energy[-1] - found.energy[0]
    assert lost < 0
    assert_allclose(simpson(found.power, x=found.time), lost, rtol=1e-3)


def test_creep_has_its_derivative_where_nothing_creeps():
    model = Model(MA_2014, effects=(CATALOGUE["km"](k_m=4e-8),))
    start = rolling.steady_precession(np.radians(16), MA_2014, omega3=1.5, nutation_amplitude=np.radians(1), psi=0.3)
    times = np.linspace(0.0, 0.3, 31)
    c = 1e-7
    creeping = model.with_effects(CATALOGUE["creep"](c=c))
    moved = rolling.simulate(creeping, start, times=times).q - rolling.simulate(model, start, times=times).q
    size = np.abs(moved).max(axis=0)
    found = rolling.sensitivities(model, start, times, ["creep.c"], components=[]).dq[..., 0] * c
    assert (size > 0).all()
    assert (np.abs(found - moved).max(axis=0) < 1e-3 * size).all()


def test_accelerations_of_the_motion_are_the_second_derivatives_of_its_poses():
    model, _ = pair("body")
    state = rolling.steady_precession(np.radians(18), MA_2014, omega3=1.5, nutation_amplitude=np.radians(2))
    h_ = 1e-4
    motion = rolling.simulate(model, state, 0.02, rate=1 / h_)
    second = (motion.q[2:, :3] - 2 * motion.q[1:-1, :3] + motion.q[:-2, :3]) / h_**2
    # truncation h^2/12 q'''' with rates of 50 1/s: 1e-9 x 6e6 x 0.01 m = 5e-5; rounding 1e-17/1e-8
    assert_allclose(motion.acceleration_world[1:-1], second, atol=1e-3)
    turn = (motion.omega_world[2:] - motion.omega_world[:-2]) / (2 * h_)
    assert_allclose(motion.angular_acceleration_world[1:-1], turn, atol=0.05)


def test_free_flight_is_a_parabola_and_a_free_top():
    state = State(0.1, 0.2, 0.3, 1.0, 0.4, 3.0, 8.0, 5.0, v_x=0.4, v_y=-0.2, z=0.3, v_z=0.5)
    times = np.linspace(0, 0.2, 41)
    motion = rolling.simulate(Model(MA_2014), state, times=times)
    assert motion.end is rolling.EndReason.TIME
    expected = free_flight.centre(np.array([0.1, 0.2, 0.3]), np.array([0.4, -0.2, 0.5]), np.array([0, 0, -9.81]), times)
    assert_allclose(motion.q[:, :3], expected, atol=1e-12)
    R0 = newton_euler.matrix_of(newton_euler.quaternion_from_angles(0.3, 1.0, 0.4))
    R = free_flight.symmetric_top(R0, motion.omega_world[0], MA_2014.moment_diametral, MA_2014.moment_axial, times)
    for angles, expected_R in zip(motion.q[:, 3:], R, strict=True):
        found = newton_euler.matrix_of(newton_euler.quaternion_from_angles(*angles))
        assert_allclose(found, expected_R, atol=1e-10)
    assert not motion.contact_force.any()
