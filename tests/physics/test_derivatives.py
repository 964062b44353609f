"""Velocities and accelerations against true motions, with the noise of real poses."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.stats import norm

from disctrack.analyse.contact import contact_quantities
from disctrack.analyse.derivatives import SYSTEMATIC_LENGTH, differentiate
from disctrack.analyse.energy import energy_quantities
from disctrack.analyse.propagation import propagate, rates
from disctrack.disc import MA_2014
from disctrack.errors import AnalysisError
from disctrack.frames import rotation_from_vector, vector_from_rotation

QUANTITIES = ("position", "rotation", "velocity", "omega", "acceleration", "alpha")
MOTIONS = {
    "from 9 degrees to rest": dict(theta_deg=9, duration=3.0),
    "25 degrees, nutating": dict(theta_deg=25, duration=0.6, nutation=0.1),
    "60 degrees, nutating": dict(theta_deg=60, duration=0.8, nutation=0.2),
}


def errors(motion, truth):
    turn = vector_from_rotation(truth.R @ np.swapaxes(motion.R_world_body, 1, 2))
    return np.concatenate(
        [
            motion.position - truth.position,
            -turn,
            motion.velocity - truth.velocity,
            motion.omega_world - truth.omega,
            motion.acceleration - truth.acceleration,
            motion.alpha_world - truth.alpha,
        ],
        axis=1,
    )


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
def test_squared_error_is_the_predicted_variance(name, seeds, low, high, true_motion, as_tracked):
    # smoothed noise is correlated over 20 frames: a copy holds 100 values and scatters by 15 %, a mean by 8 and 3 %
    truth = true_motion(**MOTIONS[name])[-700:]
    found = [
        squared_error_over_variance(differentiate(as_tracked(truth, np.random.default_rng(seed))), truth)
        for seed in range(seeds)
    ]
    for quantity in QUANTITIES:
        assert low <= np.mean([f[quantity] for f in found]) <= high, quantity


@pytest.fixture(scope="module")
def four_motions(true_motion, as_tracked):
    """The end of a motion, and four measurements of it."""
    truth = true_motion(theta_deg=9, duration=3.0)[-700:]
    return truth, [differentiate(as_tracked(truth, np.random.default_rng(seed))) for seed in range(4)]


@pytest.mark.statistical
@pytest.mark.parametrize(
    ("quantities", "low", "high"),
    [
        (rates, 0.7, 1.35),
        (lambda state: contact_quantities(state, MA_2014, 9.81), 0.65, 1.45),
        (lambda state: energy_quantities(state, MA_2014, 9.81), 0.65, 1.45),
    ],
    ids=["rates", "contact", "energy"],
)
def test_derived_quantities_are_honest_about_their_noise(quantities, low, high, four_motions):
    # each alone has 4 * 700 / 20 independent values: 12 % of scatter
    truth, motions = four_motions
    ratios = []
    for motion in motions:
        found = propagate(motion, quantities)
        variance = np.diagonal(found.covariance, axis1=1, axis2=2)
        ratios.append(np.mean((found.value - quantities(truth.state)) ** 2 / variance, axis=0))
    assert np.all(np.mean(ratios, axis=0) > low), ratios
    assert np.all(np.mean(ratios, axis=0) < high), ratios


@pytest.mark.statistical
def test_slip_is_known_to_a_tenth_of_a_millimetre_per_second(four_motions):
    motion = four_motions[1][0]
    slip = propagate(motion, lambda state: contact_quantities(state, MA_2014, 9.81)).value[:, 3:5]
    assert np.sqrt(np.mean(slip**2)) < 1e-4  # central differences leave 20 mm/s
    psidot_sigma = np.sqrt(propagate(motion, rates).covariance[:, 0, 0])
    assert psidot_sigma[-50:-20].mean() > 5 * psidot_sigma[100:200].mean()  # as the disc flattens


def test_covariance_that_is_too_small_is_noticed(true_motion, as_tracked, rng):
    """Negative control of the test above, and the data's own noise is preferred to a wrong statement about it."""
    truth = true_motion(theta_deg=25, duration=0.6, nutation=0.1)
    honest = as_tracked(truth, rng)
    boasting = replace(honest, pose_covariance=honest.pose_covariance / 4)
    motion = differentiate(boasting)
    assert_allclose(motion.noise_scale, 4, rtol=0.2)  # 600 frames, 1 or 2 channels: 3-6 % of scatter, grid 3.5 %
    shrunk = replace(motion, covariance=motion.covariance / 4)
    assert squared_error_over_variance(motion, truth)["velocity"] < 1.35
    assert squared_error_over_variance(shrunk, truth)["velocity"] > 2.5


def imagined(true_motion, n, **known):
    """A motion that nobody rolled: n instants of a disc at rest but for what is given."""
    base, zero = true_motion(theta_deg=9, duration=3.0)[:n], np.zeros((n, 3))
    still = dict.fromkeys(("position", "velocity", "omega", "acceleration", "alpha"), zero)
    return replace(base, **still | {"R": np.tile(np.eye(3), (n, 1, 1))} | known)


@pytest.mark.parametrize("frequency", [10.0, 60.0, 80.0])
def test_amplitude_of_an_oscillation_is_kept(frequency, true_motion, as_tracked, rng):
    """To 0.5 % at 60 Hz in value, velocity and acceleration, for shifts and for tilts, with the noise of real poses."""
    time = np.arange(400) * 1e-3
    w = 2 * np.pi * frequency
    wave = [np.sin(w * time), w * np.cos(w * time), -w * w * np.sin(w * time)]
    x, v, a = (np.outer(f, [1e-3, 0, 0]) for f in wave)
    spin, omega, alpha = (np.outer(f, [0, np.radians(1.0), 0]) for f in wave)
    known = {"position": x, "velocity": v, "acceleration": a, "omega": omega, "alpha": alpha}
    truth = imagined(true_motion, 400, R=rotation_from_vector(spin), **known)
    motion = differentiate(as_tracked(truth, rng))
    for found, true in (
        (motion.position[:, 0], x[:, 0]),
        (motion.velocity[:, 0], v[:, 0]),
        (motion.acceleration[:, 0], a[:, 0]),
        (motion.omega_world[:, 1], omega[:, 1]),
        (motion.alpha_world[:, 1], alpha[:, 1]),
    ):
        gain = (found[20:-20] @ true[20:-20]) / (true[20:-20] @ true[20:-20])
        # an unbiased gain still scatters with the noise, at 10 Hz most in the second derivative: 1e-3
        assert abs(gain - 1) < 0.005


@pytest.mark.statistical
@pytest.mark.parametrize(
    ("frames", "worst", "missing", "low", "high"),  # some 24 independent values: 30 % of scatter; at the ends 15 %
    [(np.r_[300:320], 310, range(300, 320), 0.3, 2.0), (np.r_[0:8, 392:400], 399, (), 0.6, 1.6)],
    ids=["a gap", "the ends"],
)
def test_sigmas_are_honest_where_samples_are_missing(frames, worst, missing, low, high, true_motion, as_tracked):
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
def test_motion_across_a_gap_too_long_to_bridge_is_unknown(true_motion, as_tracked, rng):
    truth = true_motion(theta_deg=9, duration=3.0)[:600]
    motion = differentiate(as_tracked(truth, rng, missing=range(200, 400)))
    assert not motion.known[230:370].any()
    assert motion.known[:195].all()
    assert motion.known[405:].all()
    ratio = squared_error_over_variance(motion, truth, motion.known)
    assert all(0.6 < value < 1.6 for value in ratio.values()), ratio


def test_disc_at_rest_has_no_velocity_beyond_its_sigma(true_motion, as_tracked, rng):
    still = imagined(true_motion, 300, position=np.tile([0.05, 0.04, 0.003], (300, 1)))
    motion = differentiate(as_tracked(still, rng))
    assert np.abs(motion.velocity).max() < 2e-5
    sigma = np.sqrt(np.diagonal(motion.covariance, axis1=1, axis2=2))
    assert np.all(np.abs(errors(motion, still)) < 6 * sigma)
    # flat on the table there is no direction of precession: NaN, not a number
    assert np.isnan(propagate(motion, rates).value[:, 0]).all()


def test_fast_spin_is_followed(true_motion, as_tracked, rng):
    """A coin that turns about the vertical at 60 rad/s turns by several radians inside one window."""
    spin = np.tile([0.0, 0.0, 60.0], (300, 1))
    upright = rotation_from_vector(np.array([np.radians(60.0), 0.0, 0.0]))
    R = rotation_from_vector(1e-3 * np.arange(300)[:, None] * spin) @ upright
    truth = imagined(true_motion, 300, R=R, omega=spin)
    motion = differentiate(as_tracked(truth, rng))
    ratio = squared_error_over_variance(motion, truth)
    assert 0.6 < ratio["omega"] < 1.5, ratio
    assert_allclose(motion.omega_world, spin, atol=0.02)


@pytest.mark.statistical
def test_calibration_error_is_carried_as_one_common_error(true_motion, as_tracked, rng):
    """A rig parameter that turns and shifts all poses alike changes the found motion as the sensitivity says."""
    truth = true_motion(theta_deg=25, duration=0.6, nutation=0.1)[:300]
    turn = np.array([2e-4, -1e-4, 3e-4])
    shift = np.cross(turn, truth.position)  # the world turned about its origin
    sensitivity = np.zeros((300, 6, 30))
    sensitivity[:, :3, 24], sensitivity[:, 3:, 24] = shift, turn
    trajectory = as_tracked(truth, rng, noise=0.0, sensitivity=sensitivity)
    turned = replace(truth, position=truth.position + shift, R=rotation_from_vector(turn) @ truth.R)
    before, after = differentiate(trajectory), differentiate(as_tracked(turned, rng, noise=0.0))
    S = before.calibration_sensitivity[:, :, 24]
    pairs = {
        "velocity": (after.velocity - before.velocity, S[:, 6:9]),
        "omega": (after.omega_world - before.omega_world, S[:, 9:12]),
        "acceleration": (after.acceleration - before.acceleration, S[:, 12:15]),
        "alpha": (after.alpha_world - before.alpha_world, S[:, 15:18]),
    }
    for name, (found, predicted) in pairs.items():
        # second order in a turn of 4e-4 rad
        assert_allclose(found, predicted, atol=2e-3 * np.abs(predicted).max(), err_msg=name)


def test_uneven_times_are_respected(true_motion, as_tracked, rng):
    time = np.sort(1e-3 * np.arange(200) + rng.uniform(-2e-4, 2e-4, 200))
    w = 2 * np.pi * 20
    x, v = (np.outer(f, [1e-3, 0, 0]) for f in (np.sin(w * time), w * np.cos(w * time)))
    motion = differentiate(as_tracked(imagined(true_motion, 200, time=time, position=x, velocity=v), rng))
    assert_allclose(motion.velocity[10:-10], v[10:-10], atol=2e-4)  # sigma is 3e-5 to 5e-5 m/s


@pytest.mark.parametrize("missing", [range(0, 195), range(0, 200)])
def test_too_few_poses_are_an_error_that_says_so(missing, true_motion, as_tracked, rng):
    truth = true_motion(theta_deg=25, duration=0.6, nutation=0.1)[:200]
    with pytest.raises(AnalysisError, match="of 200 frames have a pose"):
        differentiate(as_tracked(truth, rng, missing=missing))


def test_time_that_runs_backwards_is_an_error(true_motion, as_tracked, rng):
    truth = true_motion(theta_deg=25, duration=0.6, nutation=0.1)[:100]
    time = truth.time.copy()
    time[[50, 51]] = time[[51, 50]]
    with pytest.raises(AnalysisError, match="time does not increase"):
        differentiate(as_tracked(replace(truth, time=time), rng))


@pytest.mark.statistical
def test_what_repeats_in_the_poses_is_carried_to_the_rates(true_motion, as_tracked, rng):
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
    squared = {"position": [], "velocity": [], "omega_world": [], "acceleration": [], "alpha_world": []}
    for _ in range(12):
        # waves with a normal spectrum of the pace's width
        w = pace * norm.ppf((np.arange(24) + 0.5) / 24)
        phase = rng.uniform(0, 2 * np.pi, (6, 24))
        error = np.sqrt(np.diag(S)) * np.cos(w * truth.time[:, None, None] + phase).sum(-1) / np.sqrt(12)
        wrong = replace(truth, position=truth.position + error[:, :3], R=rotation_from_vector(error[:, 3:]) @ truth.R)
        found = differentiate(as_tracked(wrong, rng, noise=0.0))
        for name in squared:
            squared[name].append((getattr(found, name) - getattr(motion, name)) ** 2)
    C = np.diagonal(motion.systematic_at(np.arange(300)), axis1=1, axis2=2)
    first = {"position": 0, "velocity": 6, "omega_world": 9, "acceleration": 12, "alpha_world": 15}
    for name, values in squared.items():
        ratio = np.mean(np.mean(values, axis=0) / C[:, first[name] : first[name] + 3])
        assert 0.7 < ratio < 1.4, (name, ratio)
    silent = differentiate(as_tracked(truth, rng, noise=0.0))
    assert not silent.systematic_at(np.arange(5)).any()
