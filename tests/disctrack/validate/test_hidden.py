"""What the rates of the diagnosis rest on: what is planted is what the diagnosis means by the name of the effect."""

from dataclasses import replace

import numpy as np
import pytest

from disctrack.diagnosis import DiscSystem
from disctrack.diagnosis.model_file import declared_model
from disctrack.discrepancy.fit import fit
from disctrack.errors import DiscTrackError
from disctrack.validate import hidden
from disctrack.validate.hidden import HiddenCase, Verdict, hidden_cases, plant, sizes
from disctrack.validate.points import drawn, measured
from tests.oracles.measured_disc import assert_sized


def visible(name):
    """Faults of the measurement are planted in another way than predicted: by renderer, instants, frames, areas."""
    return name if hidden.candidates()[name][0].kind == "measurement" else pytest.param(name, marks=pytest.mark.slow)


@pytest.mark.parametrize("name", [visible(name) for name in sizes() if name not in hidden.INVISIBLE])
def test_a_planted_effect_is_what_the_diagnosis_calls_by_that_name(name):
    """Fitted alone, it comes out at the planted size within its sigma, and leaves noise."""
    truth, planted = plant(name, sizes()[name], np.random.default_rng(7))
    scene = drawn(5, planted)
    trajectory = measured(scene.changed(cameras={"n_frames": 150}))
    system = DiscSystem(trajectory, declared_model(trajectory)[0])
    candidate = next(c for c in system.candidates if set(truth) <= set(c.names))
    base = tuple(q for q in system.base if q.name not in candidate.names)
    of_shape = {k: v for k, v in planted.items() if k not in truth}
    found = fit(system, (*base, *candidate.quantities), system.start() | of_shape)
    assert found.converged
    # 3600 numbers: 1 +- 0.024
    assert found.reduced_chi_square < 1.1
    assert_sized(found, truth, 4)


@pytest.mark.statistical
def test_a_verdict_tells_what_became_of_the_hidden_effect():
    verdict = Verdict(HiddenCase({"time_offset": 1e-4}, seed=3))
    assert verdict.named
    assert verdict.within
    assert verdict.at_noise
    assert verdict.extra == 0
    assert verdict.free_run[0] > 1.2
    assert verdict.can_be_told
    assert hidden.what_was_wrong(verdict) == ""
    # by itself it gains what it stands out by; scatter of a normal number
    assert verdict.stands_out == pytest.approx(np.sqrt(verdict.gain), abs=4)
    # and of the size that it is found from it gains what a claim takes, within the same scatter
    faint = Verdict(replace(verdict.case, hidden={"time_offset": verdict.found_from}))
    assert faint.stands_out == pytest.approx(faint.needed, rel=0.2)


@pytest.mark.statistical
def test_an_effect_below_its_sigma_is_not_asked_for():
    """A hundredth of what is found leaves a bound; two that the recording cannot tell apart do so, however large."""
    faint = Verdict(HiddenCase({"time_offset": 1e-7}, seed=3))
    assert not faint.named
    assert not faint.can_be_told
    # 10 um of the radius, of which the base model allows 3: ten times that stands out
    of_radius = [Verdict(HiddenCase({"contact_radius": size}, seed=3)).can_be_told for size in (1e-5, 1e-4)]
    assert of_radius == [False, True]
    alike = Verdict(HiddenCase({"frame_rate": 0.012, "gravity": 0.05}, seed=3))
    assert alike.gain > 1e4
    assert not alike.can_be_told


@pytest.mark.statistical
def test_nothing_is_found_where_nothing_is_hidden_and_the_table_says_so():
    verdict = Verdict(HiddenCase({"nothing": 1.0}, seed=4))
    assert verdict.verdict == "nothing missing"
    assert verdict.found == []
    validation = hidden.diagnosis_validation([verdict])
    assert validation.headline == "Something claimed in 0 of 1 recordings in which nothing is hidden."
    assert 0 < verdict.p_value < 1
    assert f"{verdict.p_value < 0.5:d} of 1 |" in validation.markdown()


def test_cases_are_told_by_name_and_size_and_pairs_are_drawn_anew_for_each_seed():
    assert len(hidden_cases([], range(1, 3))) == 102
    (case,) = hidden_cases(["kz=1e-7"], [5])
    assert (dict(case.hidden), case.seed) == ({"kz": 1e-7}, 5)
    first, second = hidden_cases([], [7], pairs=2)
    assert (len(first.hidden), first.seed, second.seed) == (2, 7, 8)
    assert first.hidden.keys() != second.hidden.keys()
    with pytest.raises(DiscTrackError, match="there is no effect 'kx' to hide"):
        hidden_cases(["kx"], [1])
    with pytest.raises(DiscTrackError, match="size in m"):
        hidden_cases(["kz=much"], [1])


@pytest.mark.slow
def test_beside_an_effect_that_was_looked_for_another_of_the_catalogue_is_tried_before_a_law_outside_of_it():
    """A shaken table and a dot 20 um off: the shaking alone left chi-square 1.006, but no noise."""
    verdict = Verdict(HiddenCase({"table_shaken": 2e-6, "misprint": 3e-5}, seed=10, rate=500.0))
    assert verdict.named
    assert verdict.within
    assert verdict.verdict == "found"
    assert verdict.extra == 0
