"""From images to physics: the sample clip calibrated, tracked, analysed, compared with the motion it was drawn from."""

import contextlib
import io
import re
from pathlib import Path

import h5py
import numpy as np
import pytest

import disctrack
from disctrack.cli import main
from disctrack.recording.declaration import changed_since
from disctrack.trajectory.file import read_group
from tests.pipeline.conftest import QUICK


@pytest.fixture(scope="module")
def analysed_clip(sample_clip, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("clip")
    rig, trajectory = folder / "rig.h5", folder / "trajectory.h5"
    assert main(["calibrate", str(sample_clip), "-o", str(rig), "--no-figures"]) == 0
    assert main(["track", str(sample_clip), "--rig", str(rig), "-o", str(trajectory), *QUICK]) == 0
    with contextlib.redirect_stdout(io.StringIO()) as said:
        assert main(["analyse", str(folder), "-o", str(folder / "report")]) == 0  # the folder's trajectory.h5
    (folder / "said.txt").write_text(said.getvalue())
    return trajectory


def test_rates_from_images_agree_with_the_drawn_motion(analysed_clip, sample_clip):
    """Within the stated noise and calibration; the latter is one draw common to all frames: a factor 4 at most."""
    with h5py.File(sample_clip.parent / "truth" / f"{sample_clip.name}.h5") as file:
        qdot = file["qdot"][()]
    motion, _ = read_group(analysed_clip, "motion")
    names = ("velocity_x", "velocity_y", "velocity_z", "psidot", "thetadot", "phidot")
    for i, name in enumerate(names):
        sigma, common = motion[f"{name}_sigma"], motion[f"{name}_sigma_calibration"]
        assert 0.3 < np.mean((motion[name] - qdot[:, i]) ** 2 / (sigma**2 + common**2)) < 4, name
    assert np.sqrt(np.mean((motion["velocity_x"] - qdot[:, 0]) ** 2)) < 5e-5  # [m/s]


def test_clip_rolls_without_slip_and_on_the_table(analysed_clip):
    contact, verdict = read_group(analysed_clip, "contact")
    assert verdict["rolling_probability"] > 0.99
    assert verdict["rolling_onset_s"] < 0.02
    slip = np.hypot(contact["slip_n"], contact["slip_m"])
    assert np.sqrt(np.mean(slip[10:-10] ** 2)) < 1e-4  # [m/s]; 0.05 mm/s when written
    assert abs(np.mean(contact["contact_z"])) < 2e-6  # [m]


def test_every_attribute_of_the_groups_is_explained(analysed_clip):
    page = Path(disctrack.__file__).with_name("docs") / "result-file.md"
    explained = set(re.findall(r"`([A-Za-z0-9_.]+)`", page.read_text(encoding="utf-8")))
    for group, one in (("contact", "rolling_onset_s"), ("energy", "loss_J")):
        _, attributes = read_group(analysed_clip, group)
        assert one in attributes
        assert attributes.keys() <= explained, attributes.keys() - explained


def test_command_says_where_the_results_are(analysed_clip):
    said = (analysed_clip.parent / "said.txt").read_text()
    assert "rolls without slip" in said
    assert "report.html" in said
    assert (analysed_clip.parent / "report" / "report.html").stat().st_size > 1e5


def test_a_second_analysis_is_reused_and_another_window_or_a_missing_figure_is_not(analysed_clip, cli):
    report = analysed_clip.parent / "report"
    command = "analyse", analysed_clip, "-o", report
    before = (report / "report.html").stat().st_mtime_ns
    told = cli(*command).out
    assert "reused" in told
    assert "rolls without slip" in told
    assert len(told.splitlines()) <= 10
    assert (report / "report.html").stat().st_mtime_ns == before
    said = cli(*command, "--window", "0.4", code=1).err  # another result: kept unless told otherwise
    assert "report.html: exists" in said
    assert "--overwrite" in said


def test_a_declaration_that_changed_since_is_told_and_an_equal_one_is_not(analysed_clip, sample_clip, cli):
    beside = analysed_clip.with_name("recording.toml")
    declared = (sample_clip / "recording.toml").read_text()
    for text, told in ((declared, False), (declared.replace("square_mm = 6.0", "square_mm = 6.1"), True)):
        beside.write_text(text)
        said = cli("analyse", analysed_clip, "-o", analysed_clip.parent / "report").err
        assert ("[calibration] square_mm 6.1 (6.0 when it was measured)" in said) == told
        assert ("has changed" in said) == told
    beside.write_text("[disc]\nmass_g = 1.0\n")
    changed = changed_since(beside.parent, {"disc": {"mass_g": 1.0, "radius_mm": 2}})
    assert changed == "[disc] radius_mm not declared (2 when it was measured)"
    beside.unlink()


def test_asymptotic_exponents_are_not_refused_where_the_law_is_not_asymptotic(analysed_clip):
    """The clip was drawn with the law of Ma et al.; over 3.3 to 1.4 deg its slope is not yet 2/3."""
    page = (analysed_clip.parent / "report" / "report.html").read_text()
    assert "as θ → 0" in page
    assert "0.667 no" not in page
