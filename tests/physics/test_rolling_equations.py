"""The equations of motion against those of world vectors, in which nothing is eliminated and no angle occurs."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import simpson

from disctrack import rolling
from disctrack.disc import MA_2014
from disctrack.rolling import CATALOGUE, Model, Regime, State
from disctrack.rolling.simulate import Assembly
from tests.oracles import newton_euler


def random_state(rng, theta=None):
    theta = np.radians(rng.uniform(0.5, 85)) if theta is None else theta
    v = rng.normal(size=8)
    psidot = rng.normal() * 12 / np.sqrt(np.sin(theta))
    return State(v[0], v[1], *rng.uniform(-7, 7, 1), theta, v[4] * 3, v[5] * 3, psidot * np.sin(theta), v[7] * 5)


def nutating(theta_deg, amplitude_deg):
    theta, amplitude = np.radians([theta_deg, amplitude_deg])
    return rolling.steady_precession(theta, MA_2014, omega3=1.5, nutation_amplitude=amplitude).moved(psi=0.3)


COM = (1e-3, -5e-4, 3e-4)
COM_EFFECT = {"centre_of_mass": dict(zip(("c_1", "c_2", "c_3"), COM, strict=True))}
COSINE, SINE = np.array([0.3, -0.2, 0.5]), np.array([0.7, 0.4, -0.1])
VIBRATION = newton_euler.vibration(COSINE, SINE, 60.0)
SPRING = newton_euler.spring(0.8, (0.05, -0.03))
K_M = {"km": {"k_m": 4e-8}}
KM_LAW = newton_euler.precession_friction(4e-8)


def swinging(letter, scale=1.0):
    """Parameters of an effect that swings, with letter a or u."""
    parts = (("cos", COSINE), ("sin", SINE))
    named = {
        f"{letter}_{part}_{axis}": scale * v for part, vector in parts for axis, v in zip("xyz", vector, strict=True)
    }
    return named | {"frequency": 60.0}


def same(effects, contact=(), anywhere=(), **options):
    """In the product and in the oracle: effects; laws of its contact, laws that act in the air, too, its options."""
    return effects, [*contact], [*anywhere], options


TILTED = np.array([0.03, -0.02, -np.sqrt(1 - 0.03**2 - 0.02**2)])
EFFECTS = {
    "ideal": same({}),
    "friction": same(
        {**K_M, "kn": {"k_n": 1e-6}, "kz": {"k_z": 1e-4}, "rolling_classical": {"delta": 1e-4},
         "rolling_adhesive": {"a": 1e-4}},
        [KM_LAW, newton_euler.nutation_friction(1e-6), newton_euler.pivoting_friction(1e-4),
         newton_euler.classical_rolling_friction(1e-4), newton_euler.adhesive_rolling_friction(1e-4)],
    ),
    "forces": same(
        {"drag_linear": {"c": 0.02}, "table_tilt": {"tilt_x": 0.03, "tilt_y": -0.02}, "air_moffatt": {"f": 3.0},
         "spring": {"k": 0.8, "F_x": 0.04, "F_y": -0.024}, "table_vibration": swinging("a")},
        [newton_euler.moffatt(3 * 1.81e-5)],
        [newton_euler.linear_drag(0.02), SPRING, VIBRATION],
        gravity=9.81 * TILTED,
    ),
    "vibrating with its cameras": same(
        {"table_vibration": swinging("a"), **COM_EFFECT}, anywhere=[VIBRATION], com_body=COM
    ),
    "hollow": same(
        {"table_curved": {"kappa": 0.8, "slope_x": 0.03, "slope_y": -0.02}, **COM_EFFECT, **K_M},
        [KM_LAW], com_body=COM, bowl=(TILTED * [1, 1, -1] / 0.8, 1 / 0.8),
    ),
    "out of round": same(
        {"rim": {"oval_c": 3e-4, "oval_s": -2e-4, "lobes_c": 1e-4, "lobes_s": 1.5e-4}, **K_M},
        [KM_LAW], waves=((2, 3e-4, -2e-4), (3, 1e-4, 1.5e-4)),
    ),
    "thin air": same(
        {"air": {"density": 0.1}, "air_bildsten": {"beta": 3.0}, "air_quadratic": {"a": 5.0}},
        [newton_euler.bildsten(3.0, 0.12)], [newton_euler.quadratic_air(5.0, 0.12)],
    ),
    "flat": same(
        {"rim_flat": {"depth": 2e-4, "angle": 0.7, "width": 0.15}, **K_M}, [KM_LAW], dips=((2e-4, 0.7, 0.15),)
    ),
    "shaken": same(
        {"table_shaken": swinging("u", 1e-5), **COM_EFFECT},
        table=newton_euler.swing(1e-5 * COSINE, 1e-5 * SINE, 60.0), com_body=COM,
    ),
    "settles": same(
        {"table_settles": {"v_z": -2e-3, "a_z": 5e-2}, **COM_EFFECT},
        table=newton_euler.settling(-2e-3, 5e-2), com_body=COM,
    ),
    "turntable": same(
        {"surface_moves": {"v_x": 0.02, "v_y": -0.01, "rate": 0.8}, **COM_EFFECT},
        carries=(np.array([0.02, -0.01, 0.0]), 0.8), com_body=COM,
    ),
    "body": same(
        {**COM_EFFECT, "inertia_product": {"J_13": 1.5e-6, "J_23": -3e-6}, "edge_radius": {"rho": 5e-4},
         "inertia_axial": {"e": 0.05}, "inertia_diametral": {"e": -0.03}, "contact_radius": {"r_error": 1e-3},
         "contact_height": {"h_error": -2e-4}, "gravity": {"g_error": 0.5}},
        r=MA_2014.radius + 1e-3, h=MA_2014.half_thickness - 2e-4, gravity=(0, 0, -10.31), com_body=COM, edge=5e-4,
        J_body=np.diag(MA_2014.moment_diametral * np.array([0.97, 0.97, 0]) + [0, 0, 1.05 * MA_2014.moment_axial])
        + np.array([[0, 0, 1.5e-6], [0, 0, -3e-6], [1.5e-6, -3e-6, 0]]),
    ),
}  # fmt: skip


def model_with(effects):
    return Model(MA_2014, effects=tuple(CATALOGUE[n](**v) for n, v in effects.items()))


def pair(name, in_the_air=False):
    """Model and oracle; contact laws do nothing in the air."""
    effects, contact, anywhere, options = EFFECTS[name]
    return model_with(effects), newton_euler.Disc(**options, laws=anywhere if in_the_air else contact + anywhere)


@pytest.mark.parametrize("name", EFFECTS)
@pytest.mark.parametrize("regime", ["rolling", "slipping", "flying"])
def test_accelerations_and_forces_agree_with_the_world_vector_system(name, regime, rng):
    model, oracle = pair(name, in_the_air=regime == "flying")
    model = model.with_effects(CATALOGUE["slip"](mu=0.3))
    oracle.mu = 0.3
    for _ in range(20):
        state = random_state(rng)
        if name == "hollow":  # within it, and steeper than its sides
            state = random_state(rng, np.radians(rng.uniform(12, 85)))
            state = state.moved(x=0.05 * state.x, y=0.05 * state.y)
        velocity = None if regime == "rolling" else rng.normal(size=2)
        start = newton_euler.state_from_angles(oracle, state.array, velocity)
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


@pytest.mark.parametrize("name", EFFECTS)
def test_motion_agrees_with_the_world_vector_integration(name):
    """Tolerances: accumulated errors of two integrators at 1e-11; with k_z, its sign smoothed over 0.01 rad/s."""
    tolerance = 1e-6 if name == "friction" else 2e-9
    model, oracle = pair(name)
    state = nutating(18, 2)
    times = np.linspace(0, 0.25, 26)
    motion = rolling.simulate(model, state, times=times)
    solution = newton_euler.follow(oracle, newton_euler.state_from_angles(oracle, state.array), times)
    expected = newton_euler.coordinates(oracle, solution.y)
    assert_allclose(motion.q[:, :3], expected[:, :3], atol=tolerance)
    assert_allclose(motion.q[:, 3:], expected[:, 3:], atol=tolerance * 30)


@pytest.mark.statistical
@pytest.mark.parametrize(("slip", "c"), [((), 1e-7), ((), 1e-6), ((0.3, -0.1), 1e-7)])
def test_a_table_that_gives_way_follows_the_load_of_the_rigid_one(slip, c):
    """The oracle's table moves as the load on a rigid one would let it sink: the same to first order in c."""
    rigid, oracle = model_with(K_M | COM_EFFECT), newton_euler.Disc(laws=[KM_LAW], com_body=COM)
    start = nutating(18, 2)
    regime, fine, most = "rolling", np.linspace(0, 0.25, 1001), 1500 * c  # second order: 9e-5 and 9e-4
    if slip:  # friction's direction is held for 0.1 ms
        v_x, v_y = rolling.simulate(rigid, start, times=[0.0]).qdot[0, :2] + slip
        start, rigid, oracle.mu = start.moved(v_x=v_x, v_y=v_y), rigid.with_effects(CATALOGUE["slip"](mu=0.3)), 0.3
        regime, fine, most = "slipping", fine[:201], 0.01
    begin = lambda: newton_euler.state_from_angles(oracle.at(0.0), start.array[:8], start.array[8:] if slip else None)  # noqa: E731
    q = lambda: newton_euler.coordinates(oracle, newton_euler.follow(oracle, begin(), fine[::40], regime).y)  # noqa: E731
    of_rigid = q()
    oracle.gives_way = c
    oracle.table = newton_euler.yielding(oracle, begin(), fine, regime)
    expected = q() - of_rigid
    soft = rigid.with_effects(CATALOGUE["table_yielding"](c=c))
    found, without = (rolling.simulate(model, start, times=fine[::40]) for model in (soft, rigid))
    assert (found.regime == Regime[regime.upper()]).all()
    size = np.abs(expected).max(axis=0)
    assert (size[:3] > 0.02 * c).all()
    assert (np.abs(found.q - without.q - expected).max(axis=0) < most * size).all()
    if not slip:
        derivative = rolling.sensitivities(rigid, start, fine[::40], ["table_yielding.c"], components=[])
        assert (np.abs(derivative.dq[..., 0] * c - expected).max(axis=0) < 1500 * c * size).all()


@pytest.mark.statistical
@pytest.mark.parametrize(("c", "most"), [(1e-3, 1e-4), (0.02, 1e-3)])
def test_a_contact_that_creeps_is_one_that_slips_on_a_film(c, most):
    """The oracle slips with its inertia; ours follows the force by a series, by which 0.02 would err by a per cent."""
    rigid = model_with(K_M | COM_EFFECT)
    start = nutating(16, 1)
    oracle = newton_euler.Disc(laws=[KM_LAW], com_body=COM, friction=lambda speed: speed / c)
    state = newton_euler.state_from_angles(oracle, start.array)
    force = newton_euler.accelerations(oracle, state, "rolling")[2]
    state[7:9] -= c * force[:2] / force[2]
    times = np.linspace(0.0, 0.3, 301)
    solution = newton_euler.follow(oracle, state, times, "slipping", rtol=1e-10, method="LSODA")
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
    assert error < most
    assert_allclose(found.qdot[0, :3], solution.y[7:10, settled], atol=2e-3 * np.linalg.norm(now.v_contact))
    lost = found.energy[-1] - found.energy[0]
    assert lost < 0
    assert_allclose(simpson(found.power, x=found.time), lost, rtol=1e-3)


def test_accelerations_of_the_motion_are_the_second_derivatives_of_its_poses():
    model, _ = pair("body")
    state = nutating(18, 2)
    h_ = 1e-4
    motion = rolling.simulate(model, state, 0.02, rate=1 / h_)
    second = (motion.q[2:, :3] - 2 * motion.q[1:-1, :3] + motion.q[:-2, :3]) / h_**2
    # truncation h^2/12 q'''' with rates of 50 1/s: 1e-9 x 6e6 x 0.01 m = 5e-5; rounding 1e-17/1e-8
    assert_allclose(motion.acceleration_world[1:-1], second, atol=1e-3)
    turn = (motion.omega_world[2:] - motion.omega_world[:-2]) / (2 * h_)
    assert_allclose(motion.angular_acceleration_world[1:-1], turn, atol=0.05)
