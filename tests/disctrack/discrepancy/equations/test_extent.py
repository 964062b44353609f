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
TIME, SIGMA = np.linspace(0, 12, 1200), 1e-3


def swinging(rate=lambda t, x, v: 0.0, start=(0.5, 0.0), time=TIME):
    def rates(t, y):
        return [y[1], -9.0 * y[0] - 0.2 * y[1] + rate(t, *y)]

    return solve_ivp(rates, time[[0, -1]], start, t_eval=time, rtol=1e-10, atol=1e-12, max_step=0.02).y


def asked(rng, x):
    run = Run(TIME, {"x": x + rng.normal(0, SIGMA, len(TIME))}, sigma=SIGMA)
    return diagnose(OSCILLATOR, run, [terms.quadratic("v")], settings=Settings(max_effects=1))


@pytest.mark.parametrize(("blow", "row", "lost"), [(0.4, 400, ()), (-0.15, 960, ()), (0.4, 400, (range(150), [700]))])
def test_a_blow_is_told_by_its_instant_and_by_how_much_the_velocity_changed(rng, blow, row, lost):
    """Also where data begin late, and some are missing."""
    first = swinging(time=TIME[: row + 1])
    x = np.append(first[0], swinging(start=first[:, -1] + [0.0, blow], time=TIME[row:])[0, 1:])
    for rows in lost:
        x[rows] = np.nan
    answer = asked(rng, x)
    holds = answer.holds
    assert holds.until < holds.since
    assert [holds.until, holds.since] == pytest.approx([TIME[row]] * 2, abs=0.05)
    change, sigma = holds.changes["v"]
    # the oscillation turns what happened before the last part begins by omega times that time
    assert change == pytest.approx(blow * np.cos(3.0 * (holds.since - TIME[row])), abs=4 * sigma + 0.01 * abs(blow))
    assert 0 < sigma < 0.01
    assert f"until {holds.until:.5g} s and from {holds.since:.5g} s on; in between" in answer.sentence


def test_after_a_drag_that_sets_in_nothing_is_said_of_states_that_changed(rng):
    answer = asked(rng, swinging(lambda t, x, v: -3.0 * v * (t > 7.0))[0])
    assert answer.holds.until == pytest.approx(7.0, abs=0.15)
    assert not answer.holds.changes


def test_where_something_acts_all_the_time_what_comes_near_is_told_and_no_part_in_which_the_equations_hold(rng):
    answer = asked(rng, swinging(lambda t, x, v: -1.5 * v * abs(v) + 0.1 * np.sin(0.25 * t * t))[0])
    assert answer.verdict == "unexplained"
    assert (answer.holds.until, answer.holds.since, answer.holds.changes) == (None, None, {})
    assert "Refitted" not in answer.sentence
    assert any("[quadratic_v] (c = 1.4" in note and "would help most" in note for note in answer.notes)
