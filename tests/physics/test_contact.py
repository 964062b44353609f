"""Velocities, accelerations, slip, locus, forces, energy and the onset of rolling against true motions, with noise."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import trapezoid
from scipy.stats import norm

from disctrack.analyse.contact import locus_circle, rolling_onset
from disctrack.analyse.derivatives import SYSTEMATIC_LENGTH, differentiate
from disctrack.analyse.quantities import ALL, COLUMN, energy_of, from_to, propagate, quantities
from disctrack.disc import MA_2014
from disctrack.errors import AnalysisError
from disctrack.frames import rotation_from_vector, vector_from_rotation
from disctrack.rolling import CATALOGUE, Model, simulate
from disctrack.rolling import State as RollingState
from tests.physics.conftest import as_tracked, of_simulation, true_motion

QUANTITIES = ("position", "rotation", "velocity", "omega_world", "acceleration", "alpha_world")
MOTIONS = {
    "from 9 degrees to rest": dict(theta_deg=9, duration=3.0),
    "25 degrees, nutating": dict(theta_deg=25, duration=0.6, nutation=0.1),
    "60 degrees, nutating": dict(theta_deg=60, duration=0.8, nutation=0.2),
}


def exact(truth):
    return quantities(truth, MA_2014, 9.81)


def errors(motion, truth):
    turn = vector_from_rotation(motion.R_world_body @ np.swapaxes(truth.R_world_body, 1, 2))
    position, *rates = (getattr(motion, name) - getattr(truth, name) for name in QUANTITIES if name != "rotation")
    return np.concatenate([position, turn, *rates], axis=1)


def squared_error_over_variance(motion, truth, frames=slice(None)):
    """Per quantity, squared error over predicted covariance per degree of freedom, mean over the frames."""
    e = errors(motion, truth)[frames]
    C = motion.covariance[frames]
    result = {}
    for i, name in enumerate(QUANTITIES):
        part = slice(3 * i, 3 * i + 3)
        result[name] = np.mean(np.einsum("ni,nij,nj->n", e[:, part], np.linalg.inv(C[:, part, part]), e[:, part]) / 3)
    return result


@pytest.mark.parametrize("name", MOTIONS)
@pytest.mark.parametrize(
    ("seeds", "low", "high"),
    [pytest.param(4, 0.7, 1.3, marks=pytest.mark.statistical), pytest.param(24, 0.8, 1.25, marks=pytest.mark.slow)],
)
def test_squared_error_is_the_predicted_variance(name, seeds, low, high):
    # smoothed noise is correlated over 20 frames: a copy holds 100 values and scatters by 15 %, a mean by 8 and 3 %
    truth = true_motion(**MOTIONS[name])[-700:]
    motions = (differentiate(as_tracked(truth, np.random.default_rng(seed))) for seed in range(seeds))
    found = [squared_error_over_variance(motion, truth) for motion in motions]
    for quantity in QUANTITIES:
        assert low <= np.mean([f[quantity] for f in found]) <= high, quantity


@pytest.mark.statistical
def test_derived_quantities_are_honest_about_their_noise():
    # each alone has 4 * 700 / 20 independent values: 12 % of scatter
    truth, ratios = true_motion(theta_deg=9, duration=3.0)[-700:], []
    for seed in range(4):
        found = propagate(differentiate(as_tracked(truth, np.random.default_rng(seed))))
        variance = np.array([series.sigma**2 for series in found.series(ALL)]).T
        ratios.append(np.mean((found.value - exact(truth)) ** 2 / variance, axis=0))
    mean, rates = np.mean(ratios, axis=0), from_to("psidot", "omega_z")
    assert np.all((mean > 0.65) & (mean < 1.45)), ratios
    assert np.all((mean[rates] > 0.7) & (mean[rates] < 1.35)), ratios


def test_covariance_that_is_too_small_is_noticed(rng):
    """Negative control of the test above, and the data's own noise is preferred to a wrong statement about it."""
    truth = true_motion(theta_deg=25, duration=0.6, nutation=0.1)
    honest = as_tracked(truth, rng)
    boasting = replace(honest, pose_covariance=honest.pose_covariance / 4)
    motion = differentiate(boasting)
    assert_allclose(motion.noise_scale, 4, rtol=0.2)  # 600 frames, 1 or 2 channels: 3-6 % of scatter, grid 3.5 %
    shrunk = replace(motion, covariance=motion.covariance / 4)
    assert squared_error_over_variance(motion, truth)["velocity"] < 1.35
    assert squared_error_over_variance(shrunk, truth)["velocity"] > 2.5


def imagined(n, **known):
    """A motion that nobody rolled: n instants of a disc at rest but for what is given."""
    base, zero = true_motion(theta_deg=9, duration=3.0)[:n], np.zeros((n, 3))
    still = {name: zero for name in QUANTITIES if name != "rotation"}
    return replace(base, **still | {"R_world_body": np.tile(np.eye(3), (n, 1, 1))} | known)


@pytest.mark.parametrize("frequency", [10.0, 60.0, 80.0])
def test_amplitude_of_an_oscillation_is_kept(frequency, rng):
    """To 0.5 % at 60 Hz in value, velocity and acceleration, for shifts and for tilts, with the noise of real poses."""
    time = np.arange(400) * 1e-3
    w = 2 * np.pi * frequency
    wave = [np.sin(w * time), w * np.cos(w * time), -w * w * np.sin(w * time)]
    x, v, a = (np.outer(f, [1e-3, 0, 0]) for f in wave)
    spin, omega, alpha = (np.outer(f, [0, np.radians(1.0), 0]) for f in wave)
    known = {"position": x, "velocity": v, "acceleration": a, "omega_world": omega, "alpha_world": alpha}
    motion = differentiate(as_tracked(imagined(400, R_world_body=rotation_from_vector(spin), **known), rng))
    for name, true in known.items():
        gain = np.sum((getattr(motion, name) * true)[20:-20]) / np.sum(true[20:-20] ** 2)
        # an unbiased gain still scatters with the noise, at 10 Hz most in the second derivative: 1e-3
        assert abs(gain - 1) < 0.005


@pytest.mark.statistical
@pytest.mark.parametrize(
    ("frames", "worst", "missing", "low", "high"),  # some 24 independent values: 30 % of scatter; at the ends 15 %
    [(np.r_[300:320], 310, range(300, 320), 0.3, 2.0), (np.r_[0:8, 392:400], 399, (), 0.6, 1.6)],
    ids=["a gap", "the ends"],
)
def test_sigmas_are_honest_where_samples_are_missing(frames, worst, missing, low, high):
    truth = (
        true_motion(theta_deg=25, duration=0.6, nutation=0.1)
        if len(missing)
        else true_motion(theta_deg=9, duration=3.0)[-400:]
    )
    found = []
    for seed in range(6):
        motion = differentiate(as_tracked(truth, np.random.default_rng(seed), missing=missing))
        assert motion.known.all()
        assert not motion.measured[list(missing)].any()
        found.append(squared_error_over_variance(motion, truth, frames))
        assert motion.covariance[worst, 6, 6] > 1.5 * motion.covariance[200, 6, 6]
    for quantity in QUANTITIES:
        assert low < np.mean([f[quantity] for f in found]) < high, quantity


@pytest.mark.statistical
def test_motion_across_a_gap_too_long_to_bridge_is_unknown(rng):
    truth = true_motion(theta_deg=9, duration=3.0)[:600]
    motion = differentiate(as_tracked(truth, rng, missing=range(200, 400)))
    assert not motion.known[230:370].any()
    assert motion.known[:195].all()
    assert motion.known[405:].all()
    ratio = squared_error_over_variance(motion, truth, motion.known)
    assert all(0.6 < value < 1.6 for value in ratio.values()), ratio


def test_fast_spin_is_followed(rng):
    """A coin that turns about the vertical at 60 rad/s turns by several radians inside one window."""
    spin = np.tile([0.0, 0.0, 60.0], (300, 1))
    upright = rotation_from_vector(np.array([np.radians(60.0), 0.0, 0.0]))
    R = rotation_from_vector(1e-3 * np.arange(300)[:, None] * spin) @ upright
    truth = imagined(300, R_world_body=R, omega_world=spin)
    motion = differentiate(as_tracked(truth, rng))
    ratio = squared_error_over_variance(motion, truth)
    assert 0.6 < ratio["omega_world"] < 1.5, ratio
    assert_allclose(motion.omega_world, spin, atol=0.02)


@pytest.mark.statistical
def test_calibration_error_is_carried_as_one_common_error(rng):
    """A rig parameter that turns and shifts all poses alike changes the found motion as the sensitivity says."""
    truth = true_motion(theta_deg=25, duration=0.6, nutation=0.1)[:300]
    turn = np.array([2e-4, -1e-4, 3e-4])
    shift = np.cross(turn, truth.position)  # the world turned about its origin
    sensitivity = np.zeros((300, 6, 30))
    sensitivity[:, :3, 24], sensitivity[:, 3:, 24] = shift, turn
    trajectory = as_tracked(truth, rng, noise=0.0, sensitivity=sensitivity)
    R = rotation_from_vector(turn) @ truth.R_world_body
    turned = replace(truth, position=truth.position + shift, R_world_body=R)
    before, after = differentiate(trajectory), differentiate(as_tracked(turned, rng, noise=0.0))
    S = before.calibration_sensitivity[:, :, 24]
    for i, name in enumerate(QUANTITIES[2:], start=2):
        found, predicted = getattr(after, name) - getattr(before, name), S[:, 3 * i : 3 * i + 3]
        # second order in a turn of 4e-4 rad
        assert_allclose(found, predicted, atol=2e-3 * np.abs(predicted).max(), err_msg=name)


def test_uneven_times_are_respected(rng):
    time = np.sort(1e-3 * np.arange(200) + rng.uniform(-2e-4, 2e-4, 200))
    w = 2 * np.pi * 20
    x, v = (np.outer(f, [1e-3, 0, 0]) for f in (np.sin(w * time), w * np.cos(w * time)))
    motion = differentiate(as_tracked(imagined(200, time=time, position=x, velocity=v), rng))
    assert_allclose(motion.velocity[10:-10], v[10:-10], atol=2e-4)  # sigma is 3e-5 to 5e-5 m/s


@pytest.mark.parametrize("missing", [range(0, 195), range(0, 200)])
def test_too_few_poses_are_an_error_that_says_so(missing, rng):
    truth = true_motion(theta_deg=25, duration=0.6, nutation=0.1)[:200]
    with pytest.raises(AnalysisError, match="of 200 frames have a pose"):
        differentiate(as_tracked(truth, rng, missing=missing))


def test_a_time_that_does_not_increase_is_an_error_that_says_where(rng):
    truth = true_motion(theta_deg=25, duration=0.6, nutation=0.1)[:200]
    with pytest.raises(AnalysisError, match="time does not increase from frame 198 to 199"):
        differentiate(replace(as_tracked(truth, rng), time=np.append(truth.time[:-1], truth.time[-2])))


@pytest.mark.statistical
def test_what_repeats_in_the_poses_is_carried_to_the_rates(rng):
    """A smooth error with the stated variance and pace: of pose and rates within their stated sigma, chi-square."""
    truth = true_motion(theta_deg=25, duration=0.6, nutation=0.1)[:300]
    trajectory = as_tracked(truth, rng, noise=0.0)
    S = np.diag([2e-6, 1e-6, 3e-6, 3e-5, 2e-5, 1e-5]) ** 2
    length = SYSTEMATIC_LENGTH * 512
    pace = 40.0  # [1/s]: dots that run through the image
    px = np.broadcast_to((pace * length * truth.time)[:, None, None, None] * [1.0, 0.0], trajectory.markers_px.shape)
    trajectory = replace(trajectory, systematic_covariance=np.broadcast_to(S, (300, 6, 6)), markers_px=px)
    motion = differentiate(trajectory)
    assert_allclose(motion.systematic_pace, pace, rtol=1e-9)
    squared = {name: [] for name in QUANTITIES if name != "rotation"}
    for _ in range(12):
        # waves with a normal spectrum of the pace's width
        w = pace * norm.ppf((np.arange(24) + 0.5) / 24)
        phase = rng.uniform(0, 2 * np.pi, (6, 24))
        error = np.sqrt(np.diag(S)) * np.cos(w * truth.time[:, None, None] + phase).sum(-1) / np.sqrt(12)
        R = rotation_from_vector(error[:, 3:]) @ truth.R_world_body
        wrong = replace(truth, position=truth.position + error[:, :3], R_world_body=R)
        found = differentiate(as_tracked(wrong, rng, noise=0.0))
        for name in squared:
            squared[name].append((getattr(found, name) - getattr(motion, name)) ** 2)
    C = np.diagonal(motion.systematic_at(np.arange(300)), axis1=1, axis2=2)
    for name, values in squared.items():
        first = 3 * QUANTITIES.index(name)
        ratio = np.mean(np.mean(values, axis=0) / C[:, first : first + 3])
        assert 0.7 < ratio < 1.4, (name, ratio)
    silent = differentiate(as_tracked(truth, rng, noise=0.0))
    assert not silent.systematic_at(np.arange(5)).any()


TOTAL, POWER, ADIABATIC, LEVEL = (COLUMN[name] for name in ("total", "power", "adiabatic", "precession_level"))
SLIP, LOCUS, FORCE = from_to("slip_n", "slip_m"), from_to("locus_n", "locus_m"), from_to("force_n", "force_z")


def sliding(truth, onset, speed, heading=0.7):
    """The motion with a horizontal velocity on top that falls linearly from `speed` to zero at `onset`: all slip."""
    left = np.clip(onset - truth.time, 0, None)
    direction = np.array([np.cos(heading), np.sin(heading), 0.0])
    return replace(
        truth,
        position=truth.position - np.outer(speed / onset * left**2 / 2, direction),
        velocity=truth.velocity + np.outer(speed / onset * left, direction),
        acceleration=truth.acceleration - np.outer(speed / onset * (left > 0), direction),
    )


def test_locus_moves_with_the_derivative_of_the_contact_point():
    truth = true_motion(theta_deg=25, duration=0.6, nutation=0.1)
    q = exact(truth)
    psi = truth.euler[:, 0]
    n0, m0 = np.column_stack([np.cos(psi), np.sin(psi)]), np.column_stack([-np.sin(psi), np.cos(psi)])
    velocity = np.gradient(q[:, from_to("contact_x", "contact_y")], truth.time, axis=0)
    found = q[:, LOCUS][:, :1] * n0 + q[:, LOCUS][:, 1:] * m0
    # central differences: interval^2 / 6 of the second derivative of 2 m/s at 80 rad/s
    assert_allclose(found[5:-5], velocity[5:-5], atol=2 * 1e-6 / 6 * 80**2)


@pytest.mark.parametrize(("onset", "speed"), [(0.25, 0.5), (0.25, 0.05), (0.1, 0.2)])
def test_onset_of_rolling_lies_in_its_interval(onset, speed, rng):
    truth = sliding(true_motion(theta_deg=25, duration=0.6, nutation=0.1), onset, speed)
    found = rolling_onset(propagate(differentiate(as_tracked(truth, rng))))
    assert found.probability > 0.99
    # slip below the tolerance is rolling by definition: it sinks below 4 tolerances this much before its end
    unseen = 4 * 0.5e-3 / (speed / onset)
    assert onset - unseen - 0.004 < found.time < onset + 0.004
    assert found.low <= found.time <= found.high
    assert found.high - found.low < 0.03
    assert_allclose(found.slip_distance, speed * onset / 2, rtol=0.01)


@pytest.fixture(scope="module")
def slip_to_roll():
    """A disc at 25 degrees that slides at 0.36 m/s under Coulomb friction of 0.2 until it rolls."""
    model = Model(MA_2014).with_effects(CATALOGUE["km"](), CATALOGUE["slip"](mu=0.2))
    w2 = 50 * np.sin(np.radians(25))
    start = RollingState(theta=np.radians(25), thetadot=0.5, omega2=w2, omega3=2.0, v_x=0.35, v_y=0.1)
    return simulate(model, start, 0.5)


def test_slip_force_energy_and_power_are_those_of_the_simulation(slip_to_roll):
    q = exact(of_simulation(slip_to_roll))
    assert_allclose(q[:, SLIP], slip_to_roll.slip_velocity, atol=1e-13)  # terms of 1 m/s cancel
    # the point touches the table and does not leave it
    assert_allclose(q[:, [COLUMN["contact_z"], COLUMN["slip_z"]]], 0, atol=1e-13)
    assert_allclose(q[:, FORCE], slip_to_roll.contact_force, atol=1e-11)  # of 2 N
    assert_allclose(q[:, TOTAL], slip_to_roll.energy, rtol=1e-12)
    assert_allclose(q[:, POWER], slip_to_roll.power, atol=1e-12)
    assert slip_to_roll.power.min() < -0.1  # slip takes energy


@pytest.mark.statistical
def test_sliding_friction_is_measured_and_its_end_found(slip_to_roll, rng):
    """Onset to 1 ms, path of slip to 0.1 %, coefficient of friction to 0.5 %, from poses with noise alone."""
    simulated = slip_to_roll
    (switch,) = simulated.switches
    truth = of_simulation(simulated)
    trajectory = as_tracked(truth, rng)
    across = propagate(differentiate(trajectory))
    onset = rolling_onset(across)
    assert abs(onset.time - switch.time) < 1.5e-3  # one frame, and the tolerance's share
    assert onset.high - onset.low < 5e-3
    path = trapezoid(np.hypot(*simulated.slip_velocity.T), simulated.time)
    assert_allclose(onset.slip_distance, path, rtol=1e-3)
    motion = differentiate(trajectory, breaks=(onset.time,))
    propagated = propagate(motion)
    needed = propagated.value[simulated.time < switch.time, COLUMN["friction_needed"]]
    assert_allclose(np.median(needed), 0.2, rtol=5e-3)
    # in the last 35 ms of slip its direction turns round within 10 ms; the frame of the switch may be on the wrong side
    fair = (simulated.time < switch.time - 0.035) | (simulated.time > switch.time + 1e-3)

    def squared_error(found, frames):
        error = found.value[frames, FORCE] - simulated.contact_force[frames]
        return np.mean(error**2 / np.diagonal(found.covariance(np.flatnonzero(frames), FORCE), axis1=1, axis2=2))

    assert 0.5 < squared_error(propagated, fair) < 1.8  # 3 axes of 460 frames: about 70 independent values
    # negative control: across the jump, one smooth curve is wrong by far more than its sigma
    soon = fair & (simulated.time > switch.time) & (simulated.time < switch.time + 0.01)
    assert squared_error(across, soon) > 10 > 3 > squared_error(propagated, soon)


def test_disc_that_slips_to_the_end_has_no_onset(rng):
    truth = sliding(true_motion(theta_deg=25, duration=0.6, nutation=0.1)[:400], 0.6, 0.2)
    found = rolling_onset(propagate(differentiate(as_tracked(truth, rng))))
    assert np.isnan(found.time)
    assert found.probability < 0.01
    assert "slips to the end" in found.verdict


def test_circle_through_the_locus_of_a_steady_disc_is_the_no_slip_radius(rng):
    """Centre at rest: radius r cos theta - h sin theta, 37.29 mm at 3 degrees, as in the paper's figure 9."""
    truth = true_motion(theta_deg=3, duration=0.3, k_m=0.0, nutation=0.0)
    circle = locus_circle(propagate(differentiate(as_tracked(truth, rng))), 0.6)
    theta = np.radians(3)
    assert_allclose(circle.expected, 0.0375 * np.cos(theta) - 0.003 * np.sin(theta), rtol=1e-6)
    assert abs(circle.radius - circle.expected) < 4 * circle.sigma
    assert circle.sigma < 5e-6
    assert_allclose(circle.centre, truth.position[:, :2].mean(axis=0), atol=5e-6)


def test_short_arc_gives_no_circle(rng):
    truth = true_motion(theta_deg=25, duration=0.6, nutation=0.1)[:25]
    circle = locus_circle(propagate(differentiate(as_tracked(truth, rng))), 0.6)
    assert np.isnan(circle.radius)


def test_datum_at_rest_makes_the_adiabatic_energy_right_and_the_level_of_slow_precession_is_4g_over_r():
    """With z instead of z - h the energy at 9 degrees would be 34 % too large."""
    E = exact(true_motion(theta_deg=2, duration=0.2, k_m=0.0, nutation=0.0))
    ratio = E[:, TOTAL] / E[:, ADIABATIC]
    assert_allclose(ratio, 1, atol=0.1)  # finite thickness: h / r = 8 %
    wrong = (E[:, TOTAL] + MA_2014.mass * 9.81 * MA_2014.half_thickness) / E[:, ADIABATIC]
    assert np.all(wrong > 2)
    assert_allclose(E[:, LEVEL] / (4 * 9.81 / 0.0375), 1, atol=0.02)


def test_error_of_the_table_height_is_common_and_does_not_enter_the_loss(rng):
    """A height wrong by 2 um at all times shifts the potential energy by m g 2 um and cancels in differences."""
    truth = true_motion(theta_deg=9, duration=3.0)[:400]
    sensitivity = np.zeros((400, 6, 30))
    sensitivity[:, 2, 29] = 1.0
    rig_covariance = np.zeros((30, 30))
    rig_covariance[29, 29] = (2e-6) ** 2
    trajectory = as_tracked(truth, rng, sensitivity=sensitivity, rig_covariance=rig_covariance)
    found = propagate(differentiate(trajectory))
    energy, total = energy_of(found), found.series(ALL)[TOTAL]
    assert_allclose(total.sigma_calibration, MA_2014.mass * 9.81 * 2e-6, rtol=1e-6)
    assert energy.loss_sigma_calibration < 1e-3 * total.sigma_calibration[0]
    E = exact(truth)
    assert abs(energy.loss - (E[0, TOTAL] - E[-1, TOTAL])) < 4 * energy.loss_sigma
