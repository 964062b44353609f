"""Derivatives of the motion against differences of simulations; responses to pulses; division by zero is no error."""

import numpy as np
import pytest
from numba import cfunc, types
from numpy.testing import assert_allclose, assert_array_equal

from calibration.kit.compiled import function_of
from disctrack import rolling
from disctrack.disc import MA_2014
from disctrack.rolling import CATALOGUE, Model, Regime, sensitivities, steady_precession
from disctrack.rolling._compiled import compile_law  # of the module that teaches numba complex division
from disctrack.rolling.effects.learned import effect_from_formulas
from disctrack.rolling.records import ROLLING_COMPONENTS
from disctrack.rolling.simulate import COMPONENTS, Assembly, moved_start, responses, symmetries
from disctrack.synthetic.description import Scene

STATE = steady_precession(np.radians(15), MA_2014, omega3=2.5, nutation_amplitude=0.03).moved(psi=0.4, phi=-1.0, x=0.02)
TIMES = np.linspace(0, 0.3, 31)
MODEL = Model(MA_2014, effects=(CATALOGUE["km"](), CATALOGUE["slip"](mu=0.8)))
PARAMETERS = [f"{e.name}.{p.name}" for e in CATALOGUE.values() for p in e.parameters if e.name != "slip"]


def differences(function, value, step):
    """Central differences of order 4."""
    f = [function(value + i * step) for i in (-2, -1, 1, 2)]
    return (f[0] - 8 * f[1] + 8 * f[2] - f[3]) / (12 * step)


def q_and_rates(model, state, times=TIMES):
    motion = rolling.simulate(model, state, times=times)
    return np.concatenate([motion.q, motion.qdot], axis=1)


def assert_column(sensitivities, j, expected, tolerance, step):
    """Equal to `tolerance` of each component's largest value, above the rounding of differences of this step."""
    found = np.concatenate([sensitivities.dq[:, :, j], sensitivities.dqdot[:, :, j]], axis=1)
    for component in range(12):
        scale = np.abs(expected[:, component]).max()
        floor = 1e-10 / step  # rates of 60 rad/s are reproduced to about 1e-10: the step sizes change with the start
        assert_allclose(found[:, component], expected[:, component], atol=tolerance * scale + floor)


@pytest.mark.parametrize("component", ROLLING_COMPONENTS)
def test_derivative_by_the_initial_state(component):
    found = rolling.sensitivities(MODEL, STATE, TIMES, components=[component])
    expected = differences(lambda v: q_and_rates(MODEL, STATE.moved(**{component: v})), getattr(STATE, component), 1e-4)
    assert_column(found, 0, expected, 1e-6, 1e-4)  # truncation of the differences: (1e-4 x 50)^4


@pytest.mark.parametrize("name", PARAMETERS)
def test_derivative_by_every_parameter_of_the_catalogue(name):
    effect, parameter = name.split(".")
    # a phase of 2 pi f t may turn by 0.02 rad in 0.3 s, an angle by 0.01 rad
    step = 0.01 if parameter in ("frequency", "angle") else 0.02 * CATALOGUE[effect]().values[parameter]
    model = MODEL.with_effects(CATALOGUE[effect]())
    found = rolling.sensitivities(model, STATE, TIMES, [name], components=[])
    assert found.names == (name,)
    expected = differences(lambda v: q_and_rates(model.with_values({name: v}), STATE), model.values[name], step)
    # weak laws move q by 1e-6 at nominal size, known to the integrator's 1e-11; strong ones suffer from truncation
    assert_column(found, 0, expected, 2e-4 if np.abs(expected * step).max() > 1e-6 else 2e-2, step)


@pytest.mark.parametrize(
    "name", ["kz.k_z", "table_tilt.tilt_x", "centre_of_mass.c_2", "air_bildsten.beta", "gravity.g_error", "creep.c"]
)
def test_an_effect_that_the_model_lacks_has_its_derivative_at_null(name):
    effect, parameter = name.split(".")
    found = rolling.sensitivities(MODEL, STATE, TIMES, [name], components=[])
    step = 1e-3 * CATALOGUE[effect]().values[parameter]
    moved, plain = (q_and_rates(model, STATE) for model in (MODEL.with_values({name: step}), MODEL))
    assert_column(found, 0, (moved - plain) / step, 0.02, step)  # one-sided: bounds forbid the other side


def test_all_columns_at_once_equal_those_one_by_one():
    together = rolling.sensitivities(MODEL, STATE, TIMES, ["km.k_m", "kz.k_z"])
    assert together.names == (*ROLLING_COMPONENTS, "km.k_m", "kz.k_z")
    alone = rolling.sensitivities(MODEL, STATE, TIMES, ["km.k_m"], components=["theta"])
    assert_allclose(together.dq[:, :, [3, 8]], alone.dq, rtol=1e-13)
    assert_allclose(together.q, rolling.simulate(MODEL, STATE, times=TIMES).q, rtol=1e-13)


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({}, {"x", "y", "psi", "phi"}),
        ({"slip.mu": 0.2, "table_yielding.c": 1e-7}, {"x", "y", "psi", "phi"}),
        ({"creep.c": 1e-3}, {"x", "y", "psi", "phi"}),
        ({"creep.c": 2e-2}, {"x", "y", "psi", "phi"}),
        ({"table_settles.v_z": 1e-3}, {"x", "y", "psi", "phi"}),
        ({"table_tilt.tilt_x": 1e-3}, {"x", "y", "phi"}),
        ({"table_shaken.u_cos_x": 1e-5}, {"x", "y", "phi"}),
        ({"table_vibration.a_cos_x": 0.1}, {"x", "y", "phi"}),
        ({"centre_of_mass.c_1": 1e-4}, {"x", "y", "psi"}),
        ({"inertia_product.J_13": 1e-9}, {"x", "y", "psi"}),
        ({"spring.k": 0.1}, {"phi"}),
        ({"table_curved.kappa": 0.1}, set()),
        ({"rim.oval_c": 1e-5}, set()),
        ({"surface_moves.rate": 0.1}, set()),
    ],
)
@pytest.mark.parametrize("slides", [False, True])
def test_columns_by_symmetry_equal_those_of_the_complex_step(values, expected, slides, monkeypatch):
    model = sliding(0.2).with_values(values)
    state = STATE
    if slides:
        velocity = rolling.simulate(MODEL, STATE, times=[0.0]).qdot[0]
        state = STATE.moved(v_x=velocity[0] + 0.05, v_y=velocity[1] - 0.02)
    assert symmetries(model, Assembly(model, 0.01)) == expected
    written = rolling.sensitivities(model, state, TIMES)
    monkeypatch.setitem(sensitivities.__globals__, "symmetries", lambda *_: set())
    followed = rolling.sensitivities(model, state, TIMES)
    assert np.isfinite(followed.dq).all()
    for found, true in ((written.dq, followed.dq), (written.dqdot, followed.dqdot)):
        size = np.abs(true).max(axis=(0, 2), keepdims=True)
        # the instant of sticking is known to the slip that is dropped there, 1e-7 m/s
        assert_allclose(found / size, true / size, atol=1e-5 if slides else 1e-12)


def test_a_law_by_formula_breaks_the_symmetries_that_it_reads():
    law = effect_from_formulas("patch", {"M_m": "-c * exp(-(x * x + y * y) / 1e-4) * cos(phi) - c * x"})
    assert [p.name for p in law.parameters] == ["c"]  # once, however often it stands there
    model = MODEL.with_effects(law(c=0.0))
    assert symmetries(model, Assembly(model, 0.01)) == set()


def test_a_law_reads_what_the_functions_within_it_read():
    """Of a user's law with a comprehension: else its columns would be those of a table that is alike all round."""

    def law(p, s, w):
        w.M_m -= p.c * sum([s.x * s.psi * k for k in (1.0, 2.0)])

    kind = effect_from_formulas("within", {"M_m": "c"})
    kind.law = staticmethod(law)
    model = MODEL.with_effects(kind(c=0.0))
    assert symmetries(model, Assembly(MODEL, 0.01)) == {"y", "phi"}


def sliding(mu):
    return MODEL.with_effects(CATALOGUE["slip"](mu=mu))


@pytest.mark.parametrize("name", ["v_x", "theta", "omega2", "slip.mu", "km.k_m"])
def test_derivative_goes_through_the_instant_at_which_slip_ends(name):
    """The instant of sticking moves with the parameter; a derivative that forgot it would be off by some 10 %."""
    velocity = rolling.simulate(MODEL, STATE, times=[0.0]).qdot[0]
    state = STATE.moved(v_x=velocity[0] + 0.05, v_y=velocity[1])
    model = sliding(0.3)
    motion = rolling.simulate(model, state, times=TIMES)
    assert [s.after for s in motion.switches] == [Regime.ROLLING]
    assert 0.005 < motion.switches[0].time < 0.2
    if "." in name:
        found = rolling.sensitivities(model, state, TIMES, [name], components=[])
        value = model.values[name]
        expected = differences(lambda v: q_and_rates(model.with_values({name: v}), state), value, 2e-3 * value)
    else:
        found = rolling.sensitivities(model, state, TIMES, components=[name])
        expected = differences(lambda v: q_and_rates(model, state.moved(**{name: v})), getattr(state, name), 1e-5)
    after = motion.time > motion.switches[0].time + 0.01
    for j in range(6):
        scale = np.abs(expected[after, j]).max()
        # the slip that is dropped at sticking, 1e-7 m/s, leaves 1e-6 of a speed of 0.05 m/s
        assert_allclose(found.dq[after, j, 0], expected[after, j], atol=2e-4 * scale + 1e-9 * np.abs(expected).max())


def test_derivatives_are_nan_after_the_end():
    model = Model(MA_2014, effects=(CATALOGUE["km"](),))
    state = steady_precession(np.radians(1.0), MA_2014)
    found = rolling.sensitivities(model, state, np.linspace(0, 1, 101), ["km.k_m"])
    ended = np.isnan(found.q[:, 0])
    assert 0 < ended.sum() < 101
    assert np.isnan(found.dq[ended]).all()
    assert np.isfinite(found.dq[~ended]).all()


def test_a_friction_that_is_never_reached_has_no_influence():
    found = rolling.sensitivities(Model(MA_2014), STATE, TIMES, ["slip.mu"], components=[])
    assert (found.dq == 0).all()


def test_a_law_that_switches_within_a_step_has_its_derivative_at_null():
    """Pivoting friction absent from a motion whose omega_z passes through zero, where the motion feels nothing."""
    model = Model(MA_2014, effects=(CATALOGUE["km"](),))
    state = steady_precession(np.radians(9), MA_2014, omega3=-0.6)
    times = np.linspace(0, 1.2, 121)
    plain = rolling.simulate(model, state, times=times)
    omega_z = plain.omega_world[:, 2]
    assert omega_z.max() > 0.1
    assert omega_z.min() < -0.1
    found = rolling.sensitivities(model, state, times, ["kz.k_z"], components=[])
    tiny = 1e-9  # lever arm at which the response is linear: it moves omega_z by 1e-4 of the width of the sign
    moved = rolling.simulate(model.with_values({"kz.k_z": tiny}), state, times=times)
    for component in range(6):
        slope = (moved.q - plain.q)[:, component] / tiny
        assert_allclose(found.dq[:, component, 0], slope, atol=2e-3 * np.abs(slope).max())


DISC = Scene().declared_disc
THETA_END = np.radians(0.05)


@pytest.fixture(scope="module")
def nutating():
    model = Model(DISC).with_values({"km.k_m": 0.381e-7})
    return model, steady_precession(np.radians(10.0), DISC, omega3=1.0, nutation_amplitude=0.01)


@pytest.mark.parametrize("width", [0.02, 0.005])
def test_a_pulse_of_any_component_moves_the_disc_as_its_sensitivity_says(nutating, width):
    model, state = nutating
    times = np.linspace(0.0, 0.5, 1001)
    motion, kernel = responses(model, state, times, THETA_END)
    wrenches = np.exp(-0.5 * ((times - 0.2) / width) ** 2)[:, None, None] * np.eye(len(COMPONENTS))
    by_start = sensitivities(model, state, times, (), None, THETA_END).dq
    moved = by_start @ moved_start(motion.time, kernel, wrenches)
    probe = effect_from_formulas("pulse", {c: f"of_{c} * exp(-((time - 0.2) / {width})**2 / 2)" for c in COMPONENTS})
    names = [f"pulse.of_{c}" for c in COMPONENTS]
    probed = model.knowing(probe).with_values(dict.fromkeys(names, 0.0))
    found = sensitivities(probed, state, times, names, (), THETA_END)
    # the integral is of fourth order in 0.5 ms over the width; the derivatives hold to 1e-9
    assert (np.abs(moved - found.dq).max(axis=0) < 2.5 * (5e-4 / width) ** 4 * np.abs(found.dq).max(axis=0)).all()
    # the tail of a pulse, from 1e-300 of its height on, takes no steps: four times as many for the short one if it does
    assert found.n_steps < 200 * (1 + len(names))


def test_where_the_motion_ends_there_are_no_responses(nutating):
    model, state = nutating
    braked = model.with_values({"km.k_m": 1e-5})
    assert responses(braked, state, np.linspace(0.0, 3.0, 301), THETA_END) is None


def test_complex_numbers_are_divided_as_in_python_and_by_zero_without_a_word(capfd, rng):
    numbers = types.CPointer(types.complex128)

    @cfunc(types.void(numbers), error_model="numpy")
    def divided(p):
        p[2] = p[0] / p[1]

    for a, b in (rng.standard_normal((20, 2, 2)) * [1.0, 1e-30]).view(complex)[..., 0]:
        three = np.array([a, b, 0.0])
        divided.ctypes(three.ctypes.data)
        assert three[2] == complex(a) / complex(b)
    three = np.array([1.0 + 1.0j, 0.0, 0.0])
    divided.ctypes(three.ctypes.data)
    assert_array_equal(three[2], complex(np.nan, np.nan))
    assert capfd.readouterr().err == ""


def test_machine_code_of_a_law_by_formula_is_kept():
    """The second function of the same text is loaded; one of another text is another."""
    text = "def law(p, s, w):\n    w.M_z += -p.c * s.omega_z\n"
    laws = [function_of(t, "law", {}) for t in (text, text, text.replace("M_z", "M_n"))]
    compiled = [compile_law.__wrapped__(law, ("c",), (), float) for law in laws]
    assert compiled[1].cache_hits == 1
    assert compiled[2].address != compiled[1].address
