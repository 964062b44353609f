"""Effects hidden in measured trajectories, and dots misprinted alone, are found, named and sized; nothing else is."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy import stats

from disctrack.diagnosis import diagnose
from disctrack.diagnosis.pages.output import as_json
from disctrack.diagnosis.recorded import with_declared_dots
from disctrack.diagnosis.stage import with_plan
from disctrack.discrepancy.noise import common_modes
from disctrack.discrepancy.search import explain
from disctrack.faults.keys import Faults
from tests.oracles.measured_disc import assert_found, assert_sized, measured, system_of, with_base_fit


@pytest.mark.statistical
def test_a_thickness_within_its_tolerance_is_no_effect():
    """0.03 mm off in height, 2 sigma of what a caliper may err by and 20 of a micrometer's."""
    trajectory = measured({"contact_height.h_error": 3e-5}, seed=8, n=200, declared_rate=500.0)
    assert diagnose(trajectory).diagnosis.verdict == "found"
    disc = replace(trajectory.disc, thickness_tolerance=3e-5)
    result = diagnose(replace(trajectory, disc=disc))
    assert result.diagnosis.verdict == "nothing missing"
    assert_sized(result.diagnosis.after, {"contact_height.h_error": 3e-5}, 4, 3e-5)


@pytest.mark.statistical
def test_derivatives_agree_with_differences_of_the_prediction(monkeypatch):
    system, base = with_base_fit(measured({"kz.k_z": 2e-5}, seed=12, n=80))
    quantities = [*system.base[:9], *(q for c in system.candidates for q in c.quantities)]
    quantities = [q for q in quantities if not q.name.startswith(("exposure", "air_quadratic"))]
    values = {q.name: q.null for q in quantities} | base.values
    names = [q.name for q in quantities]
    _, derivative = system.linearise(values, names)
    with monkeypatch.context() as patch:  # nothing is integrated again, nor for effects that are absent
        patch.setattr("disctrack.diagnosis.disc_system.sensitivities", None)
        assert_array_equal(system.linearise(base.values, names)[1], derivative)
    for i, q in enumerate(quantities):
        low = 0.0 if np.isfinite(q.lower) else -1.0
        up, down = ({**values, q.name: values[q.name] + s * q.scale} for s in (1.0, low))
        difference = system.linearise(down, [])[0] - system.linearise(up, [])[0]
        numeric = difference / ((1.0 - low) * q.scale)
        size = np.abs(derivative[..., i]).max()
        # one-sided where the effect has a sign: then the error is the curvature over one step; and the integration errs
        # by some millionths of a sigma
        share, integration = 2e-2 if low == 0.0 else 1e-4, 1e-5 / ((1.0 - low) * q.scale)
        assert np.abs(numeric - derivative[..., i]).max() < share * max(size, 1e-12) + integration, q.name


@pytest.mark.slow
def test_false_alarms_are_rare():
    """Of 40 recordings with nothing hidden at most 2 may be found to lack something (one in 20)."""
    alarms = sum(bool(diagnose(measured(seed=1000 + i, n=400)).diagnosis.found) for i in range(40))
    assert alarms <= 2


@pytest.mark.statistical
def test_no_recording_is_proposed_to_tell_gravity_from_the_frame_rate():
    result = diagnose(measured(faults=Faults(frame_rate_hz=1004.0), seed=14, n=300))
    (found,) = result.diagnosis.found
    assert len(found.cannot_be_told_from) == 1
    # all laws at hand are quadratic in the rates: time can be stretched
    assert with_plan(result).plan.best(0).answers[0] < 0.01


HIDDEN = {  # faults, or effects; what is found, within so many sigmas, which are smaller than that; how it is measured
    "two effects": (
        None, {"table_tilt.tilt_x": 0.002, "kz.k_z": 2e-5}, 4, np.inf, {"seed": 6, "n": 250, "declared_rate": 500.0}
    ),
    "a turntable": (None, {"surface_moves.rate": 0.35}, 3, 3.5e-3, {"seed": 14, "n": 300}),
    "a clock that slows down": (
        Faults(frame_interval_growth=0.014), {"clock_drift.growth": 0.014}, 3, 1.4e-4, {"seed": 14, "n": 300}
    ),
    "a clock at twice the declared rate": (
        Faults(frame_rate_hz=2000.0), {"frame_rate.change": 1.0}, 4, 1e-3, {"seed": 1, "n": 200}
    ),
}  # fmt: skip


@pytest.mark.statistical
@pytest.mark.parametrize("name", HIDDEN)
def test_what_is_hidden_is_named_and_sized_and_is_no_law_without_a_name(name):
    faults, truth, sigmas, most, how = HIDDEN[name]
    result = diagnose(measured({} if faults else truth, faults=faults, **how))
    assert_found(result, truth, sigmas, most)
    assert result.learned is None
    assert "twice" not in name or any("precession" in note for note in result.notes)


@pytest.mark.slow
def test_slip_is_found_by_the_friction_at_which_it_sets_in():
    """Slip has no derivative where the disc does not slip yet: it is fitted from where it would begin."""
    result = diagnose(measured({"slip.mu": 0.1}, seed=100, n=300, theta_deg=20.0))
    assert [f.candidate.name for f in result.diagnosis.found] == ["slip"]
    mu = as_json(result)["effects"][0]["parameters"][0]
    assert mu["name"] == "mu"
    # switches between rolling and slip are instants of the noise too: a thousandth, far above sigma
    assert abs(mu["value"] - 0.1) < 1e-4
    assert result.after.reduced_chi_square < 1.1


@pytest.mark.statistical
def test_a_wrong_effect_offered_alone_is_refused_by_the_free_run():
    """Drag takes a part of what an unbalanced disc does to the fitted frames, and errs the more in those to come."""
    trajectory = measured({"centre_of_mass.c_1": 3e-5}, seed=9, n=160, declared_rate=500.0)
    answer = explain(system := system_of(trajectory, ["drag_rotation"]), system.start())
    assert answer.found == ()
    assert answer.verdict == "unexplained"
    (drag,) = answer.tried
    # of chi-square 1, noise alone reaches 8; the gain of 48 +- 14 would do, the loss of 90 +- 19 decides
    assert drag.gain > 16
    assert drag.held_out_gain < -30
    assert drag.reason == "the prediction of held-out data does not improve"
    right = explain(system := system_of(trajectory, ["drag_rotation", "centre_of_mass"]), system.start())
    assert [f.candidate.name for f in right.found] == ["centre_of_mass"]


@pytest.mark.statistical
def test_frames_that_scatter_as_a_whole_are_as_significant_as_chance_has_it():
    """What a tilted table leaves, frame by frame in random order and with a random sign: large, and made by no effect.

    About a motion whose tolerances are at their middle: what a fit has strained would truly be there.
    """
    p_values = []
    for seed in range(16):
        trajectory = measured({"table_tilt.tilt_x": 1e-3}, seed=100 + seed, n=160, declared_rate=500.0)
        system, base = with_base_fit(trajectory)
        assert base.reduced_chi_square > 4
        rng = np.random.default_rng(seed)
        scatter = rng.permutation(system.residual_px(base.values)) * rng.choice([-1.0, 1.0], (160, 1, 1, 1))
        values = base.values | {q.name: q.null for q in base.quantities if np.isfinite(q.prior_sigma)}
        answer = explain(system_of(replace(trajectory, markers_px=system.pixels(values) + scatter)), values)
        assert answer.found == ()
        p_values.append(answer.chance.p_value)
    # Fisher's sum of uniform ones
    assert -2 * np.sum(np.log(p_values)) < stats.chi2.isf(1e-3, 2 * len(p_values))


@pytest.mark.statistical
def test_a_camera_that_shakes_is_no_effect_of_the_motion():
    """Every frame of the right camera is shifted by 0.02 px, 3 sigma of a dot: a scatter that its dots share."""
    trajectory = measured(seed=12, n=200, declared_rate=500.0)
    shake = np.zeros((200, 2, 1, 2))
    shake[:, 1] = 0.02 * np.random.default_rng(4).standard_normal((200, 1, 2))
    system, base = with_base_fit(replace(trajectory, markers_px=trajectory.markers_px + shake))
    assert base.reduced_chi_square > 5
    vectors, variances = common_modes(system, base)
    # two directions of the right camera's dots and none else: 1 + 6 (0.02 / 0.006)^2 = 68, within 20 %
    assert variances[-2:] == pytest.approx([68, 68], rel=0.35)
    assert variances[:-2].max() < 3
    assert np.abs(vectors[:, :12, -2:]).max() < 0.1
    assert explain(system, base.values).found == ()


def test_independent_noise_has_no_common_modes():
    assert common_modes(*with_base_fit(measured(seed=13, n=200, declared_rate=500.0))) is None


@pytest.mark.statistical
def test_before_the_base_fit_has_converged_nothing_is_attributed():
    """From a start whose motion ends before the recording there is no fit; from the measured poses there is."""
    system = system_of(measured({"table_tilt.tilt_x": 5e-4}, seed=11, n=100, declared_rate=500.0))
    good = system.start()
    answer = explain(system, good | {"state.theta": np.radians(0.3), "state.omega2": 0.0})
    assert not answer.before.converged
    assert answer.verdict == "unexplained"
    assert answer.found == answer.tried == ()
    assert answer.held_out_before is None
    assert "has not converged" in answer.reason
    assert [f.candidate.name for f in explain(system, good).found] == ["table_tilt"]


@pytest.mark.statistical
def test_dots_of_one_camera_alone_are_diagnosed():
    trajectory = measured({}, seed=3, n=160)
    dots = trajectory.markers_px.copy()
    dots[:, 1] = np.nan
    assert diagnose(replace(trajectory, markers_px=dots)).diagnosis.verdict == "nothing missing"


SIGMA = np.full((6, 2), 0.3)


def shifts(of_dots):
    shift = np.zeros((6, 2))
    for dot, by in of_dots.items():
        shift[dot] = by
    return shift


@pytest.mark.parametrize("of_dots", [{2: (120, -80)}, {2: (120, -80), 4: (0, 9)}, {1: (12, 0)}])
def test_one_or_two_dots_out_of_six_come_back_to_their_declared_places(of_dots):
    trajectory, shift = measured(n=5), shifts(of_dots)
    told = {"marker_shift_um": shift.tolist(), "marker_shift_sigma_um": SIGMA.tolist()}
    declared = with_declared_dots(trajectory, told).disc.marker_centres_body
    moved = trajectory.disc.marker_centres_body - declared
    assert_allclose(moved[:, :2], 1e-6 * shift, atol=1e-15)
    assert_array_equal(moved[:, 2], 0.0)


@pytest.mark.parametrize(
    ("shift", "sigma"),
    [
        (0.5 * np.ones((6, 2)), SIGMA),  # within what dots may differ by
        (np.random.default_rng(1).normal(0, 20, (6, 2)), SIGMA),  # all of them are off
        (shifts({1: (12, 0)}), 5.0 + 0 * SIGMA),  # within its sigma
        (shifts({1: (400, 0)}), SIGMA),  # declared wrongly, and told by the tracking
        (shifts({1: (0, 50)}), []),  # an older file
    ],
)
def test_anything_else_is_no_misprint(shift, sigma):
    trajectory = measured(n=5)
    told = {"marker_shift_um": np.asarray(shift).tolist(), "marker_shift_sigma_um": np.asarray(sigma).tolist()}
    assert with_declared_dots(trajectory, told) is trajectory
