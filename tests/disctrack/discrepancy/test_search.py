"""The engine on a system that is no disc: a damped oscillator; sigmas of a gain, chance, words for what is open."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from mpmath import mp
from numpy.testing import assert_allclose
from scipy import stats
from scipy.optimize import least_squares
from scipy.stats import chi2

from disctrack.discrepancy.document import bounds, correlated
from disctrack.discrepancy.fit import Fit, attempt, fit, settled
from disctrack.discrepancy.held_out import held_out, training_rows
from disctrack.discrepancy.score import Linearisation, score_all
from disctrack.discrepancy.search import Found, Settings, explain, length
from disctrack.discrepancy.significance import as_sigmas, chance, ljung_box, ljung_box_p_value, whiteness
from disctrack.discrepancy.system import Budget, Candidate, Quantity
from tests.oracles.linear_system import Linear, Predicted, candidate, one

SIGMA = 0.01


class Oscillator(Predicted):
    """x'' = -w0^2 x - 2 d x' + f: started at (a, b); what it may lack: damping, a drift, a hum at 3 Hz, its twin."""

    def __init__(self, observed, time):
        base = Quantity("a", "m", 0.1), Quantity("b", "m", 0.1), Quantity("w0", "rad/s", 0.1, null=7.0)
        candidates = (
            candidate("damping", one("d", lower=0.0)),
            replace(candidate("drift"), kind="measurement"),
            replace(candidate("hum", one("hum_c"), one("hum_s")), kind="measurement"),
            replace(candidate("twin"), kind="measurement"),  # minus the drift
            candidate("nothing"),
        )
        super().__init__(time, observed, base, candidates, SIGMA)

    def predicted(self, values: Mapping[str, float]):
        get = lambda n: values.get(n, 0.0)  # noqa: E731
        t = self.time
        envelope = np.exp(-get("d") * t)
        x = envelope * (get("a") * np.cos(get("w0") * t) + get("b") * np.sin(get("w0") * t))
        hum = get("hum_c") * np.cos(6 * np.pi * t) + get("hum_s") * np.sin(6 * np.pi * t)
        return x + (get("drift") - get("twin")) * t + hum


def oscillator(rng, hidden=None, n=400):
    time = np.linspace(0, 4, n)
    truth = {"a": 1.0, "b": 0.3, "w0": 6.5, **(hidden or {})}
    clean = Oscillator(np.zeros(n), time).predicted(truth)
    return Oscillator(clean + SIGMA * rng.standard_normal(n), time)


START = {"a": 0.9, "b": 0.4, "w0": 6.4}


def test_fit_scatters_as_its_covariance_says(rng):
    fits = [fit(s, s.base, START) for s in (oscillator(rng) for _ in range(60))]
    assert all(f.converged for f in fits)
    pull = np.array([(f.values["w0"] - 6.5) / f.sigma("w0") for f in fits])
    assert abs(pull.mean()) < 4 / np.sqrt(60)
    assert 0.7 < pull.std() < 1.35  # chi-square of 60 at one in a thousand


def with_tolerance(system, sigma):
    """The oscillator whose clock may drift by so much, as was declared."""
    (drift,) = system.candidates[1].quantities
    system.base = (*system.base, replace(drift, prior_sigma=sigma))
    return system


def test_score_of_an_effect_beyond_its_tolerance_equals_its_refit(rng):
    system = with_tolerance(oscillator(rng, {"drift": 0.02}), 0.005)
    base = fit(system, system.base, START)
    scores = {s.candidate.name: s for s in score_all(Linearisation(system, base, system.candidates), system.candidates)}
    free = fit(system, (*system.base[:3], *system.candidates[1].quantities), base.values)
    assert base.cost - free.cost == pytest.approx((0.02 / 0.005) ** 2, rel=0.1)  # known to 0.0003
    drift = scores["drift"]
    refitted = base.cost - free.cost, free.values["drift"], free.sigma("drift")
    assert_allclose([drift.gain, drift.values[0], drift.sigma[0]], refitted, rtol=1e-2)
    assert scores["twin"].gain == pytest.approx(drift.gain, rel=1e-6)


@pytest.mark.parametrize(("tolerance", "verdict"), [(0.01, "nothing missing"), (1e-4, "found")])
def test_an_effect_within_its_tolerance_is_not_claimed(rng, tolerance, verdict):
    answer = explain(with_tolerance(oscillator(rng, {"drift": 0.01}), tolerance), START)
    assert answer.verdict == verdict
    if answer.found:  # freed, it is as well known as if nothing had been declared
        assert answer.after.sigma("drift") < 1e-3
        assert answer.after.values["drift"] == pytest.approx(0.01, abs=4e-3)


@pytest.mark.parametrize(
    ("hidden", "names"),
    [({"d": 0.02}, {"damping"}), ({"drift": 0.01}, {"drift", "twin"}), ({"hum_c": 0.005, "hum_s": -0.004}, {"hum"})],
)
def test_a_hidden_effect_is_named_with_all_that_cannot_be_told_from_it(rng, hidden, names):
    answer = explain(oscillator(rng, hidden), START)
    assert answer.verdict == "found"
    (found,) = answer.found
    assert {found.candidate.name, *(r.candidate.name for r in found.cannot_be_told_from)} == names
    reasons = {t.candidate.name: t.reason for t in answer.tried}
    assert "no trace" in reasons["nothing"]


@pytest.mark.statistical
def test_noise_alone_raises_an_alarm_at_most_once_in_twenty(rng):
    alarms = sum(bool(explain(oscillator(rng), START).found) for _ in range(60))
    assert alarms <= 3  # the threshold promises one in a hundred


def test_a_negative_damping_is_not_allowed_to_explain_growth(rng):
    answer = explain(oscillator(rng, {"d": -0.02}), START)
    assert all(f.candidate.name != "damping" for f in answer.found)
    assert answer.verdict == "unexplained"


def test_an_effect_outside_the_catalogue_is_left_unexplained(rng):
    system = oscillator(rng)
    system.observed = system.observed + 0.05 * np.sign(np.sin(11.0 * system.time))
    answer = explain(system, START)
    assert answer.verdict == "unexplained"
    assert not answer.found


def test_held_out_error_of_the_true_model_is_at_its_floor(rng):
    system = oscillator(rng)
    answer = held_out(system, system.base, START, training_rows(system))
    # 140 test samples: the ratio scatters by 6 %
    assert answer.ratio_to_floor == pytest.approx(1.0, abs=0.25)
    worse = oscillator(rng, {"d": 0.05})
    assert held_out(worse, worse.base, START, training_rows(worse)).ratio_to_floor > 2


def line(observed, time):
    """Noise, or a line through the origin: a model that declares no quantity of its own."""
    columns = {"k": time, "unseen": 0 * time, "q": time**2}
    candidates = (candidate("slope", one("k"), one("unseen")), candidate("bend", one("q")))
    return Linear(time, observed, columns, (), candidates, SIGMA)


def test_a_model_without_quantities_is_diagnosed_and_rows_are_judged_as_asked(rng):
    time = np.linspace(0, 1, 90)
    system = line(0.05 * time + SIGMA * rng.standard_normal(90), time)
    rows = np.arange(90) % 3 != 0
    answer = explain(system, {}, Settings(noise=1.0), rows)
    assert [f.candidate.name for f in answer.found] == ["slope"]
    assert answer.noise == 1.0
    assert (answer.held_out_after.test_rows == ~rows).all()
    assert abs(answer.after.values["k"] - 0.05) < 4 * answer.after.sigma("k")
    assert not explain(line(SIGMA * rng.standard_normal(90), time), {}, Settings(noise=1.0), rows).found


def test_what_acts_in_the_fitted_part_alone_is_claimed_if_it_is_obvious(rng):
    """A blow of 15 sigma before what is held out, which says nothing of it. What would stay after it is refused."""
    time = np.linspace(0, 1, 900)
    blow, rows = np.exp(-(((time - 0.3) / 0.1) ** 2)), time <= 0.65
    columns = {"blow": blow, "stays": np.where(rows, np.exp(-((time / 0.6) ** 4)), 1.0)}
    observed = 0.014 * blow + SIGMA * rng.standard_normal(900)
    systems = (Linear(time, observed, columns, (), [candidate(name)], SIGMA) for name in columns)
    answer, wrong = (explain(system, {}, Settings(noise=1.0), rows) for system in systems)
    assert [f.candidate.name for f in answer.found] == ["blow"]
    assert abs(answer.after.values["blow"] - 0.014) < 4 * answer.after.sigma("blow")
    (tried,) = wrong.tried
    assert tried.gain > 20
    assert tried.held_out_gain < -20
    assert not wrong.found


def test_a_quantity_that_the_data_do_not_see_is_open_and_its_neighbour_is_not(rng):
    time = np.linspace(0, 1, 50)
    system = line(SIGMA * rng.standard_normal(50), time)
    scores = score_all(Linearisation(system, fit(system, (), {}), system.candidates), system.candidates)
    (slope, _) = sorted(scores, key=lambda s: -len(s.sigma))
    assert slope.sigma[0] == pytest.approx(SIGMA / np.sqrt(np.sum(time**2)), rel=1e-6)
    assert slope.sigma[1] == np.inf


def test_linear_quantities_that_are_taken_out_beforehand_leave_the_same_fit(rng):
    system = oscillator(rng, {"drift": 0.02, "hum_c": 0.01})
    nuisances = [Quantity("drift", "1", 0.1, prior_sigma=0.01), Quantity("hum_c", "1", 0.1, prior_sigma=0.03)]
    fits, scores = [], []
    for linear in (False, True):
        system.base = (*system.base[:3], *(replace(q, linear=linear) for q in nuisances))
        fits.append(fit(system, system.base, START))
        others = [c for c in system.candidates if c.name in ("damping", "nothing")]
        scores.append(score_all(Linearisation(system, fits[-1], others), others))
    plain, taken_out = fits
    sigmas = np.sqrt(np.diag(plain.covariance))
    for name, sigma in zip(plain.names, sigmas, strict=True):
        assert_allclose(taken_out.values[name], plain.values[name], atol=0.05 * sigma)  # both stop 1e-3 of chi^2 short
    assert_allclose(taken_out.covariance, plain.covariance, rtol=1e-3, atol=1e-3 * np.outer(sigmas, sigmas).max())
    assert_allclose([taken_out.chi_square, taken_out.penalty], [plain.chi_square, plain.penalty], atol=0.1)
    for a, b in zip(*scores, strict=True):
        assert a.candidate.name == b.candidate.name
        assert_allclose([b.gain, *b.sigma], [a.gain, *a.sigma], rtol=0.02, atol=0.02)


class Impatient(Oscillator):
    """Will not follow the drift where that is one trial of many."""

    trial_work = 10.0

    def linearise(self, values, names):
        if values.get("drift"):
            self.budget.work(10.0)
        return super().linearise(values, names)


def test_a_hypothesis_that_takes_too_long_is_left_and_the_others_are_tried(rng):
    system = oscillator(rng, {"drift": 0.02, "hum_c": 0.05})
    assert sorted(f.candidate.name for f in explain(system, START).found) == ["drift", "hum"]
    impatient = Impatient(system.observed, system.time)
    impatient.budget = Budget()
    answer = explain(impatient, START)  # the twin of the drift does what the drift did
    assert sorted(f.candidate.name for f in answer.found) == ["hum", "twin"]
    assert not any(r.candidate.name == "drift" for f in answer.found for r in f.cannot_be_told_from)
    assert attempt(impatient, (*impatient.base, Quantity("drift", "1", 0.1)), START).values == START | {"drift": 0.0}


def test_when_the_work_is_used_up_nothing_more_is_put_forward(rng):
    system = oscillator(rng, {"hum_c": 0.05})
    system.budget = Budget(10.0)
    assert [f.candidate.name for f in explain(system, START).found] == ["hum"]
    system.budget.work(6.0)  # half of it is kept for laws
    answer = explain(system, START)
    assert (answer.found, answer.verdict) == ((), "unexplained")


def test_a_fit_that_leaves_much_is_found_to_a_share_of_its_own_scatter(rng):
    """What no fit reaches makes all sigmas wider: to go on within them gains nothing, and takes as long."""
    system = oscillator(rng, {"hum_c": 3.0})
    near, trial = fit(system, system.base, START), attempt(system, system.base, START)
    assert near.converged
    assert near.reduced_chi_square > 1000
    residual = lambda x: system.linearise(dict(zip(near.names, x, strict=True)), [])[0][:, 0]  # noqa: E731
    exact = least_squares(residual, [near.values[n] for n in near.names], xtol=1e-15, ftol=1e-15, gtol=1e-15).x
    scatter = np.sqrt(near.reduced_chi_square) * np.array([near.sigma(n) for n in near.names])
    for found, most in ((near, 1e-3), (trial, 0.1), (settled(system, trial), 1e-3)):
        off = np.array([found.values[n] for n in near.names]) - exact
        assert np.abs(off / scatter).max() < np.sqrt(most)


def test_a_fit_that_cannot_reach_what_is_wanted_is_given_up_and_no_other(rng):
    system = oscillator(rng, {"hum_c": 3.0})
    whole = fit(system, system.base, START)
    last = fit(system, system.base, START, whole.n_iterations - 1)  # a hundred times what its next step promises ...
    for lacking, is_reached in ((70.0, True), (140.0, False)):
        found = fit(system, system.base, START, wanted=last.cost - lacking * last.promised)
        assert (found.values == whole.values, found.converged) == (is_reached, is_reached)


def test_explanations_that_fit_alike_are_listed_with_their_odds(rng):
    listed = dict(explain(oscillator(rng, {"drift": 0.01}), START).explanations)
    assert {("drift",), ("twin",)} <= set(listed)  # one and the same but for the sign
    assert abs(listed["drift",] - listed["twin",]) < 0.1
    assert () not in listed  # the control: that nothing is missing is no alternative
    nothing = explain(oscillator(rng), START)
    assert nothing.explanations[0] == ((), 0.0)
    (drift,) = (t for t in nothing.tried if t.candidate.name == "drift")
    assert all(words in drift.reason for words in ("noise alone reaches", "only bounded: "))


def test_the_length_of_an_explanation_is_chi_square_with_its_prices(rng):
    system = oscillator(rng)
    base = fit(system, system.base, START)
    drift = next(c for c in system.candidates if c.name == "drift")
    drift = replace(drift, quantities=tuple(replace(q, typical=0.1) for q in drift.quantities))
    with_it = replace(base, quantities=(*base.quantities, *drift.quantities))

    def longer(size):
        fitted = replace(with_it, values=base.values | {"drift": size})
        return length(system, Settings(), 1.0, fitted, [drift]) - length(system, Settings(), 1.0, base, [])

    tests = len(system.candidates)
    assert longer(0.1) == pytest.approx(chi2.isf(0.005 / tests, 1))  # what the best of so many gains by noise
    assert longer(0.02) == longer(0.1)  # a size that surprises nobody costs nothing
    assert longer(1.0) - longer(0.1) == pytest.approx(2 * np.log(101 / 2))


def exact(gain, n):
    with mp.workdps(60):
        tail = mp.gammainc(mp.mpf(n) / 2, mp.mpf(gain) / 2, regularized=True)
        start = mp.sqrt(max(gain - (n - 1) * mp.log(gain + 2), 0.1))
        return float(mp.findroot(lambda z: mp.log(mp.erfc(z / mp.sqrt(2))) - mp.log(tail), start))


@pytest.mark.parametrize("gain", [0.5, 9.0, 40.0, 499.0, 501.0, 3e3, 5e4])
def test_sigmas_have_the_probability_of_the_gain(gain):
    assert_allclose(as_sigmas(gain, 1), np.sqrt(gain), rtol=1e-9)
    for n in (2, 3, 6):
        assert_allclose(as_sigmas(gain, n), exact(gain, n), rtol=1e-6)
    assert as_sigmas(gain, 1) > as_sigmas(gain, 2) > as_sigmas(gain, 6)


def test_noise_alone_is_no_sigma():
    assert as_sigmas(0.0, 2) == as_sigmas(-1.0, 1) == 0.0
    assert as_sigmas(9.0, 3) == pytest.approx(2.18, abs=0.01)  # not 3: three numbers gain 3 on average


def waves(data):
    """A line with noise of variance 1; it may lack waves that overlap, some of one sign only, and pairs of them."""
    time = np.linspace(0.0, 1.0, 120)
    columns, found = {"a": np.ones(120), "b": time}, []
    for i, rate in enumerate(np.linspace(4.0, 30.0, 25)):
        names = (f"c{i}", f"s{i}") if i % 3 == 0 else (f"c{i}",)
        columns |= {name: wave(rate * time) for name, wave in zip(names, (np.cos, np.sin), strict=False)}
        lower = 0.0 if i % 3 == 1 else -np.inf
        found.append(candidate(f"wave {i}", *(one(name, lower=lower) for name in names)))
    return Linear(time, data, columns, (one("a"), one("b")), found)


def of(data):
    system = waves(data)
    base = fit(system, system.base, {})
    linear = Linearisation(system, base, system.candidates)
    return chance(linear, score_all(linear, system.candidates), 1.0, draws=1000)


@pytest.mark.statistical
def test_the_probability_is_uniform_where_nothing_is_missing(rng):
    found = [of(rng.standard_normal(120)) for _ in range(250)]
    p = np.array([c.p_value for c in found])
    assert stats.kstest(p, "uniform").pvalue > 1e-3
    for level in (0.2, 0.05):
        assert stats.binomtest(int(np.sum(p < level)), len(p), level).pvalue > 1e-3
    # 25 waves that overlap are fewer independent chances, and more than none
    assert 5 < np.median([c.tests for c in found]) < 25


def test_what_is_there_is_improbable(rng):
    system = waves(np.zeros(120))
    assert of(rng.standard_normal(120) + 2.0 * system.columns["c9"]).p_value < 1e-10
    # a wave that may only be positive does not gain from its opposite, but its neighbours do
    assert of(rng.standard_normal(120) - 2.0 * system.columns["c10"]).p_value < 1e-10
    assert of(rng.standard_normal(120)).p_value > 1e-3


def test_the_tail_of_ljung_and_box_is_as_stated_in_short_series(rng):
    """Chi-square's is too thin: at 200 samples its 1e-3 is seen four times as often."""
    statistic = ljung_box(rng.standard_normal((200, 20_000)))
    for level in (0.05, 0.01, 1e-3):
        seen = int(sum(ljung_box_p_value(x, 200) < level for x in statistic if x > 25))
        assert stats.binomtest(seen, 20_000, level).proportion_ci(1 - 1e-4).high > 0.7 * level
        assert seen / 20_000 < 1.3 * level + 4 * np.sqrt(level / 20_000)
    assert np.mean(stats.chi2.sf(statistic, 20) < 1e-3) > 2.5e-3


def test_a_slow_wave_is_no_noise_and_named_after_the_frequency_that_it_lies_at(rng):
    wave = rng.standard_normal((500, 3)) + np.sin(2 * np.pi * 27.0 * np.arange(500) / 1000.0)[:, None]
    answer = whiteness(wave, 1000.0, {"precession": 27.0})
    assert answer.p_value < 1e-6
    assert answer.peak_near == ("precession",) * 3
    assert (answer.peak_p_value < 1e-6).all()


TILT = tuple(Quantity(f"table_tilt.tilt_{axis}", "rad", 1e-6) for axis in "xy")
DECLARED = Quantity("km.k_m", "m s^2", 1e-9)
CANDIDATE = Candidate("table_tilt", "table_tilt", "motion", "table tilted", "", TILT)


def told(values, sigmas, correlation=0.0):
    covariance = np.diag(np.square(sigmas)).astype(float)
    covariance[1, 2] = covariance[2, 1] = correlation * sigmas[1] * sigmas[2]
    numbers = dict(zip(("table_tilt.tilt_x", "table_tilt.tilt_y", "km.k_m"), values, strict=True))
    fitted = Fit((*TILT, DECLARED), numbers, covariance, 100.0, 0.0, 100, True, 3)
    return bounds(Found(CANDIDATE, 50.0, 10.0, 10.0, ()), fitted)


@pytest.mark.parametrize(
    ("tilt_y", "correlation", "why"),
    [(-4e-6, 0.0, None), (1e-6, 0.0, "by the noise"), (1e-6, -0.97, "as km.k_m moves with it")],
)
def test_a_number_that_may_be_zero_is_bounded_and_what_keeps_it_open_is_named(tilt_y, correlation, why):
    bounded = told((5e-6, tilt_y, 1.0), (1e-6, 1e-6, 0.1), correlation)
    assert bounded == ([f"tilt_y is only bounded, |tilt_y| < 2.96 µrad (95 %), {why}"] if why else [])


def two_nearly_equal_slopes(seed):
    """y = a t + b t^1.1 + c with noise of variance 1."""
    time = np.linspace(0.5, 1.5, 200)
    columns = {"a": time, "b": time**1.1, "c": np.ones(200)}
    observed = 3 * columns["a"] + 2 * columns["b"] + 1 + np.random.default_rng(seed).standard_normal(200)
    return Linear(time, observed, columns, [one(name) for name in "abc"])


def test_the_combination_that_is_known_is_known_as_well_as_stated():
    errors, sigmas, alone = [], [], []
    for seed in range(60):
        system = two_nearly_equal_slopes(seed)
        found = fit(system, system.base, {})
        (pair,) = correlated(found, ["a"], ["b"])
        errors.append(pair.value - (3.0 + pair.factor * 2.0))
        sigmas.append(pair.sigma)
        alone.append(found.sigma("a"))
    assert pair.correlation < -0.99
    assert max(sigmas) < 0.1 * min(alone)
    assert np.sqrt(np.mean((np.array(errors) / sigmas) ** 2)) == pytest.approx(1.0, abs=4 / np.sqrt(120))
