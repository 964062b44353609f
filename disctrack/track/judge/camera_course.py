"""A camera that moves a little while the disc is filmed: what both cameras say of the same dots, over time, knows it.

In stretches of the recording a turn of the right camera against the left one is fitted beside a free pose for every
frame. A turn across the epipolar lines shows at once, one along them hardly, as the poses make up for it: so the turn
in the direction that the dots know best, its scatter between stretches included, tells whether a camera moved. What
moves it there moves it elsewhere, too: the poses are as uncertain as a turn of either camera by as much about any axis
makes them. What a lens or misprinted dots leave depends on the disc's place: as a rule it comes back, and is part of
the scatter; where it does not, as the disc settles, it is as much in other directions, and a turn is hardly any of it.
"""

import numpy as np

from calibration.cameras.camera import N_RIG, PAIR_SHIFT, PAIR_TURN, WORLD_SHIFT, WORLD_TURN, StereoRig
from calibration.kit.arrays import Array, Mask
from disctrack.findings import MISFITS, Finding, Kind, Remedy, Severity, Subject
from disctrack.numbers import Measured
from disctrack.track.judge.dropped_frames import HARDLY
from disctrack.track.pose import DotsInFrames, PoseFits
from disctrack.track.side_by_side import SHARED_FRAMES, evenly

STRETCHES = 20
SURE = 5.0  # sigmas of the difference before and after; a drift, whose scatter is its own, reaches 7


def camera_course(seen: DotsInFrames, fits: PoseFits, pairs: range) -> tuple[Array, tuple[Finding, ...]]:
    """What a camera that moved makes the poses uncertain by (n, 6, 6), zero for none, and what is to be told of it.

    seen, fits : with the covariances of the dots' own noise
    """
    by_both: Mask = np.asarray(fits.used.sum(axis=2).min(axis=1) > 0)
    rows = evenly(np.flatnonzero(fits.converged & by_both), SHARED_FRAMES)
    if len(rows) < 2 * STRETCHES:
        return np.zeros((6, 6)), ()
    parts = np.array_split(rows, STRETCHES)
    free = np.arange(N_RIG + 2 * seen.disc.n_markers) < N_RIG
    either = _turns(seen.rig)
    told = [seen.at(part).normal(np.zeros(len(free)), fits.used[part], free) for part in parts]
    normals, gradients, squares = zip(*told, strict=True)
    right = either[:, 3:]
    best = right @ np.linalg.eigh(right.T @ sum(normals) @ right)[1][:, -1]
    known = np.array([best @ normal @ best for normal in normals])
    course = np.array([best @ gradient for gradient in gradients]) / known
    sure, first = max((_difference(course, cut), cut) for cut in range(2, STRETCHES - 1))
    # of chi-square beyond the noise: what a turn throughout would explain, and beside it one that changes
    constant = (known @ course) ** 2 / known.sum()
    explained, misfit = known @ course**2 - constant, sum(squares) - fits.degrees_of_freedom[rows].sum()
    if sure < SURE or explained < HARDLY * (misfit - constant):
        return np.zeros((6, 6)), ()
    turn, frame = float(np.ptp(course)), pairs[parts[first][0]]
    by_turn = turn * fits.sensitivity @ either
    text = (
        f"a camera moved by {turn * seen.rig.right.fx:.3f} px while the disc was filmed, most of it at frame {frame}, "
        "in the direction that the dots know best; the sigmas hold as much in any other"
    )
    of, size = Subject("track", frames=((frame, frame),)), {"turn": Measured(float(np.degrees(turn)), unit="deg")}
    advice = (Remedy(action="clamp the cameras, and calibrate again"),)
    finding = Finding(Kind.CAMERA_MOVED, Severity.WARNING, text, of, size, advice, MISFITS)
    return by_turn @ by_turn.swapaxes(1, 2), (finding,)


def _turns(rig: StereoRig) -> Array:
    """(30, 6) of the RIG_PARAMETERS by turns of the left and of the right camera about their own centres, own axes."""
    by = np.zeros((N_RIG, 6))
    by[WORLD_TURN, :3], by[WORLD_SHIFT, :3] = np.eye(3), np.cross(np.eye(3), rig.t_left_world).T
    by[PAIR_TURN, :3] = -rig.R_right_left
    by[PAIR_TURN, 3:], by[PAIR_SHIFT, 3:] = np.eye(3), np.cross(np.eye(3), rig.t_right_left).T
    return by


def _difference(course: Array, cut: int) -> float:
    """Of the means before and after, in sigmas."""
    before, after = course[:cut], course[cut:]
    square = len(before) * before.var() + len(after) * after.var()
    variance = square / (len(course) - 2) * (1 / len(before) + 1 / len(after))
    return float(abs(after.mean() - before.mean()) / np.sqrt(variance))
