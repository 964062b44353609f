"""The disc's dots as a second ruler beside the board."""

from dataclasses import replace

import numpy as np
import pytest

from calibration.cameras.camera import Allowance
from calibration.judge.tolerances import SIZE
from disctrack.track.refine.self_calibration import refine_as_built
from tests.oracles.measured_disc import dots_of, measured

SHORT = 1e-4  # relative, by which the rig takes all lengths for too short


@pytest.fixture(scope="module")
def trajectory():
    return measured(n=80)


def refined(trajectory, rng, size_sigma, misprint=0.0):
    """The dots seen with a rig that is too small, and what is made of both."""
    true = trajectory.rig
    shift = np.zeros(30)
    shift[21:24], shift[27:30] = true.t_right_left, true.t_left_world
    small = replace(true.perturbed(-SHORT * shift), covariance=size_sigma**2 * np.outer(shift, shift))
    small = replace(small, allowances=(Allowance(SIZE, size_sigma * shift),) if size_sigma else ())
    centres = trajectory.disc.marker_centres_body.copy()
    centres[:, :2] += misprint * rng.normal(size=(len(centres), 2))
    disc = replace(trajectory.disc, marker_centres_body=centres)  # as declared: others than those that were seen
    seen = dots_of(trajectory)
    return true, refine_as_built(replace(seen, rig=small, disc=disc, t=seen.t * (1 - SHORT)))


def test_regular_dots_correct_a_board_of_unknown_size(trajectory, rng):
    true, found = refined(trajectory, rng, size_sigma=1e-4)
    assert abs(found.size - SHORT) < 4 * found.size_sigma < 1e-4
    assert found.size_share > 0.8
    assert abs(found.rig.baseline / true.baseline - 1) < 4 * found.size_sigma
    left = np.linalg.norm(found.rig.allowances[0].shift[21:24]) / true.baseline
    assert 0.5 * found.size_sigma < left < 1.1 * found.size_sigma  # what is known of both together
    assert np.abs(found.marker_shift).max() < 2e-6


def test_misprinted_dots_or_a_declared_board_leave_the_rig_alone(trajectory, rng):
    true, found = refined(trajectory, rng, size_sigma=1e-5, misprint=30e-6)
    assert found.size_sigma > 1e-4
    assert abs(found.rig.baseline / true.baseline - (1 - SHORT)) < 1e-5
    true, found = refined(trajectory, rng, size_sigma=0.0)
    assert found.size_share == 0.0
    assert abs(found.rig.baseline / true.baseline - (1 - SHORT)) < 1e-9
