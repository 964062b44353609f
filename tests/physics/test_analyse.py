"""The stage that ties the analysis together, and its report: groups in the file, verdicts in words, one whole page."""

import re
from dataclasses import replace
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
from numpy.testing import assert_allclose

from disctrack import FrameStatus, Provenance, read_group, read_trajectory, run_analyse, write_trajectory
from disctrack.analyse.analysis import analyse
from disctrack.analyse.stage import write_analysis
from disctrack.disc import MA_2014
from disctrack.errors import AnalysisError, OutputError
from disctrack.frames import continuous_quaternions, quaternion_from_rotation, rotation_from_euler
from disctrack.numbers import measured
from disctrack.trajectory import at_full_length
from tests.physics.conftest import as_tracked, true_motion


@pytest.fixture(scope="module")
def late():
    rng = np.random.default_rng(20140703)
    return as_tracked(true_motion(theta_deg=9, duration=3.0)[-450:], rng, missing=range(100, 106))


@pytest.fixture(scope="module")
def analysed(late):
    return analyse(late)


def stored(folder: Path, trajectory) -> Path:
    path = folder / "trajectory.h5"
    write_trajectory(path, trajectory, Provenance("simulated", {"left": "0" * 64}, {"case": "test"}))
    return path


def test_file_gets_the_groups_and_keeps_what_it_had(tmp_path, late, analysed):
    path = stored(tmp_path, late)
    write_analysis(path, analysed)
    again = read_trajectory(path)
    assert_allclose(again.q, late.q, atol=0)
    for name, quantities in {
        "motion": ("psidot", "omega_3", "velocity_x", "alpha_z", "covariance", "bridged"),
        "contact": ("slip_n", "slip_m", "locus_m", "force_z", "friction_needed"),
        "energy": ("total", "potential", "power", "precession_level"),
        "scaling": ("n_theta", "n_psidot", "n_energy", "t_f"),
    }.items():
        arrays, _ = read_group(path, name)
        assert set(quantities) <= set(arrays), name
    motion, attributes = read_group(path, "motion")
    truth = true_motion(theta_deg=9, duration=3.0)[-450:]
    for name, true in (("psidot", truth.rates[:, 0]), ("omega_3", truth.rates[:, 3])):
        assert np.all(np.abs(motion[name] - true) < 6 * motion[f"{name}_sigma"]), name
    assert motion["bridged"].sum() == 6
    assert "bridged" in attributes["warnings"]
    with h5py.File(path) as file:
        for group in ("motion", "contact", "energy", "scaling"):
            for name, dataset in file[group].items():
                assert dataset.attrs["units"], f"{group}/{name}"
                assert dataset.attrs["long_name"], f"{group}/{name}"


@pytest.mark.slow
def test_recording_that_runs_on_after_the_end_gives_what_one_that_ends_there_gives():
    """A patch stops the precession at 0.5 degrees within 20 ms, then the disc lies still for 0.2 s."""
    truth = true_motion(theta_deg=9, duration=3.0)[-600:]
    fall = np.clip(1 - np.arange(1, 221) / 20, 0, 1)
    turned = np.cumsum(fall)[:, None] * 1e-3 * truth.rates[-1, [0, 1, 2]] * [1, 0, 1]
    euler = np.concatenate([truth.euler, truth.euler[-1] + turned])
    position = np.concatenate([truth.position, np.tile(truth.position[-1], (220, 1))])
    time = truth.time[0] + np.arange(len(euler)) * 1e-3
    still = replace(truth, time=time, position=position, R_world_body=rotation_from_euler(*euler.T), euler=euler)
    free = analyse(as_tracked(truth, np.random.default_rng(1)))
    stopped = analyse(as_tracked(still, np.random.default_rng(1)))
    assert stopped.laws.determined
    assert abs(stopped.laws.n_theta.value - free.laws.n_theta.value) < 0.005
    assert abs(stopped.laws.t_f - free.laws.t_f) < 2e-3
    assert "from the first frame" in stopped.onset.verdict
    assert_allclose(stopped.circle.radius, free.circle.radius, atol=2e-5)


@pytest.mark.statistical
def test_disc_that_precesses_the_other_way_gives_the_same_exponents(late, analysed):
    """Seen in a mirror (y -> -y) psi runs backwards, and nothing else changes."""
    q = late.q * np.array([1, -1, 1, -1, 1, -1])
    q[:, 3] += np.pi  # the mirrored e1 points the other way
    q[:, 5] += np.pi
    quaternion = continuous_quaternions(quaternion_from_rotation(rotation_from_euler(*q[:, 3:].T)))
    flip = np.diag([1.0, -1.0, 1.0, -1.0, 1.0, -1.0])
    mirrored = replace(late, q=q, quaternion=quaternion, pose_covariance=flip @ late.pose_covariance @ flip)
    here, there = analysed.laws, analyse(mirrored).laws
    assert here.determined
    assert_allclose(there.n_theta.value, here.n_theta.value, atol=1e-6)
    assert_allclose(there.n_psidot.value, here.n_psidot.value, atol=1e-6)
    assert_allclose(there.t_f, here.t_f, atol=1e-7)


@pytest.mark.statistical
@pytest.mark.parametrize("tilt_deg", [0.5, 0.0])
def test_disc_at_rest_gives_no_rates_and_no_exponents(tilt_deg, rng):
    base, tilt = true_motion(theta_deg=9, duration=3.0)[:300], np.radians(tilt_deg)
    place = [0.05, 0.04, MA_2014.radius * np.sin(tilt) + MA_2014.half_thickness * np.cos(tilt)]
    R = rotation_from_euler(0.3, tilt, 0.1)
    still = replace(base, position=np.tile(place, (300, 1)), R_world_body=np.tile(R, (300, 1, 1)))
    analysis = analyse(as_tracked(still, rng))
    assert not analysis.laws.determined
    assert np.isnan(analysis.laws.n_theta.value)
    assert np.isnan(analysis.circle.radius)
    psidot, motion = analysis.series("psidot"), analysis.motion
    assert np.abs(motion.velocity).max() < 2e-5
    assert np.all(np.abs(motion.velocity) < 6 * np.sqrt(np.diagonal(motion.covariance, axis1=1, axis2=2)[:, 6:9]))
    if tilt_deg:
        assert np.all(np.abs(psidot.value) < 6 * psidot.sigma)
        assert_allclose(np.nanmean(analysis.series("force_z").value), MA_2014.mass * 9.81, rtol=1e-3)
    else:  # flat on the table there is no direction of precession
        assert np.isnan(psidot.value).all()
        assert not np.isfinite(analysis.onset.time)


@pytest.mark.statistical
def test_understated_noise_is_said(late):
    shy = replace(late, pose_covariance=late.pose_covariance / 9)
    assert sum("times what the tracker states" in finding.text for finding in analyse(shy).findings) == 4


def test_most_frames_lost_is_an_error(late):
    lost = np.ones(len(late.q), bool)
    lost[::20] = False  # twenty poses 20 ms apart: each oscillation is seen twice or thrice
    q, quaternion = late.q.copy(), late.quaternion.copy()
    q[lost], quaternion[lost] = np.nan, np.nan
    with pytest.raises(AnalysisError, match="neighbouring frames"):
        analyse(replace(late, q=q, quaternion=quaternion))


def test_trajectory_without_table_frame_is_refused_and_the_file_named(tmp_path, late):
    path = stored(tmp_path, replace(late, rig=replace(late.rig, world_is_table=False)))
    with pytest.raises(AnalysisError, match=r"trajectory\.h5.* not of the table"):
        run_analyse(path)


def test_report_is_not_overwritten_unasked(tmp_path, late):
    path = stored(tmp_path, late)
    (tmp_path / "trajectory_analysis").mkdir()
    (tmp_path / "trajectory_analysis" / "report.html").write_text("mine")
    with pytest.raises(OutputError, match="exists"):
        run_analyse(path)
    assert (tmp_path / "trajectory_analysis" / "report.html").read_text() == "mine"


@pytest.mark.statistical
def test_rest_that_was_left_out_costs_nothing_and_changes_no_number(tmp_path, late, analysed):
    """The same motion in the middle of a recording ten times as long, of which the rest was not tracked."""
    long = at_full_length(replace(late, time=late.time - late.time[0] + 1.8), 10 * len(late), 1800)
    status = long.frame_status.copy()
    status[:1800] = status[1800 + len(late) :] = FrameStatus.STILL
    long = replace(long, frame_status=status)
    found = analyse(long)
    assert len(found.motion) == len(late)
    assert_allclose(found.motion.omega_world, analysed.motion.omega_world, rtol=1e-9, atol=1e-9)
    assert_allclose(found.laws.n_theta.value, analysed.laws.n_theta.value, atol=1e-6)
    path = stored(tmp_path, long)
    write_analysis(path, found)
    energy, _ = read_group(path, "energy")
    assert energy["total"].shape == (10 * len(late),)
    assert_allclose(energy["total"][1800 : 1800 + len(late)], found.series("total").value, atol=0)
    assert np.isnan(energy["total"][:1800]).all()
    assert any("of 450 frames" in finding.text for finding in found.findings)


@pytest.fixture(scope="module")
def reported(tmp_path_factory):
    """Report of a disc that rolls down to 0.5 degrees, with a gap."""
    folder = tmp_path_factory.mktemp("report")
    trajectory = as_tracked(
        true_motion(theta_deg=9, duration=3.0)[-1200:], np.random.default_rng(3), missing=range(100, 106)
    )
    path = folder / "rolling down.h5"
    write_trajectory(path, trajectory, Provenance("rolling <down>", {"left": "0" * 64}, {}))
    return run_analyse(path, folder / "out", figures=True)


@pytest.mark.statistical
def test_report_says_what_was_found(reported):
    page = reported.report.read_text()
    laws = reported.analysis.laws
    half = (laws.n_theta.high - laws.n_theta.low) / 2
    assert "exponent of θ (95 %)" in page
    assert measured(laws.n_theta.value, half) in page  # 4.3 sigmas, Student's t: what a reader takes for it
    assert measured(laws.n_theta.value, laws.n_theta.sigma) in page
    assert "rolls without slip from the first frame" in page
    assert "6 of 1200 frames have no pose" in page
    assert "rolling &lt;down&gt;" in page  # names are not taken for markup
    references = re.findall(r'(?:src|href)="([^"]{0,40})', page)
    assert references
    assert all(text.startswith("data:image/") for text in references)  # the links of pages are another matter
    assert not re.search(r"\bnan\b", re.sub(r"base64,[^\"]*", "", page))


@pytest.mark.statistical
def test_every_figure_is_there_as_png_and_pdf(reported):
    assert {path.stem[:2] for path in reported.figures} == {f"{number:02d}" for number in range(4, 17)}
    assert {path.suffix for path in reported.figures} == {".png", ".pdf"}
    assert all(cv2.imread(str(path)).std() > 5 for path in reported.figures if path.suffix == ".png")  # not blank
