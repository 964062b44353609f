"""A camera that was moved while the views were taken: found, named, sized, and kept out of how the cameras stand."""

import re

import numpy as np
import pytest
from numpy.testing import assert_allclose

from calibration import calibrate_from_corners
from tests.calibration.conftest import corner_view, squared
from tests.calibration.test_board_motion import BOARD, SETTINGS, errors
from tests.oracles import moved_boards

TURN = np.radians([0.05, -0.04, 0.03])  # 0.07 deg: 1.1 px, as when somebody touches a camera
SHIFT = np.array([1e-4, 0.0, 0.0])


def calibrated(parts, table_view=None, noise=0.1, **motion):
    """parts : (rig, number of pairs) in the order in which the views are taken."""
    taken = [moved_boards.pairs(rig, n, 10 + k, noise=noise, **motion) for k, (rig, n) in enumerate(parts)]
    left, right = (np.concatenate(side) for side in zip(*taken, strict=True))
    views = ([corner_view(p, noise) for p in side] for side in (left, right))
    return calibrate_from_corners(*views, BOARD, SETTINGS, table_view)


def pair_error(found, rig):
    """Squared error of how the cameras stand over its variance, per number."""
    error, C = errors(found, rig)
    return squared(error[-6:], C[-6:, -6:])


def told(found):
    return [text for text in found.warnings if "camera was moved" in text]


@pytest.fixture(scope="module")
def rig():
    return moved_boards.make_rig(3)


@pytest.mark.statistical
def test_a_camera_touched_between_the_views_is_named_and_sized(rig):
    later = moved_boards.turned(rig, TURN, SHIFT)
    found = calibrated([(rig, 12), (later, 7)])
    (text,) = told(found)
    assert "from left 12 and right 12 on" in text
    (step,) = [float(size) for size in re.findall(r"by ([0-9.]+) deg", text)]
    assert_allclose(step, np.degrees(np.linalg.norm(TURN)), atol=0.02)  # by medians of pairs that scatter by 0.03
    assert found.apart == tuple(range(12, 19))
    assert not any("not synchronised" in other for other in found.warnings)
    assert pair_error(found, rig) < 3.0  # chi-square of six over six, at three sigma
    # negative control: the other stretch is as far off as the camera was turned
    assert pair_error(found, later) > 5.0


@pytest.mark.statistical
def test_the_cameras_stand_as_they_did_at_the_view_on_the_table(rig):
    later = moved_boards.turned(rig, TURN, SHIFT)
    found = calibrated([(rig, 12), (later, 7)], table_view=14)
    assert "those with the view on the table" in told(found)[0]
    assert found.apart == tuple(range(12))
    assert pair_error(found, later) < 3.0


@pytest.mark.statistical
def test_a_camera_pushed_by_degrees_in_pairs_that_were_not_synchronised(rig):
    later = moved_boards.turned(rig, np.radians([4.0, -1.0, 0.0]), np.array([0.02, 0.0, 0.0]))
    found = calibrated([(rig, 14), (later, 9)], shift=2e-3, turn=2e-3)
    assert found.apart == tuple(range(14, 23))
    assert "by 4 deg" in told(found)[0] or "by 4.1 deg" in told(found)[0]
    assert any("not synchronised" in text for text in found.warnings)
    assert pair_error(found, rig) < 3.0


@pytest.mark.statistical
def test_a_camera_that_was_moved_twice_leaves_three_stretches(rig):
    later = moved_boards.turned(rig, TURN, SHIFT)
    found = calibrated([(rig, 8), (later, 6), (moved_boards.turned(later, 10 * TURN[::-1], SHIFT), 5)])
    assert found.apart == tuple(range(8, 19))
    assert told(found)[0].count(" on the cameras stand otherwise") == 2


@pytest.mark.statistical
@pytest.mark.parametrize("motion", [{}, {"shift": 1e-3, "turn": 1e-3}, {"correlation": 0.6}])
def test_cameras_that_stood_still_are_not_said_to_have_moved(motion):
    for seed in range(4):
        found = calibrated([(moved_boards.make_rig(seed), 16)], **motion)
        assert not told(found)
        assert not found.apart
