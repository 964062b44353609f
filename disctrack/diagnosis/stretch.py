"""Selection of the frames of a recording in which the disc moves freely, and the reasons why others are left out."""

import numpy as np
from numpy.typing import NDArray

from calibration.kit.types import Array, Indices, Mask
from disctrack.errors import AnalysisError
from disctrack.frames import rotation_from_euler, vector_from_rotation
from disctrack.track.side_by_side import stretches
from disctrack.trajectory import Trajectory

MIN_THETA = np.radians(0.7)  # below, the disc of Ma et al. touches its paper, and the model does not hold
MIN_FRAMES = 40
AT_REST = 0.3  # [rad/s] a rolling disc rotates at 3 rad/s or more, 10 ms after it was released
REST_SIGMAS = 6.0  # of the rotation between two poses, below which it may be noise
HAND = 0.005  # [s] next to a rest, in which a hand may still touch the disc
FIRST_POSES = 6  # among the first 20 frames at least, from which the initial state is estimated
HELD = "the disc is at rest or held"
OTHERWISE = ("the disc lies flat", HELD, "the disc slips")  # reasons why frames are not of a free motion


def free_stretch(trajectory: Trajectory, start: float = -np.inf) -> tuple[slice, tuple[str, ...]]:
    """The longest run of frames from `start` [s] on in which the disc moves freely and does not lie flat.

    Lost frames do not end a run. Also remarks on the frames that are left out. Raises AnalysisError if no run has
    MIN_FRAMES poses.
    """
    if not trajectory.rig.world_is_table:
        raise AnalysisError(
            "the trajectory is in the axes of the left camera, not of the table: the rolling model needs heights and "
            "the vertical. Name the view whose board lies on the table, calibrate and track again."
        )
    measured = np.flatnonzero(trajectory.measured)
    time, flat = trajectory.time[measured], trajectory.q[measured, 4] < MIN_THETA
    why = np.select([flat, at_rest(trajectory, measured), time < start], OTHERWISE, "")
    first, last = max(stretches(why == "").tolist(), key=lambda run: run[1] - run[0], default=(0, 0))
    if first > 0 and why[first - 1] == HELD:
        first = int(np.searchsorted(time, time[first - 1] + HAND))
    if last < len(measured) and why[last] == HELD:
        last = int(np.searchsorted(time, time[last] - HAND, side="right"))
    first = _dense_start(time[:last], first)
    if last - first < MIN_FRAMES:
        counts = "; ".join([f"{len(measured)} of {len(trajectory)} frames have a pose", *_counts(why)])
        run = f"; the longest motion on its own has {max(last - first, 0)}" if last - first < len(measured) else ""
        raise AnalysisError(
            f"{counts}{run}. A diagnosis needs {MIN_FRAMES} poses of one motion (nutation above "
            f"{np.degrees(MIN_THETA):.1f} deg). Track more of the recording, or film it again."
        )
    rows, notes = slice(int(measured[first]), int(measured[last - 1]) + 1), list[str]()
    for which, part in (("first", slice(first)), ("last", slice(last, None))):
        if (out := time[part]).size:
            reason = "; ".join(_counts(why[part])) or "they are cut off from the longest run of frames in free motion"
            notes.append(f"the {which} {out.size} frames ({out[0]:.4f} to {out[-1]:.4f} s) are left out: {reason}")
    lost = rows.stop - rows.start - (last - first)
    if lost:
        notes.append(f"{lost} of the {rows.stop - rows.start} frames have no pose")
    return rows, tuple(notes)


def _counts(why: NDArray[np.str_]) -> list[str]:
    """How many frames are left out for each reason."""
    counts = {text: int(np.sum(why == text)) for text in OTHERWISE}
    return [f"{text} in {n} of them" for text, n in counts.items() if n]


def at_rest(trajectory: Trajectory, measured: Indices) -> Mask:
    """(k,) True for frames among `measured` before or after which the disc does not rotate."""
    if len(measured) < 2:
        return np.ones(len(measured), bool)
    R = rotation_from_euler(*trajectory.q[measured, 3:].T)
    turn = np.linalg.norm(vector_from_rotation(R[1:] @ np.swapaxes(R[:-1], 1, 2)), axis=1)
    variance = np.trace(trajectory.pose_covariance[measured, 3:, 3:], axis1=1, axis2=2)
    noise = REST_SIGMAS * np.sqrt(variance[1:] + variance[:-1])
    still = turn < np.maximum(AT_REST * np.diff(trajectory.time[measured]), noise)
    # where the noise is large a single step may look like rest; two in a row do not
    lasting = still & (np.append(still[1:], still[-1]) | np.insert(still[:-1], 0, still[0]))
    return np.asarray(np.append(lasting, False) | np.insert(lasting, 0, False), bool)


def _dense_start(time: Array, first: int) -> int:
    """The first frame from `first` on that is followed by enough others for an estimate of the state."""
    interval = float(np.median(np.diff(time))) if len(time) > 1 else 1.0
    following = np.searchsorted(time, time + 20 * interval, side="right") - np.arange(len(time))
    dense = np.flatnonzero(following[first:] >= FIRST_POSES)
    return first + int(dense[0]) if dense.size else len(time)
