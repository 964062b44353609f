"""Cameras that contradict each other for a part of the recording: one of them left out images, or moved a little.

**Left out.** A camera that leaves out an image is ahead of the other from there on: its dots lie where they will be one
frame later. To first order they are displaced by their velocity in the image times the delay; what of that a change of
the pose makes up for is no sign of it.

**Moved.** In stretches of the recording a turn of the right camera against the left one is fitted beside a free pose
for every frame. A turn across the epipolar lines shows at once, one along them hardly, as the poses make up for it: so
the turn in the direction that the dots know best, its scatter between stretches included, tells whether a camera moved.
What moves it there moves it elsewhere, too: the poses are as uncertain as a turn of either camera by as much about any
axis makes them. What a lens or misprinted dots leave depends on the disc's place: as a rule it comes back, and is part
of the scatter; where it does not, as the disc settles, it is as much in other directions, and a turn is hardly any of
it.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calibration.cameras.camera import N_RIG, PAIR_SHIFT, PAIR_TURN, WORLD_SHIFT, WORLD_TURN, StereoRig
from calibration.kit.arrays import Array, Mask
from disctrack.findings import MISFITS, Finding, Kind, Remedy, Severity, Subject
from disctrack.frames import CAMERAS, vector_from_rotation
from disctrack.numbers import Measured
from disctrack.track.pose import DotsInFrames, PoseFits
from disctrack.track.side_by_side import FEW, SHARED_FRAMES, evenly

# Share of the square of a misfit that a delay explains, from which on it is its cause; and below which it has no part
# in it: what a camera that moved leaves looks a little like one
LATE, HARDLY = 0.9, 0.3
STRETCHES = 20
SURE = 5.0  # sigmas of the difference before and after; a drift, whose scatter is its own, reaches 7


def left_out(ahead: int, pairs: range, first: int) -> Finding:
    """One camera left out images at a row of the pairs, or before: the right one where `ahead` is positive.

    ahead : frames by which it is ahead of the other
    """
    n, (camera, other), frame = abs(ahead), CAMERAS[::-1] if ahead > 0 else CAMERAS, pairs[first]
    text = (
        f"the {camera} camera is {n} frame{'s' * (n > 1)} ahead of the {other}, and its images are not used from there "
        f"on: it left out {n} image{'s' * (n > 1)} {'at' if first else 'before'} frame {frame}"
    )
    of, numbers = Subject("track", camera, ((frame, pairs[-1]),)), {"images": Measured(n)}
    remedy = Remedy(action=f"number its images from there on higher by {n}")
    explains = (Kind.DELAY, *MISFITS) if first else MISFITS
    return Finding(Kind.DROPPED_FRAMES, Severity.DOUBT, text, of, numbers, (remedy,), explains)


def frames_ahead(left: Array, right: Array) -> int:
    """Frames by which the right camera is ahead of the left; 0 where they see one disc at once, or none tells.

    left, right : (n, 3, 3) attitudes of the disc as each camera alone sees them, NaN where it does not. They are those
    of one motion where the median of what is between them is less than half of what the disc turns in a frame, and that
    they were taken at once explains next to nothing of it.
    """

    def apart(a: Array, b: Array) -> float:
        turn = np.linalg.norm(vector_from_rotation(a @ np.swapaxes(b, 1, 2)), axis=1)
        turn = turn[np.isfinite(turn)]
        return float(np.median(turn)) if len(turn) >= FEW else np.inf

    n = len(left)
    misfit = {
        ahead: apart(left[max(ahead, 0) : n + min(ahead, 0)], right[max(-ahead, 0) : n - max(ahead, 0)])
        for ahead in range(FEW - n, n - FEW + 1)
    }
    best = min(misfit, key=misfit.__getitem__, default=0)
    one = misfit.get(best, np.inf) < 0.5 * min(apart(a[1:], a[:-1]) for a in (left, right))
    return best if one and misfit[best] ** 2 < (1 - LATE) * misfit[0] ** 2 else 0


def delay_of_right(seen: DotsInFrames, rows: NDArray[np.intp]) -> tuple[float, float]:
    """Frame periods by which the right camera is ahead of the left in these frames, and the share of misfit explained.

    (0, 0) where no frame has both its neighbours.
    """
    inside = rows[(rows > 0) & (rows < len(seen.t) - 1)]
    rows = evenly(inside[seen.posed[inside]], SHARED_FRAMES)
    velocity = np.zeros_like(seen.pixels[rows])
    velocity[:, 1] = 0.5 * (seen.pixels[rows + 1, 1] - seen.pixels[rows - 1, 1])
    some = replace(seen.at(rows), further=velocity[..., None])
    used = np.isfinite(some.pixels + velocity).all(axis=-1)
    used &= used.sum(axis=(1, 2), keepdims=True) >= 4
    free = np.append(np.zeros(N_RIG + 2 * seen.disc.n_markers, bool), True)
    ((by_itself,),), (across,), whole = some.normal(np.zeros(len(free)), used, free)
    if not (whole > 0 and by_itself > 0):
        return 0.0, 0.0
    return float(across / by_itself), float(across**2 / (by_itself * whole))


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
