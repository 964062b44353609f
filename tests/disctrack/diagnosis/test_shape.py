"""The exponent or scale of a law that was found is measured where the recording determines it, and only there."""

import pytest

from disctrack.diagnosis import DiscSystem, diagnose
from disctrack.diagnosis.model_file import declared_model
from disctrack.discrepancy.fit import fit
from disctrack.discrepancy.search import explain
from disctrack.discrepancy.shape import profiled
from disctrack.validate.diagnoses import HiddenCase, recorded
from tests.oracles.measured_disc import assert_sized, measured, system_of


@pytest.mark.statistical
def test_an_exponent_is_measured_along_its_profile():
    trajectory = measured({"rolling_power.k": 4e-4, "rolling_power.p": 1.0}, k_m=0.0, seed=72, n=250, theta_deg=5.0)
    system = system_of(trajectory, model="none")
    (power,) = [c for c in system.candidates if c.name == "rolling_power"]
    nominal = fit(system, (*system.base, *power.quantities), system.start())
    free = profiled(system, nominal, power.shape[0], 0.1)
    assert free.converged
    assert_sized(free, {"rolling_power.p": 1.0}, 4, 4 * 0.05)
    assert free.reduced_chi_square < 1.1 < nominal.reduced_chi_square


def test_an_exponent_that_cannot_be_seen_is_said_to_be_assumed():
    """At 14 deg and over 0.2 s the rate hardly changes: any exponent gives the same moment."""
    trajectory = measured({"rolling_power.k": 2e-4}, seed=74, n=200)
    system = system_of(trajectory, ["rolling_power"])
    answer = explain(system, system.start())
    assert [f.candidate.name for f in answer.found] == ["rolling_power"]
    assert "rolling_power.p" not in answer.after.names
    (note,) = answer.remarks
    assert "does not determine p" in note


@pytest.mark.slow
def test_a_law_beyond_the_declared_one_is_found_by_its_exponent():
    """With p = 2.8 beside the k_m of p = 2 the law at its nominal p = 1.5 would have to be negative."""
    hidden = {"rolling_power.k": 1.5e-4, "rolling_power.p": 2.8}
    result = diagnose(measured(hidden, seed=71, n=400, theta_deg=8.0))
    (found,) = result.diagnosis.found
    assert found.candidate.name == "rolling_power"
    assert_sized(result.diagnosis.after, {"rolling_power.p": 2.8}, 4)
    assert result.after.reduced_chi_square < 1.1
    assert "p = " in result.sentence


@pytest.mark.slow
def test_the_pivoting_rate_at_which_creep_begins_is_measured():
    hidden = {"pivoting_contensou.k": 6e-5, "pivoting_contensou.omega_s": 4.0}
    result = diagnose(measured(hidden, seed=74, n=400))
    (found,) = result.diagnosis.found
    assert found.candidate.name == "pivoting_contensou"
    assert_sized(result.diagnosis.after, {"pivoting_contensou.omega_s": 4.0}, 4)
    assert "pivoting_contensou.a" not in result.diagnosis.after.names  # without slip its radius does nothing


@pytest.mark.slow
def test_a_flat_of_the_rim_beside_a_fault_of_a_camera_is_no_inertia():
    """The flat's place has to be looked for, and only an effect that stands in for it is met by the search."""
    _, trajectory = recorded(HiddenCase({"rim_flat": 1e-5, "distortion": 0.05}, seed=2014, rate=500.0))
    model = declared_model(trajectory).model
    every = {c.name: c for c in DiscSystem(trajectory, model).candidates}

    def found(*names):
        system = DiscSystem(trajectory, model, tuple(every[name] for name in names))
        return explain(system, system.start())

    answer = found("right_distortion", "inertia_product", "rim_flat")
    assert [f.candidate.name for f in answer.found] == ["right_distortion", "rim_flat"]
    assert_sized(answer.after, {"rim_flat.depth": 1e-5, "rim_flat.width": 0.15, "right_distortion.k1": -0.05}, 3)
    without = found("right_distortion", "inertia_product")  # noise is left there, too
    assert [f.candidate.name for f in without.found] == ["right_distortion", "inertia_product"]
    assert answer.after.cost < without.after.cost - 30.0
