"""Formulas of a user are read, never run; what is said of inputs on a clock of their own, of runs not seen."""

import numpy as np
import pytest
import sympy
from scipy.integrate import solve_ivp

from disctrack.discrepancy.equations import Equations, Parameter, Run, Term, diagnose, terms
from disctrack.discrepancy.equations.expressions import parsed, smooth
from disctrack.errors import AnalysisError

X, V = sympy.symbols("x v", real=True)
NAMES = {"x": X, "v": V}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("-2*x - 0.5*v**2/3", -2 * X - 0.5 * V**2 / 3),
        ("x - v - 1 + abs(-x)", X - V - 1 + sympy.Abs(X)),
        ("sqrt(x**2 + v**2)**(1/2)", (X**2 + V**2) ** sympy.Rational(1, 4)),
        ("Piecewise((x, (x > 0) & (v <= 1)), (0, True))", sympy.Piecewise((X, (X > 0) & (V <= 1)), (0, True))),
        ("+".join(["x"] * 1500), 1500 * X),
    ],
)
def test_a_formula_means_what_it_says(text, expected):
    assert parsed(text, NAMES, "here") == expected


@pytest.mark.parametrize(
    "text",
    ["__import__('os').system('true')", "x.__class__", "[x for x in (1,)]", "(lambda: x)()", "9**9**9", "x ^ 2", "x +",
     "sin(x)(v)", "sin(x, y=2)", "'x'", "x if v else 1", "9" * 5000, "(" * 500 + "x" + ")" * 500,
     "+".join(["x"] * 5000), "sin", "(x, v)", "x > 0", "True"],
)  # fmt: skip
def test_what_is_no_formula_is_an_error_in_words(text):
    with pytest.raises(AnalysisError, match="here"):
        parsed(text, NAMES, "here")


def test_an_unknown_name_is_named_with_the_nearest():
    with pytest.raises(AnalysisError, match="'sine' is not known; did you mean 'sin'"):
        parsed("sine(x)", NAMES, "here")


def test_a_speed_has_a_slope_where_nothing_moves():
    widths: dict = {}
    speed = smooth(sympy.sqrt(X**2 + V**2), widths, {X, V})
    (width,) = widths.values()
    assert speed.diff(X).subs({X: 0, V: 0, width: 1e-3}) == 0
    assert float(speed.subs({X: 3, V: 4, width: 1e-3})) == pytest.approx(5, rel=1e-6)
    assert smooth(sympy.sqrt(X**2 + 1), widths, {X, V}) == sympy.sqrt(X**2 + 1)  # the control: it never vanishes


TIME = np.arange(0, 8, 0.02)
DRAG = [terms.quadratic("w"), terms.viscous("w")]


def followed(rates, start, time=TIME, **options):
    return solve_ivp(rates, (time[0], time[-1]), start, t_eval=time, rtol=1e-9, atol=1e-11, **options).y


def noise(n=400, seed=0, sigma=0.01):
    return sigma * np.random.default_rng(seed).standard_normal(n)


def driven(time):
    """A force with a strong line at 31 Hz, which samples at 25 Hz would take for one at 6 Hz."""
    return sum(a * np.cos(2 * np.pi * f * time + f) for f, a in ((0.3, 1.0), (1.7, 1.0), (4.1, 1.0), (31.0, 3.0)))


@pytest.mark.statistical
def test_inputs_of_a_finer_clock_drive_the_motion_as_it_was_driven():
    fine = np.arange(0, 12.0005, 1e-3)
    x = followed(lambda t, y: [y[1], 2 * driven(t) - 0.5 * y[1] - 4 * y[0]], [0.0, 0.0], fine)[0]
    cart = Equations({"x": "v", "v": "g*F - c*v - k*x"}, {"g": 1.5, "c": 0.4, "k": 3.5}, inputs=["F"])
    whole = Run(fine, {"x": x + noise(len(fine), sigma=1e-3)}, inputs={"F": driven(fine)}, sigma=1e-3)
    by_hand = Run(fine[::40], {"x": whole.data["x"][::40]}, inputs={"F": driven(fine[::40])}, sigma=1e-3)
    answers = [diagnose(cart, run, [terms.coulomb("v")]) for run in (whole.thinned(40), by_hand)]
    assert answers[0].verdict == "nothing missing"
    assert abs(answers[0].values["g"] - 2.0) < 4 * answers[0].sigmas["g"]
    # samples of the force are another force: its lines beyond half the rate come back as an error that remembers
    mine, theirs = (answer.after["x"].rms for answer in answers)
    assert mine < 1.2e-3 < 2.5e-3 < theirs
    assert "autocorrelated" in str(answers[1])


def test_an_input_has_to_last_as_long_as_the_data():
    run = Run(TIME, {"x": np.cos(3 * TIME)}, inputs={"F": np.zeros(50)}, input_time=np.linspace(0, 4, 50))
    with pytest.raises(AnalysisError, match="input_time"):
        diagnose(Equations({"x": "w", "w": "F - k*x"}, {"k": 9.0}, inputs=["F"]), run, DRAG)


@pytest.mark.statistical
def test_a_forecast_begins_in_the_window_and_its_band_holds():
    equations = Equations({"x": "w", "w": "-k*x - c*w"}, {"k": 9.5, "c": 0.2})
    rates = lambda t, y: [y[1], -9 * y[0] - 0.15 * y[1]]  # noqa: E731
    answer = diagnose(equations, Run(TIME, {"x": followed(rates, [1.0, 0.0])[0] + noise()}, sigma=0.01), DRAG)
    covered = []
    for seed in range(1, 9):
        start = np.random.default_rng(seed).standard_normal(2)
        x = followed(rates, start)[0] + noise(seed=seed)
        score = answer.score(Run(TIME, {"x": x}), window=0.5)["x"]
        covered.append(score.covered)
        assert score.n_samples == np.sum(TIME > 0.5)
        assert score.rms < 0.03  # the start from 26 samples is known to half of their noise
        # what comes after the window is not looked at
        x[40:] = 7.0
        again = answer.forecast(Run(TIME, {"x": x}), window=0.5)
        assert np.sqrt(np.mean((again["x"] - followed(rates, start)[0]) ** 2)) < 0.03
    assert 0.88 < np.mean(covered) < 0.99


@pytest.mark.statistical
def test_a_slow_change_of_the_system_is_no_force_of_time():
    """A spring that softens as a hidden state warms: a function of time describes that, and is not found."""
    rates = lambda t, y: [y[1], -144 * (1 - 0.05 * y[2]) * y[0] - 0.3 * y[1], (y[1] ** 2 / 30 - y[2]) / 4]  # noqa: E731
    time = np.arange(870) * 0.01
    x = followed(rates, [1.0, 0.0, 0.0], time)[0] + noise(870, sigma=2e-3)
    equations = Equations({"x": "v", "v": "-omega**2*x - 2*beta*v"}, {"omega": 12.0, "beta": 0.15})
    answer = diagnose(equations, Run(time, {"x": x}, sigma=2e-3), [terms.coulomb("v"), terms.constant("v")])
    assert answer.law is None or answer.law.along.variable != "t" or not answer.found
    assert answer.verdict != "nothing missing"


@pytest.mark.statistical
def test_what_leaves_more_than_the_sensor_scatters_is_not_found():
    """A tank with an outlet that nobody declared: an error that lasts, however well one sample predicts the next."""
    time, pump = np.arange(0, 600, 1.0), np.repeat(np.random.default_rng(3).uniform(0.5, 2.0, 30), 20)
    undeclared = lambda h: 0.05 * np.maximum(h - 4.0, 0.0) ** 0.3 * np.sin(h) ** 2  # noqa: E731
    (level,) = followed(lambda t, h: 0.3 * pump[int(t)] - 0.15 * np.sqrt(h) - undeclared(h), [4.0], time, max_step=0.1)
    tank = Equations({"h": "k*u - c*sqrt(Max(h, 0.001))"}, {"k": 0.3, "c": 0.15}, inputs=["u"])
    for sigma in (None, 1e-3):
        run = Run(time, {"h": level + noise(600, sigma=1e-3)}, inputs={"u": pump}, hold="hold", sigma=sigma)
        answer = diagnose(tank, run, [terms.viscous("h")])
        assert answer.after["h"].rms < 5e-3 or answer.verdict == "unexplained"


@pytest.mark.statistical
def test_of_declared_noise_a_memory_is_no_excuse_for_what_is_found_and_leaves_more():
    """Growth that saturates: three usual terms together leave half more than declared, hardly correlated."""
    time, grown = np.arange(300) / 10.0, lambda x, s: 0.6 * s / (1.0 + s) * x
    x, s = followed(lambda t, y: [grown(*y) - 0.2 * y[0], 2 - 0.2 * y[1] - 1.5 * grown(*y)], [0.5, 8.0], time)
    linear = Equations({"x": "m*s*x - 0.2*x", "s": "2 - 0.2*s - y*m*s*x"}, {"m": 0.1, "y": 1.5})
    seen = {"x": x + noise(300), "s": s + noise(300, seed=1)}
    assert diagnose(linear, Run(time, seen, sigma=0.01)).verdict == "unexplained"


def test_what_is_usual_follows_from_the_structure():
    """Friction acts on a velocity, a level runs over into the next one, and a sensor has limits."""
    tanks = Equations(
        {"upper": "u - a*sqrt(upper)", "lower": "a*sqrt(upper) - b*sqrt(lower)"}, {"a": 1.0, "b": 1.0},
        inputs=["u"], observed={"seen": "lower"},
    )  # fmt: skip
    offered = {t.name: t for t in terms.usual(tanks)}
    assert set(offered["overflow_upper"].rates) == {"upper", "lower"}
    assert set(offered["overflow_lower"].rates) == {"lower"}
    assert {"limit_seen", "square_upper_into_lower", "exchange_upper_lower"} <= set(offered)
    assert not {"coulomb_upper", "quadratic_upper", "spring_upper"} & set(offered)
    of_motion = {t.name for t in terms.usual(Equations({"x": "v", "v": "-k*x"}, {"k": 1.0}))}
    assert {"coulomb_v", "quadratic_v", "spring_x"} <= of_motion
    motor = Equations({"w": "(K*u - b*w)/J"}, {"K": 1.0, "b": 1.0, "J": 1.0}, inputs=["u"], units={"w": "rad/s"})
    assert {"coulomb_w", "delay_u"} <= {t.name for t in terms.usual(motor)}
    assert not any(name.startswith("overflow") for name in of_motion)
    of_two = Equations({"x": "v", "v": "-k*x", "q": "w", "w": "-k*q"}, {"k": 1.0}, units={"x": "m", "q": "rad"})
    assert not {"coupling_x_q", "across_v_w", "quadratic_v_w"} & {t.name for t in terms.usual(of_two)}
    fall = Equations({"x": "v", "v": "-g - c*v/m"}, {"g": 9.81, "c": 1.0}, {"m": 1.0})
    assert {"coulomb_v_by_1_m"} == {t.name for t in terms.usual(fall, {"m"}) if t.name.startswith("coulomb_v_")}


@pytest.mark.statistical
def test_two_numbers_that_nothing_tells_apart_do_not_end_the_search():
    """Of a lag and two gains in a row only the product of the gains is seen; the start is not followed either."""
    time = np.arange(0, 8, 0.02)
    u = np.sign(np.sin(2.1 * time) + 0.4 * np.sin(5.3 * time))
    rates = lambda t, y: [(2 * u[min(int(t / 0.02), 399)] - y[0]) / 0.3, y[2], 200 * (y[0] - y[1]) - 5 * y[2]]  # noqa: E731
    speed = np.abs(followed(rates, [0.0, 0.0, 0.0], time, max_step=0.01)[1])
    drives = Equations(
        {"d": "(a*b*u - d)/lag", "p": "q", "q": "omega**2*(d - p) - c*q"},
        {"a": 1.0, "b": 1.5, "lag": Parameter(0.4, lower=0.01), "omega": 13.0, "c": 4.0}, inputs=["u"],
        observed={"speed": "abs(p)"},
    )  # fmt: skip
    run = Run(time, {"speed": speed + noise(400)}, inputs={"u": u}, hold="hold", sigma=0.01)
    answer = diagnose(drives, run, [Term("scale", observed={"speed": "s*abs(p)"}, parameters={"s": 0.0})])
    assert answer.diagnosis.held_out_before is not None
    assert any("cannot be distinguished from other numbers" in note for note in answer.notes)


@pytest.mark.statistical
def test_a_wrong_sign_a_sensor_at_its_limit_and_a_dead_one_are_told():
    x = np.cos(3 * TIME) + noise()
    wrong = diagnose(Equations({"x": "w", "w": "k*x"}, {"k": 14.0}), Run(TIME, {"x": x}, sigma=0.01), DRAG)
    assert any(note.startswith("k = -") and "sign is another" in note for note in wrong.notes)
    swing = Equations({"x": "w", "w": "-k*x"}, {"k": 9.0})
    clipped = diagnose(swing, Run(TIME, {"x": np.minimum(x, 0.9)}, sigma=0.01), [terms.viscous("w")])
    assert any("at its limit" in note for note in clipped.notes)
    assert not any("at its limit" in note for note in wrong.notes)
    below = diagnose(swing, Run(TIME, {"x": np.maximum(x, -0.9)}, sigma=0.01))  # a usual term where the data show it
    assert below.found == ("limit_below_x",)
    assert below.values["limit_below_x.top"] == pytest.approx(-0.9, abs=2e-3)
    with pytest.raises(AnalysisError, match="its sensor is dead"):
        diagnose(swing, Run(TIME, {"x": 0 * TIME}), DRAG)
