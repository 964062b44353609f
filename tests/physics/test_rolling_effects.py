"""Effects: passive ones take energy, their sizes are the published ones, and a new one is one small class."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from disctrack import Model, State, rolling, steady_precession
from disctrack.disc import MA_2014
from disctrack.errors import ArgumentError, ModelError
from disctrack.rolling import CATALOGUE, EffectParameter, sensitivities, struck_disc
from disctrack.rolling.effects.base import catalogue_table, effect
from disctrack.rolling.effects.learned import effect_from_formulas
from disctrack.rolling.equations import FLYING
from disctrack.rolling.motion import effect_power, effect_wrench
from disctrack.rolling.simulate import Assembly

MOVES_THE_TABLE = ("table_shaken", "table_settles")  # and exerts nothing in its axes
LAWS = [name for name, effect in CATALOGUE.items() if effect.law is not None and name not in MOVES_THE_TABLE]
PASSIVE = [name for name in LAWS if name not in ("spring", "table_vibration")]  # which give back what they take
COUNTER_ROTATING = ("km", "rolling_power", "air_moffatt", "air_bildsten")  # they read psidot and work on phidot


def instants(q, qdot):
    """All that laws read at coordinates and rates (n, 6), whatever the velocity of the centre: as in the air."""
    (x, y, z, psi, theta, phi), (v_x, v_y, v_z, psidot, thetadot, phidot) = q.T, qdot.T
    omega = thetadot, psidot * np.sin(theta), psidot * np.cos(theta) + phidot
    states = np.stack([x, y, psi, theta, phi, *omega, v_x, v_y, z, v_z], axis=-1)
    return Assembly(Model(MA_2014), 0.0).at(FLYING, np.zeros(len(q)), states)[2].view(np.recarray)


def random_motion(rng, n, counter_rotating):
    theta = np.radians(rng.uniform(0.5, 89, n))
    q = np.column_stack([rng.normal(size=(n, 2)), theta, rng.uniform(-9, 9, n), theta, rng.uniform(-9, 9, n)])
    qdot = rng.normal(size=(n, 6)) * [1, 1, 1, 100, 10, 100]
    if counter_rotating:
        qdot[:, 5] = -np.sign(qdot[:, 3]) * np.abs(qdot[:, 5])
    return instants(q, qdot)


def largest_power(effect, rng):
    motion = random_motion(rng, 2000, effect.name in COUNTER_ROTATING)
    load = rng.uniform(0, 10, 2000)
    return effect_power(effect, motion, load).max()


@pytest.mark.parametrize("name", PASSIVE)
def test_a_passive_effect_never_feeds_energy(name, rng):
    assert largest_power(CATALOGUE[name](), rng) <= 1e-15


def test_a_law_of_the_wrong_sign_is_noticed(rng):
    effect = CATALOGUE["kz"](k_z=1e-5)
    effect.values["k_z"] = -1e-5
    assert largest_power(effect, rng) > 1e-4


def test_laws_that_read_psidot_but_work_on_phidot_say_so(rng):
    """Without the restriction to psidot phidot < 0 their power has both signs."""
    for name in COUNTER_ROTATING:
        assert effect_power(CATALOGUE[name](), random_motion(rng, 500, False), np.full(500, 2.0)).max() > 0


@pytest.mark.parametrize("name", LAWS)
def test_every_amount_of_a_passive_effect_is_bounded_below_by_zero(name):
    effect = CATALOGUE[name]
    for parameter in effect.parameters:
        assert parameter.unit
        assert parameter.meaning
        if name in PASSIVE:
            assert parameter.lower >= 0
            with pytest.raises(ModelError, match="outside"):
                effect(**{parameter.name: -1.0})


# Power at nominal size over that of k_m = 0.381e-7 m s^2, steady precession with the centre at rest, 20/8/2/0.5 deg.
POWER_SHARES = {
    "kz": (0.038, 0.008, 0.001, 0.0002),
    "contour_dry": (0.98, 1.00, 1.01, 1.01),
    "contour_viscous": (0.009, 0.015, 0.030, 0.060),
    "rolling_classical": (0.084, 0.035, 0.009, 0.002),
    "rolling_viscous": (0.147, 0.041, 0.005, 0.001),
    "pivoting_viscous": (0.31, 0.02, 0.001, 0.0001),
    "air_moffatt": (0.0015, 0.006, 0.046, 0.36),
    "air_bildsten": (0.046, 0.090, 0.26, 0.72),
    "air_quadratic": (0.015, 0.002, 0.0001, 0.0),
}


@pytest.mark.parametrize("name", POWER_SHARES)
def test_power_relative_to_the_published_rolling_friction(name):
    for theta_deg, share in zip((20, 8, 2, 0.5), POWER_SHARES[name], strict=True):
        theta = np.radians(theta_deg)
        state = steady_precession(theta, MA_2014)
        z = MA_2014.radius * np.sin(theta) + MA_2014.half_thickness * np.cos(theta)
        phidot = state.omega3 - state.omega2 / np.tan(theta)
        motion = instants(np.array([[0, 0, z, 0, theta, 0]]), np.array([[0, 0, 0, state.psidot, 0, phidot]]))
        load = [MA_2014.mass * 9.81]
        power = effect_power(CATALOGUE[name](), motion, load) / effect_power(CATALOGUE["km"](), motion, load)
        digits = len(f"{share:g}".split(".")[-1]) if share else 4
        assert_allclose(power, share, atol=1.01 * 10.0**-digits)  # the table is rounded or cut


@pytest.mark.parametrize("name", LAWS)
def test_compiled_law_equals_the_law_in_numpy(name, rng):
    model = Model(MA_2014, effects=(CATALOGUE[name](),))
    state = steady_precession(np.radians(20), MA_2014, omega3=2.0, nutation_amplitude=0.05)
    motion = rolling.simulate(model, state, 0.05)
    moment, force = effect_wrench(CATALOGUE[name](), motion.instants, motion.contact_force[:, 2])
    assert_allclose(motion.contact_moment, moment, rtol=1e-9, atol=1e-20)
    assert_allclose(motion.external_force, force, rtol=1e-9, atol=1e-20)
    assert np.abs(motion.contact_moment).max() + np.abs(motion.external_force).max() > 0


@pytest.mark.statistical
def test_a_new_effect_is_one_small_function():
    @effect("magnetic brake", "this test", EffectParameter("b", "N m s", 1e-6, "moment per rate", lower=0.0))
    def test_magnet(p, s, w):
        """Moment about the vertical that falls with the distance from the origin: in no list but this test's."""
        w.M_z -= p.b * s.omega_z * np.exp(-(s.x * s.x + s.y * s.y) / 1e-4)

    try:
        assert largest_power(test_magnet(), np.random.default_rng(1)) <= 0
        model = Model(MA_2014, effects=(CATALOGUE["km"](), CATALOGUE["test_magnet"](b=1e-4)))
        state = steady_precession(np.radians(10), MA_2014, omega3=3.0)
        motion = rolling.simulate(model, state, 0.2)
        without = rolling.simulate(model.with_values({"test_magnet.b": 0.0}), state, 0.2)
        assert np.abs(motion.q - without.q).max() > 1e-3
        slope = rolling.sensitivities(model, state, motion.time, ["test_magnet.b"]).dq[-1, 5, -1]
        more = rolling.simulate(model.with_values({"test_magnet.b": 1.001e-4}), state, 0.2)
        less = rolling.simulate(model.with_values({"test_magnet.b": 0.999e-4}), state, 0.2)
        assert_allclose((more.q[-1, 5] - less.q[-1, 5]) / 2e-7, slope, rtol=1e-5)
    finally:
        del CATALOGUE["test_magnet"]


def km(p, s, w):
    w.M_m -= s.psidot


def simulated(theta=0.3, effects=(), times=(0.0, 0.01), **state):
    return rolling.simulate(Model(MA_2014, effects=effects), State(theta=theta, omega2=5.0, **state), times=times)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: CATALOGUE["km"](k=1.0), "no parameter 'k'; it has k_m"),
        (lambda: Model(MA_2014, air_density=-0.1), "a number from 0 to 1000, in kg"),
        (lambda: Model(MA_2014, gravity=-1.0), "expected a number from 0"),
        (lambda: Model(MA_2014).with_values({"km.mu": 1.0}), "no parameter; effect 'km' has k_m"),
        (lambda: Model(MA_2014).with_values({"kx.mu": 1.0}), "there is no effect 'kx'"),
        (lambda: simulated(effects=(CATALOGUE["km"](), CATALOGUE["km"]())), "twice"),
        (lambda: effect("another", "this test")(km), "two effects are called 'km'"),
        (lambda: simulated(v_x=1.0), "the state has v_x: give none for rolling"),
        (lambda: simulated(z=0.1, v_z=0.0), "the state has z, v_z: give none for rolling"),
        (lambda: simulated(v_x=0.0, v_y=0.0, z=0.1), "the state has v_x, v_y, z: give none for rolling"),
        (lambda: simulated(theta=np.radians(0.3)), "outside"),
        (lambda: simulated(times=[0.0, 0.0]), "increasing"),
        (lambda: sensitivities(Model(MA_2014), State(theta=0.3), [0, 1], ["kz.k_x"]), "'kz.k_x' is no .*has k_z"),
        (lambda: sensitivities(Model(MA_2014), State(theta=0.3), [0, 1], ["nothing.x"]), "no effect 'nothing'"),
        (lambda: struck_disc(MA_2014, 0.0, -0.02, 0.05), "hit it higher"),
        (lambda: struck_disc(MA_2014, 0.03, 0.03, 0.05), "outside the face"),
        (lambda: struck_disc(MA_2014, 0.0, 0.02, 0.05, friction=-0.2), "friction of -0.2"),
        (lambda: effect_from_formulas("km", {"M_z": "-c*omega_z"}), "already"),
        (lambda: effect_from_formulas("formula_bad", {"M_z": "__import__('os')"}), "no function __import__"),
        (lambda: effect_from_formulas("formula_bad", {"M_z": "c.real"}), "not allowed"),
        (lambda: effect_from_formulas("formula_bad", {"M_z": "c *"}), "is no formula"),
        (lambda: effect_from_formulas("formula_bad", {"M_z": "c if theta else 1"}), "not allowed"),
        (lambda: effect_from_formulas("formula_bad", {"M_q": "c"}), "no component"),
        (lambda: effect_from_formulas("formula_bad", {}), "no formula"),
    ],
)
def test_what_cannot_be_a_model_a_start_or_a_law_is_refused_in_words(make, message):
    with pytest.raises((ArgumentError, ModelError), match=message):
        make()


@pytest.mark.parametrize("name", CATALOGUE)
def test_an_absent_effect_changes_nothing(name):
    state = steady_precession(np.radians(15), MA_2014, omega3=2.0, nutation_amplitude=0.02)
    times = np.linspace(0, 0.1, 11)
    base = Model(MA_2014, effects=(CATALOGUE["km"](),)) if name != "km" else Model(MA_2014)
    absent = base.with_effects(CATALOGUE[name].absent())
    without, with_it = (rolling.simulate(model, state, times=times).q for model in (base, absent))
    assert_allclose(with_it, without, atol=1e-14)


@pytest.mark.parametrize(("name", "power"), [("air_moffatt", 0.0), ("air_bildsten", 0.5), ("air_quadratic", 1.0)])
def test_every_law_of_the_air_reads_its_density(name, power):
    """Declared, or by the effect `air`: an amount in thin air is the power of the density smaller in ordinary air."""
    state, times = steady_precession(np.radians(9), MA_2014), np.linspace(0, 0.3, 31)
    q = lambda model: rolling.simulate(model, state, times=times).q  # noqa: E731
    amount = CATALOGUE[name].parameters[0]
    law = CATALOGUE[name](**{amount.name: 20 * amount.nominal})
    thin = q(Model(MA_2014, effects=(law,), air_density=0.12))
    assert_allclose(q(Model(MA_2014, effects=(law, CATALOGUE["air"](density=0.1)))), thin, rtol=1e-13)
    weaker = CATALOGUE[name](**{amount.name: 20 * amount.nominal * 0.1**power})
    assert_allclose(q(Model(MA_2014, effects=(weaker,))), thin, rtol=0, atol=1e-10)
    usual = q(Model(MA_2014, effects=(law,)))
    assert (np.abs(usual - thin).max() > 1e-4) == (power > 0)


def test_the_published_law_is_that_of_its_formula_and_the_free_power_with_exponent_two():
    written = effect_from_formulas("formula_km", {"load_m": "-k * psidot * magnitude(psidot)"})
    state = steady_precession(np.radians(9), MA_2014)
    times = np.linspace(0, 0.3, 31)
    laws = CATALOGUE["km"](k_m=5e-8), written(k=5e-8), CATALOGUE["rolling_power"](k=5e-4, p=2.0)
    published, *others = (rolling.simulate(Model(MA_2014, effects=(law,)), state, times=times).q for law in laws)
    for other in others:
        assert_allclose(other, published, rtol=1e-13, atol=1e-15)
    two = effect_from_formulas("formula_two", {"M_z": "-c*omega_z", "X_n": "-(c + d)*v_n*exp(-theta**2)"})
    assert [p.name for p in two.parameters] == ["c", "d"]
    assert effect_from_formulas("formula_two", two.formulas)(c=2, d=3) == two(c=2, d=3)
    assert "formula_two" not in CATALOGUE  # nor, therefore, among the candidates for the next recording


def test_laws_of_one_name_live_side_by_side_in_one_process():
    """Two recordings taught laws of the default name; each model carries its own."""
    one = effect_from_formulas("learned", {"M_z": "-c_0 * omega_z"})
    other = effect_from_formulas("learned", {"M_z": "-c_0 * omega_z", "M_m": "c_1 * time"})
    first, second = Model(MA_2014, laws=(one,)), Model(MA_2014, laws=(other,))
    with_first = first.with_values({"learned.c_0": 1e-7})
    with_second = second.with_values({"learned.c_0": 2e-7, "learned.c_1": 1e-6})
    assert with_first.with_values({"learned.c_0": 3e-7}).values == {"learned.c_0": 3e-7}
    assert with_second.with_values({"learned.c_1": 4e-6}).values == {"learned.c_0": 2e-7, "learned.c_1": 4e-6}
    assert one(c_0=1e-7) != other(c_0=1e-7)
    with pytest.raises(ModelError, match="no effect 'learned'"):
        Model(MA_2014).with_values({"learned.c_0": 1.0})
    with pytest.raises(ModelError, match="no parameter; effect 'learned' has c_0"):
        first.with_values({"learned.c_1": 1.0})
    state, times = steady_precession(np.radians(9), MA_2014), np.linspace(0, 0.2, 21)
    found = rolling.sensitivities(second, state, times, ["learned.c_1"])
    step = 1e-7
    moved = rolling.simulate(with_second.with_values({"learned.c_0": 0.0, "learned.c_1": step}), state, times=times)
    assert_allclose(found.dq[:, :, -1] * step, moved.q - found.q, rtol=1e-2, atol=1e-10)  # integrated to 1e-11


def test_spin_drifts_whichever_direction_the_dissipative_moment_has():
    """The falling nutation drives omega3 through the contact force, m r psidot thetadot L2; the moment modifies it.

    Along m0 its component along the axis, k_m F_z psidot^2 sin(theta), works against the drift; along e2 there is none.
    """
    state = steady_precession(np.radians(8), MA_2014)
    along_m0, along_e2 = (
        rolling.simulate(Model(MA_2014, effects=(CATALOGUE[n](),)), state, 1.2) for n in ("km", "km_e2")
    )
    assert_allclose(along_m0.energy[-1], along_e2.energy[-1], rtol=0.05)
    assert along_m0.state[-1, 7] < 0.05 < state.omega3
    assert along_e2.state[-1, 7] < along_m0.state[-1, 7] - 0.1


def test_catalogue_table_names_every_effect_with_its_parameters():
    table = catalogue_table().splitlines()
    assert len(table) == len(CATALOGUE) + 2
    for row, kind in zip(table[2:], CATALOGUE.values(), strict=True):
        assert row.startswith(f"| `{kind.name}` |")
        assert all(f"`{p.name}`" in row for p in kind.parameters)
