"""What all frames share apart from the scatter of the dots: cameras, printed dots, clock, the size of the board."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from calibration.cameras.camera import Allowance
from calibration.judge.tolerances import SIZE
from disctrack.disc import MA_2014
from disctrack.faults.keys import CameraFault, Faults
from disctrack.frames import rotation_from_euler, rotation_from_vector, vector_from_rotation
from disctrack.track.refine import self_calibration
from disctrack.track.refine.assembly import fit_all
from disctrack.track.refine.scatter import split_scatter, without_shared_faults
from disctrack.trajectory import FrameStatus
from disctrack.validate.points import SIGMA_PX
from tests.oracles.measured_disc import dots_of, measured
from tests.oracles.point_laboratory import DOT_PX, tracked

N = 160
# relative scatter of chi-square with 18 degrees of freedom in N frames: sqrt(2 / 18 / N) = 2.6 %; four of these
TOLERANCE = 0.105


def judged(trajectory):
    return without_shared_faults(dots_of(trajectory))


@pytest.mark.parametrize(
    "faults",
    [
        Faults(),
        Faults(right_delay_s=2.5e-4),
        Faults(right=CameraFault(rotation_deg=(0.02, -0.01, 0.015), translation_mm=(0.1, 0.0, -0.1))),
        Faults(left=CameraFault(focal_scale=1.004, k1_change=0.01)),
    ],
    ids=["none", "delay", "moved", "lens"],
)
def test_faulty_cameras_do_not_count_as_noise_and_move_no_dot(faults):
    trajectory = measured(faults=faults, n=N)
    loud = np.nanmedian(trajectory.reduced_chi_square)
    found = judged(trajectory)
    assert abs(found.reduced_chi_square - 1) < TOLERANCE
    assert loud > 5 or faults == Faults()
    assert np.abs(found.marker_shift[:, :2]).max() < 5 * found.marker_shift_sigma.max()


def test_noise_of_the_dots_themselves_remains(rng):
    trajectory = measured(n=N)
    doubled = trajectory.markers_px + np.sqrt(3) * 0.006 * rng.standard_normal(trajectory.markers_px.shape)
    assert_allclose(judged(replace(trajectory, markers_px=doubled)).reduced_chi_square, 4.0, rtol=TOLERANCE)


def test_what_repeats_is_not_noise_and_noise_does_not_repeat(rng):
    """A smooth field in the image is told apart from white noise; both sizes are known here."""
    trajectory = measured(n=N)
    field = 0.02 * np.sqrt(2) * np.sin(trajectory.markers_px[..., ::-1] * 2 * np.pi / 300 + [0.3, 1.1])
    white = SIGMA_PX * rng.standard_normal(trajectory.markers_px.shape)

    def split(markers):
        seen = dots_of(replace(trajectory, markers_px=markers))
        return split_scatter(fit_all(seen), seen.covariance, None)

    # second differences of triples that overlap tell half as much as independent frames
    smooth = split(trajectory.markers_px + field)
    assert_allclose(smooth.noise, 1.0, atol=2 * TOLERANCE)
    assert_allclose(smooth.systematic_px, 0.02, rtol=0.35)  # a few places of the image stand for the whole
    rough = split(trajectory.markers_px + white)
    assert_allclose(rough.noise, 2.0, rtol=2 * TOLERANCE)
    assert rough.systematic_px == (0.0, 0.0)


def test_too_few_frames_give_no_judgement():
    assert judged(measured(n=15)) is None


@pytest.mark.parametrize("m", [4, 6, 12])
def test_the_place_of_a_pattern_is_as_uncertain_as_its_dots_are_misplaced(m, rng):
    """Dots off at random: by how much the gauge then misses the pattern's place, over the variance stated for it."""
    angle = 2 * np.pi * np.arange(m) / m
    radius = 0.02 + 0.006 * (np.arange(m) % 3)
    centres = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle])
    disc = replace(MA_2014, marker_centres_body=centres)
    off = disc.marker_centres_body[:, :2] - disc.marker_centres_body[:, :2].mean(axis=0)
    ratios = []
    for _ in range(400):
        shift = 3e-5 * rng.normal(size=(m, 2))
        kept = self_calibration.declared_places_kept(disc, shift)
        moved = shift - kept[:, :2]
        turn = float(np.sum(off[:, 0] * moved[:, 1] - off[:, 1] * moved[:, 0]) / np.sum(off**2))
        place_variance, turn_variance = self_calibration.pattern_place(disc, kept, np.full((m, 2), 6e-7))
        ratios.append([*(moved.mean(axis=0) ** 2 / place_variance), turn**2 / turn_variance])
    trimmed = np.sort(ratios, axis=0)[:-4]  # few dots may agree by chance: of 400 the four worst
    assert np.all((trimmed.mean(axis=0) > 0.5) & (trimmed.mean(axis=0) < 1.5)), trimmed.mean(axis=0)


def test_dots_as_declared_and_one_that_is_not_leave_the_pattern_where_it_is(rng):
    sigma = np.full((6, 2), 6e-7)
    within = np.column_stack([0.5 * sigma * rng.normal(size=(6, 2)), np.zeros(6)])
    assert self_calibration.pattern_place(MA_2014, within, sigma) == (0, 0)
    one = np.zeros((6, 3))
    one[2, 0] = 1e-3
    assert self_calibration.pattern_place(MA_2014, one, sigma) == (0, 0)


def test_poses_move_with_the_pattern():
    """Against poses that explain dots which were displaced and turned together about their middle."""
    disc, R = MA_2014, rotation_from_euler(0.3, 0.4, 1.1)
    displaced, turn = np.array([2e-5, -1e-5]), 3e-4
    middle = disc.marker_centres_body.mean(axis=0)
    R_found = R @ rotation_from_vector(np.array([0, 0, turn]))
    t_found = R @ (middle + np.array([*displaced, 0])) - R_found @ middle
    expected = self_calibration.motions_of_pattern(R[None], disc)[0] @ [*displaced, turn]
    np.testing.assert_allclose(t_found, expected[:3], atol=1e-8)
    np.testing.assert_allclose(vector_from_rotation(R_found @ R.T), expected[3:], atol=1e-7)
    # and no dot is said to have moved in it
    turned = turn * np.column_stack([-disc.marker_centres_body[:, 1], disc.marker_centres_body[:, 0]]) + displaced
    assert_allclose(self_calibration.declared_places_kept(disc, turned), 0.0, atol=2e-9)


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
    return true, self_calibration.refine_as_built(replace(seen, rig=small, disc=disc, t=seen.t * (1 - SHORT)))


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


@pytest.mark.parametrize("frame_rate", [1000.0, 400.0])
def test_ends_of_a_slow_recording_are_measured_and_an_exchange_there_is_refused(frame_rate):
    """At 400 pairs/s a quadratic through three frames misses the next by 11 times its noise, and no other is there."""
    trajectory = measured(n=80, declared_rate=frame_rate, sigma_px=DOT_PX)
    seen = dots_of(trajectory)
    px, R, t = seen.pixels, seen.R, seen.t
    px[40, 0, 0] = np.nan  # one dot hidden
    found = tracked(px, R, t, trajectory.time, seen.rig, frame_rate).trajectory
    assert np.all(found.frame_status == FrameStatus.MEASURED)
    px[[1, 3]], R[[1, 3]], t[[1, 3]] = px[[3, 1]], R[[3, 1]], t[[3, 1]]
    found = tracked(px, R, t, trajectory.time, seen.rig, frame_rate).trajectory
    assert found.frame_status[1] == found.frame_status[3] == FrameStatus.JUMPED
    assert np.all(found.frame_status[6:] == FrameStatus.MEASURED)


def test_dots_are_moved_by_the_share_of_their_displacement_that_is_no_noise(rng):
    sigma = np.full((6, 2), 0.5e-6)
    pattern = rng.normal(size=(6, 2))
    sizes = np.geomspace(1e-8, 1e-4, 400)
    shares = np.array([self_calibration.share_of_places(MA_2014, size * pattern, sigma) for size in sizes])
    assert np.all(np.diff(shares) >= 0)
    assert np.diff(shares).max() < 0.05  # 2.3 % more displacement never tips anything
    assert shares[0] == 0.0
    assert shares[-1] > 0.9999
    moved = 1e-3 + 0.02 * (MA_2014.marker_centres_body[:, :2] @ [[0, 1], [-1, 0]])  # the pattern as a whole
    assert self_calibration.share_of_places(MA_2014, moved, sigma) == 0.0
