"""Which frames of a recording belong to one motion of the disc on its own, and what the others are."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.kit.arrays import Array, Mask
from disctrack.errors import AnalysisError
from disctrack.frames import rotation_from_euler, vector_from_rotation
from disctrack.trajectory import Trajectory

Rows = NDArray[np.int64]

MIN_THETA = np.radians(0.7)  # below, the disc of Ma et al. touches its paper, and leaves the model
MIN_FRAMES = 40
AT_REST = 0.3  # [rad/s] a disc that rolls turns at 3 rad/s or more; one that is let go does so after 10 ms
REST_SIGMAS = 6.0  # a turn between two poses that is smaller may be noise
HAND = 0.005  # [s] next to a rest, in which what held the disc is still there, or there again
FIRST_WINDOW = 0.02  # [s] in which the first state is read off the poses
FIRST_POSES = 6  # in it at least: a cubic has four numbers


@dataclass(frozen=True)
class Stretch:
    """Frames to diagnose, and remarks on those that were left out."""

    rows: slice
    notes: tuple[str, ...] = ()


def free_stretch(trajectory: Trajectory, start: float = -np.inf) -> Stretch:
    """The longest run of frames from `start` [s] on in which the disc moves, is not flat, and nobody holds it.

    Lost frames do not end a run. Raises AnalysisError where no run has MIN_FRAMES poses.
    """
    if not trajectory.rig.world_is_table:
        raise AnalysisError(
            "the trajectory is in the axes of the left camera, not of the table: the rolling model needs heights and "
            "the vertical. Name the view whose board lies on the table, calibrate and track again."
        )
    measured = np.flatnonzero(trajectory.measured)
    time, flat = trajectory.time[measured], trajectory.q[measured, 4] < MIN_THETA
    still = at_rest(trajectory, measured)
    first, last = _longest(~still & ~flat & (time >= start))
    if first > 0 and still[first - 1]:
        first = int(np.searchsorted(time, time[first - 1] + HAND))
    if last < len(measured) and still[last] and not flat[last]:
        last = int(np.searchsorted(time, time[last] - HAND, side="right"))
    first = _dense_start(time[:last], first)
    if last - first < MIN_FRAMES:
        raise AnalysisError(_too_short(len(trajectory), len(measured), max(last - first, 0), still, flat))
    rows = slice(int(measured[first]), int(measured[last - 1]) + 1)
    notes = [
        *_left_out("first", trajectory, measured[:first], still[:first], flat[:first], start),
        *_left_out("last", trajectory, measured[last:], still[last:], flat[last:], start),
    ]
    lost = rows.stop - rows.start - (last - first)
    if lost:
        notes.append(f"{lost} of the {rows.stop - rows.start} frames have no pose")
    return Stretch(rows, tuple(notes))


def at_rest(trajectory: Trajectory, measured: Rows) -> Mask:
    """(k,) True for frames among `measured` from or to which the disc does not turn."""
    if len(measured) < 2:
        return np.ones(len(measured), bool)
    R = rotation_from_euler(*trajectory.q[measured, 3:].T)
    turn = np.linalg.norm(vector_from_rotation(R[1:] @ np.swapaxes(R[:-1], 1, 2)), axis=1)
    variance = np.trace(trajectory.pose_covariance[measured, 3:, 3:], axis1=1, axis2=2)
    noise = REST_SIGMAS * np.sqrt(variance[1:] + variance[:-1])
    still = turn < np.maximum(AT_REST * np.diff(trajectory.time[measured]), noise)
    # a single step may look like a rest where the noise is large; a rest lasts
    lasting = still & (np.append(still[1:], still[-1]) | np.insert(still[:-1], 0, still[0]))
    return np.asarray(np.append(lasting, False) | np.insert(lasting, 0, False), bool)


def _longest(good: Mask) -> tuple[int, int]:
    """Longest run of True as [first, last); (0, 0) where there is none."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], good.astype(np.int8), [0]])))
    if edges.size == 0:
        return 0, 0
    starts, ends = edges[::2], edges[1::2]
    i = int(np.argmax(ends - starts))
    return int(starts[i]), int(ends[i])


def _dense_start(time: Array, first: int) -> int:
    """The first frame from `first` on that enough others follow soon: a state can be read off there."""
    interval = float(np.median(np.diff(time))) if len(time) > 1 else 1.0
    window = max(FIRST_WINDOW, 10 * interval)
    following = np.searchsorted(time, time + window, side="right") - np.arange(len(time))
    dense = np.flatnonzero(following[first:] >= FIRST_POSES)
    return first + int(dense[0]) if dense.size else len(time)


def _left_out(which: str, trajectory: Trajectory, rows: Rows, still: Mask, flat: Mask, start: float) -> list[str]:
    """Why frames with a pose before or after the stretch are not in it."""
    if rows.size == 0:
        return []
    time = trajectory.time[rows]
    kinds = [*_counts(flat, still), ("the disc slips", int(np.sum(time < start)))]
    reasons = [f"{text} in {n} of them" if n < rows.size else text for text, n in kinds if n]
    reason = "; ".join(reasons) if reasons else "they are cut off from the longest run of frames in free motion"
    return [f"the {which} {rows.size} frames ({time[0]:.4f} to {time[-1]:.4f} s) are left out: {reason}"]


def _counts(flat: Mask, still: Mask) -> list[tuple[str, int]]:
    return [("the disc lies flat", int(flat.sum())), ("the disc is at rest or held", int(np.sum(still & ~flat)))]


def _too_short(n: int, measured: int, longest: int, still: Mask, flat: Mask) -> str:
    kinds = "".join(f"; {text} in {k} of them" for text, k in _counts(flat, still) if k)
    run = f"; the longest motion on its own has {longest}" if longest < measured else ""
    return (
        f"{measured} of {n} frames have a pose{kinds}{run}. A diagnosis needs {MIN_FRAMES} poses of one motion "
        f"(nutation above {np.degrees(MIN_THETA):.1f} deg). Track more of the recording, or film it again."
    )
