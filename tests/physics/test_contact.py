"""Slip, locus, forces and the onset of rolling against true motions."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import trapezoid

from disctrack.analyse.contact import analyse_contact, contact_quantities
from disctrack.analyse.derivatives import differentiate
from disctrack.disc import MA_2014
from disctrack.frames import rotation_from_euler
from disctrack.rolling import CATALOGUE, Model, simulate
from disctrack.rolling import State as RollingState

COLUMN = {"slip": slice(3, 6), "locus": slice(6, 8), "force": slice(8, 11), "needed": 11}


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


def horizontal_axes(truth):
    """n0 and m0, each (n, 2)."""
    psi = truth.euler[:, 0]
    return np.column_stack([np.cos(psi), np.sin(psi)]), np.column_stack([-np.sin(psi), np.cos(psi)])


def test_material_point_at_the_contact_is_at_rest_in_pure_rolling(true_motion):
    truth = true_motion(theta_deg=60, duration=0.8, nutation=0.2)
    q = contact_quantities(truth.state, MA_2014, 9.81)
    assert_allclose(q[:, COLUMN["slip"]], 0, atol=1e-14)  # terms of 1 m/s cancel
    assert_allclose(q[:, 2], 0, atol=1e-16)  # and it touches the table


def test_locus_moves_with_the_derivative_of_the_contact_point(true_motion):
    truth = true_motion(theta_deg=25, duration=0.6, nutation=0.1)
    q = contact_quantities(truth.state, MA_2014, 9.81)
    n0, m0 = horizontal_axes(truth)
    velocity = np.gradient(q[:, :2], truth.time, axis=0)
    found = q[:, 6, None] * n0 + q[:, 7, None] * m0
    # central differences: interval^2 / 6 of the second derivative of 2 m/s at 80 rad/s
    assert_allclose(found[5:-5], velocity[5:-5], atol=2 * 1e-6 / 6 * 80**2)


def test_force_equals_what_the_rolling_equations_ask_for(true_motion):
    """The torque about the centre that these forces exert is the rate of the angular momentum: eq. (2.8)."""
    truth = true_motion(theta_deg=25, duration=0.6, k_m=0.0, nutation=0.1)
    state = truth.state
    q = contact_quantities(state, MA_2014, 9.81)
    e1, e2, e3 = state.axes()
    k = np.array([0.0, 0.0, 1.0])
    force = q[:, 8, None] * e1 + q[:, 9, None] * np.cross(k, e1) + q[:, 10, None] * k
    arm = -MA_2014.radius * e2 - MA_2014.half_thickness * e3
    J1, J3 = MA_2014.moment_diametral, MA_2014.moment_axial

    def momentum(vector):
        return J1 * vector + (J3 - J1) * np.sum(vector * e3, axis=1)[:, None] * e3

    rate = momentum(truth.alpha) + np.cross(truth.omega, momentum(truth.omega))
    assert_allclose(np.cross(arm, force), rate, atol=1e-14)  # terms of 0.1 N m


def test_swapped_components_are_noticed(true_motion):
    """Negative control: with the printed labels of (2.3) the slip of a sliding disc points elsewhere."""
    truth = sliding(true_motion(theta_deg=25, duration=0.6, nutation=0.1), 0.3, 0.5, heading=0.7)
    q = contact_quantities(truth.state, MA_2014, 9.81)
    n0, m0 = horizontal_axes(truth)
    right = q[:, 3, None] * n0 + q[:, 4, None] * m0
    swapped = q[:, 4, None] * n0 + q[:, 3, None] * m0
    slip = np.outer(0.5 * np.clip(1 - truth.time / 0.3, 0, None), [np.cos(0.7), np.sin(0.7)])
    assert_allclose(right, slip, atol=1e-14)
    assert np.abs(swapped - slip).max() > 0.3


@pytest.mark.parametrize(("onset", "speed"), [(0.25, 0.5), (0.25, 0.05), (0.1, 0.2)])
def test_onset_of_rolling_lies_in_its_interval(onset, speed, true_motion, as_tracked, rng):
    truth = sliding(true_motion(theta_deg=25, duration=0.6, nutation=0.1), onset, speed)
    found = analyse_contact(differentiate(as_tracked(truth, rng))).onset
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


@pytest.mark.statistical
def test_sliding_friction_is_measured_and_its_end_found(slip_to_roll, true_motion, as_tracked, rng):
    """Onset to 1 ms, path of slip to 0.1 %, coefficient of friction to 0.5 %, from poses with noise alone."""
    simulated = slip_to_roll
    (switch,) = simulated.switches
    base = true_motion(theta_deg=25, duration=0.6, nutation=0.1)[: len(simulated)]
    truth = replace(
        base,
        time=simulated.time,
        position=simulated.q[:, :3],
        R=rotation_from_euler(*simulated.q[:, 3:].T),
        euler=simulated.q[:, 3:],
        velocity=simulated.qdot[:, :3],
        omega=simulated.omega_world,
    )
    trajectory = as_tracked(truth, rng)
    contact = analyse_contact(differentiate(trajectory))
    assert abs(contact.onset.time - switch.time) < 1.5e-3  # one frame, and the tolerance's share
    assert contact.onset.high - contact.onset.low < 5e-3
    path = trapezoid(np.hypot(*simulated.slip_velocity.T), simulated.time)
    assert_allclose(contact.onset.slip_distance, path, rtol=1e-3)
    motion = differentiate(trajectory, breaks=(contact.onset.time,))
    propagated = analyse_contact(motion).propagated
    needed = propagated.value[simulated.time < switch.time, COLUMN["needed"]]
    assert_allclose(np.median(needed), 0.2, rtol=5e-3)
    # in the last 35 ms of slip its direction turns round within 10 ms; the frame of the switch may be on the wrong side
    fair = (simulated.time < switch.time - 0.035) | (simulated.time > switch.time + 1e-3)

    def squared_error(found, frames):
        error = found.value[frames, COLUMN["force"]] - simulated.contact_force[frames]
        return np.mean(error**2 / np.diagonal(found.covariance, axis1=1, axis2=2)[frames, COLUMN["force"]])

    assert 0.5 < squared_error(propagated, fair) < 1.8  # 3 axes of 460 frames: about 70 independent values
    # negative control: across the jump, one smooth curve is wrong by far more than its sigma
    soon = fair & (simulated.time > switch.time) & (simulated.time < switch.time + 0.01)
    assert squared_error(contact.propagated, soon) > 10 > 3 > squared_error(propagated, soon)


def test_disc_that_rolls_from_the_start_is_said_to(true_motion, as_tracked, rng):
    truth = true_motion(theta_deg=25, duration=0.6, nutation=0.1)
    found = analyse_contact(differentiate(as_tracked(truth, rng))).onset
    assert found.time == truth.time[0]
    assert "from the first frame" in found.verdict
    assert found.slip_distance < 1e-5
    assert found.n_late_slips == 0


def test_disc_that_slips_to_the_end_has_no_onset(true_motion, as_tracked, rng):
    truth = sliding(true_motion(theta_deg=25, duration=0.6, nutation=0.1)[:400], 0.6, 0.2)
    found = analyse_contact(differentiate(as_tracked(truth, rng))).onset
    assert np.isnan(found.time)
    assert found.probability < 0.01
    assert "slips to the end" in found.verdict


def test_circle_through_the_locus_of_a_steady_disc_is_the_no_slip_radius(true_motion, as_tracked, rng):
    """Centre at rest: radius r cos theta - h sin theta, 37.29 mm at 3 degrees, as in the paper's figure 9."""
    truth = true_motion(theta_deg=3, duration=0.3, k_m=0.0, nutation=0.0)
    circle = analyse_contact(differentiate(as_tracked(truth, rng))).circle
    theta = np.radians(3)
    assert_allclose(circle.expected, 0.0375 * np.cos(theta) - 0.003 * np.sin(theta), rtol=1e-6)
    assert abs(circle.radius - circle.expected) < 4 * circle.sigma
    assert circle.sigma < 5e-6
    assert_allclose(circle.centre, truth.position[:, :2].mean(axis=0), atol=5e-6)


def test_short_arc_gives_no_circle(true_motion, as_tracked, rng):
    truth = true_motion(theta_deg=25, duration=0.6, nutation=0.1)[:25]
    circle = analyse_contact(differentiate(as_tracked(truth, rng))).circle
    assert np.isnan(circle.radius)
