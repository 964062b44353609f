"""Poses from dots: derivatives, covariance, one camera, few dots, a wrong dot, the flat disc; scatter beyond."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import least_squares

from disctrack import frames
from disctrack.disc import MA_2014
from disctrack.faults.dots import marker_pixels
from disctrack.synthetic.cameras import rig_of
from disctrack.synthetic.description import Scene
from disctrack.track.pose import DotsInFrames, PoseFits, fit_poses
from disctrack.track.refine.assembly import status_of
from disctrack.track.refine.scatter import scatter_of_poses
from disctrack.trajectory import FrameStatus

SIGMA_PX = 0.01
CENTRES = MA_2014.marker_centres_body


def poses(rng, n):
    q = rng.uniform([0.02, 0.01, 0.003, -3, 0.0, -3], [0.045, 0.03, 0.03, 3, 0.8, 3], (n, 6))
    return q, frames.rotation_from_euler(*q[:, 3:].T), q[:, :3]


@pytest.fixture(scope="module")
def rig():
    return rig_of(Scene())


def filmed(rng, n, rig, sigma=SIGMA_PX):
    """n poses, and the dots as seen in them."""
    _, R, t = poses(rng, n)
    return R, t, *noisy_markers(R, t, rig, rng, sigma)


def noisy_markers(R, t, rig, rng, sigma=SIGMA_PX):
    pixels, _ = marker_pixels(R, t, rig, CENTRES)
    covariance = np.broadcast_to(sigma**2 * np.eye(2), (*pixels.shape, 2)).copy()
    return pixels + sigma * rng.normal(size=pixels.shape), covariance


def fitted(markers, covariance, rig, R, t, **how):
    return fit_poses(DotsInFrames(rig, MA_2014, markers, covariance, R, t), **how)


def near(R, t, rng):
    turn = frames.rotation_from_vector(rng.normal(scale=5e-3, size=(len(R), 3)))
    return turn @ R, t + rng.normal(scale=2e-4, size=t.shape)


def pose_error(fits, R, t):
    turn = frames.vector_from_rotation(fits.R_world_body @ np.swapaxes(R, 1, 2))
    return np.concatenate([fits.t_world_body - t, turn], axis=1)


def chi_square(fits, R, t):
    error = pose_error(fits, R, t)
    return np.einsum("ni,nij,nj->n", error, np.linalg.inv(fits.covariance), error)


def test_jacobian_agrees_with_central_differences(rng, rig):
    _, R, t = poses(rng, 6)
    pixels, J = marker_pixels(R, t, rig, CENTRES)
    assert_allclose(pixels, rig.project(CENTRES @ np.swapaxes(R, 1, 2) + t[:, None]), atol=1e-10)
    assert np.isnan(marker_pixels(R, t + 10 * rig.R_left_world[2] * [-1, -1, -1], rig, CENTRES)[0][:, 0]).all()
    for k, step in enumerate([1e-6] * 3 + [1e-5] * 3):
        v = step * (np.arange(6) == k)
        ahead, _ = marker_pixels(frames.rotation_from_vector(v[3:]) @ R, t + v[:3], rig, CENTRES)
        behind, _ = marker_pixels(frames.rotation_from_vector(-v[3:]) @ R, t - v[:3], rig, CENTRES)
        numeric = (ahead - behind) / (2 * step)
        assert_allclose(numeric, J[..., k], atol=1e-6 * np.abs(J[..., k]).max())


def test_pose_scatter_equals_the_predicted_covariance(rng, rig):
    R, t, markers, covariance = filmed(rng, 500, rig)
    fits = fitted(markers, covariance, rig, *near(R, t, rng), with_sensitivity=False)
    assert fits.converged.all()
    # 500 x 6 degrees of freedom: the mean of chi-square / 6 scatters by sqrt(2 / 3000) = 0.026
    assert abs(chi_square(fits, R, t).mean() / 6 - 1) < 0.1
    assert abs(fits.reduced_chi_square.mean() - 1) < 0.06  # 500 x 18 degrees of freedom, 4 sigma


def test_minimum_is_that_of_scipy(rng, rig):
    R, t, markers, covariance = filmed(rng, 4, rig)
    A = SIGMA_PX * rng.normal(size=covariance.shape)  # each dot has ellipses of its own, one is not seen
    covariance += A @ np.swapaxes(A, -1, -2)
    markers[:, 0, 2] = np.nan
    start = near(R, t, rng)
    fits = fitted(markers, covariance, rig, *start, reject_outliers=False, with_sensitivity=False)
    for i in range(4):

        def residual(v, i=i):
            points = CENTRES @ (frames.rotation_from_vector(v[3:]) @ start[0][i]).T + start[1][i] + v[:3]
            missed = np.linalg.solve(np.linalg.cholesky(covariance[i]), (markers[i] - rig.project(points))[..., None])
            return missed[np.isfinite(missed)]

        reference = least_squares(residual, np.zeros(6), x_scale=[1e-4] * 3 + [1e-3] * 3, xtol=1e-15, ftol=1e-15)
        sigma = np.sqrt(np.diag(fits.covariance[i]))
        assert_allclose(fits.t_world_body[i], start[1][i] + reference.x[:3], atol=2e-3 * sigma[:3].max())
        R_reference = frames.rotation_from_vector(reference.x[3:]) @ start[0][i]
        turn = frames.vector_from_rotation(fits.R_world_body[i] @ R_reference.T)
        assert np.abs(turn).max() < 2e-3 * sigma[3:].max()


def test_a_flat_disc_is_as_well_conditioned_as_any(rng, rig):
    q, _, _ = poses(rng, 40)
    q[:, 4] = 0.0
    R, t = frames.rotation_from_euler(*q[:, 3:].T), q[:, :3]
    markers, covariance = noisy_markers(R, t, rig, rng)
    fits = fitted(markers, covariance, rig, *near(R, t, rng), with_sensitivity=False)
    assert fits.converged.all()
    sigma_rotation = np.sqrt(np.diagonal(fits.covariance, axis1=1, axis2=2))[:, 3:]
    assert sigma_rotation.max() < np.radians(5e-3)


def test_one_camera_still_gives_a_pose_with_a_larger_sigma(rng, rig):
    R, t, markers, covariance = filmed(rng, 60, rig)
    both = fitted(markers, covariance, rig, R, t)
    markers[:, 1] = np.nan
    one = fitted(markers, covariance, rig, R, t)
    assert one.converged.all()
    assert np.all(np.linalg.det(one.covariance) > np.linalg.det(both.covariance))
    assert 0.7 < np.median(chi_square(one, R, t)) / 5.35 < 1.3  # median of chi-square with 6 degrees of freedom


def test_three_dot_images_are_the_least_and_two_or_dots_at_one_place_give_nothing(rng, rig):
    R, t, markers, covariance = filmed(rng, 3, rig, 1e-4)
    markers[:, 1], markers[0, 0, 3:], markers[1, 0, 2:], markers[2, 0] = np.nan, np.nan, np.nan, markers[2, 0, 0]
    seen = DotsInFrames(rig, MA_2014, markers, covariance, R, t)
    fits = fit_poses(seen)
    assert fits.converged.tolist() == [True, False, False]
    assert np.isnan(fits.t_world_body[1:]).all()
    assert fits.degrees_of_freedom.tolist() == [0, 0, 0]
    expected = [FrameStatus.ONE_CAMERA, FrameStatus.MARKERS_NOT_FOUND, FrameStatus.NOT_CONVERGED]
    assert status_of(np.zeros(3, np.uint8), seen, fits).tolist() == expected


@pytest.mark.parametrize("wrong_px", [0.3, 40.0])
def test_a_wrong_dot_is_struck_and_named(rng, rig, wrong_px):
    R, t, markers, covariance = filmed(rng, 50, rig)
    markers[::2, 0, 2, 0] += wrong_px
    fits = fitted(markers, covariance, rig, *near(R, t, rng))
    assert not fits.used[::2, 0, 2].any()
    assert fits.used.sum() == fits.used.size - 25  # no good dot with it
    assert chi_square(fits, R, t).mean() / 6 < 1.4
    assert_allclose(np.abs(fits.residuals_px[::2, 0, 2, 0]), wrong_px, atol=0.2)  # still reported


def test_sensitivity_tells_where_the_pose_goes_when_the_rig_changes(rng, rig):
    R, t, markers, covariance = filmed(rng, 5, rig)
    fits = fitted(markers, covariance, rig, R, t)
    scale = np.array([1.0, 1, 1, 1, 1e-3, 1e-2, 1e-4, 1e-4, 0.1] * 2 + ([1e-4] * 3 + [1e-5] * 3) * 2)
    for k in range(30):
        delta = 0.1 * scale * (np.arange(30) == k)
        ahead, behind = (
            fitted(markers, covariance, rig.perturbed(way * delta), R, t, with_sensitivity=False) for way in (1, -1)
        )
        change = pose_error(ahead, behind.R_world_body, behind.t_world_body)
        predicted = 2 * fits.sensitivity[:, :, k] * delta[k]
        # the noise leaves residuals that second derivatives multiply: 0.01 px against a field of 500 px
        assert_allclose(change, predicted, atol=0.01 * np.abs(predicted).max() + 1e-9)


def test_a_frame_without_a_start_is_nan_and_the_others_are_not(rng, rig):
    R, t, markers, covariance = filmed(rng, 3, rig)
    t_start = t.copy()
    t_start[1] = np.nan
    fits = fitted(markers, covariance, rig, R, t_start)
    assert np.isfinite(fits.t_world_body).all(1).tolist() == [True, False, True]
    nothing = fitted(markers, covariance, rig, R, np.full_like(t, np.nan))
    assert not nothing.converged.any()


def test_exchanged_cameras_are_noticed(rng, rig):
    """Negative control: the residuals of a wrong assignment are nowhere near the noise."""
    R, t, markers, covariance = filmed(rng, 5, rig)
    fits = fitted(markers[:, ::-1], covariance, rig, R, t, reject_outliers=False)
    reduced = np.where(fits.converged, fits.reduced_chi_square, np.inf)
    assert np.all(reduced > 1e3)


def test_a_pose_does_not_depend_on_which_frames_are_fitted_with_it(rng, rig):
    """Some with a dot that was struck, by unlike amounts, so that every round of rejection has another company."""
    R, t, pixels, covariance = filmed(rng, 60, rig)
    struck = rng.choice(60, 25, replace=False)
    pixels[struck, rng.integers(0, 2, 25), rng.integers(0, 6, 25)] += rng.uniform(0.1, 40.0, (25, 1))
    twice = struck[:8]
    pixels[twice, 1, rng.integers(0, 6, 8)] -= rng.uniform(1.0, 9.0, (8, 1))
    R_start, t_start = near(R, t, rng)

    def of(rows):
        return fitted(pixels[rows], covariance[rows], rig, R_start[rows], t_start[rows])

    together = of(np.arange(60))
    assert (together.used.sum((1, 2)) < 12).sum() >= 20  # the struck ones were felt
    for rows in (np.arange(10, 34), np.sort(struck), *np.arange(0, 60, 7)[:, None]):
        alone = of(rows)
        np.testing.assert_array_equal(alone.used, together.used[rows])
        # round-off of a position of 0.05 m; a median over the company moved poses by 3.7 um
        assert_allclose(alone.t_world_body, together.t_world_body[rows], rtol=0, atol=1e-12)
        assert_allclose(alone.R_world_body, together.R_world_body[rows], rtol=0, atol=1e-11)


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
