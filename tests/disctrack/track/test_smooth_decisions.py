"""Decisions that must not tip: poses vary as little as their data do, and ends of a recording are no fault."""

import numpy as np
import pytest

from disctrack.disc import MA_2014
from disctrack.track.refine.self_calibration import share_of_places
from disctrack.trajectory import FrameStatus
from tests.oracles.measured_disc import dots_of, measured
from tests.oracles.point_laboratory import DOT_PX, tracked


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
    shares = np.array([share_of_places(MA_2014, size * pattern, sigma) for size in np.geomspace(1e-8, 1e-4, 400)])
    assert np.all(np.diff(shares) >= 0)
    assert np.diff(shares).max() < 0.05  # 2.3 % more displacement never tips anything
    assert shares[0] == 0.0
    assert shares[-1] > 0.9999
    moved = 1e-3 + 0.02 * (MA_2014.marker_centres_body[:, :2] @ [[0, 1], [-1, 0]])  # the pattern as a whole
    assert share_of_places(MA_2014, moved, sigma) == 0.0
