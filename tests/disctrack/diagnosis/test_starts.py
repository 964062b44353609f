"""Recordings that hold more than rolling, and laboratories that are not ideal, by a little or by degrees."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from disctrack.diagnosis import diagnose, motion_search
from disctrack.diagnosis.disc_system import DiscSystem
from disctrack.diagnosis.errors import ResidualTests
from disctrack.diagnosis.large_faults import poses_with
from disctrack.diagnosis.pages.output import as_json
from disctrack.diagnosis.stretch import at_rest, free_stretch
from disctrack.diagnosis.systematic import find_systematic, noise_over_stated, with_noise_of_frames
from disctrack.discrepancy.fit import fit
from disctrack.discrepancy.noise import inflation
from disctrack.discrepancy.search import FAR, Settings
from disctrack.errors import AnalysisError
from disctrack.faults.keys import CameraFault, Faults
from disctrack.rolling import Model, Regime, State, simulate, steady_precession
from disctrack.synthetic.description import Scene
from disctrack.trajectory import MarkerStatus, Trajectory
from disctrack.validate.points import LABORATORY
from tests.oracles.linear_system import Linear, one
from tests.oracles.measured_disc import K_M, assert_sized, measured, system_of

DISC = Scene().declared_disc
PAPER = Model(DISC).with_values({"km.k_m": K_M})


def start(theta_deg=16.0, slip=None):
    """Regular precession; slip : (2,) velocity [m/s] by which the contact differs from rolling."""
    state = steady_precession(np.radians(theta_deg), DISC, omega3=1.0, nutation_amplitude=np.radians(0.4))
    state = state.moved(psi=0.7, phi=-1.0, x=0.032, y=0.02)
    if slip is None:
        return state
    v = simulate(PAPER, state, times=[0.0, 1e-4]).qdot[0, :2]
    return state.moved(v_x=float(v[0] + slip[0]), v_y=float(v[1] + slip[1]))


def sliding(mu, slip, effects=None, **options):
    """Times -> coordinates of a disc that slides at first."""
    model, state = PAPER.with_values({"slip.mu": mu, **(effects or {})}), start(slip=slip, **options)
    return lambda times: simulate(model, state, times=np.r_[0.0, times]).q[1:]


def rolling(times):
    return simulate(PAPER, start(), times=np.r_[-1e-9, times]).q[1:]


def rolling_between(begin, end):
    """In a hand until then, which lets go with the velocity of the motion; stopped at the end."""

    def moves(times):
        instants, which = np.unique(np.clip(times - begin, 0.0, end - begin), return_inverse=True)
        return rolling(instants)[which]

    return moves


def lost(trajectory, frames, camera=None):
    """Without the images of these frames, of one camera or of both."""
    status, pixels, q = trajectory.marker_status.copy(), trajectory.markers_px.copy(), trajectory.q.copy()
    which = slice(None) if camera is None else camera
    status[frames, which], pixels[frames, which] = MarkerStatus.NOT_LOOKED_FOR, np.nan
    if camera is None:
        q[frames] = np.nan
    return replace(trajectory, marker_status=status, markers_px=pixels, q=q)


def assert_nothing_is_claimed(result):
    assert result.diagnosis.verdict == "nothing missing", result.sentence
    # what is left is noise: the k_m of the true motion within four of its sigmas
    assert_sized(result.diagnosis.after, {"km.k_m": K_M}, 4)


@pytest.mark.statistical
def test_slip_at_the_start_is_found_with_its_friction_and_its_end():
    motion, n = sliding(0.2, (0.08, 0.04)), 220
    result = diagnose(measured(motion=motion, seed=41, n=n))
    assert [f.candidate.name for f in result.diagnosis.found] == ["slip_start"]
    (effect,) = as_json(result)["effects"]
    mu = effect["parameters"][0]
    assert (effect["name"], mu["name"]) == ("slip", "mu")
    assert abs(mu["value"] - 0.2) < 4 * mu["sigma"]
    assert result.after.reduced_chi_square < 1.1 < result.before.reduced_chi_square
    assert result.after.ratio_to_floor < 1.2
    true = simulate(PAPER.with_values({"slip.mu": 0.2}), start(slip=(0.08, 0.04)), 0.2)
    end = next(s.time for s in true.switches if s.after is Regime.ROLLING) - 0.002  # the film begins 2 ms later
    (note,) = [text for text in result.notes if "slips at first" in text]
    assert f"until {end:.3f}"[:-1] in note


@pytest.mark.statistical
@pytest.mark.parametrize("n", [300, pytest.param(900, marks=pytest.mark.slow)])
def test_slip_of_a_millimetre_per_second_at_the_first_frame_is_found(n):
    """Friction below what rolling needs: no velocity shows the slip; 900 frames slip seven times, within a trial."""
    result = diagnose(measured({"slip.mu": 0.06}, seed=100, n=n, theta_deg=20.0))
    assert result.system.budget.open(kept=0.5)  # not half of the work is needed
    assert [f.candidate.name for f in result.diagnosis.found] == ["slip_start"]
    assert result.after.reduced_chi_square < 1.03 < 1000 < result.before.reduced_chi_square
    assert_sized(result.diagnosis.after, {"slip.inverse_mu": 1 / 0.06}, 4, 4 * 0.002 / 0.06)


@pytest.mark.statistical
@pytest.mark.parametrize("effects", [{"table_tilt.tilt_x": 5e-3}, {"kz.k_z": 3e-4}, {"slip.mu": 0.1}])
def test_what_rolls_at_first_does_not_begin_in_slip(effects):
    system = DiscSystem(measured(effects, seed=100, n=150, theta_deg=20.0), PAPER)
    assert fit(system, system.base, system.start()).reduced_chi_square > FAR
    assert not motion_search._slips_slowly(Settings(), system)


@pytest.mark.statistical
def test_slip_to_the_end_of_the_recording_is_found_too():
    result = diagnose(measured(motion=sliding(0.2, (0.2, 0.1)), seed=42, n=70))
    assert [f.candidate.name for f in result.diagnosis.found] == ["slip_start"]
    assert any("to the end of the recording" in text for text in result.notes)


@pytest.mark.slow
def test_an_effect_is_found_behind_slip_at_the_start():
    motion = sliding(0.2, (0.1, 0.1), {"kz.k_z": 6e-5})
    result = diagnose(measured(motion=motion, seed=43, n=400))
    assert [f.candidate.name for f in result.diagnosis.found] == ["slip_start", "kz"]
    assert_sized(result.diagnosis.after, {"kz.k_z": 6e-5}, 4)
    assert result.after.reduced_chi_square < 1.1


@pytest.mark.slow
def test_slip_that_no_coefficient_describes_is_left_out_and_said_so():
    """Friction that falls with the speed of slip, as between lubricated surfaces: not Coulomb's law."""
    half, weak = 0.05, PAPER.with_values({"slip.mu": 0.1})
    at_half = State(*simulate(weak, start(slip=(0.12, 0.06)), times=[0.0, half]).end_state.tolist())

    def falling(times):
        q, late = sliding(0.1, (0.12, 0.06))(times), times > half
        if late.any():
            stronger = PAPER.with_values({"slip.mu": 0.35})
            q[late] = simulate(stronger, at_half, times=np.r_[half, times[late]]).q[1:]
        return q

    result = diagnose(measured(motion=falling, seed=44, n=400))
    assert_nothing_is_claimed(result)
    assert any("no coefficient of friction describes that" in text for text in result.notes)
    assert result.system.rows.start > 50


@pytest.mark.statistical
def test_dots_off_centre_are_not_taken_for_slip():
    """They give the contact a velocity all the time: pattern_offset or its class, not slip."""
    result = diagnose(measured(faults=Faults(pattern_offset_mm=(1.0, 0.0)), seed=45, n=150))
    names = {f.candidate.name for f in result.diagnosis.found}
    assert "slip_start" not in names
    assert names


@pytest.mark.statistical
def test_a_disc_that_is_held_and_stopped_is_diagnosed_in_between():
    result = diagnose(measured(motion=rolling_between(0.0301, 0.2104), seed=46, n=260))
    assert_nothing_is_claimed(result)
    rows = result.system.rows
    # frames are taken 2 ms late; nothing within 5 ms of the hand
    assert 33 <= rows.start <= 36
    assert 200 <= rows.stop <= 208
    assert sum("at rest or held" in text for text in result.notes) == 2


@pytest.mark.statistical
def test_a_disc_that_lies_flat_at_the_end_is_diagnosed_before_that():
    def lying(times):
        down = simulate(PAPER, start(2.0), times=np.r_[-1e-9, times], theta_end=np.radians(0.5)).q[1:]
        q = np.tile([0.03, 0.02, DISC.half_thickness, 0.0, 1e-6, 0.0], (len(times), 1))
        q[: len(down)] = down
        return q

    result = diagnose(measured(motion=lying, seed=47, n=200))
    assert_nothing_is_claimed(result)
    assert any("lies flat" in text for text in result.notes)


@pytest.mark.statistical
@pytest.mark.parametrize(
    ("trajectory", "notes"),
    [
        (lambda: lost(measured(seed=48, n=200), np.arange(60, 120)), 1),
        (lambda: lost(measured(seed=48, n=200), np.arange(3, 40)), 1),
        (lambda: lost(measured(seed=48, n=200), np.flatnonzero(np.arange(200) % 3)), 1),
        (lambda: lost(measured(seed=49, n=150), np.arange(40, 110), camera=0), 0),
        *((lambda n=n: measured(seed=50 + n, n=n), 0) for n in (45, 70, 100)),
    ],
    ids=["gap", "early", "many", "one camera for a while", "45 frames", "70 frames", "100 frames"],
)
def test_little_that_is_seen_claims_nothing(trajectory, notes):
    result = diagnose(trajectory())
    assert_nothing_is_claimed(result)
    assert sum("no pose" in text or "cut off" in text for text in result.notes) >= notes


def test_a_disc_without_a_motion_is_an_error_that_says_what_it_does():
    flat = measured(motion=lambda t: np.tile([0.03, 0.02, 0.003, 0.0, 1e-6, 0.0], (len(t), 1)), seed=51, n=60)
    with pytest.raises(AnalysisError, match="60 of 60 frames have a pose; the disc lies flat in 60"):
        free_stretch(flat)
    leaning = measured(motion=lambda t: np.tile([0.03, 0.02, 0.012, 0.0, 0.3, 0.0], (len(t), 1)), seed=52, n=60)
    with pytest.raises(AnalysisError, match="at rest or held in 60"):
        free_stretch(leaning)
    with pytest.raises(AnalysisError, match=r"30 of 30 frames have a pose\. A diagnosis needs 40"):
        free_stretch(measured(seed=53, n=30))


def recording(effects=None, *, laboratory=LABORATORY, faults=None, seed=1, n=300):
    """As a tracking states it whose covariances cover all that the dots show."""
    trajectory = measured(
        effects, faults=faults, laboratory=laboratory, seed=seed, n=n, declared_rate=500.0, theta_deg=9.0
    )
    inflated = max(1.0, float(np.median(trajectory.reduced_chi_square)))
    larger = {name: inflated * getattr(trajectory, name) for name in ("markers_covariance_px2", "pose_covariance")}
    return replace(trajectory, **larger, reduced_chi_square=trajectory.reduced_chi_square / inflated), inflated


def systematic_of(trajectory):
    return find_systematic(system_of(with_noise_of_frames(trajectory)))


def test_the_noise_is_what_changes_from_frame_to_frame():
    trajectory, inflated = recording()
    assert inflated > 5
    # 300 frames of 18 numbers: 2 %, and 4 % for third differences that share their frames
    assert noise_over_stated(trajectory) * inflated == pytest.approx(1.0, rel=0.08)
    ideal = measured(seed=2, n=200)
    assert with_noise_of_frames(ideal) is ideal


def test_a_camera_that_turned_does_not_make_the_motion_look_like_rest():
    """0.07 deg, 2.5 px: covariances that cover it are larger than what the disc moves in a frame."""
    turned = Faults(right=CameraFault(rotation_deg=(0.04, 0.05, 0.02)))
    trajectory, inflated = recording(laboratory={}, faults=turned, n=120)
    assert inflated > 1e4
    measured_rows = np.flatnonzero(trajectory.measured)
    assert at_rest(trajectory, measured_rows).all()
    assert not at_rest(with_noise_of_frames(trajectory), measured_rows).any()


@pytest.mark.statistical
def test_fields_are_sized_from_the_dots_alone_and_faults_are_no_fields():
    found = systematic_of(recording()[0])
    assert found.left == pytest.approx(1.0, abs=0.1)  # 200 frames of 18 numbers: 2 %, and what bumps miss
    assert 0.008 < found.lens_px < 0.05  # 0.02 px over the whole image; the dots see a part of it
    assert 75 < found.lens_length_px < 150  # waves of 0.4 to 1.4 periods along it: their mean square is that of 86 px
    assert found.faults_px == 0.0
    alone = systematic_of(recording(laboratory={}, faults=Faults(right_delay_s=2e-4))[0])
    assert (alone.present, alone.faults_px > 0.03) == (False, True)  # 0.2 ms, in which dots move by a tenth of a pixel
    both = systematic_of(recording(faults=Faults(right_delay_s=2e-4))[0])
    assert both.lens_px > 0.008
    assert both.faults_px == pytest.approx(alone.faults_px, rel=0.1)
    assert not systematic_of(measured(seed=3, n=200)).present


@pytest.mark.statistical
def test_an_imperfect_laboratory_claims_nothing_about_the_motion():
    trajectory, _ = recording(seed=5)
    result = diagnose(trajectory)
    assert result.diagnosis.verdict != "unexplained"
    assert all(f.candidate.kind == "measurement" for f in result.diagnosis.found)
    assert result.sentence.startswith("Nothing")
    assert "systematic errors of 0.0" in result.sentence


def test_sigmas_know_that_neighbouring_rows_err_alike(rng):
    """Images of a dot two pixels apart share pixels of uneven gain: a correlation that one series hides."""

    time = np.arange(250.0)
    course = 0.01 * np.sin(0.02 * time)[:, None] * np.cos(np.arange(24))

    def pulls(share):
        found = []
        for _ in range(200):
            white = rng.standard_normal((251, 24))
            noise = (white[1:] + share * white[:-1]) / np.sqrt(1 + share**2)
            line = Linear(time, noise, {"a": course}, [one("a")])
            fitted = fit(line, line.base, {})
            factor = inflation(line, fitted)[0]
            found.append((fitted.values["a"] / fitted.sigma("a"), fitted.values["a"] / fitted.sigma("a") / factor))
        return np.std(found, axis=0)

    white, stated = pulls(0.21)  # correlation 0.2: a smooth sum has 1 + 2 * 0.2 of the variance
    # of 200 pulls the scatter is known to 5 %
    assert_allclose([white, stated], [np.sqrt(1.4), 1.0], rtol=0.18)
    assert white > 1.1
    assert_allclose(pulls(0.0), 1.0, rtol=0.18)


@pytest.mark.parametrize(
    ("left", "motion", "measurement", "doubtful"),
    [
        (ResidualTests(1.10, 1.00, 1e-40, 0.5, 36), True, False, True),
        (ResidualTests(1.10, 1.10, 1e-40, 1e-40, 36), False, True, False),
        (ResidualTests(1.30, 1.20, 1e-9, 1e-9, 36), False, True, False),
        (ResidualTests(9.00, 1.20, 1e-9, 1e-9, 36), True, False, True),
        (ResidualTests(1.00, 1.00, 0.4, 0.6, 36), False, False, False),
        (ResidualTests(1.09, 0.99, 0.02, 1.0, 36), False, False, True),  # a groove that a tilt stands in for
        (ResidualTests(1.00, 1.03, 0.3, 4e-10, 36), False, False, False),  # a misprint beside a shaken table
        (ResidualTests(1.22, 1.27, 0.4, 3e-4, 36), False, True, False),  # lenses with fields: nothing of the motion
        (ResidualTests(1.18, 1.18, 2e-3, 5e-3, 36), False, True, False),  # likewise, and seen in the poses
        (ResidualTests(1.80, 1.18, 2e-3, 5e-3, 36), False, False, True),
    ],
)
def test_what_is_left_is_the_motions_only_where_the_poses_alone_hold_it(left, motion, measurement, doubtful):
    assert (left.of_the_motion, left.of_the_measurement, left.doubtful) == (motion, measurement, doubtful)


TURN_DEG, SHIFT_MM = (0.6, -0.7, 0.4), (1.2, -1.4, 0.8)
TURNED = {f"right_turned.rotation_{a}": float(np.radians(v)) for a, v in zip("xyz", TURN_DEG, strict=True)}
SHIFTED = {f"right_shifted.translation_{a}": 1e-3 * v for a, v in zip("xyz", SHIFT_MM, strict=True)}


def noisy(trajectory: Trajectory, sigma_px: float = 0.006) -> float:
    """Median of what the poses leave of the dots, over the noise."""
    return float(np.sqrt(np.nanmedian(trajectory.markers_residual_px**2) / 0.4549) / sigma_px)


def test_poses_with_the_fault_agree_again():
    turned = measured(faults=Faults(right=CameraFault(rotation_deg=TURN_DEG)), seed=3, n=60)
    assert noisy(turned) > 300
    # 18 of 24 numbers are left: root of 3/4; 2880 of them tell the median to 3 %
    assert noisy(poses_with(turned, TURNED)) == pytest.approx(0.866, rel=0.1)
    late = measured(faults=Faults(right_delay_s=3e-3), seed=3, n=60)
    assert noisy(late) > 100
    assert noisy(poses_with(late, {"time_offset.delay": 3e-3})) == pytest.approx(0.866, rel=0.1)


@pytest.mark.statistical
@pytest.mark.parametrize(
    ("faults", "truth"),
    [
        (Faults(right=CameraFault(rotation_deg=TURN_DEG)), TURNED),
        (Faults(right=CameraFault(translation_mm=SHIFT_MM)), SHIFTED),
        (Faults(right_delay_s=6e-3), {"time_offset.delay": 6e-3}),
    ],
)
def test_large_faults_are_named_and_sized_in_an_imperfect_laboratory(faults, truth):
    """1 deg, 2 mm, three frames; the fields of the lenses reach 0.02 px rms, and sigmas contain them."""
    result = diagnose(recording(faults=faults, seed=1)[0])
    found = [f.candidate for f in result.diagnosis.found]
    assert all(c.kind == "measurement" for c in found)
    assert any(set(truth) <= set(c.names) for c in found)
    assert_sized(result.diagnosis.after, truth, 4)
