"""What the rates of the diagnosis rest on: what is planted is what the diagnosis means by the name of the effect."""

import numpy as np
import pytest

from disctrack.diagnosis import DiscSystem
from disctrack.diagnosis.model_file import declared_model
from disctrack.diagnosis.trials.hidden_effects import HIDDEN_EFFECTS, Planted, hidden_effect
from disctrack.diagnosis.trials.power import power
from disctrack.diagnosis.trials.rates import draw, trajectory_of, trial
from disctrack.discrepancy.fit import fit

# whose planting takes another way than the prediction: through the renderer's faults, instants, frames, areas
MEASUREMENT = {e.name for e in HIDDEN_EFFECTS if e.visible and not e.plant(e.size, np.random.default_rng(1)).effects}


def candidate_of(system, truth):
    return next(c for c in system.candidates if set(truth) <= set(c.names))


@pytest.mark.parametrize(
    "name",
    [
        e.name if e.name in MEASUREMENT else pytest.param(e.name, marks=pytest.mark.slow)
        for e in HIDDEN_EFFECTS
        if e.visible
    ],
)
def test_a_planted_effect_is_what_the_diagnosis_calls_by_that_name(name):
    """Fitted alone, it comes out at the planted size within its sigma, and leaves noise."""
    effect = hidden_effect(name)
    planted = effect.plant(effect.size, np.random.default_rng(7))
    recording = draw(5, planted)
    trajectory = trajectory_of(recording, planted, n=150)
    system = DiscSystem(trajectory, declared_model(trajectory, "paper").model)
    candidate = candidate_of(system, planted.truth)
    base = tuple(q for q in system.base if q.name not in candidate.names)
    of_shape = {k: v for k, v in planted.effects.items() if k not in planted.truth}
    found = fit(system, (*base, *candidate.quantities), system.start() | of_shape)
    assert found.converged
    # 3600 numbers: 1 +- 0.024
    assert found.reduced_chi_square < 1.1
    for key, value in planted.truth.items():
        assert abs(found.values[key] - value) < 4 * found.sigma(key), key


@pytest.mark.statistical
def test_a_trial_tells_what_became_of_the_hidden_effect():
    verdict = trial([hidden_effect("time_offset")], [1e-4], seed=3)
    assert verdict.named
    assert verdict.within
    assert verdict.at_noise
    assert verdict.extra == 0
    assert verdict.free_run_before > 1.2
    assert verdict.can_be_told
    # by itself it gains what it stands out by; scatter of a normal number
    assert verdict.stands_out == pytest.approx(np.sqrt(verdict.gain), abs=4)


@pytest.mark.statistical
def test_an_effect_below_its_sigma_is_not_asked_for():
    """A hundredth of what is found leaves a bound; two that the recording cannot tell apart do so, however large."""
    faint = trial([hidden_effect("time_offset")], [1e-7], seed=3)
    assert not faint.named
    assert not faint.can_be_told
    alike = trial([hidden_effect("frame_rate"), hidden_effect("gravity")], [0.012, 0.05], seed=3)
    assert alike.gain > 1e4
    assert not alike.can_be_told


@pytest.mark.statistical
def test_a_trial_without_an_effect_finds_nothing():
    verdict = trial([], [], seed=4)
    assert verdict.verdict == "nothing missing"
    assert verdict.found == ()


@pytest.mark.statistical
def test_an_effect_stands_out_by_what_its_refit_gains():
    """The power curve's prediction, of a linearisation without the effect, is the gain of a fit with it."""
    effect, seed = hidden_effect("table_tilt"), 6
    (predicted,) = power([effect], [seed], rate=500.0)
    size = 20.0 / predicted.standing_out[0] * effect.size
    planted = effect.plant(size, np.random.default_rng([seed, 34]))
    trajectory = trajectory_of(draw(seed, Planted({}), 500.0), planted)
    system = DiscSystem(trajectory, declared_model(trajectory, "paper").model)
    base = fit(system, system.base, system.start())
    more = fit(system, (*base.quantities, *candidate_of(system, planted.truth).quantities), base.values)
    # noncentral chi-square of two degrees at 20^2: 402 +- 40
    assert base.cost - more.cost == pytest.approx(402, abs=4 * 40)
    assert predicted.probability(size) > 0.999
    assert predicted.probability(0.01 * size) < 0.01
    assert 0 < predicted.smallest(0.5) < predicted.smallest(0.9) < size


@pytest.mark.slow
def test_beside_an_effect_that_was_looked_for_another_of_the_catalogue_is_tried_before_a_law_outside_of_it():
    """A shaken table and a dot 20 um off: the shaking alone left chi-square 1.006, but no noise."""
    effects = [hidden_effect(name) for name in ("table_shaken", "misprint")]
    verdict = trial(effects, [e.size for e in effects], 10, 500.0)
    assert verdict.named
    assert verdict.within
    assert verdict.verdict == "found"
    assert verdict.extra == 0
