"""The table from a rolling disc, in recordings whose table is not where the board says."""

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from calibration.cameras.camera import N_RIG
from disctrack.diagnosis.stage import diagnose
from disctrack.faults.keys import Faults
from disctrack.frames import euler_from_rotation, quaternion_from_rotation, unwrap_euler
from disctrack.track.judge.doubts import off_the_table
from disctrack.track.refine import table_contact
from disctrack.track.refine.assembly import fit_all
from disctrack.track.refine.self_calibration import motions_of_pattern
from disctrack.track.refine.table_contact import off_centre, table_from_disc
from tests.oracles.measured_disc import assert_found, dots_of, measured

TURN, HEIGHT = (6e-4, -4e-4), 60e-6


@pytest.fixture(scope="module")
def leaning():
    return measured(faults=Faults(table_turn_deg=tuple(np.degrees(TURN)), table_height_mm=1e3 * HEIGHT), n=200)


def poses_of(trajectory, lift=0.0):
    fits = fit_all(dots_of(trajectory))
    lifted = fits.t_world_body + np.multiply.outer(lift, [0.0, 0.0, 1.0])
    return replace(fits, t_world_body=lifted), np.zeros((len(trajectory), 6, 6))


def heights(fits, disc):
    theta = np.arccos(fits.R_world_body[:, 2, 2])
    return fits.t_world_body[:, 2] - disc.radius * np.sin(theta) - disc.half_thickness * np.cos(theta)


def test_table_is_found_where_the_rim_rolls(leaning):
    fits, _, rig, table = table_from_disc(*poses_of(leaning), leaning.rig, leaning.disc, "disc")
    a, b = -TURN[1], TURN[0]  # z of the true table over x and y, seen from the believed axes
    sigma = np.hypot(table.sigma, table.board_sigma)
    assert np.all(np.abs(table.plane - [HEIGHT + np.dot([a, b], table.middle), a, b]) < 4 * sigma)
    assert sigma[0] < 3e-6
    assert sigma[1:].max() < np.radians(5e-3)
    # what is left is the noise of single frames
    theta = np.arccos(fits.R_world_body[:, 2, 2])
    e1 = np.cross(leaning.disc.radius * np.array([0.0, 0.0, 1.0]), fits.R_world_body[:, :, 2]) / np.sin(theta)[:, None]
    J = np.column_stack([np.tile([0.0, 0.0, 1.0], (len(e1), 1)), -e1 * np.cos(theta)[:, None]])
    noise = np.sqrt(np.einsum("ni,nij,nj->n", J, fits.covariance, J))
    assert abs(np.median(heights(fits, leaning.disc) / noise)) < 4 * 1.25 / np.sqrt(len(noise))
    assert_allclose(np.std(heights(fits, leaning.disc) / noise), 1.0, atol=4 / np.sqrt(2 * len(noise)))
    # poses, moved, and rig, moved, still tell of the same pixels
    points = leaning.disc.marker_centres_body @ np.swapaxes(fits.R_world_body, 1, 2) + fits.t_world_body[:, None]
    seen = np.moveaxis(rig.project(points), -3, 1)
    assert_allclose(seen, leaning.markers_px - fits.residuals_px, atol=1e-6)


def test_board_and_disc_count_as_their_sigmas_say(leaning):
    given = leaning.rig, leaning.disc
    told = {source: table_from_disc(*poses_of(leaning), *given, source)[3] for source in ("board", "both")}
    assert_allclose(told["board"].applied, 0.0, atol=0)
    assert_allclose(told["both"].applied, told["both"].plane, rtol=0.1)  # it differs by more than a board may
    assert told["both"].probability < 1e-2
    assert told["board"].beyond == (0.0, 0.0, 0.0)
    height, *slopes = told["both"].beyond
    assert 0.9 * HEIGHT < height < 1.5 * HEIGHT  # with what the slopes are worth at the origin
    assert_allclose(slopes, np.abs(told["both"].applied[1:]), rtol=0.1)
    sure = replace(leaning.disc, thickness_tolerance=1e-3)  # a disc that nobody measured: the board tells
    assert abs(table_from_disc(*poses_of(leaning), leaning.rig, sure)[3].applied[0]) < 0.1 * HEIGHT


def test_true_table_is_left_where_it_is():
    trajectory = measured(n=200)
    table = table_from_disc(*poses_of(trajectory), trajectory.rig, trajectory.disc)[3]
    assert table.probability > 1e-3
    assert table.beyond == (0.0, 0.0, 0.0)
    assert np.all(np.abs(table.plane) < 4 * np.hypot(table.sigma, table.board_sigma))


@pytest.mark.parametrize("way", [(1.0, 0.0), (0.0, -1.0), (-0.6, 0.8)])
def test_a_pattern_off_the_centre_leans_the_rims_table_within_its_sigma(way):
    """Dots placed by a ruler: the centre is 40 um off, and as phi follows -psi the rim seems to roll on a slope."""
    off = 40e-6
    trajectory = measured(n=200)
    fits, none = poses_of(trajectory)
    shifted = replace(fits, t_world_body=fits.t_world_body + off * fits.R_world_body[:, :, :2] @ np.array(way))
    ways = off * motions_of_pattern(fits.R_world_body, trajectory.disc)[:, :, :2]

    def pull(by_pattern):
        table = table_from_disc(
            deepcopy(shifted), none.copy(), trajectory.rig, trajectory.disc, "disc", by_pattern=by_pattern
        )[3]
        return np.abs(table.plane[1:]) / np.hypot(table.sigma, table.board_sigma)[1:]

    assert pull(None).max() > 6.0  # negative control: as if the dots' middle were the disc's
    assert pull(ways).max() < 2.0


def test_told_is_from_where_on_a_pattern_off_the_centre_shows():
    trajectory, least, doubted = measured(n=200), 0.0, []
    fits, none = poses_of(trajectory)
    for share in (0.0, 0.3, 2.0):
        off = share * least
        shifted = replace(deepcopy(fits), t_world_body=fits.t_world_body + off * fits.R_world_body[:, :, 0])
        table = table_from_disc(shifted, none.copy(), trajectory.rig, trajectory.disc)[3]
        least = table.details(trajectory.q[:, 4], trajectory.disc)["least_off_centre"]
        doubted.append(off_centre(table, trajectory.q[:, 4], trajectory.disc) > 0.3 * off)
    assert doubted == [False, False, True]


@pytest.mark.slow
def test_hollow_that_was_taken_for_a_slope_is_found_alone():
    """Where the disc rolls, a radius of 4 m is a slope: tracking turns the world by it, and the diagnosis back."""
    trajectory = measured({"table_curved.kappa": 0.25}, n=220)
    fits, _, rig, table = table_from_disc(*poses_of(trajectory), trajectory.rig, trajectory.disc)
    assert np.hypot(*table.applied[1:]) > 2e-3
    q = np.column_stack([fits.t_world_body, unwrap_euler(euler_from_rotation(fits.R_world_body))])
    levelled = replace(trajectory, q=q, quaternion=quaternion_from_rotation(fits.R_world_body), rig=rig)
    result = diagnose(replace(levelled, table_moved=table.beyond))
    assert_found(result, {"table_curved.kappa": 0.25}, 3)
    # as if the sigmas of board and disc held for the hollow, too
    assert [f.candidate.name for f in diagnose(levelled).diagnosis.found] != ["table_curved"]


def test_derivative_by_the_rig_agrees_with_differences(leaning):
    """A rig that is off by a little moves the plane by as much as the gain counts with."""
    fits, none = poses_of(leaning)
    plane, _, by_rig, *_ = table_contact._contacts(fits, none, leaning.disc, none[..., :0])
    step = np.zeros(N_RIG)
    step[[2, 12, 18, 22, 25, 29]] = [0.3, -0.2, 1e-4, 1e-5, 2e-4, 3e-5]
    off = replace(leaning, rig=leaning.rig.perturbed(step))
    other, *_ = table_contact._contacts(poses_of(off)[0], none, off.disc, none[..., :0])
    # the estimated rig is ahead of the true one by the step
    assert_allclose(other - plane, -by_rig @ step, rtol=0.02, atol=2e-7)


def test_disc_in_the_air_few_frames_or_a_world_without_table_tell_of_none(leaning):
    time = np.linspace(0, 1, len(leaning))
    (fits, none), (flying, _) = poses_of(leaning), poses_of(leaning, lift=2e-3 * time * (1 - time))
    lost = replace(fits, converged=np.arange(len(leaning)) < 19)
    elsewhere = replace(leaning.rig, world_is_table=False)
    for poses, rig in ((flying, leaning.rig), (lost, leaning.rig), (fits, elsewhere)):
        assert table_from_disc(poses, none, rig, leaning.disc)[3] is None


def test_scatter_about_the_table_is_told_where_noise_does_not_explain_it():
    """A noisy recording's lowest point scatters by 40 um as stated: no thickness is to be suspected for that."""
    trajectory, sigma = measured(n=200), 40e-6
    trajectory.q[:, 2] += sigma * np.random.default_rng(1).normal(size=len(trajectory))
    assert off_the_table(trajectory)  # poses are stated as sure as before
    trajectory.pose_covariance[:, 2, 2] += sigma**2
    assert not off_the_table(trajectory)
    trajectory.q[:, 2] += 3e-5
    assert off_the_table(trajectory)[0].numbers["height"].value > 0  # that all frames share
