"""Energy of true and of tracked motions."""

import numpy as np
from numpy.testing import assert_allclose
from scipy.integrate import trapezoid

from disctrack.analyse.derivatives import differentiate
from disctrack.analyse.energy import analyse_energy, energy_quantities
from disctrack.disc import MA_2014

TOTAL, POWER, ADIABATIC, LEVEL = 5, 6, 7, 8


def exact(truth):
    return energy_quantities(truth.state, MA_2014, 9.81)


def test_energy_is_constant_without_losses(true_motion):
    E = exact(true_motion(theta_deg=25, duration=0.6, k_m=0.0, nutation=0.1))
    assert_allclose(E[:, TOTAL], E[0, TOTAL], rtol=1e-10)  # the integrator's tolerance is 1e-11
    assert_allclose(E[:, POWER], 0, atol=1e-12)


def test_lost_power_is_that_of_the_rolling_moment(true_motion):
    """dE/dt = -M_m phidot sin theta, M_m = -k_m F_z psidot |psidot| (5.4, 5.5); F_z from the vertical acceleration."""
    k_m = 0.381e-7
    truth = true_motion(theta_deg=9, duration=3.0)
    psidot, phidot = truth.rates[:, 0], truth.rates[:, 2]
    F_z = MA_2014.mass * (9.81 + truth.acceleration[:, 2])
    expected = k_m * F_z * psidot * np.abs(psidot) * phidot * np.sin(truth.euler[:, 1])
    E = exact(truth)
    assert_allclose(E[:, POWER], expected, rtol=1e-9)
    assert_allclose(E[-1, TOTAL] - E[0, TOTAL], trapezoid(expected, truth.time), rtol=1e-5)


def test_datum_at_rest_is_what_makes_the_adiabatic_energy_right(true_motion):
    """With z instead of z - h the energy at 9 degrees would be 34 % too large."""
    truth = true_motion(theta_deg=2, duration=0.2, k_m=0.0, nutation=0.0)
    E = exact(truth)
    ratio = E[:, TOTAL] / E[:, ADIABATIC]
    assert_allclose(ratio, 1, atol=0.1)  # finite thickness: h / r = 8 %
    wrong = (E[:, TOTAL] + MA_2014.mass * 9.81 * MA_2014.half_thickness) / E[:, ADIABATIC]
    assert np.all(wrong > 2)


def test_level_of_thin_slow_precession_is_4g_over_r(true_motion):
    E = exact(true_motion(theta_deg=2, duration=0.2, k_m=0.0, nutation=0.0))
    assert_allclose(E[:, LEVEL] / (4 * 9.81 / 0.0375), 1, atol=0.02)


def test_error_of_the_table_height_is_common_and_does_not_enter_the_loss(true_motion, as_tracked, rng):
    """A height wrong by 2 um at all times shifts the potential energy by m g 2 um and cancels in differences."""
    truth = true_motion(theta_deg=9, duration=3.0)[:400]
    sensitivity = np.zeros((400, 6, 30))
    sensitivity[:, 2, 29] = 1.0
    rig_covariance = np.zeros((30, 30))
    rig_covariance[29, 29] = (2e-6) ** 2
    trajectory = as_tracked(truth, rng, sensitivity=sensitivity, rig_covariance=rig_covariance)
    energy = analyse_energy(differentiate(trajectory))
    total = energy.series[TOTAL]
    assert_allclose(total.sigma_calibration, MA_2014.mass * 9.81 * 2e-6, rtol=1e-6)
    assert energy.loss_sigma_calibration < 1e-3 * total.sigma_calibration[0]
    E = exact(truth)
    assert abs(energy.loss - (E[0, TOTAL] - E[-1, TOTAL])) < 4 * energy.loss_sigma
