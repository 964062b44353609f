"""Time stamps are used where they can be meant, and tell, with frame numbers, where two cameras do not run together."""

from types import SimpleNamespace

import numpy as np
import pytest

from disctrack.recording.readers.time_stamps import check_time_stamps, usable_times

RATE, N = 1000.0, 400
EVEN = 17.25 + np.arange(N) / RATE


def warnings_of(left, right=EVEN) -> tuple[str, ...]:
    doubts, warnings = check_time_stamps(
        *(SimpleNamespace(timestamps=stamps, header=None) for stamps in (left, right)), RATE
    )
    return (*warnings, *doubts)


def without(times: np.ndarray, *lost: int) -> np.ndarray:
    """Times of a camera that lost these frames; as many frames as before."""
    return np.delete(17.25 + np.arange(N + len(lost)) / RATE, lost)


def test_cameras_that_run_together_are_not_warned_of(rng):
    jitter = rng.normal(scale=5e-7, size=N)  # a twentieth of what counts
    assert warnings_of(EVEN, EVEN + jitter) == ()
    assert warnings_of(None) == ()
    assert usable_times(SimpleNamespace(timestamps=EVEN), RATE) is EVEN


@pytest.mark.parametrize(
    ("times", "reason"),
    [
        (1e3 * EVEN, "give 1 frames/s, frame_rate_hz of 1000"),
        (np.where(np.arange(N) == 31, np.nan, EVEN), "frame 31 is not a number"),
        (np.where(np.arange(N) == 31, EVEN[30], EVEN), "do not increase from frame 30 to 31"),
        (EVEN * 1.02, "give 980.392 frames/s"),
    ],
)
def test_stamps_that_cannot_be_meant_are_not_used_and_why_is_said(times, reason):
    (warning,) = warnings_of(times)
    assert "left camera: time stamps are not used" in warning
    assert reason in warning
    assert usable_times(SimpleNamespace(timestamps=times), RATE) is None


def test_frames_lost_by_both_cameras_together_are_counted_and_numbered():
    both = without(EVEN, 101, 102, 300)
    left, right = warnings_of(both, both)
    assert left == "left camera: by its time stamps 3 frames missing, after frame 100, 297"
    assert right.startswith("right camera")


def test_a_frame_lost_by_one_camera_alone_parts_the_pairs_from_there_on():
    lost, parted = warnings_of(EVEN, without(EVEN, 101))
    assert "right camera: by its time stamps 1 frame missing, after frame 100" in lost
    assert "does not show the same instant from frame 101 on" in parted
    *_, parted = warnings_of(without(EVEN, 200), without(EVEN, 101))
    assert "from frame 101 on" in parted
    assert "at frame 101, 200)" in parted


@pytest.mark.parametrize("offset", [2.5e-4, -0.3])
def test_a_constant_offset_is_measured(offset):
    (warning,) = warnings_of(EVEN, EVEN + offset)
    assert f"{1e6 * offset:.4g} µs after" in warning


def test_clocks_of_their_own_are_told_by_their_drift_and_jitter_by_its_worst_frame():
    (drift,) = warnings_of(EVEN, EVEN[0] + (EVEN - EVEN[0]) * (1 + 4e-5) - 8e-6)
    assert "drift apart by +40 µs per second" in drift
    (jitter,) = warnings_of(EVEN, EVEN + np.where(np.arange(N) == 222, 1e-4, 0))
    assert "most at frame 222: +99" in jitter
