"""What each of many runs has of its own is eliminated run by run; answers are those of one problem in all numbers."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline
from scipy.linalg import null_space

from disctrack.discrepancy.equations import Equations, Parameter, Run, diagnose, terms
from disctrack.discrepancy.equations.declared import checked
from disctrack.discrepancy.equations.formulas import Formulas
from disctrack.discrepancy.equations.loop import unidentifiable
from disctrack.discrepancy.equations.shooting import fitted_start, misfits
from disctrack.discrepancy.equations.system import EquationSystem
from disctrack.discrepancy.fit import fit
from disctrack.discrepancy.held_out import held_out
from disctrack.discrepancy.noise import inflation, with_autocorrelation
from disctrack.discrepancy.score import Linearisation, score_all
from disctrack.discrepancy.system import subset

SIGMA = 2e-3
# an offset of the sensor that is known from elsewhere, and a spring, differ from run to run
NUMBERS = {"k": Parameter(140.0, per="run"), "c": 0.3, "b": Parameter(0.0, sigma=0.01, per="run")}
SWINGS = Equations({"x": "v", "v": "-k*x - c*v"}, NUMBERS, observed={"x": "x + b"}, units={"x": "m"})
OFFERED = [terms.coulomb("v"), terms.quadratic("v"), terms.constant("v")]


def swings(rng, n=5, samples=150):
    """Oscillators with a dry friction that the equations lack; of one the start is known, of another it is not."""
    runs = []
    for i in range(n):
        time = np.arange(samples + 10 * i) * 0.01
        k, x0 = rng.uniform(130, 150), rng.uniform(0.5, 1.0)
        rates = lambda t, y, k=k: [y[1], -k * y[0] - 0.3 * y[1] - 0.5 * np.tanh(y[1] / 1e-3)]  # noqa: E731
        x = solve_ivp(rates, (0, time[-1]), [x0, 0.0], t_eval=time, rtol=1e-9, atol=1e-12).y[0]
        x = x + rng.normal(0, 0.01) + SIGMA * rng.standard_normal(len(time))
        known = {"v": 0.0} if i == 0 else {"x": (x0, 1e-4)} if i == 1 else {}
        runs.append(Run(time, {"x": x}, sigma=SIGMA, name=f"swing {i}", known=known))
    return runs


@pytest.fixture(scope="module")
def answer():
    return diagnose(SWINGS, swings(np.random.default_rng(5)), OFFERED)


def together(quantities):
    """The same quantities, as if every run shared them all: one problem, nothing eliminated."""
    return tuple(replace(q, slot="") for q in quantities)


def test_what_is_hidden_is_found_and_what_is_each_runs_own_is_eliminated(answer):
    assert answer.found == ("coulomb_v",)
    own = {q.name for q in answer.system.base if q.slot}
    assert own == {q.name for q in answer.system.base} - {"c"}
    assert "state.v[swing 0]" not in own  # known exactly: no number at all
    assert abs(answer.values["coulomb_v.c"] - 0.5) < 4 * answer.sigmas["coulomb_v.c"]


def test_the_fit_is_that_of_one_problem_in_all_numbers(answer):
    """Values, standard deviations, covariances, chi-square, and what a step promises: to the integration's rounding."""
    system, start = answer.system, answer.diagnosis.before.values
    reduced = fit(system, system.base, start)
    whole = fit(system, together(system.base), start)
    assert reduced.converged
    assert whole.converged
    assert reduced.names == whole.names
    assert reduced.degrees_of_freedom == whole.degrees_of_freedom
    assert_allclose([reduced.chi_square, reduced.penalty], [whole.chi_square, whole.penalty], rtol=1e-7)
    for name in whole.names:
        assert abs(reduced.values[name] - whole.values[name]) < 1e-3 * whole.sigma(name)
    assert_allclose([reduced.sigma(n) for n in whole.names], [whole.sigma(n) for n in whole.names], rtol=1e-5)
    mixed, size = whole.covariance[whole.names.index("c")], np.sqrt(np.diag(whole.covariance))
    assert_allclose(reduced.covariance_with("c") / size, mixed / size, atol=1e-5 * whole.sigma("c"))
    # the control: what is eliminated costs certainty, which merely leaving it out would not
    alone = fit(system, [q for q in system.base if not q.slot], reduced.values)
    assert alone.sigma("c") < 0.8 * reduced.sigma("c")


def test_scores_and_sigmas_that_know_the_memory_are_those_of_one_problem(answer):
    system, fitted = answer.system, answer.diagnosis.before
    whole = fit(system, together(system.base), fitted.values)
    scores = [score_all(Linearisation(system, f, system.candidates), system.candidates) for f in (fitted, whole)]
    for a, b in zip(*scores, strict=True):
        assert a.candidate.name == b.candidate.name
        assert_allclose(a.gain, b.gain, rtol=1e-4, atol=1e-4)  # of what a fit has, its last step's is left
        assert_allclose([*a.values, *a.sigma], [*b.values, *b.sigma], rtol=1e-4, atol=1e-9)
    c = whole.names.index("c")
    assert_allclose(inflation(system, fitted)[c], inflation(system, whole)[c], rtol=1e-4)
    a, b = (with_autocorrelation(system, f) for f in (fitted, whole))
    assert_allclose(a.sigma("c"), b.sigma("c"), rtol=1e-4)
    assert a.sigma("c") > 1.5 * fitted.sigma("c")  # what is left is no white noise
    ratio = [a.sigma(n) / b.sigma(n) for n in whole.names if n != "c"]
    assert 0.8 < np.min(ratio) <= np.max(ratio) < 1.25  # without the errors that move both kinds at once


def test_a_free_run_is_as_probable_as_by_one_problem(answer):
    system, after = answer.system, answer.diagnosis.after
    for quantities in (system.base, after.quantities):
        a, b = (held_out(system, q, after.values, system.training) for q in (quantities, together(quantities)))
        assert a.n_data == b.n_data
        assert_allclose([a.chi_square, a.expected, a.log_density], [b.chi_square, b.expected, b.log_density], rtol=1e-5)


def test_of_a_run_that_is_kept_back_what_its_own_numbers_cannot_move_is_judged(answer):
    """Against contrasts by SciPy's null space; how they are turned among themselves does not matter."""
    system, after = answer.system, answer.diagnosis.after
    back = system.blocks[-1]
    rows = system.weights > 0
    rows[back] = False
    held = held_out(system, after.quantities, after.values, rows)
    own = [q.name for q in after.quantities if q.slot and q.block == len(system.blocks) - 1]
    b = f"b[{system.stretches[-1].run}]"
    free = [i for i, name in enumerate(own) if name != b]  # this one has a prior
    residual, derivative = system.linearise(held.train.values, [*own, *held.train.shared])
    C = null_space(derivative[back, 0, free].T).T
    prior = C @ derivative[back, 0, own.index(b)]
    r, J = C @ residual[back, 0] + prior * held.train.values[b], C @ derivative[back, 0, len(own) :]
    covariance = np.eye(len(r)) + J @ held.train.covariance @ J.T + 0.01**2 * np.outer(prior, prior)
    assert held.n_data == len(r)
    assert_allclose(held.chi_square, r @ r, rtol=1e-9)
    assert_allclose(held.expected, np.trace(covariance), rtol=1e-9)
    square = r @ np.linalg.solve(covariance, r)
    assert abs(square - len(r)) < 4 * np.sqrt(2 * len(r))
    assert_allclose(held.log_density, -0.5 * (square + np.linalg.slogdet(covariance)[1]), rtol=1e-9)


def test_a_number_that_nothing_in_its_run_shows_stays_as_it_is(answer):
    """The friction of a run at rest: no variance, no step, and nothing else is disturbed."""
    system = answer.system
    seen = np.ones(len(system.time), bool)
    seen[system.blocks[2]] = False
    fitted = fit(subset(system, seen), system.base, answer.diagnosis.after.values)
    assert fitted.converged
    assert fitted.values["state.x[swing 2]"] == answer.values["state.x[swing 2]"]
    assert fitted.sigma("state.x[swing 2]") == 0
    assert fitted.sigma("c") > answer.diagnosis.before.sigma("c")


@pytest.mark.statistical
@pytest.mark.parametrize("per", ["", "run"])
def test_parameters_that_cannot_be_parted_are_told_beside_own_numbers(rng, per):
    """Mass and stiffness of oscillators, shared or each one's own: one of them is held."""
    runs = [replace(run, known={}) for run in swings(rng, 3)]
    both = {"s": Parameter(140.0, per=per), "m": Parameter(1.0, per=per), "c": 0.3}
    twice = Equations({"x": "v", "v": "-s/m*x - c*v"}, both)
    answer = diagnose(twice, runs, [terms.coulomb("v")])
    assert any("cannot be distinguished from" in note for note in answer.notes)
    assert answer.system.held in (("m",), ("s",))
    held = unidentifiable(replace(answer.system, held=()), answer.values | {"m": 1.0, "s": 140.0})
    assert held in (("m",), ("s",))


def test_a_run_that_is_kept_back_as_a_whole_judges(rng):
    """What is found in the others predicts it, whatever its spring and its start."""
    *others, last = swings(rng, 4)
    runs = [*(replace(run, fit_until=np.inf) for run in others), replace(last, fit_until=0)]
    answer = diagnose(SWINGS, runs, OFFERED)
    assert answer.found == ("coulomb_v",)
    held, back = answer.diagnosis.held_out_after, answer.system.blocks[-1]
    assert held.test_rows[back].all()
    assert held.test_rows.sum() == back.stop - back.start
    assert answer.diagnosis.found[0].held_out_gain > 20
    assert answer.after["x"].held_out < 1.15 * SIGMA  # 180 samples: 5 % one sigma
    assert answer.before["x"].held_out > 1.1 * answer.after["x"].held_out


@pytest.mark.statistical
def test_short_stretches_of_many_runs_lead_to_a_gain_of_the_other_sign(rng):
    time, runs = np.arange(80) * 0.05, []
    for i in range(60):
        push = np.interp(time, np.arange(0, 5), rng.uniform(-1, 1, 5))
        course = CubicSpline(time, push)
        rates = lambda t, y, u=course: [y[1], -9.0 * y[0] - 0.5 * y[1] - 4.0 * u(t)]  # noqa: E731
        x = solve_ivp(rates, (0, time[-1]), rng.uniform(-0.3, 0.3, 2), t_eval=time, rtol=1e-8, atol=1e-10).y[0]
        data = {"x": x + SIGMA * rng.standard_normal(80)}
        runs.append(Run(time, data, sigma=SIGMA, inputs={"u": push}, name=f"run {i}"))
    driven = Equations({"x": "v", "v": "-k*x - c*v + g*u"}, {"k": 7.0, "c": 0.4, "g": 3.0}, inputs=["u"])
    compiled = Formulas(driven, [], {"x": "x"})
    system = EquationSystem(compiled, checked(driven, runs), np.ones(2), {})
    start = fitted_start(system, {})
    assert_allclose([start.values[n] for n in "kcg"], [9.0, 0.5, -4.0], rtol=0.01)
    assert misfits(system, start.values).max() < 0.02


@pytest.mark.statistical
@pytest.mark.parametrize("fault", ["", "shaken", "noisy"])
def test_a_run_that_does_not_fit_the_others_is_named(rng, fault):
    """What shakes one run of twelve, or a sensor three times as noisy there; else none is named."""
    runs = swings(rng, 12, 80)
    x = runs[7].data["x"]
    if fault == "shaken":
        x = x + 0.02 * np.sin(15.0 * runs[7].time ** 2)
    if fault == "noisy":
        x = x + 3 * SIGMA * rng.standard_normal(len(x))
    runs[7] = replace(runs[7], data={"x": x})
    named = [note for note in diagnose(SWINGS, runs, OFFERED).notes if "other runs" in note]
    assert len(named) == bool(fault)
    assert all("in swing 7 (" in note and note.count("times") == 1 for note in named)
