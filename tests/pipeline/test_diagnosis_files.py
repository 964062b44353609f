"""disctrack diagnose from file to file: the group, diagnosis.json, the page, and a model that can be used again."""

import json
import re
import tomllib

import numpy as np
import pytest

from disctrack import Provenance, diagnose, read_group, read_trajectory, write_trajectory
from disctrack.cli import main
from disctrack.diagnosis.supplement import force_of, supplement
from disctrack.synthetic.description import load_scene
from disctrack.synthetic.motion import simulate_scene
from tests.oracles.measured_disc import measured


@pytest.fixture(scope="module")
def diagnosed(tmp_path_factory):
    """A disc with its centre of mass 0.1 mm off, measured and diagnosed by the command."""
    folder = tmp_path_factory.mktemp("diagnosed")
    path = folder / "trajectory.h5"
    trajectory = measured({"centre_of_mass.c_1": 1e-4}, seed=31, n=300)
    write_trajectory(path, trajectory, Provenance("unbalanced", {}, {}))
    assert main(["diagnose", str(path), "--figures"]) == 0
    return path, folder / "trajectory_diagnosis"


def test_json_holds_verdict_effects_before_after_and_what_was_tried(diagnosed):
    document = json.loads((diagnosed[1] / "diagnosis.json").read_text())
    assert document["verdict"] == "found"
    (effect,) = document["effects"]
    assert effect["name"] == "centre_of_mass"
    assert {"parameters", "class", "score", "held_out_gain"} <= set(effect)
    c_1 = effect["parameters"][0]
    assert (c_1["name"], c_1["unit"]) == ("c_1", "m")
    assert abs(c_1["value"] - 1e-4) < 4 * c_1["sigma"]
    for when in ("before", "after"):
        assert {"reduced_chi_square", "rms_px", "held_out"} <= set(document[when])
    assert document["after"]["reduced_chi_square"] < 1.1 < document["before"]["reduced_chi_square"]
    names = {t["name"] for t in document["tried"]}
    assert {"kz", "table_tilt", "time_offset", "frame_rate", "ellipse_centre"} <= names
    assert all(t["reason"] for t in document["tried"])


def test_group_holds_the_residuals_and_the_document(diagnosed):
    arrays, attributes = read_group(diagnosed[0], "diagnosis")
    assert attributes["verdict"] == "found"
    assert json.loads(attributes["diagnosis"])["verdict"] == "found"
    # 1800 numbers of variance 1: the mean square scatters by 3 %
    assert np.nanmean(arrays["residual_after"] ** 2) == pytest.approx(1.0, abs=0.15)
    assert np.nanmean(arrays["residual_before"] ** 2) > 2
    assert len(read_trajectory(diagnosed[0])) == 300  # the rest of the file is as it was


def test_group_holds_the_moment_and_force_that_were_missing(diagnosed):
    arrays, _ = read_group(diagnosed[0], "diagnosis")
    inner = slice(30, -30)  # derivatives at the ends of a film are poor
    force, sigma = (arrays[name][inner] for name in ("missing_force", "missing_force_sigma"))
    # 0.1 mm off at 70 rad/s: m e psidot^2 sin(theta) and more, some mN at a sigma of 1
    assert np.sqrt(np.mean((force / sigma) ** 2)) > 2
    moment, sigma = (arrays[name] for name in ("missing_moment", "missing_moment_sigma"))
    assert moment.shape == sigma.shape
    assert np.sqrt(np.mean((moment[:, 0] / sigma[:, 0]) ** 2)) > 3  # m g 0.1 mm = 0.2 mN m tips the disc


@pytest.mark.statistical
def test_what_was_found_supplies_the_missing_force(diagnosed):
    """Two routes: accelerations of the poses without a model, and the force of the enlarged model."""
    result = diagnose(read_trajectory(diagnosed[0]))
    beside = supplement(result)
    added = force_of(result.system, result.diagnosis.after) - force_of(result.system, result.diagnosis.before)
    missing, sigma = beside.force.values, beside.force.sigma
    inner = slice(30, -30)
    pull = (missing - added)[inner] / sigma[inner]
    # neighbouring frames share noise: some ten independent values per axis, mean square 1 +- 0.25
    assert np.mean(pull**2) < 2
    assert np.mean((missing[inner] / sigma[inner]) ** 2) > 4
    of_law, moment = beside.moment_of_law, beside.moment
    left = (moment.values - of_law.values)[2:-2] / moment.sigma[2:-2]
    assert np.mean(left**2) < 2


def test_page_says_the_sentence_and_shows_the_figures_and_every_error_before_and_after(diagnosed):
    page = (diagnosed[1] / "diagnosis.html").read_text()
    for row in (
        *("reduced chi-square of the dots", "rms of the dots [px]", "Ljung-Box", "highest line of the spectrum"),
        *(f"free run 0.1 s ahead: {what}" for what in ("nutation", "precession", "position")),
        *("change of km.k_m", "energy lost [mJ]", "sigmas"),
    ):
        assert row in page, row
    assert "too short for free runs of 0.3 and 0.5 s" in page  # 0.3 s of film
    assert not re.search(r"\bnan\b", re.sub(r"base64,[^\"]*", "", page))
    assert "Missing in the model" in page
    assert page.count("<figure>") == len(list((diagnosed[1] / "figures").glob("*.png"))) >= 7


def test_enlarged_model_simulates_the_measured_motion(diagnosed):
    scene = load_scene(diagnosed[1] / "model.toml")
    motion = simulate_scene(scene)
    measured_q = read_trajectory(diagnosed[0]).q
    predicted = np.array([np.interp(np.arange(300) / 1000.0, motion.time, motion.q[:, i]) for i in range(3)]).T
    # noise 0.5 um a frame, the rig's error some um in common
    assert np.abs(predicted - measured_q[:, :3]).max() < 2e-5
    tree = tomllib.loads((diagnosed[1] / "model.toml").read_text())
    assert "centre_of_mass" in tree["motion"]["rolling"]["effects"]


@pytest.mark.statistical
def test_against_the_enlarged_model_nothing_is_missing(diagnosed, cli):
    words = json.loads(cli("diagnose", diagnosed[0], "--json").out)["next"].split()[1:]  # the command that is printed
    cli(*words)
    assert not (diagnosed[1] / words[-1] / "figures").exists()  # on request only
    assert json.loads((diagnosed[1] / words[-1] / "diagnosis.json").read_text())["verdict"] == "nothing missing"


def test_errors_are_one_line(diagnosed, tmp_path, cli):
    command = "diagnose", diagnosed[0]
    assert "reused" in cli(*command, "--verbose").out
    assert "--overwrite" in cli(*command, "--model", "none", code=1).err  # another result: kept unless told otherwise
    assert "no such model" in cli(*command, "-o", tmp_path / "x", "--model", "no-such-model", code=1).err
