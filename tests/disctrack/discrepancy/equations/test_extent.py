"""Equations that fail at one event: until when they hold, since when again, and what happened in between.

Motions come from SciPy's `solve_ivp`, in pieces: a blow changes the velocity between two of them.
"""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from disctrack.discrepancy.equations import Equations, Run, diagnose, terms
from disctrack.discrepancy.search import Settings

pytestmark = pytest.mark.statistical
OSCILLATOR = Equations({"x": "v", "v": "-k*x - c*v"}, {"k": 8.5, "c": 0.1}, units={"x": "m"})
OFFERED = [terms.quadratic("v")]
TIME = np.linspace(0, 12, 1200)
SIGMA = 1e-3


def swinging(rate, start, time):
    return solve_ivp(
        lambda t, y: [y[1], -9.0 * y[0] - 0.2 * y[1] + rate(t, *y)], time[[0, -1]], start, t_eval=time,
        rtol=1e-10, atol=1e-12, max_step=0.02,
    ).y  # fmt: skip


def asked(rng, x):
    return diagnose(
        OSCILLATOR,
        Run(TIME, {"x": x + rng.normal(0, SIGMA, len(TIME))}, sigma=SIGMA),
        OFFERED,
        settings=Settings(max_effects=1),
    )


@pytest.mark.parametrize(("blow", "instant"), [(0.4, 4.0), (-0.15, 9.6)])
def test_a_blow_is_told_by_its_instant_and_by_how_much_the_velocity_changed(rng, blow, instant):
    row = int(np.searchsorted(TIME, instant))
    first = swinging(lambda t, x, v: 0.0, [0.5, 0.0], TIME[: row + 1])
    last = swinging(lambda t, x, v: 0.0, first[:, -1] + [0.0, blow], TIME[row:])
    answer = asked(rng, np.append(first[0], last[0, 1:]))
    assert answer.verdict == "unexplained"
    holds = answer.holds
    assert holds.until < holds.since < holds.until + 0.1
    assert holds.until - 0.05 < TIME[row] < holds.since + 0.05
    change, sigma = holds.changes["v"]
    # the oscillation turns what happened before the last part begins by omega times that time
    assert change == pytest.approx(blow * np.cos(3.0 * (holds.since - TIME[row])), abs=4 * sigma + 0.01 * abs(blow))
    assert 0 < sigma < 0.01
    assert f"until {holds.until:.5g} s and from {holds.since:.5g} s on; in between" in answer.sentence


def test_after_a_drag_that_sets_in_nothing_is_said_of_states_that_changed(rng):
    x = swinging(lambda t, x, v: -3.0 * v * (t > 7.0), [0.5, 0.0], TIME)[0]
    holds = asked(rng, x).holds
    assert holds.until == pytest.approx(7.0, abs=0.15)
    assert not holds.changes


def test_where_something_acts_all_the_time_the_equations_hold_nowhere(rng):
    answer = asked(rng, swinging(lambda t, x, v: -3.0 * x * np.sin(1.7 * t), [0.5, 0.0], TIME)[0])
    assert answer.verdict == "unexplained"
    assert (answer.holds.until, answer.holds.since, answer.holds.changes) == (None, None, {})
    assert "Refitted" not in answer.sentence


def test_of_what_is_explained_no_extent_is_sought(rng):
    answer = asked(rng, swinging(lambda t, x, v: -0.1 * v * abs(v), [0.5, 0.0], TIME)[0])
    assert answer.found == ("quadratic_v",)
    assert answer.holds is None


def test_data_that_begin_late_and_a_gap_change_nothing(rng):
    row = int(np.searchsorted(TIME, 4.0))
    first = swinging(lambda t, x, v: 0.0, [0.5, 0.0], TIME[: row + 1])
    x = np.append(first[0], swinging(lambda t, x, v: 0.0, first[:, -1] + [0.0, 0.4], TIME[row:])[0, 1:])
    x[:150] = x[700:720] = np.nan
    holds = asked(rng, x).holds
    assert holds.until == pytest.approx(4.0, abs=0.05)
    assert holds.since == pytest.approx(4.0, abs=0.05)
    assert holds.changes["v"][0] == pytest.approx(0.4, abs=0.01)
