"""Sigmas of a gain beside arithmetic of 60 digits; probabilities by chance are uniform where nothing is missing."""

import numpy as np
import pytest
from mpmath import mp
from numpy.testing import assert_allclose
from scipy import stats

from disctrack.discrepancy.fit import fit
from disctrack.discrepancy.score import Linearisation, score_all
from disctrack.discrepancy.significance import as_sigmas, chance, false_discovery, ljung_box, no_memory, whiteness
from tests.oracles.linear_system import Linear, candidate, one


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


def test_false_discoveries_among_many_recordings_are_as_stated(rng):
    """Benjamini and Hochberg's own example of fifteen p values, and 300 batches with ten true effects in forty."""
    known = [0.0001, 0.0004, 0.0019, 0.0095, 0.0201, 0.0278, 0.0298, 0.0344, 0.0459, 0.324, 0.4262, 0.5719, 0.6528,
             0.759, 1.0]  # fmt: skip
    assert int(np.sum(false_discovery(known) <= 0.05)) == 4
    assert false_discovery([]).size == 0
    shares = []
    for _ in range(300):
        z = rng.standard_normal(40)
        z[:10] += 3.5
        claimed = false_discovery(2 * stats.norm.sf(np.abs(z))) < 0.1
        shares.append(claimed[10:].sum() / max(claimed.sum(), 1))
    assert np.mean(shares) == pytest.approx(0.075, abs=4 * np.std(shares) / np.sqrt(300))
    naive = 30 * 0.1 / (30 * 0.1 + 10)
    assert np.mean(shares) < 0.5 * naive


def test_the_tail_of_ljung_and_box_is_as_stated_in_short_series(rng):
    """Chi-square's is too thin: at 200 samples its 1e-3 is seen four times as often."""
    statistic = ljung_box(rng.standard_normal((200, 20_000)))
    for level in (0.05, 0.01, 1e-3):
        seen = int(sum(no_memory(x, 200) < level for x in statistic if x > 25))
        assert stats.binomtest(seen, 20_000, level).proportion_ci(1 - 1e-4).high > 0.7 * level
        assert seen / 20_000 < 1.3 * level + 4 * np.sqrt(level / 20_000)
    assert np.mean(stats.chi2.sf(statistic, 20) < 1e-3) > 2.5e-3


def test_a_slow_wave_is_no_noise_and_named_after_the_frequency_that_it_lies_at(rng):
    wave = rng.standard_normal((500, 3)) + np.sin(2 * np.pi * 27.0 * np.arange(500) / 1000.0)[:, None]
    answer = whiteness(wave, 1000.0, {"precession": 27.0})
    assert answer.p_value < 1e-6
    assert answer.peak_near == ("precession",) * 3
    assert (answer.peak_p_value < 1e-6).all()
