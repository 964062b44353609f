"""Poses that scatter beside what their dots tell: seen in their motion, and in nothing else."""

import numpy as np
import pytest

from disctrack import frames
from disctrack.track.pose import PoseFits
from disctrack.track.refine.pose_scatter import scatter_of_poses

SIGMA = np.array([1e-6, 2e-6, 2e-6, 4e-5, 4e-5, 3e-5])  # [m, rad] that dots tell


def rolling(rng, n=400, psidot=0.08, tilt=0.2, shake=0.0):
    """Poses of a disc that precesses by psidot [rad] a frame and nods, with the noise that is stated.

    shake : sigma of a noise of x, y and of the tilt's axes beside it, in SIGMA
    """
    i = np.arange(n)
    psi = psidot * i + 0.05 * np.sin(0.9 * psidot * i)
    theta = tilt * (1 - 1e-3 * i + 0.1 * np.sin(1.7 * psidot * i))
    t = np.column_stack([4e-3 * np.sin(psi), -4e-3 * np.cos(psi), 37.5e-3 * np.sin(theta)])
    noise = rng.normal(size=(n, 6)) * SIGMA
    noise[:, [0, 1, 3, 4]] += shake * rng.normal(size=(n, 4)) * SIGMA[[0, 1, 3, 4]]
    R = frames.rotation_from_vector(noise[:, 3:]) @ frames.rotation_from_euler(psi, theta, -0.97 * psi)
    empty = np.zeros((n, 2, 6))
    covariance = np.broadcast_to(np.diag(SIGMA**2), (n, 6, 6)).copy()
    return PoseFits(R, t + noise[:, :3], covariance, empty, empty, empty > 0, i, i, np.ones(n, bool))


def test_noise_as_stated_is_left_as_stated():
    told = np.array([scatter_of_poses(rolling(np.random.default_rng(seed)))[0] for seed in range(40)])
    # forty means of 400 frames: sigma 0.11 each for pairs of components, 0.15 for single ones
    np.testing.assert_allclose(told.mean(axis=0), 1.0, atol=0.08)
    scatter = told.std(axis=0) / scatter_of_poses(rolling(np.random.default_rng(99)))[1]
    assert (scatter > 0.7).all()
    assert (scatter < 1.35).all()


def test_poses_that_tremble_state_it_and_no_others():
    factors = np.array([scatter_of_poses(rolling(np.random.default_rng(s), shake=2.0))[2] for s in range(20)])
    np.testing.assert_allclose(factors[:, [0, 1, 3, 4]].mean(axis=0), 5.0, rtol=0.1)  # 1 + 2^2
    assert np.median(factors[:, [2, 5]]) == 1.0
    assert factors[:, [2, 5]].max() < 1.6


@pytest.mark.parametrize("motion", [{"psidot": 0.35}, {"tilt": 1e-5}])
def test_a_motion_too_fast_or_too_flat_to_tell_tells_nothing(motion):
    """Negative control: sixth differences of the fast one are all motion, which must not be taken for noise."""
    told, _, factor = scatter_of_poses(rolling(np.random.default_rng(1), shake=2.0, **motion))
    assert np.isnan(told).all()
    assert (factor == 1.0).all()


def test_unrelated_poses_tell_nothing():
    fits = rolling(np.random.default_rng(1))
    order = np.random.default_rng(2).permutation(len(fits.t_world_body))
    fits.R_world_body[:], fits.t_world_body[:] = fits.R_world_body[order], fits.t_world_body[order]
    assert (scatter_of_poses(fits)[2] == 1.0).all()


def test_single_blows_are_no_noise():
    fits = rolling(np.random.default_rng(3))
    for frame in (100, 250):  # [m] per frame: 0.03 m/s at 1000 Hz
        fits.t_world_body[frame:, 0] += 3e-5 * np.arange(len(fits.t_world_body) - frame)
    assert scatter_of_poses(fits)[2].max() < 1.3
