"""Pairs that both cameras lost are told from the motion, with number and place; nothing else is taken for them."""

from dataclasses import fields, replace

import numpy as np
import pytest

from disctrack.diagnosis import diagnose
from disctrack.faults.clock_jump import clock_jumps, without_jumps
from tests.oracles.measured_disc import measured

FRAME = 50


def without(trajectory, lost):
    """The recording in which these frames were lost, and the files numbered on."""
    kept = np.setdiff1d(np.arange(len(trajectory)), lost)
    series = {f.name: getattr(trajectory, f.name) for f in fields(trajectory)}
    series = {k: v[kept] for k, v in series.items() if isinstance(v, np.ndarray) and len(v) == len(trajectory)}
    return replace(trajectory, **series | {"frame": np.arange(len(kept)), "time": trajectory.time[: len(kept)]})


@pytest.fixture(scope="module", params=[(14.0, 0.5), (2.0, 0.1)], ids=["steep", "flat"])
def rolling(request):
    theta, nutation = request.param
    return measured(seed=3, n=120, theta_deg=theta, nutation_deg=nutation)


@pytest.mark.parametrize("k", [1, 2, 3, 10])
def test_lost_pairs_are_counted_and_their_place_is_told(rolling, k):
    assert clock_jumps(without(rolling, range(FRAME, FRAME + k))) == {FRAME: k}


def test_two_losses_are_two_and_the_right_times_come_back(rolling):
    faulty = without(rolling, [30, 71, 72])
    jumps = clock_jumps(faulty)
    assert jumps == {30: 1, 70: 2}
    mended = without_jumps(faulty, jumps)
    np.testing.assert_allclose(mended.time, np.delete(rolling.time, [30, 71, 72]))
    assert not clock_jumps(mended)  # uneven times need no number


def test_what_is_no_loss_is_not_taken_for_one(rolling):
    """The motion itself; a camera that moved by 0.1 mm; a blow, which changes the velocity."""
    later = np.arange(len(rolling)) >= FRAME
    moved, struck = rolling.q.copy(), rolling.q.copy()
    moved[later, 0] += 1e-4
    struck[later, :2] += 1e-3 * (rolling.time[later] - rolling.time[FRAME])[:, None] * 300
    for q in (rolling.q, moved, struck):
        assert not clock_jumps(replace(rolling, q=q))


def test_frames_without_a_pose_at_the_loss_do_not_hide_it(rolling):
    faulty = without(rolling, [FRAME, FRAME + 1])
    faulty.q[FRAME - 1 : FRAME + 1] = np.nan
    assert clock_jumps(faulty) == {FRAME + 1: 2}


@pytest.mark.statistical
def test_a_diagnosis_counts_the_lost_pairs_before_it_looks_for_a_law():
    result = diagnose(without(measured(seed=3, n=300), [100, 101]))
    assert "frame 100: the clock jumps by 2 frames" in result.notes[0]
    assert result.diagnosis.verdict == "nothing missing"
