"""A tossed cube: hidden effects are found, named and sized; noise is not; the published tosses hold several."""

import json
from copy import copy

import numpy as np
import pytest

from disctrack.examples import cube_tosses
from disctrack.examples._command import command
from tests.oracles import tossed_cube

N = 50  # tosses that are simulated


@pytest.fixture(scope="module")
def published(shared_data):
    folder = shared_data / "contactnets_cube"
    if not (folder / "cube_tosses.npz").is_file():
        pytest.skip(f"{folder} is not there")
    return cube_tosses.read_tosses(folder)


@pytest.fixture(scope="module")
def answer(published):
    system = system_of(published)
    return system, cube_tosses.diagnosed(system)


def system_of(tosses):
    return cube_tosses.CubeTosses(cube_tosses.flights(cube_tosses.without_copies(tosses)))


def simulated(rng, folder, n=N, **hidden):
    state, offset = tossed_cube.toss(rng, n, **hidden)
    np.savez(folder / "cube_tosses.npz", state=state.astype(np.float32), offset=offset)
    return cube_tosses.read_tosses(folder)


def named(diagnosis):
    return {f.candidate.name for f in diagnosis.found}


@pytest.mark.statistical
@pytest.mark.parametrize(
    ("hidden", "expected"),
    [
        ({}, {}),
        (
            {"scale": 0.015, "centre_of_mass": (2e-3, 0, -1e-3)},
            {"length_scale.change": 0.015, "centre_of_mass.c_1": 2e-3, "centre_of_mass.c_3": -1e-3},
        ),
        ({"inertia": (1.08, 1.06, 1.0)}, {"principal_moments.e_11": 0.08, "principal_moments.e_22": 0.06}),
        ({"lean": 0.01}, {"toss_tilt.across": 0.01}),  # with every toss, not in the room
    ],
    ids=["nothing", "scale and centre of mass", "inertia", "a vertical that leans with every toss"],
)
def test_what_is_hidden_in_simulated_tosses_is_named_and_sized(rng, tmp_path, hidden, expected):
    found = cube_tosses.diagnosed(system_of(simulated(rng, tmp_path, **hidden)))
    assert named(found) == {key.partition(".")[0] for key in expected}
    assert found.verdict == ("found" if expected else "nothing missing")
    for key, value in expected.items():
        # four sigmas, and what first order leaves out: a fiftieth
        assert abs(found.after.values[key] - value) < 4 * found.after.sigma(key) + 0.02 * abs(value)


@pytest.mark.statistical
def test_gravity_and_frame_rate_are_one_number_where_cubes_at_rest_deny_the_scale(rng, tmp_path):
    found = cube_tosses.diagnosed(system_of(simulated(rng, tmp_path, gravity=9.7)))
    (effect,) = found.found
    alternatives = {r.candidate.name for r in effect.cannot_be_told_from}
    assert {effect.candidate.name} | alternatives == {"gravity", "frame_rate"}


def test_flights_end_before_contact_and_begin_after_release(published):
    tosses = cube_tosses.without_copies(published[:180])
    found = cube_tosses.flights(tosses)
    assert len(found) > 0.85 * len(tosses)
    for f in found[::10]:
        assert f.toss.clearance[1 : 1 + len(f.time)].min() > cube_tosses.CLEARANCE
    # second differences of the height scatter about g by sqrt(6) x 24 um x rate^2 = 1.3 m/s^2; a contact adds hundreds
    bends = np.concatenate([np.diff(f.position[:, 2], 2) for f in found]) * 148.0**2
    assert np.percentile(np.abs(bends + 9.6), 99.5) < 6


def test_some_published_tosses_are_copies_of_others_turned_about_the_vertical(published):
    assert (len(published), len(cube_tosses.without_copies(published))) == (570, 537)


@pytest.mark.statistical
def test_published_tosses_lack_a_scale_a_vertical_and_the_place_of_the_centre_of_mass(answer):
    system, d = answer
    assert d.verdict == "found"
    assert {"length_scale", "toss_tilt", "centre_of_mass", "tag_axes"} <= named(d)
    assert d.before.reduced_chi_square == pytest.approx(3.4, abs=0.3)
    assert d.after.reduced_chi_square < 1.05
    assert d.held_out_after.ratio_to_floor < 1.05
    values = d.after.values
    assert values["length_scale.change"] == pytest.approx(-0.0249, abs=0.001)
    assert d.after.sigma("length_scale.change") < 5e-4
    assert values["toss_tilt.across"] == pytest.approx(0.0138, abs=0.002)
    assert values["centre_of_mass.c_3"] == pytest.approx(5.4e-3, abs=0.6e-3)
    assert values["principal_moments.e_11"] == pytest.approx(0.064, abs=0.01)
    assert values["principal_moments.e_22"] == pytest.approx(0.052, abs=0.01)
    before, after = cube_tosses.errors(system, d)
    assert all(after[group] < 0.6 * before[group] for group in ("horizontal", "vertical"))
    assert after["horizontal"] < 30e-6
    assert after["vertical"] < 26e-6


@pytest.mark.statistical
def test_what_a_flight_s_own_motion_makes_whole_leaves_no_trace(answer):
    """A delay of the positions is another start, a smoothed parabola another height."""
    outcome = {t.candidate.name: (t.score, t.reason) for t in answer[1].tried}
    for name in ("clock_offset", "smoothing"):
        assert outcome[name][0] == 0
        assert "leaves no trace" in outcome[name][1]


@pytest.mark.statistical
def test_a_wrong_effect_alone_does_not_bring_the_residual_to_noise(answer):
    system = copy(answer[0])
    system.candidates = tuple(c for c in system.candidates if c.name in ("clock_offset", "rotational_drag", "tilt"))
    refused = cube_tosses.diagnosed(system)
    assert refused.verdict == "unexplained"
    assert not refused.found


@pytest.mark.statistical
def test_shuffled_residuals_of_the_tosses_give_no_finding(answer, rng):
    system, d = copy(answer[0]), answer[1]
    residual, _ = system.linearise(d.after.values, [])
    system.seen = rng.permutation(residual[:, 0])
    assert not cube_tosses.diagnosed(system).found


def test_command_writes_the_diagnosis_of_the_tosses(rng, tmp_path, capsys):
    simulated(rng, tmp_path, 30, scale=-0.02)
    command(cube_tosses.example, "tosses", [str(tmp_path), "-o", str(tmp_path / "out")])
    assert "length_scale" in capsys.readouterr().out
    found = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert found["verdict"] == "found"
    assert found["effects"][0]["name"] == "length_scale"
    assert found["after"]["reduced_chi_square"] < 1.15
    assert found["before"]["rms"]["vertical"] > found["after"]["rms"]["vertical"]
    with pytest.raises(SystemExit):
        command(cube_tosses.example, "tosses", [str(tmp_path / "out")])
    assert "cube_tosses.npz" in capsys.readouterr().err
