"""Repeats of one experiment: on one clock, with their spread, their averages, and the run that does not belong."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import optimize, stats

from disctrack.analyse.analysis import analyse
from disctrack.analyse.stage import write_analysis
from disctrack.disc import MA_2014
from disctrack.repeats import compare, write
from disctrack.repeats.alignment import Curves, align
from disctrack.repeats.averages import average
from disctrack.repeats.runs import INDEX, QUANTITIES, UNKNOWN, AnalysedRun, FittedNumber, k_m_of_energy
from disctrack.repeats.spread import independent_samples, spread
from disctrack.trajectory.file import Provenance, write_trajectory

# of one smoothed frame, in the order of QUANTITIES: what the analysis of a recorded motion states at 5 degrees
SIGMA = np.array([0.15e-6, 0.15e-6, 0.15e-6, 1e-4, 6e-6, 1e-4, 0.03, 1e-6])


def quantities(truth) -> np.ndarray:
    """True (n, 8) in the order of QUANTITIES."""
    m, r, h, g = MA_2014.mass, MA_2014.radius, MA_2014.half_thickness, 9.81
    J1, J3 = m * (r * r / 4 + h * h / 3), m * r * r / 2
    w1, w2, w3 = truth.rates[:, 3], truth.rates[:, 4], truth.rates[:, 5]
    energy = 0.5 * m * np.sum(truth.velocity**2, axis=1) + 0.5 * (J1 * (w1**2 + w2**2) + J3 * w3**2)
    energy += m * g * (truth.position[:, 2] - h)
    return np.column_stack([truth.position, truth.euler, truth.rates[:, 0], energy])


@pytest.fixture
def run_of(as_tracked):
    rig = None

    def make(truth, rng, name="run", t_f=UNKNOWN, offset=0.0) -> AnalysedRun:
        nonlocal rig
        rig = rig or as_tracked(truth[:20], rng).rig
        value = quantities(truth)
        return AnalysedRun(
            path=Path(f"{name}.h5"),
            name=name,
            case="",
            surface="",
            disc=MA_2014,
            rig=rig,
            time=truth.time + offset,
            value=value + SIGMA * rng.standard_normal(value.shape),
            sigma=np.broadcast_to(SIGMA, value.shape).copy(),
            fitted=dict.fromkeys(("n_energy", "n_theta", "n_psidot", "k_m"), UNKNOWN) | {"t_f": t_f},
            k_m_source="energy",
            fingerprint=name,
            notes=(),
        )

    return make


def test_motion_alone_puts_runs_on_one_clock_to_the_stated_sigma(true_motion, run_of, rng):
    """Cameras started at other instants of one motion: the clocks' differences are known."""
    truth = true_motion(theta_deg=9, duration=3.0)
    starts, zeros = (0, 130, 310), np.array([0.0, 0.8, -0.45])
    runs = [run_of(truth[s : s + 900], rng, f"run {s}", offset=z) for s, z in zip(starts, zeros, strict=True)]
    found = align(runs, [Curves(run) for run in runs])
    error = found.shift - found.shift.mean() - (zeros - zeros.mean())
    # psidot alone, sigma 0.03 of a curve that oscillates by some rad/s, 600 frames shared: a few microseconds
    assert (found.sigma < 3e-5).all()
    assert (np.abs(error) < 5 * found.sigma.max()).all()
    assert found.method == ("motion",) * 3
    assert "zeros" in found.zero


def test_the_sigma_of_a_shift_tells_its_scatter(true_motion, run_of):
    truth = true_motion(theta_deg=9, duration=3.0)[400:700]
    errors = []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        runs = [run_of(truth, rng, f"{i}") for i in range(2)]
        found = align(runs, [Curves(run) for run in runs])
        errors.append((found.shift[1] - found.shift[0]) / found.sigma[1])
    # both shifts are against the other run: their difference, halved by no gauge, has the sigma of one
    assert 0.4 < np.std(errors) < 1.9  # 10 draws, and a sigma from some ten stretches: each scatters by a quarter


def test_collapse_is_the_common_clock_where_it_was_fitted(true_motion, run_of, rng):
    truth = true_motion(theta_deg=9, duration=3.0)
    t_f = [FittedNumber(3.1, 2e-4), FittedNumber(1.1, 3e-4), UNKNOWN]
    offsets = np.array([0.0, -2.0, 0.7])
    runs = [
        run_of(truth[500 + 20 * i : 1500 + 20 * i], rng, f"{i}", t, o)
        for i, (t, o) in enumerate(zip(t_f, offsets, strict=True))
    ]
    found = align(runs, [Curves(run) for run in runs])
    assert found.method == ("t_f", "t_f", "motion")
    assert_allclose(found.shift, 3.1 + offsets, atol=5e-5)
    assert "t_f" in found.zero


def test_equal_runs_spread_by_the_measurement_and_a_planted_spread_is_found(true_motion, run_of, rng):
    truth = true_motion(theta_deg=9, duration=3.0)[400:1000]
    exact = FittedNumber(3.0, 1e-9)
    same = [run_of(truth, rng, f"{i}", exact) for i in range(6)]
    found = spread([Curves(r) for r in same], align(same, [Curves(r) for r in same]))
    for part in found.parts:
        # 600 frames x 5 degrees of freedom: 2 %; interpolation between the frames adds nothing at equal instants
        assert 0.93 < part.spread / part.noise < 1.07, part.name
        assert part.p_value > 1e-3, part.name
    assert not any(found.standing_out)

    drawn = 1e-3 * np.array([-1.2, 0.3, 0.9, -0.5, 1.4, -0.9])  # rad, a constant added to theta
    shifted = []
    for run, d in zip(same, drawn, strict=True):
        value = run.value.copy()
        value[:, INDEX["theta"]] += d
        value[:, INDEX["psi"]] += 40 * d + 4 * np.pi  # its own origin: no spread
        shifted.append(replace(run, value=value))
    again = spread([Curves(r) for r in shifted], align(shifted, [Curves(r) for r in shifted]))
    theta, psi = again.parts[INDEX["theta"]], again.parts[INDEX["psi"]]
    assert_allclose(theta.physics, drawn.std(ddof=1), rtol=0.01)  # the noise is 6e-3 of it
    assert theta.p_value < 1e-6
    assert_allclose(again.std[:, INDEX["theta"]].mean(), drawn.std(ddof=1), rtol=0.01)
    assert psi.p_value > 1e-3
    assert_allclose(again.offset[:, INDEX["psi"]], 40 * (drawn - drawn.mean()), atol=1e-3)


def test_runs_that_started_turned_about_the_vertical_have_the_same_path(true_motion, run_of, rng):
    truth = true_motion(theta_deg=9, duration=3.0)[400:1000]
    exact, runs = FittedNumber(3.0, 1e-9), []
    for i, angle in enumerate((0.0, 1.0, -0.8)):
        run = run_of(truth, rng, f"{i}", exact)
        c, s = np.cos(angle), np.sin(angle)
        value = run.value.copy()
        value[:, :2] = value[:, :2] @ np.array([[c, s], [-s, c]]) + [0.01 * i, 0.0]
        value[:, INDEX["psi"]] += angle
        runs.append(replace(run, value=value))
    found = spread([Curves(r) for r in runs], align(runs, [Curves(r) for r in runs]))
    assert found.turned
    for name in ("x", "y"):
        part = found.parts[INDEX[name]]
        assert part.spread < 1.1 * part.noise  # as filmed they lie centimetres apart


def test_average_agrees_with_least_squares_and_says_when_runs_do_not_agree(rng):
    sigma = rng.uniform(0.5, 2.0, 7) * 1e-3
    value = 0.667 + sigma * rng.standard_normal(7)
    found = average(value, sigma)
    fit, covariance = optimize.curve_fit(lambda x, a: a + 0 * x, np.zeros(7), value, sigma=sigma, absolute_sigma=True)
    assert_allclose([found.weighted, found.sigma_internal], [fit[0], np.sqrt(covariance[0, 0])], rtol=1e-6)
    _, scaled = optimize.curve_fit(lambda x, a: a + 0 * x, np.zeros(7), value, sigma=sigma)
    assert_allclose(found.sigma_external, np.sqrt(scaled[0, 0]), rtol=1e-6)
    assert_allclose(found.p_value, stats.chi2.sf(np.sum(((value - fit[0]) / sigma) ** 2), 6), rtol=1e-6)
    assert_allclose([found.mean, found.standard_error], [np.mean(value), stats.sem(value)], rtol=1e-12)
    assert found.agree
    apart = average(value + 0.01 * rng.standard_normal(7), sigma)
    assert not apart.agree
    assert "do not agree" in apart.verdict
    assert apart.best == (apart.mean, apart.standard_error)
    assert found.best == (found.weighted, found.sigma)
    assert apart.sigma == apart.sigma_external > 3 * apart.sigma_internal


def test_published_trials_average_to_what_scipy_says_and_no_sigma_is_invented():
    from disctrack.analyse.published import published_table

    table = published_table("glass")
    found = average(table.exponents[:, 1], np.full(len(table.exponents), 1.0))
    assert_allclose(found.mean, table.average[1], rtol=1e-12)
    assert_allclose(found.standard_error, stats.sem(table.exponents[:, 1]), rtol=1e-12)
    assert average([np.nan], [1.0]).verdict == "not determined"
    assert average([0.5], [0.1]).verdict == "no repeat"


def test_outliers_are_found_and_good_runs_are_rarely_accused(rng):
    accused = 0
    for _ in range(400):
        sigma = rng.uniform(0.5, 2.0, 5)
        accused += bool(average(sigma * rng.standard_normal(5), sigma).outliers)
    assert accused <= 25  # 2 % of 400 is 8, and t in place of the normal law where chance looks like disagreement
    # others that scatter by 2 %, measured to 1e-4: 15 % stand apart
    assert average([0.3836, 0.3873, 0.3835, 0.3711, 0.4381], np.full(5, 1e-5)).outliers == (4,)
    for i in range(5):
        value = 0.01 * np.array([-0.9, 0.4, 1.1, -0.3, 0.2])
        value[i] += 0.3
        assert average(value, np.full(5, 1e-4)).outliers == (i,)


def test_independent_samples_of_white_and_of_slow_deviations(rng):
    white = rng.standard_normal((4, 2000))
    assert 1000 < independent_samples(white) <= 2000
    slow = np.repeat(rng.standard_normal((4, 100)), 20, axis=1)
    assert 60 < independent_samples(slow) < 200  # 100 plateaus


def test_energy_gives_the_coefficient_that_the_motion_was_integrated_with(true_motion):
    for k_m in (0.381e-7, 0.28e-7):
        truth = true_motion(theta_deg=9, duration=3.0, k_m=k_m)
        z = truth.acceleration[:, 2]
        found = k_m_of_energy(truth.time, quantities(truth), truth.rates[:, 2], MA_2014.mass * (z + 9.81))
        assert_allclose(found.value, k_m, rtol=1e-4)  # trapezoidal rule over ripples of 30 frames
        assert found.sigma < 1e-4 * k_m


@pytest.fixture(scope="module")
def folder_of_runs(tmp_path_factory, true_motion, as_tracked):
    """Analysed files: three repeats, one with the paper's other k_m and case, one not analysed, one damaged."""
    folder, rng = tmp_path_factory.mktemp("repeats"), np.random.default_rng(3)
    for name, k_m, case in (
        ("a1", 0.3810e-7, "Case I"),
        ("a2", 0.3825e-7, "Case I"),
        ("a3", 0.3800e-7, "Case I"),
        ("b1", 0.3810e-7, "Case II"),
        ("raw", 0.3810e-7, "Case I"),
    ):
        truth = true_motion(theta_deg=9, duration=3.0, k_m=k_m, rate=500.0)[-230:]
        trajectory = as_tracked(replace(truth, time=truth.time - truth.time[0]), rng)
        path = folder / f"{name}.h5"
        settings = {"recording": {"case": case, "surface": "steel"}}
        write_trajectory(path, trajectory, Provenance(name, {"left": name}, settings))
        if name != "raw":
            write_analysis(path, analyse(trajectory))
    (folder / "damaged.h5").write_bytes((folder / "a1.h5").read_bytes()[:20000])
    return folder


@pytest.fixture(scope="module")
def compared(folder_of_runs):
    names = ("a1", "a2", "a3", "b1", "raw", "damaged", "missing", "a1")
    return compare([folder_of_runs / f"{name}.h5" for name in names])


def test_files_are_grouped_averaged_and_what_cannot_be_used_is_listed(compared):
    assert [(g.name, [r.name for r in g.runs]) for g in compared.groups] == [
        ("Case I", ["a1", "a2", "a3"]),
        ("Case II", ["b1"]),
    ]
    reasons = {item.path.stem: item.reason for item in compared.left_out}
    assert set(reasons) == {"raw", "damaged", "missing", "a1"}
    assert "no group 'motion'" in reasons["raw"]
    assert "not a readable trajectory" in reasons["damaged"]
    assert "no such file" in reasons["missing"]
    assert "same recording" in reasons["a1"]
    group = compared.groups[0]
    assert group.alignment.method == ("t_f",) * 3
    runs = group.runs
    for run, k_m in zip(runs, (0.3810e-7, 0.3825e-7, 0.3800e-7), strict=True):
        assert_allclose(run.fitted["k_m"].value, k_m, rtol=5e-4)  # the loss over 0.4 s is known to 2e-4
    v, s = (np.array([getattr(r.fitted["n_theta"], part) for r in runs]) for part in ("value", "sigma"))
    assert_allclose(group.averages["n_theta"].weighted, np.average(v, weights=s**-2), rtol=1e-12)
    assert group.averages["n_theta"].agree
    assert not group.averages["k_m"].agree  # drawn 0.3 % apart, measured to 0.02 %
    assert any("k_m" in remark for remark in group.remarks)
    assert len(compared.tables) == 1  # one disc, one surface: one table over both cases
    assert compared.tables[0].averages["n_theta"].n == 4


@pytest.mark.statistical
def test_page_tables_and_figures_say_the_same_as_the_comparison(compared, tmp_path):
    written = write(compared, tmp_path)
    page = written.page.read_text()
    for word in (
        "Case I",
        "Case II",
        "steel",
        "no group &#x27;motion&#x27;",
        "do not agree",
        "Birge",
        "data:image",
    ):
        assert word in page, word
    assert written.fragment in page
    assert all(file.exists() for file in written.files)
    names = {file.name for file in written.files}
    for stem in ("01_case_i_nutation", "01_case_i_spread", "01_case_i_deviations", "fitted_01"):
        assert {f"{stem}.png", f"{stem}.pdf"} <= names
        assert cv2.imread(str(tmp_path / "figures" / f"{stem}.png")).std() > 5  # not blank
    document = json.loads((tmp_path / "repeats.json").read_text())
    found = compared.groups[0].averages["k_m"]
    assert document["groups"][0]["averages"]["k_m"]["weighted"] == found.weighted
    with (tmp_path / "averages.csv").open() as stream:
        rows = {(row["over"], row["quantity"]): row for row in csv.DictReader(stream)}
    assert_allclose(float(rows["Case I", "k_m"]["weighted"]), found.weighted, rtol=1e-8)
    with (tmp_path / "runs.csv").open() as stream:
        assert [row["recording"] for row in csv.DictReader(stream)] == ["a1", "a2", "a3", "b1"]
    with (tmp_path / "spread_01_case_i.csv").open() as stream:
        table = list(csv.DictReader(stream))
    assert set(QUANTITIES[4].name + end for end in ("_mean_rad", "_std_rad")) <= set(table[0])


def test_a_run_that_does_not_belong_is_pointed_at(true_motion, run_of, rng):
    exact, runs = FittedNumber(3.0, 1e-4), []
    truth = true_motion(theta_deg=9, duration=3.0)[400:1000]
    for i, factor in enumerate((1.0, 1.004, 0.997, 1.1, 0.999)):  # of theta: the fourth is another experiment
        run = run_of(truth, rng, f"run {i}", exact)
        value = run.value.copy()
        value[:, INDEX["theta"]] *= factor
        runs.append(replace(run, value=value))
    found = spread([Curves(r) for r in runs], align(runs, [Curves(r) for r in runs]))
    assert ["θ" in words for words in found.standing_out] == [False, False, False, True, False]
    without = spread([Curves(r) for r in runs[:3]], align(runs[:3], [Curves(r) for r in runs[:3]]))
    assert not any(without.standing_out)


def test_other_disc_other_rig_other_surface_and_other_energies_are_no_repeats(true_motion, run_of, rng):
    from disctrack.repeats.compare import _same_experiment

    truth = true_motion(theta_deg=9, duration=3.0)
    base = run_of(truth[:600], rng)
    assert _same_experiment(base, run_of(truth[100:700], rng, "later"))
    assert not _same_experiment(base, replace(base, disc=replace(base.disc, mass=0.2)))
    assert not _same_experiment(base, replace(base, surface="glass"))
    assert not _same_experiment(base, replace(base, case="Case II"))
    rig = base.rig
    moved = replace(rig, t_left_world=rig.t_left_world + np.array([0.01, 0.0, 0.0]))
    assert not _same_experiment(base, replace(base, rig=moved))
    calibrated_again = replace(rig, t_left_world=rig.t_left_world + np.array([1e-4, 0.0, 0.0]))
    assert _same_experiment(base, replace(base, rig=calibrated_again))
    assert not _same_experiment(base, run_of(truth[-300:], rng, "the end only"))
