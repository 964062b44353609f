"""Recordings of the disc diagnosed together, and what a further one would bring."""

import json

import numpy as np
import pytest

from disctrack import Provenance, diagnose, write_trajectory
from disctrack.diagnosis.plan import Proposal, planner_alone
from disctrack.diagnosis.recorded import Recorded
from disctrack.diagnosis.together.recordings import diagnose_together
from disctrack.synthetic.description import Scene
from tests.oracles import newton_euler
from tests.oracles.measured_disc import K_M, assert_sized, measured, with_base_fit

RATE = 400.0
RIG = {"declared_rate": RATE, "rig_seed": 5}
F = 0.3


def independent(seed, f=0.0, axial=1.0):
    """A recording of a disc in world vectors and quaternions; `axial` times its moment about the axis."""
    declared = Scene().declared_disc
    rng = np.random.default_rng([seed, 5])
    J1, J3 = declared.moment_diametral, declared.moment_axial
    body = newton_euler.Disc(
        declared.radius, declared.half_thickness, declared.mass, J_body=np.diag([J1, J1, axial * J3]),
        laws=(newton_euler.precession_friction(K_M), newton_euler.moffatt(1.81e-5 * f)),
    )  # fmt: skip
    theta_deg, psi, omega3 = rng.uniform([4, -3, 0], [9, 3, 2])
    motion = newton_euler.filmed_motion(body, theta_deg, omega3, 130 / RATE, RATE, psi)
    return Recorded(f"run {seed}", measured(seed=seed, n=130, motion=motion, **RIG))


@pytest.mark.slow
def test_air_that_single_recordings_do_not_show_is_found_in_four_and_another_disc_is_named():
    filmed = [independent(seed, F) for seed in range(4)]
    alone = diagnose(filmed[0].trajectory).diagnosis
    assert "air_moffatt" not in {f.candidate.name for f in alone.found}
    answer = diagnose_together([*filmed[:2], independent(9, F, axial=1.02), *filmed[2:]])
    assert [r.name for r in answer.recordings if r.reason] == ["run 9"]
    (found,) = answer.diagnosis.found
    named = {found.candidate.name: answer.diagnosis.after} | {
        r.candidate.name: r.fit for r in found.cannot_be_told_from
    }
    assert_sized(named["air_moffatt"], {"air_moffatt.f": F}, 3)
    (bound,) = [b for b in answer.bounds if b.candidate.name == "air_moffatt"]
    assert bound.by_number[1][0] > F / 3
    assert bound.by_number[4][0] < 0.5 * bound.by_number[1][0]


@pytest.mark.slow
def test_nothing_is_claimed_of_recordings_without_an_effect_and_the_command_says_so(tmp_path, cli):
    paths = []
    for seed in range(4):
        paths.append(tmp_path / f"{seed}.h5")
        theta = 5.0 + seed
        trajectory = measured(seed=50 + seed, n=100, theta_deg=theta, **RIG)
        write_trajectory(paths[-1], trajectory, Provenance("one name", {"frames": str(seed)}, {}))
    command = "diagnose", *paths, "-o", tmp_path / "out", "-j", "2"
    assert "nothing is missing" in cli(*command).out
    document = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert document["verdict"] == "nothing missing"
    assert [r["left_out"] for r in document["recordings"]] == [""] * 4
    assert [r["name"] for r in document["recordings"]] == [f"{i}.h5" for i in range(4)]  # of one name: by their files
    value, sigma = (document["after"]["parameters"]["km.k_m"][k] for k in ("value", "sigma"))
    assert abs(value - K_M) < 3 * sigma
    alone = [r["alone"]["parameters"]["km.k_m"]["sigma"] for r in document["recordings"]]
    assert sigma < 0.8 * min(alone)
    page = (tmp_path / "out" / "diagnosis.html").read_text()
    assert "What many recordings bring" in page
    for bound in document["bounds"]:  # of a vector every number
        assert all(f">{p['name']}" in page for p in bound["parameters"])
    cli(*command)  # the complete result is used again
    assert "more than once" in cli("diagnose", paths[0], paths[0], code=1).err


@pytest.mark.statistical
def test_files_that_cannot_be_read_are_left_out_by_name_and_the_others_are_diagnosed(tmp_path, cli):
    for seed in range(2):
        trajectory = measured(seed=50 + seed, n=60, theta_deg=5.0 + seed, **RIG)
        write_trajectory(tmp_path / f"{seed}.h5", trajectory, Provenance(f"run {seed}", {"frames": str(seed)}, {}))
    (tmp_path / "empty.h5").write_bytes(b"")
    (tmp_path / "cut.h5").write_bytes((tmp_path / "0.h5").read_bytes()[:9000])
    files = [tmp_path / name for name in ("0.h5", "empty.h5", "1.h5", "cut.h5")]
    for _ in range(2):  # the second time the result is used again
        told = cli("diagnose", *files, "-o", tmp_path / "out", "-j", "1", "--verbose", code=3)
        out = " ".join(told.out.split())
        assert "2 recordings together (2 left out): nothing is missing" in out
        assert "empty.h5 was left out" in out
        assert "cut.h5 was left out" in out
        assert "2 recordings could not be used" in told.err
    document = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert [name.rpartition("/")[2] for name in document["unusable"]] == ["empty.h5", "cut.h5"]
    assert "empty.h5" in (tmp_path / "out" / "diagnosis.html").read_text()
    assert "empty.h5" in cli("diagnose", *files[:2], "-o", tmp_path / "other", code=1).err  # one alone is not many
    assert "mistyped.h5" in cli("diagnose", files[0], tmp_path / "mistyped.h5", code=1).err


@pytest.mark.slow
@pytest.mark.parametrize("mass", [1.0, 0.35])
def test_a_planned_recording_brings_what_it_brings_when_it_is_made(mass):
    """With another disc, too, whose k_m is its own."""
    first = measured(seed=1, n=120, theta_deg=6.0, omega3=1.0, **RIG)
    result = diagnose(first)
    system, fit = result.system, result.diagnosis.after
    candidate = next(c for c in system.candidates if c.name == "air_bildsten")
    planner = planner_alone(system, fit, [(candidate,)])
    rows, duration = planner.with_(Proposal(12.0, 2.0, 0.3, mass=mass), system, fit.values)
    disc = {"mass_g": mass * Scene().disc.mass_g}
    made = measured(seed=2, n=round(duration * RATE) + 1, theta_deg=12.0, nutation_deg=0.6, omega3=2.0,
                    disc=disc, **RIG)  # fmt: skip
    both = diagnose_together([Recorded("first", first), Recorded("second", made)])
    (bound,) = [b for b in both.bounds if b.candidate.name == "air_bildsten"]
    assert planner.answer(planner.now, (candidate,), fit.values) == pytest.approx(
        float(bound.by_number[1][0]), rel=0.05
    )
    assert planner.answer(rows, (candidate,), fit.values) == pytest.approx(float(bound.by_number[2][0]), rel=0.1)
    assert both.diagnosis.verdict == "nothing missing"


def test_the_answer_to_a_question_does_not_depend_on_what_else_is_asked():
    """A tolerance that is in question itself is fitted while another effect is judged."""
    system, fit = with_base_fit(measured(n=60))
    questions = [(c,) for c in system.candidates if c.name in ("air_spin", "contact_radius")]
    for question in questions:
        alone, among = (planner_alone(system, fit, asked) for asked in ([question], questions))
        sigma = alone.answer(alone.now, question, fit.values)
        assert among.answer(among.now, question, fit.values) == pytest.approx(sigma, rel=1e-6)
