"""Faults are planted, run and compared; what is off by more than its sigmas and not named is told."""

from dataclasses import replace

import numpy as np
import pytest

from disctrack.faults.catalogue import FAULTS
from disctrack.synthetic.description import Scene
from disctrack.validate import planted_faults

WELL = planted_faults.FaultOutcome("rendered", "turned", 3e-4, "rad", 2.0, "camera moved, doubt", True, 3)


@pytest.mark.parametrize(
    ("outcome", "said"),
    [
        (WELL, ""),
        (replace(WELL, worst=400.0), ""),
        (replace(WELL, worst=0.0, told="refused", named=False, code=1), ""),
        (replace(WELL, worst=5.1, named=False), "5.1 sigma off, and not named"),
        (replace(WELL, code=-11), "exit code -11"),
    ],
)
def test_a_pose_beyond_its_sigmas_that_nothing_names_is_a_complaint(outcome, said):
    (complaint,) = planted_faults.faults_validation([outcome]).complaints or ("",)
    assert said in complaint
    assert bool(said) == bool(complaint)


def test_the_table_tells_from_which_size_on_a_fault_is_named_and_what_was_missed_below():
    small, large = replace(WELL, size=1e-5, worst=1.2, named=False), replace(WELL, size=1e-3, worst=90.0)
    filmed = [replace(one, make="clip", named=not one.named) for one in (small, WELL, large)]
    lines = planted_faults.faults_validation([large, small, WELL, *filmed]).markdown().splitlines()
    assert "| turned [rad] | 0.0003 | 1.2 | - | 90 |" in lines


def test_every_fault_of_the_catalogue_that_a_run_can_show_is_planted(sample_clip):
    kinds = {fault.name for fault in FAULTS if fault.named_by}
    filmed = planted_faults.Ground(sample_clip, None, np.empty((0, 6)))
    assert kinds <= planted_faults.plantings(replace(filmed, scene=Scene())).keys()
    assert kinds - planted_faults.plantings(filmed).keys() == {"time_offset", "exposure_blur"}, (
        "what is no matter of rig, disc, dots or rate"
    )


@pytest.fixture(scope="module")
def grounds(sample_clip, tmp_path_factory):
    return list(planted_faults.untouched(tmp_path_factory.mktemp("planted"), [sample_clip]))


@pytest.mark.statistical
def test_some_faults_of_one_size_are_named_or_within_the_sigmas(grounds):
    names = ("turned", "shifted", "pattern_offset", "radius", "pairs lost by both", "negative views")
    largest = {(case[0].recording, case[1]): case for case in planted_faults.fault_cases(grounds)}
    outcomes = [planted_faults.plant_and_run(case) for (_, name), case in largest.items() if name in names]
    assert planted_faults.faults_validation(outcomes).complaints == []
    assert {outcome.fault for outcome in outcomes} == set(names)
    assert sum(outcome.named for outcome in outcomes) >= len(outcomes) - 1


@pytest.mark.slow
def test_no_fault_of_any_size_is_silently_wrong_but_those_below_a_known_limit(grounds):
    outcomes = [planted_faults.plant_and_run(case) for case in planted_faults.fault_cases(grounds)]
    # off by more than the sigmas, and not named: too small to be seen
    assert {(o.fault, round(o.size, 9)) for o in outcomes if [*planted_faults.complaints([o])]} <= {
        ("pattern_offset", 3e-6)
    }
