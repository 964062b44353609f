"""A force that no term names, learned as a function of one variable or two: its course, its alternatives, and that it
is not claimed where known terms do. Motions come from SciPy's `solve_ivp`."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from disctrack.discrepancy.equations import Equations, Run, diagnose, terms
from disctrack.discrepancy.equations.law import NAME, Along, LearnedForce

pytestmark = pytest.mark.statistical
OSCILLATOR = Equations({"x": "v", "v": "-omega**2*x - 2*beta*v"}, {"omega": 11.5, "beta": 0.12}, units={"x": "m"})
DECLARED = {"x": 11.5**2, "v": 0.24, "t": 0.0}  # what the declared equations pull back with, by variable
TRUE = {"x": 144.0, "v": 0.3, "t": 0.0}
TIME = np.arange(900) * 0.01
SIGMA = 2e-3


def spring_of_a_table(x):
    return np.interp(x, [-1.2, -0.6, -0.3, 0, 0.25, 0.5, 0.8, 1.2], [30, 22, 6, 0, -3, -14, -16, -30])


LAWS = {
    "a drag that saturates": ("v", lambda v: -6 * np.tanh(v / 2)),
    "a spring of a table": ("x", spring_of_a_table),
    "a hollow": ("x", lambda x: -25 * x * np.exp(-((x / 0.35) ** 2))),
    "a wavy spring": ("x", lambda x: -9 * np.sin(6 * x)),
    "a drag that drops": ("v", lambda v: -0.12 * v * np.abs(v) * (1 - 0.6 / (1 + np.exp((6 - np.abs(v)) / 0.6)))),
    "a drag in one direction": ("v", lambda v: -np.where(v > 0, 1.5 * v, 0.1 * v)),
    "an odd friction": ("v", lambda v: -np.tanh(v / 1e-3) * (1.2 + np.exp(-((v / 3) ** 2)) * np.sin(np.abs(v)))),
    "a push by time": ("t", lambda t: 8 * np.exp(-0.5 * (t - 4) ** 2) - t / 3),
}
KNOWN = {
    "friction and drag": (lambda x, v: -0.6 * np.tanh(v / 1e-3) - 0.05 * v * abs(v), {"coulomb_v", "quadratic_v"}),
    "a spring of two terms": (lambda x, v: -20 * x**3 - 8 * x**2, {"cubic_spring_x", "asymmetric_spring_x"}),
    "nothing": (lambda x, v: 0.0, set()),
}


def recorded(force, seed, sigma=SIGMA):
    """The oscillator with omega = 12, beta = 0.15 and a force(x, v, t), seen with noise."""
    swing = solve_ivp(
        lambda t, y: [y[1], -144 * y[0] - 0.3 * y[1] + force(y[0], y[1], t)],
        (0, TIME[-1]), [1.0, 0.0], t_eval=TIME, rtol=1e-9, atol=1e-11, method="LSODA",
    )  # fmt: skip
    return Run(TIME, {"x": swing.y[0] + sigma * np.random.default_rng(seed).standard_normal(len(TIME))}, sigma=sigma)


QUICK = ("a drag that saturates", "a spring of a table", "an odd friction", "a push by time")


@pytest.mark.parametrize("name", [pytest.param(n, marks=() if n in QUICK else pytest.mark.slow) for n in LAWS])
def test_a_law_of_one_variable_is_learned(name):
    """Within 3 sigma of the true force nearly everywhere, on a course that it does not follow by being open."""
    variable, force = LAWS[name]
    answer = diagnose(OSCILLATOR, recorded(lambda x, v, t: force({"x": x, "v": v, "t": t}[variable]), seed=11))
    law = answer.law
    assert answer.verdict == ("unexplained" if variable == "t" else "found")  # of time, it describes any motion
    assert answer.found == (() if variable == "t" else (NAME,))
    assert (law.along.equation, law.along.variable) == ("v", variable)
    truth = force(law.variable) + (DECLARED[variable] - TRUE[variable]) * law.variable
    pulls = (law.force - truth) / law.sigma
    assert np.mean(np.abs(pulls) < 3) >= 0.85
    assert np.sqrt(np.mean(pulls**2)) < 2.0
    assert np.sqrt(np.mean(law.sigma**2)) < 0.15 * np.ptp(truth)
    assert bool(law.formula) == (name == "a drag in one direction")  # v and |v|; the others have no usual form
    # known terms are told with their odds, and what is left is noise
    if variable != "t":
        assert answer.after["x"].rms == pytest.approx(SIGMA, rel=0.1)


@pytest.mark.parametrize(("of", "size"), [("v |v|", -0.3), ("sign v", -1.2)])
def test_a_law_of_usual_form_is_told_by_its_formula(of, size):
    """Beside what the declared friction lacks: 0.06 v. With the first x the equations have no value at large v."""
    f = {"v |v|": lambda v: v * np.abs(v), "sign v": lambda v: np.tanh(v / 1e-3)}[of]
    limited = {"x": "v", "v": f"{OSCILLATOR.rates['v']} + 1e-9*sqrt(1.2 - x**2 - v**2/144)"}
    law = diagnose(Equations(limited, OSCILLATOR.parameters), recorded(lambda x, v, t: size * f(v), seed=11), []).law
    assert law.document()["formula"].keys() == law.formula.keys() == {"v", of}
    for function, amount in {"v": -0.06, of: size}.items():
        assert abs(law.formula[function].value - amount) < 3.5 * law.formula[function].sigma < 0.2 * abs(size)
    assert law.text({}).endswith(f"v + ({law.formula[of]}) {of}")


def test_of_an_uncertain_course_no_formula_is_told():
    """Where x has one sign, x |x| and x^2 are equal: the simpler one is told."""
    x = np.linspace(0, 1, 61)
    for sigma, told in ((1e-3, {"x²"}), (3.0, set())):
        seen = SimpleNamespace(course=(x, x**2, sigma**2 * np.eye(61)), along=Along("v", ("x",)))
        assert LearnedForce.formula.func(seen).keys() == told


def test_a_law_of_time_that_fits_first_does_not_keep_a_law_of_the_state_from_being_tried(rng):
    """A circuit with a diode, far from the equations without one."""
    t = np.arange(0, 20, 0.02)
    u = 2 * np.sin(1.3 * t) + 1.5 * np.sin(0.41 * t + 1)
    circuit = solve_ivp(
        lambda s, q: (np.interp(s, t, u) - q) / 0.5 - 0.05 * (np.exp(q / 0.4) - 1), (0, t[-1]), [0.0], t_eval=t,
        rtol=1e-8, atol=1e-10, max_step=0.02,
    )  # fmt: skip
    run = Run(t, {"q": circuit.y[0] + 0.005 * rng.standard_normal(len(t))}, inputs={"u": u})
    answer = diagnose(Equations({"q": "(u - q)/tau"}, {"tau": 0.4}, inputs=["u"], units={"q": "V"}), run)
    assert answer.found == (NAME,)
    assert answer.law.along.variables == ("q",)


def test_terms_that_explain_the_data_only_together_are_found(rng):
    """An epidemic whose immunity is lost: into s flows 0.01 (1000 - s - i), which is three of the usual terms."""
    t = np.arange(120.0)
    epidemic = solve_ivp(
        lambda _, y: [-0.3e-3 * y[0] * y[1] + 0.01 * (1000 - y[0] - y[1]), 0.3e-3 * y[0] * y[1] - 0.1 * y[1]],
        (0, 120), [990.0, 10.0], t_eval=t, rtol=1e-9, atol=1e-9,
    )  # fmt: skip
    s, i = epidemic.y + [[2.0], [1.0]] * rng.standard_normal((2, len(t)))
    declared = Equations({"s": "-b*s*i/1000", "i": "b*s*i/1000 - g*i"}, {"b": 0.25, "g": 0.12})
    answer = diagnose(declared, Run(t, {"s": s, "i": i}))
    named = [{f.candidate.name, *(a.candidate.name for a in f.cannot_be_told_from)} for f in answer.diagnosis.found]
    assert len(named) == 3
    assert {"constant_s", "viscous_s", "coupling_s_i"} <= set().union(*named)


def test_a_law_of_an_angle_that_goes_round_is_the_same_in_every_turn(rng):
    """A dent that brakes a motor once a turn: over ten turns no smooth function of the angle has it."""

    def force(q):
        return -3 * np.exp((np.cos(q - 1) - 1) / 0.1)

    u = 0.6 + 0.3 * np.sin(0.9 * TIME)
    rates = lambda t, y: [y[1], 20 * (0.6 + 0.3 * np.sin(0.9 * t)) - 2 * y[1] + force(y[0])]  # noqa: E731
    turned = solve_ivp(rates, (0, TIME[-1]), [0.3, 5.0], t_eval=TIME, rtol=1e-9, atol=1e-11).y[0]
    motor = Equations({"q": "w", "w": "g*u - c*w"}, {"g": 18.0, "c": 1.8}, inputs=["u"], units={"q": "rad"})
    run = Run(TIME, {"q": turned + 1e-3 * rng.standard_normal(len(TIME))}, inputs={"u": u}, sigma=1e-3)
    answer = diagnose(motor, run)
    law = answer.law
    assert (answer.found, law.along.variable, law.along.period) == ((NAME,), "q", 2 * np.pi)
    assert np.mean(np.abs(law.force - force(law.variable)) < 3 * law.sigma) > 0.9
    assert f"{law.force.min():.3g}(" in answer.sentence  # its extremes are told


def test_a_sample_long_before_all_others_tells_no_turn(rng):
    time = np.append(0.0, 2.0 + 0.05 * np.arange(300))
    swing = solve_ivp(
        lambda t, y: [y[1], -20 * y[0] - 30 * y[0] ** 3 - 0.3 * y[1]], time[[0, -1]], [1.2, 0.0],
        t_eval=time, rtol=1e-9, atol=1e-11,
    )  # fmt: skip
    run = Run(time, {"x": swing.y[0] + SIGMA * rng.standard_normal(len(time))}, sigma=SIGMA)
    declared = Equations({"x": "v", "v": "-k*x - c*v"}, {"k": 25.0, "c": 0.3})
    answer = diagnose(declared, run, [terms.constant("v")])
    assert answer.found == (NAME,)
    course = answer.law.variable
    assert np.median(np.abs(answer.law.force - (5 * course - 30 * course**3)) / answer.law.sigma) < 2.0


def test_a_law_of_two_variables_is_learned_where_none_of_one_will_do(tmp_path):
    """A drag that drives near the middle and brakes outside, less and less: a swing that no term sustains."""

    def force(x, v):
        return v * (1.5 - 4 * x**2 / (x**2 + 0.25))

    answer = diagnose(OSCILLATOR, recorded(lambda x, v, t: force(x, v), seed=17), [])
    law = answer.law
    assert answer.found == (NAME,)
    assert (law.along.equation, law.along.variables, set(law.held)) == ("v", ("x", "v"), {"omega", "beta"})
    truth = force(*law.variable.T) + law.variable @ [DECLARED["x"] - TRUE["x"], DECLARED["v"] - TRUE["v"]]
    assert np.mean(np.abs(law.force - truth) < 3 * law.sigma) > 0.95
    assert np.sqrt(np.mean(law.sigma**2)) < 0.3 * np.std(truth)
    assert answer.after["x"].rms == pytest.approx(SIGMA, rel=0.1)
    told, page = answer.write(tmp_path)
    assert np.shape(json.loads(told.read_text())["law"]["at"]) == (len(law.force), 2)
    assert "a force on v that is a function of x and v, learned from the residuals" in page.read_text()


@pytest.mark.parametrize("name", KNOWN)
def test_known_terms_stay_named_where_they_act(name):
    force, names = KNOWN[name]
    answer = diagnose(OSCILLATOR, recorded(lambda x, v, t: force(x, v), seed=12))
    assert set(answer.found) == names
    if not names:
        assert answer.law is None
        return
    # one variable is enough for them: the law is told beside, with less evidence
    assert not answer.law.is_shorter
    assert any("one law describes the data in place of" in note for note in answer.notes)


def test_a_law_beside_a_known_term():
    """A wavy spring and a sensor whose zero drifts: neither alone is noise."""
    run = recorded(lambda x, v, t: -9 * np.sin(6 * x), seed=13)
    shown = Equations(OSCILLATOR.rates, OSCILLATOR.parameters, observed={"X": "x"})
    data = np.asarray(run.data["x"]) + 0.01 * TIME
    answer = diagnose(shown, Run(TIME, {"X": data}, sigma=SIGMA), [terms.sensor_drift("X"), terms.coulomb("v")])
    assert set(answer.found) == {NAME, "drift_X"}
    assert abs(answer.values["drift_X.b"] - 0.01) < 3.5 * answer.sigmas["drift_X.b"]


def test_a_law_is_a_force_where_a_mass_matrix_is_declared(rng):
    """A cart whose friction saturates carries a pendulum; M and the law are those that the motion was made with."""
    time = np.arange(0, 8, 0.01)
    push = 0.8 * np.sin(2.1 * time) + 0.5 * np.sin(5.3 * time)

    def rates(t, y):
        _, th, vx, w = y
        masses = np.array([[1.2, 0.08 * np.cos(th)], [0.08 * np.cos(th), 0.032]])
        forces = np.interp(t, time, push) + 0.08 * np.sin(th) * w**2 - 0.9 * np.tanh(vx / 0.15), -0.7848 * np.sin(th)
        return [vx, w, *np.linalg.solve(masses, forces)]

    x, th = solve_ivp(rates, (0, time[-1]), [0, 0.6, 0, 0], t_eval=time, rtol=1e-8, atol=1e-10).y[:2]
    cart = Equations(
        {"x": "vx", "th": "w", "vx": "F + m*l*sin(th)*w**2 - b*vx", "w": "-m*g*l*sin(th)"}, {"M": 1.05, "b": 0.4},
        constants={"m": 0.2, "l": 0.4, "g": 9.81}, inputs=["F"],
        mass={("vx", "vx"): "M + m", ("vx", "w"): "m*l*cos(th)", ("w", "w"): "m*l**2"},
    )  # fmt: skip
    data = {"x": x + 1e-3 * rng.standard_normal(800), "th": th + 2e-3 * rng.standard_normal(800)}
    run = Run(time, data, inputs={"F": push}, hold="linear")
    answer = diagnose(cart, run, [terms.coulomb("vx"), terms.quadratic("vx"), terms.spring("vx", "x")])
    law = answer.law
    assert answer.found == (NAME,)
    assert (law.along.equation, law.along.variable, law.held) == ("vx", "vx", ("b",))
    truth = -0.9 * np.tanh(law.variable / 0.15) + 0.4 * law.variable
    assert np.mean(np.abs(law.force - truth) < 3 * law.sigma) > 0.9
    assert law.sigma.max() < 0.05
    assert abs(answer.values["M"] - 1) < 3.5 * answer.sigmas["M"]


def test_the_law_is_told_on_the_page_and_in_json(tmp_path):
    variable, force = LAWS["a drag that saturates"]
    answer = diagnose(OSCILLATOR, recorded(lambda x, v, t: force(v), seed=15), [terms.coulomb("v")])
    assert "a force on v that is a function of v" in " ".join(str(answer).split())
    assert f"{NAME}.a3" not in str(answer)
    assert answer.diagnosis.explanations[0] == ((NAME,), 0.0)  # one of the list
    told, page = answer.write(tmp_path)
    found = json.loads(told.read_text())
    assert {"verdict", "sentence", "effects", "before", "after", "tried", "notes", "runs"} <= set(found)
    assert found["after"]["channels"]["x"]["rms"] < found["before"]["channels"]["x"]["rms"]
    law = found["law"]
    assert law["variable"] == variable == "v"
    assert len(law["at"]) == len(law["force"]) == len(law["sigma"])
    assert law["known_terms"] == [c.name for c in answer.law.instead.candidates]
    assert "a force on v that is a function of v, learned from the residuals" in page.read_text()


def test_a_law_that_leaves_more_than_the_sensor_scatters_is_no_finding_and_foretells():
    """A good sensor sees a drive that nothing describes; beside known terms the law still comes nearest."""
    run = recorded(lambda x, v, t: -1.5 * np.tanh(v / 1e-3) - 0.3 * np.sin(v) + 0.03 * np.sin(1.3 * t), 16, 1e-5)
    answer = diagnose(OSCILLATOR, run, [terms.coulomb("v"), terms.constant("v")])
    assert answer.verdict == "unexplained"
    assert not any(found.candidate.name == NAME for found in answer.diagnosis.found)
    assert not answer.law.at_noise
    assert answer.law.along.variable == "v"
    left = {by: np.std(answer.forecast(run, by=by)["x"] - run.data["x"]) for by in ("before", "after")}
    assert left["after"] < 0.02 * left["before"]
