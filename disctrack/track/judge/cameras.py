"""Cameras that contradict each other in part of the recording: one of them dropped images, or moved a little.

**Dropped images.** A camera that drops an image is ahead of the other from there on: its dots are where they should be
one frame later. To first order they are displaced by their velocity in the image times the delay. The part of this
that a change of the pose can absorb does not count.

**Moved camera.** In stretches of the recording, a rotation of the right camera relative to the left one is fitted
together with a free pose for every frame. A rotation across the epipolar lines is well determined; one along them
hardly, as the poses absorb it. So the best determined rotation is tested, against its scatter between stretches. A
camera that moved in this direction may have moved in others: the poses are given the uncertainty of an equal rotation
of either camera about any axis. Residuals of a lens or of misprinted dots depend on the position of the disc. Usually
they recur, and are part of the scatter. If they do not, as the disc settles, they are as large in other directions, and
a rotation explains hardly any of them.
"""

import numpy as np

from calibration.cameras.camera import N_RIG, PAIR_SHIFT, PAIR_TURN, WORLD_SHIFT, WORLD_TURN, StereoRig
from calibration.kit.types import Array, Mask
from disctrack.analyse.quantities import SIGMAS
from disctrack.findings import MISFITS, Finding, Kind, Remedy, Severity, Subject
from disctrack.frames import CAMERAS, vector_from_rotation
from disctrack.numbers import Measured
from disctrack.track.pose import DotsInFrames, PoseFits
from disctrack.track.side_by_side import FEW, SHARED_FRAMES, evenly

# Fraction of a squared misfit explained by a delay above which the delay is its cause, and below which it is not even
# part of it: the residuals of a moved camera resemble those of a delay a little
LATE, HARDLY = 0.9, 0.3
STRETCHES = 20


def left_out(ahead: int, pairs: range, first: int) -> Finding:
    """Finding: one camera dropped images at row `first` of the pairs, or before; the right one if `ahead` is positive.

    ahead : frames by which the right camera is ahead of the left one
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
    """Frames by which the right camera is ahead of the left; 0 if they are synchronous, or if this is not determined.

    left, right : (n, 3, 3) attitudes of the disc by each camera alone, NaN if not available. A shift is accepted if the
    median angle between the attitudes is less than half the rotation per frame, and its square less than 1 - LATE of
    that without a shift.
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


def delay_of_right(seen: DotsInFrames) -> tuple[float, float]:
    """Frame periods by which the right camera is ahead, and the fraction of the misfit explained by it.

    (0, 0) if no frame has both neighbours.
    """
    rows = evenly(np.flatnonzero(seen.posed[1:-1]) + 1, SHARED_FRAMES)
    some = seen.delayed(rows)
    used = np.isfinite(some.pixels + some.further[..., 0]).all(axis=-1)
    used &= used.sum(axis=(1, 2), keepdims=True) >= 4
    free = np.append(np.zeros(N_RIG + 2 * seen.disc.n_markers, bool), True)
    ((normal,),), (gradient,), whole = some.normal(np.zeros(len(free)), used, free)
    if not (whole > 0 and normal > 0):
        return 0.0, 0.0
    return float(gradient / normal), float(gradient**2 / (normal * whole))


def camera_motion(seen: DotsInFrames, fits: PoseFits, pairs: range) -> tuple[Array, tuple[Finding, ...]]:
    """Covariance (n, 6, 6) of the poses by the motion of a camera, zero if none moved, and the finding.

    seen, fits : with the covariances of the dots' noise
    """
    by_both: Mask = np.asarray(fits.used.sum(axis=2).min(axis=1) > 0)
    rows = evenly(np.flatnonzero(fits.converged & by_both), SHARED_FRAMES)
    if len(rows) < 2 * STRETCHES:
        return np.zeros((6, 6)), ()
    parts = np.array_split(rows, STRETCHES)
    free = np.arange(N_RIG + 2 * seen.disc.n_markers) < N_RIG
    either = _turns(seen.rig)
    sums = [seen.at(part).normal(np.zeros(len(free)), fits.used[part], free) for part in parts]
    normals, gradients, squares = zip(*sums, strict=True)
    right = either[:, 3:]
    best = right @ np.linalg.eigh(right.T @ sum(normals) @ right)[1][:, -1]
    weight = np.array([best @ normal @ best for normal in normals])
    angle = np.array([best @ gradient for gradient in gradients]) / weight  # in each stretch
    significance, first = max((_difference(angle, cut), cut) for cut in range(2, STRETCHES - 1))
    # decrease of chi-square by a constant rotation, and the further decrease if it varies; excess over the noise
    constant = (weight @ angle) ** 2 / weight.sum()
    explained, misfit = weight @ angle**2 - constant, sum(squares) - fits.degrees_of_freedom[rows].sum()
    if significance < SIGMAS or explained < HARDLY * (misfit - constant):
        return np.zeros((6, 6)), ()
    turn, frame = float(np.ptp(angle)), pairs[parts[first][0]]
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
    """(30, 6) d RIG_PARAMETERS / d rotation of the left and of the right camera, about its centre, in its own axes."""
    by = np.zeros((N_RIG, 6))
    by[WORLD_TURN, :3], by[WORLD_SHIFT, :3] = np.eye(3), np.cross(np.eye(3), rig.t_left_world).T
    by[PAIR_TURN, :3] = -rig.R_right_left
    by[PAIR_TURN, 3:], by[PAIR_SHIFT, 3:] = np.eye(3), np.cross(np.eye(3), rig.t_right_left).T
    return by


def _difference(values: Array, cut: int) -> float:
    """Difference of the means before and after the cut, in sigmas; a linear drift, its own scatter, reaches 7."""
    before, after = values[:cut], values[cut:]
    square = len(before) * before.var() + len(after) * after.var()
    variance = square / (len(values) - 2) * (1 / len(before) + 1 / len(after))
    return float(abs(after.mean() - before.mean()) / np.sqrt(variance))
