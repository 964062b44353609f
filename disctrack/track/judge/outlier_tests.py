"""Which dots and poses are to be believed: each by its own residuals, by its neighbours, by the other camera.

A fault of the measurement (glare, a shadow, a repeated or exchanged image) is found where it does what noise does
not. Levels are those of chi-square distributions; what is usual, in a recording whose dots or lens are not perfect, is
taken from the frames around, so that a frame is judged by its neighbours and by nothing far away.
"""

import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from math import comb

import numpy as np
import scipy
from numpy.typing import NDArray

from calibration.kit.arrays import Array, Mask
from disctrack.frames import rotation_from_vector, vector_from_rotation
from disctrack.track.pose import PoseFits
from disctrack.track.side_by_side import FEW, stretches
from disctrack.trajectory import FrameStatus

BLOCK = 16  # frames whose median is what is usual, with those of the blocks on both sides: half may be at fault
SIGMAS = 4.0  # beyond which a dot's misfit is hardly chance (6e-5): such a dot loses its weight, and no frame is lost
# Square of a centre's shift over that of the misfit, both in sigmas: a disturbance is taken for a shift in one part and
# shows in the other. Of random glare, shadows, dirt and edges of a hand over dots the largest ratio was 1.96.
HIDDEN_SHARE = 2.0
CHANCE = 1e-6  # of a frame without fault to be refused by its chi-square: one in a thousand recordings of a thousand
SUSPECT = 1e-3  # below this chance a frame's covariance follows its residuals
OUTLYING = 6.0  # times the median reduced chi-square: of 18 degrees of freedom one in 10^14
GREATEST_BLOW = 3.0  # [m/s] by which the disc's velocity may change between two frames: a fall from half a metre
MOST_STRUCK = 0.2  # part of a frame's dots that may be struck as outliers: more, and it is open which are right


def unexpected_misfit(misfit: NDArray[np.floating], n_pixels: NDArray[np.floating]) -> Array:
    """Factor (n, 2, m), at least 1, on the covariance of dots whose surroundings are not as declared.

    misfit : (n, 2, m) reduced chi-square of the grey values about the template, NaN where there is no dot
    n_pixels : (n, 2, m) grey values that it was taken over
    Glare, a shadow's edge, dirt or a hand raise a dot's misfit over that of the same dot in the frames around (and
    over twice that of the camera's other dots, for what stays). The excess times the number of pixels is the square of
    the disturbance in sigmas; HIDDEN_SHARE times that may be the square of the centre's shift. What disturbs a dot may
    reach the image's other dots, and shift them by ten sigmas without showing by itself: there, a small excess counts.
    """
    shown, pixels = np.asarray(misfit, float), np.asarray(n_pixels, float)
    own, spread = _usual(shown)
    others = _usual(_nanmedian(np.swapaxes(shown, 1, 2)))[0][..., None]
    expected = np.fmin(own, 2.0 * others)
    with np.errstate(invalid="ignore", divide="ignore"):
        chance = np.maximum(spread / own, np.sqrt(2.0 / pixels)) * expected
        above = (shown - expected) / chance
        disturbed = (above > SIGMAS).any(axis=2)
        # one sigma for the other dots of an image in which something is: glare is larger than a dot
        excess = np.where(above > np.where(disturbed, 1.0, SIGMAS)[..., None], shown - expected, 0.0)
        return 1.0 + HIDDEN_SHARE * np.nan_to_num(excess * pixels / np.maximum(shown, 1.0))


def _usual(values: Array) -> tuple[Array, Array]:
    """Running median over time and its robust spread, of values (n, ...) with NaN; same shape, by blocks of frames."""
    n, blocks = len(values), -(-len(values) // BLOCK) + 2
    padded = np.full((blocks * BLOCK, *values.shape[1:]), np.nan)
    padded[BLOCK : BLOCK + n] = values
    cut = padded.reshape(blocks, BLOCK, *values.shape[1:])
    around = np.concatenate([cut[:-2], cut[1:-1], cut[2:]], axis=1)
    middle = _nanmedian(around)
    spread = 1.4826 * _nanmedian(np.abs(around - middle[:, None]))
    rows = np.arange(n) // BLOCK
    return middle[rows], spread[rows]


def _nanmedian(values: Array) -> Array:
    """Median along axis 1 without NaN; NaN where there is nothing, without a warning."""
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):
        return np.asarray(np.nanmedian(values, axis=1))


def outlying_frames(residuals: Array) -> Mask:
    """(n,) True where a frame's dots miss the tracked pose by far more than is usual: it must not teach the others.

    residuals : (n, 2, m, 2) of the dots about the tracked pose, in their sigmas; NaN where a dot was not seen
    What all frames share (printed dots, lens, a camera that moved before) shows in all of them, and changes slowly with
    the place of the disc. A fault of some frames sets in from one frame to the next: the recording is cut where the
    residuals jump, and a part whose misfit stands far above that of the part beside it is at fault, however long it
    is. So it is found that a camera left out an image early on; a calibration that is off is no fault of frames.
    """
    seen: Mask = np.asarray(np.isfinite(residuals).all(-1))
    freedom = 2 * seen.sum((1, 2)) - 6
    square = np.sum(np.where(seen[..., None], residuals, 0.0) ** 2, axis=(1, 2, 3))
    with np.errstate(invalid="ignore", divide="ignore"):
        reduced = np.where(freedom >= 2, square / np.maximum(freedom, 1), np.nan)
    late = _at_fault_since_a_jump(residuals, np.where((seen.sum(axis=2) >= 2).all(axis=1), reduced, np.nan))
    usual = np.where(late, np.nan, reduced)
    if not np.isfinite(usual).any():
        return np.zeros(len(residuals), bool)
    return late | (np.nan_to_num(reduced) > OUTLYING * max(1.0, float(np.nanmedian(usual))))


def _at_fault_since_a_jump(residuals: Array, reduced: Array) -> Mask:
    """(n,) True in parts of the recording that begin or end with a jump of the residuals and stand out by their misfit.

    reduced : (n,) chi-square of the frames in which both cameras tell, NaN in the others
    """
    rows = np.flatnonzero(np.isfinite(reduced))
    step = residuals[rows[1:]] - residuals[rows[:-1]]
    both: Mask = np.asarray(np.isfinite(step).all(-1))
    square = 0.5 * np.sum(np.where(both[..., None], step, 0.0) ** 2, axis=(1, 2, 3))
    change = square / np.maximum(2 * both.sum((1, 2)) - 6, 1)
    usual = np.fmax(_usual(change[:, None])[0][:, 0], 1.0)
    pieces = np.split(rows, np.flatnonzero((change > OUTLYING * usual) & (np.diff(rows) <= BLOCK)) + 1)
    long = np.array([len(piece) >= 2 for piece in pieces])  # one frame alone is no measure for the others
    if not long.any():
        return np.zeros(len(reduced), bool)
    first, last = (
        np.array([np.median(reduced[piece[end]]) for piece in pieces]) for end in (slice(FEW), slice(-FEW, None))
    )
    best = int(np.argmin(np.where(long, np.maximum(first, last), np.inf)))

    def as_usual(left: int, right: int, kept: int) -> bool:
        here, there = (last[left], first[right]) if kept == left else (first[right], last[left])
        return bool(there <= OUTLYING * max(1.0, here))

    return _unconnected(len(reduced), pieces, best, as_usual)


def _unconnected(n: int, pieces: list[NDArray[np.intp]], best: int, fits: Callable[[int, int, int], bool]) -> Mask:
    """(n,) True in the pieces of a recording that agree neither with the best of them nor with one that does.

    fits(left, right, kept) compares a piece with the nearest that is kept already, which is one of the two.
    """
    apart = np.zeros(n, bool)
    for others in (range(best + 1, len(pieces)), range(best - 1, -1, -1)):
        nearest = best
        for k in others:
            if fits(min(k, nearest), max(k, nearest), nearest):
                nearest = k
            else:
                apart[pieces[k][0] : pieces[k][-1] + 1] = True
    return apart


def judge_poses(
    fits: PoseFits, repeated: Mask, outlying: Mask, period: float, radius: float
) -> tuple[PoseFits, NDArray[np.uint8]]:
    """Judge every pose by its residuals and by the motion of its neighbours.

    Returns the poses without those that are refused, their covariances, altered, as their residuals have them, and of n
    frames MEASURED, or why the pose is refused (REPEATED, CONTRADICTED or JUMPED).

    fits : with the covariances and chi-squares scaled as they will be told; repeated (n,): both images are those of a
    frame before; outlying (n,): frames by which no other is to be judged; period [s] of the frames; radius [m] of the
    disc
    """
    struck = (np.isfinite(fits.residuals_px).all(-1) & ~fits.used).sum(axis=(1, 2))  # dots left out as outliers
    status = np.full(len(struck), FrameStatus.MEASURED, np.uint8)
    freedom = fits.degrees_of_freedom
    reduced = np.where(outlying, np.nan, fits.reduced_chi_square)
    middle = max(1.0, float(np.nanmedian(reduced))) if np.isfinite(reduced).any() else 1.0
    # a fault that lasts is usual where it is, but not in the rest of the recording
    usual = np.clip(np.nan_to_num(_usual(reduced[:, None])[0][:, 0], nan=middle), 1.0, OUTLYING * middle)
    with np.errstate(invalid="ignore"):
        square = fits.chi_square / usual
        chance = np.where(freedom > 0, scipy.special.chdtrc(np.maximum(freedom, 1), square), 1.0)
        factor = np.where(chance < SUSPECT, square / np.maximum(freedom, 1), 1.0)
    total = fits.used.sum(axis=(1, 2)) + struck
    contradicted = (chance < CHANCE) | (struck > np.maximum(MOST_STRUCK * total, 1))
    rest = _at_rest(fits)
    lost = repeated & ~_still_over_the_repeats(repeated, rest)
    good = replace(fits, converged=fits.converged & ~contradicted & ~lost)
    *one_sided, both = (
        departure(good, weights) for weights in (differences(3, -3), differences(3, 0), differences(4, -2))
    )
    nearest = np.fmin(*one_sided)
    moved = nearest / _quiet(nearest, rest)
    # next to an end or a gap, a quadratic is all there is, and it follows a slow camera's frames far worse
    inner = np.fmin.reduce([*one_sided, both])
    moved = np.where(np.isnan(both), moved, inner / _quiet(inner, rest))
    with np.errstate(invalid="ignore"):
        jumped = moved > _of_six(CHANCE) * 2.0  # the smallest of three, in motion that is not quite steady
    status[jumped | torn_off(good, period, radius)] = FrameStatus.JUMPED
    status[contradicted] = FrameStatus.CONTRADICTED
    status[lost] = FrameStatus.REPEATED
    status[~fits.converged] = FrameStatus.MEASURED  # nothing to judge
    fits.covariance[...] *= np.maximum(np.nan_to_num(factor, nan=1.0), 1.0)[:, None, None]
    return replace(fits, converged=fits.converged & (status == FrameStatus.MEASURED)), status


def _of_six(chance: float) -> float:
    """What chi-square of six degrees of freedom exceeds by that chance."""
    return float(scipy.special.chdtri(6, chance))


def _quiet(moved: Array, rest: Mask) -> Array:
    """(n,) how many times farther than noise makes them, at least once, poses usually are from where others lead."""
    # a disc at rest does not tell how smooth its motion will be
    usual = _usual(np.where(rest, np.nan, moved)[:, None])[0][:, 0]
    return np.fmax(usual / _of_six(0.5), 1.0)


def departure(fits: PoseFits, weights: Mapping[int, float]) -> Array:
    """Squared length (n,), in its sigmas, of a sum of each frame's neighbours (and its own pose, 0): offset -> weight.

    The weights' sum is 0, so that the sum is a pose's distance from where the others lead: third differences from
    before and from after carry the quadratic through three neighbours on by a frame. A blow changes the velocity
    between two frames, so each of them agrees with its own side; a pose that agrees with neither lies on no motion.
    Fourth ones hold the cubic through two neighbours on either side, which follows a motion that changes quickly from
    frame to frame far better. NaN where one of the poses is missing.
    """
    square = np.full(len(fits.converged), np.nan)
    rows, away, spread = sums_over_time(fits, weights)
    square[rows] = np.einsum("ni,ni->n", away, np.linalg.solve(spread, away[..., None])[..., 0])
    return square


def differences(order: int, first: int) -> dict[int, float]:
    """Weights of a difference of this order over successive frames: offset -> weight, from the first offset on."""
    return {first + k: (-1.0) ** k * comb(order, k) for k in range(order + 1)}


def sums_over_time(fits: PoseFits, weights: Mapping[int, float]) -> tuple[NDArray[np.intp], Array, Array]:
    """Weighted sums of neighbours as in `departure`.

    returns : frames (k,); sums (k, 6) in POSE_COMPONENTS; the covariance (k, 6, 6) that noise gives them
    """
    R, t, C, offsets = fits.R_world_body, fits.t_world_body, fits.covariance, np.array([*weights])
    rows = np.arange(max(-offsets.min(), 0), len(t) - max(offsets.max(), 0))
    rows = rows[fits.converged[rows[:, None] + offsets].all(axis=1)]
    back = np.swapaxes(R[rows + offsets[len(offsets) // 2]], 1, 2)
    away, spread = np.zeros((len(rows), 6)), np.zeros((len(rows), 6, 6))
    for offset, weight in weights.items():
        near = rows + offset
        turn = vector_from_rotation(R[near] @ back)  # by little, from there
        away += weight * np.concatenate([t[near], turn], axis=1)
        spread += weight**2 * C[near]
    return rows, away, spread


def torn_off(fits: PoseFits, period: float, radius: float) -> Mask:
    """(n,) True for frames that no motion joins to the longest piece of motion, or to what is joined to that.

    Between two frames the disc may be hit: its centre's velocity changes by GREATEST_BLOW, its turn by that over the
    radius. A pose farther than that from where the frames before lead, and the frames after, begins another motion.
    Over frames without a pose, too: where a false motion ends, the true one goes on.
    """
    rows = np.flatnonzero(fits.converged)
    pieces = np.split(rows, np.flatnonzero(_torn(fits, rows[:-1], rows[1:], period, radius)) + 1)
    longest = int(np.argmax([len(piece) for piece in pieces]))

    def leads_on(left: int, right: int, kept: int) -> bool:
        return not _torn(fits, pieces[left][-1:], pieces[right][:1], period, radius)[0]

    return _unconnected(len(fits.converged), pieces, longest, leads_on)


def _torn(fits: PoseFits, last: NDArray[np.intp], first: NDArray[np.intp], period: float, radius: float) -> Mask:
    """(k,) True where no motion leads from frames `last` (k,) to the later frames `first` (k,).

    Neither at the velocity before the gap nor at that after it; False where neither is known.
    """
    miss = np.full((2, len(last)), np.nan)
    n, R, t = len(fits.converged), fits.R_world_body, fits.t_world_body
    variance = np.trace(fits.covariance[:, :3, :3], axis1=1, axis2=2)
    turn_variance = np.trace(fits.covariance[:, 3:, 3:], axis1=1, axis2=2)
    gap = (first - last).astype(float)
    reach = GREATEST_BLOW * period * gap
    for side, (here, there, beyond) in enumerate([(last, first, last - 1), (first, last, first + 1)]):
        known = (beyond >= 0) & (beyond < n) & fits.converged[np.clip(beyond, 0, n - 1)]
        here, there, beyond, g = here[known], there[known], beyond[known], gap[known]
        shift = t[there] - t[here] - g[:, None] * (t[here] - t[beyond])
        rate = vector_from_rotation(R[here] @ np.swapaxes(R[beyond], 1, 2))
        carried = rotation_from_vector(g[:, None] * rate) @ R[here]
        turn = vector_from_rotation(R[there] @ np.swapaxes(carried, 1, 2))
        noise, turn_noise = (
            6.0 * np.sqrt(v[there] + (1 + g) ** 2 * v[here] + g**2 * v[beyond]) for v in (variance, turn_variance)
        )
        miss[side, known] = np.maximum(
            np.linalg.norm(shift, axis=1) / (reach[known] + noise),
            np.linalg.norm(turn, axis=1) / (reach[known] / radius + turn_noise),
        )
    return np.asarray(np.nan_to_num(np.fmin(*miss)) > 1.0)


def _still_over_the_repeats(repeated: Mask, rest: Mask) -> Mask:
    """(n,) True in repeats of a disc that lies still; False where a recorder stuck while the disc moved.

    One repeat is still where the frames around it are. In a longer run the frames in between are alike whatever the
    disc did: it is still where rest, or the recording's end, lies on one side of it.
    """
    n = len(repeated)
    still = np.zeros(n, bool)
    for first, end in stretches(repeated):  # a handful, if any
        before, after = first - 2, end  # `rest` of a frame is about the frames on both sides of it
        alone = end - first == 1
        still[first:end] = rest[first] if alone else before < 0 or after >= n or rest[before] or rest[after]
    return still


def _at_rest(fits: PoseFits) -> Mask:
    """(n,) True where the poses before and after differ by no more than their noise: then a repeat shows no fault."""
    with np.errstate(invalid="ignore"):
        rest = departure(fits, {-1: -1, 1: 1}) < _of_six(SUSPECT)
    if len(rest) > 1:
        rest[-1] = rest[-2]
    return np.asarray(rest)
