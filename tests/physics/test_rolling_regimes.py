"""Slip, stick, loss of contact and the other ends of a motion; a disc on its edge that a ball hits."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import simpson

from disctrack import rolling
from disctrack.disc import MA_2014
from disctrack.rolling import CATALOGUE, EndReason, Model, Regime, State, steady_precession, struck_disc
from tests.oracles import newton_euler


def slippery(mu, *effects):
    return Model(MA_2014, effects=(*effects, CATALOGUE["slip"](mu=mu)))


def sliding_start():
    """A disc at 40 deg whose centre moves 0.3 m/s too fast for rolling."""
    rolling_state = steady_precession(np.radians(40), MA_2014, nutation_amplitude=0.05)
    qdot = rolling.simulate(Model(MA_2014), rolling_state, times=[0.0]).qdot[0]
    return rolling_state.moved(v_x=qdot[0] + 0.3, v_y=qdot[1] - 0.1)


def test_slip_opposes_the_sliding_velocity_and_lies_on_the_cone():
    motion = rolling.simulate(slippery(0.3), sliding_start(), 0.3, rate=4000)
    slipping = motion.regime == Regime.SLIPPING
    assert slipping[0]
    F, v = motion.contact_force[slipping], motion.slip_velocity[slipping]
    assert_allclose(np.hypot(F[:, 0], F[:, 1]), 0.3 * F[:, 2], rtol=1e-12)
    speed = np.hypot(*v.T)
    assert_allclose(np.sum(F[:, :2] * v, axis=1), -0.3 * F[:, 2] * speed, rtol=1e-9)
    rolls = motion.regime == Regime.ROLLING
    assert (motion.friction_needed[rolls] <= 0.3).all()
    assert (motion.slip_velocity[rolls] == 0).all()


def test_slip_ends_where_an_independent_integration_ends_it_and_rolling_goes_on():
    state, mu = sliding_start(), 0.35
    motion = rolling.simulate(slippery(mu), state, 0.15)
    assert [s.after for s in motion.switches] == [Regime.ROLLING]
    oracle = newton_euler.Disc(mu=mu)
    start = newton_euler.state_from_angles(oracle, *state.array[:8], velocity=state.array[8:])

    def slip_left(t, y):
        return np.linalg.norm(newton_euler.Instant(oracle, y).v_contact) - 1e-6

    slip_left.terminal = True
    slide = newton_euler.follow(oracle, start, [0.0, 0.15], "slipping", events=slip_left)
    stick = slide.t_events[0][0]
    # both stop at a small slip speed, 1e-7 and 1e-6 m/s, with a deceleration of some m/s^2
    assert_allclose(motion.switches[0].time, stick, atol=1e-6)
    rest = newton_euler.follow(oracle, slide.y_events[0][0], [stick, 0.15], "rolling")
    expected = newton_euler.coordinates(oracle, rest.y[:, -1:])[0]
    assert_allclose(motion.q[-1, :3], expected[:3], atol=1e-7)
    assert_allclose(motion.q[-1, 3:], expected[3:], atol=1e-5)


def test_a_table_gives_way_under_a_sliding_disc_too():
    """The oracle's table moves as the load of the slip on a rigid one would let it sink: the same to first order."""
    state, c, times = sliding_start(), 1e-7, np.linspace(0, 0.05, 401)
    oracle = newton_euler.Disc(mu=0.3)
    begin = lambda d: newton_euler.state_from_angles(d.at(0.0), *state.array[:8], velocity=state.array[8:])  # noqa: E731
    q = lambda d: newton_euler.coordinates(d, newton_euler.follow(d, begin(d), times[::40], "slipping").y)  # noqa: E731
    rigid = q(oracle)
    oracle.gives_way = c
    oracle.table = newton_euler.yielding(oracle, begin(oracle), times, "slipping")
    expected = q(oracle) - rigid
    soft = slippery(0.3, CATALOGUE["table_yielding"](c=c))
    motions = [rolling.simulate(model, state, times=times[::40]) for model in (soft, slippery(0.3))]
    assert all((motion.regime == Regime.SLIPPING).all() for motion in motions)
    found = motions[0].q - motions[1].q
    size = np.abs(expected).max(axis=0)
    assert (size[:3] > 0.05 * c).all()
    assert (np.abs(found - expected).max(axis=0) < 0.01 * size).all()  # friction's direction is held for 0.1 ms


def test_a_stiff_table_does_not_change_when_the_disc_slips():
    """Sinking by a nanometre moves switches by microseconds, and slip that has just begun is no harder to follow."""
    state = steady_precession(np.radians(20), MA_2014, omega3=1.0, nutation_amplitude=np.radians(0.5), psi=0.5, phi=1.0)
    stiff = slippery(0.1, CATALOGUE["km"](), CATALOGUE["table_yielding"](c=1e-8))
    motions = [rolling.simulate(m, state, 0.3) for m in (slippery(0.1, CATALOGUE["km"]()), stiff)]
    switches = [np.array([s.time for s in motion.switches]) for motion in motions]
    assert len(switches[0]) > 2
    assert_allclose(switches[1], switches[0], atol=1e-5)
    found = rolling.sensitivities(stiff, state, [0.0, 0.15, 0.3], ["table_yielding.c"], components=[])
    assert_allclose(found.dq[:, :3, 0] * 1e-8, (motions[1].q - motions[0].q)[[0, 150, 300], :3], atol=1e-12, rtol=0.02)
    assert found.slip_steps < 30_000  # of two runs


def test_slip_starts_when_rolling_needs_more_than_the_cone_and_energy_falls_by_its_work():
    state = steady_precession(np.radians(50), MA_2014, nutation_amplitude=np.radians(12), nutation_phase=0.5)
    free = rolling.simulate(Model(MA_2014), state, 0.3)
    mu = 0.85 * free.friction_needed.max()
    assert free.friction_needed[0] < mu
    motion = rolling.simulate(slippery(mu), state, 0.3, rate=8000)
    assert motion.switches[0].before is Regime.ROLLING
    assert motion.switches[0].after is Regime.SLIPPING
    assert len(motion.switches) > 1
    before = motion.time < motion.switches[0].time
    assert_allclose(motion.energy[before], motion.energy[0], rtol=1e-11)
    lost = motion.energy[-1] - motion.energy[0]
    assert lost < 0
    # the power has kinks at the switches: Simpson's rule errs there by (1/8 ms)^2 x slope
    assert_allclose(simpson(motion.power, x=motion.time), lost, rtol=1e-3)


@pytest.fixture
def jump():
    """A disc flung upwards about its edge so fast that the table would have to pull."""
    return State(theta=np.radians(30), thetadot=35.0, omega2=10.0, omega3=1.0)


def test_contact_is_lost_where_the_table_would_have_to_pull_and_the_flight_keeps_energy_and_momentum(jump):
    motion = rolling.simulate(Model(MA_2014), jump, 0.5, rate=4000)
    assert motion.switches[0].after is Regime.FLYING
    flying = motion.regime == Regime.FLYING
    assert flying.sum() > 10
    assert_allclose(motion.energy, motion.energy[0], rtol=1e-10)
    assert_allclose(motion.acceleration_world[flying], np.tile([0, 0, -9.81], (flying.sum(), 1)), atol=1e-12)
    gap = motion.q[:, 2] - MA_2014.radius * np.sin(motion.q[:, 4]) - MA_2014.half_thickness * np.cos(motion.q[:, 4])
    assert_allclose(gap[~flying], 0, atol=1e-15)
    assert (gap[flying] >= -1e-12).all()
    assert gap.max() > 1e-4
    assert motion.end in (EndReason.LANDED, EndReason.UPRIGHT)
    assert (motion.contact_force[~flying, 2] > 0).all()


def test_every_end_has_its_reason():
    model = Model(MA_2014, effects=(CATALOGUE["km"](k_m=1e-6),))
    state = steady_precession(np.radians(8), MA_2014)
    assert rolling.simulate(model, state, 0.01).end is EndReason.TIME
    stopped = rolling.simulate(model, state, 1.0, theta_end=np.radians(2))
    assert stopped.end is EndReason.NUTATION
    assert_allclose(stopped.end_state[3], np.radians(2), atol=1e-12)
    assert stopped.time[-1] <= stopped.end_time < stopped.time[-1] + 1e-3
    upright = rolling.simulate(Model(MA_2014), State(theta=np.radians(80), thetadot=9.0), 1.0)
    assert upright.end is EndReason.UPRIGHT
    assert_allclose(upright.end_state[3], np.pi / 2, atol=1e-12)


def test_end_time_does_not_depend_on_the_output_rate():
    model = Model(MA_2014, effects=(CATALOGUE["km"](),))
    state = steady_precession(np.radians(4), MA_2014)
    ends = [rolling.simulate(model, state, 2.0, rate=rate).end_time for rate in (10.0, 333.0, 5000.0)]
    assert_allclose(ends, ends[0], atol=1e-10)


def random_model(rng):
    names = [str(n) for n in rng.choice([n for n in CATALOGUE if n != "slip"], size=rng.integers(0, 4), replace=False)]
    effects = []
    for name in names:
        scale = 10 ** rng.uniform(-1, 1.5)
        values = {p.name: float(np.clip(p.nominal * scale, p.lower, p.upper)) for p in CATALOGUE[name].parameters}
        effects.append(CATALOGUE[name](**values))
    return slippery(rng.uniform(0.05, 0.5), *effects)


def test_any_model_from_any_state_ends_with_a_reason_and_finite_numbers(rng):
    for _ in range(60):
        theta = np.radians(10 ** rng.uniform(0, 1.9))
        psidot = rng.uniform(-1.5, 1.5) * np.sqrt(4 * 9.81 / 0.0375 / np.sin(theta))
        state = State(theta=theta, thetadot=rng.normal(), omega2=psidot * np.sin(theta), omega3=3 * rng.normal())
        if rng.random() < 0.5:
            state = state.moved(v_x=0.3 * rng.normal(), v_y=0.0)
        motion = rolling.simulate(random_model(rng), state, 0.3)
        assert motion.end not in (EndReason.FAILED, EndReason.CHATTER)
        assert len(motion) > 0
        assert (motion.contact_force[motion.regime != Regime.FLYING, 2] >= 0).all()
        for values in (motion.q, motion.qdot, motion.energy, motion.contact_force, motion.acceleration_world):
            assert np.isfinite(values).all()


def test_velocity_that_happens_to_be_that_of_rolling_starts_rolling():
    state = steady_precession(np.radians(20), MA_2014)
    v = rolling.simulate(Model(MA_2014), state, times=[0.0]).qdot[0]
    motion = rolling.simulate(slippery(0.3), state.moved(v_x=v[0], v_y=v[1]), 0.1)
    assert motion.switches[0].time == 0.0
    assert (motion.regime == Regime.ROLLING).all()


def test_a_motion_over_at_its_start_has_its_first_instant():
    motion = rolling.simulate(Model(MA_2014), State(theta=np.pi / 2, thetadot=1.0), 0.1)
    assert motion.end is EndReason.UPRIGHT
    assert len(motion) == 1
    assert motion.q[0, 4] == np.pi / 2


def test_motion_does_not_depend_on_the_tolerance():
    """A hundred times finer tolerance moves slip, its end and the rolling after it by 1e-9 m and 1e-7 rad at most."""
    model = slippery(0.25, CATALOGUE["km"](), CATALOGUE["kz"](k_z=6e-5))
    coarse, fine = (rolling.simulate(model, sliding_start(), 0.4, rtol=rtol) for rtol in (1e-10, 1e-12))
    assert_allclose(coarse.q[:, :3], fine.q[:, :3], atol=1e-9)
    assert_allclose(coarse.q[:, 3:], fine.q[:, 3:], atol=1e-7)


def test_enough_friction_never_slips():
    state = steady_precession(np.radians(40), MA_2014, nutation_amplitude=0.02)
    free = rolling.simulate(Model(MA_2014), state, 0.2)
    motion = rolling.simulate(slippery(1.05 * free.friction_needed.max()), state, 0.2)
    assert motion.switches == ()
    assert_allclose(motion.q, free.q, atol=1e-12)


TABLE_1 = [(0.020, 0.0105), (0.010, 0.0175), (0.020, 0.0175), (0.020, 0.0225)]


@pytest.mark.parametrize(("a", "b"), TABLE_1)
@pytest.mark.parametrize("friction", [0.0, 0.2])
def test_impact_balances_momentum_and_the_edge_does_not_go_down(a, b, friction):
    P, psi = 0.05, 0.6
    state = struck_disc(MA_2014, a, b, P, friction=friction, psi=psi)
    m, r, h = MA_2014.mass, MA_2014.radius, MA_2014.half_thickness
    e1, e2, e3 = (
        np.array([np.cos(psi), np.sin(psi), 0]),
        np.array([0, 0, 1.0]),
        np.array([np.sin(psi), -np.cos(psi), 0]),
    )
    motion = rolling.simulate(Model(MA_2014, effects=(CATALOGUE["slip"](mu=0.2),)), state, times=[0.0, 1e-6])
    v, omega = motion.qdot[0, :3], motion.omega_world[0]
    from_table = m * v + P * e3
    moment = MA_2014.moment_diametral * (omega @ e1 * e1 + omega @ e2 * e2) + MA_2014.moment_axial * omega @ e3 * e3
    from_ball = np.cross(a * e1 + b * e2 + h * e3, -P * e3)
    arm = -r * e2 - h * e3
    assert_allclose(moment, from_ball + np.cross(arm, from_table), atol=1e-12)
    edge = v + np.cross(omega, arm)
    assert edge[2] >= -1e-12
    assert from_table[2] >= 0
    tangential = from_table - from_table[2] * e2
    assert_allclose(np.linalg.norm(tangential), friction * from_table[2], atol=1e-10)
    if friction:
        assert tangential @ edge < 0


def test_struck_disc_slips_first_and_rolls_later_while_energy_falls():
    model = Model(MA_2014, effects=(CATALOGUE["km"](), CATALOGUE["slip"](mu=0.1)))
    state = struck_disc(MA_2014, 0.020, 0.0105, 0.05, friction=0.1, x=0.03)
    motion = rolling.simulate(model, state, 3.0)
    assert motion.regime[0] == Regime.SLIPPING
    assert motion.regime[-1] == Regime.ROLLING
    assert motion.end is EndReason.TIME
    assert (np.diff(motion.energy) < 1e-12).all()
    assert motion.q[0, 4] == np.pi / 2
    assert motion.q[-1, 4] < np.radians(50)
