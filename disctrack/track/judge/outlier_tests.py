"""Tests for outliers among dots and poses: by their residuals, by neighbouring frames, by the other camera.

A fault of the measurement (glare, a shadow, a repeated or exchanged image) is found if noise cannot explain it. Levels
are those of chi-square distributions. The typical misfit, in a recording whose dots or lens are not perfect, is the
local median over the frames around, so that only neighbours affect the result of a frame.
"""

import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from math import comb

import numpy as np
import scipy

from calibration.kit.types import AnyArray, Array, Codes, Indices, Mask
from disctrack.frames import rotation_from_vector, vector_from_rotation
from disctrack.track.pose import PoseFits
from disctrack.track.side_by_side import FEW, stretches
from disctrack.trajectory import FrameStatus

BLOCK = 16  # frames; the running median is over three blocks, of which half may be faulty
SIGMAS = 4.0  # misfit above which a dot's covariance is increased; by chance once in 16 000
# Square of a centre's shift over that of its misfit, both in sigmas: part of a disturbance is absorbed as a shift, the
# rest is misfit. The largest ratio for random glare, shadows, dirt and edges of a hand over dots was 1.96.
HIDDEN_SHARE = 2.0
CHANCE = 1e-6  # probability that chi-square rejects a good frame: one in a thousand recordings of a thousand frames
SUSPECT = 1e-3  # probability below which a frame's covariance is scaled by its residuals
OUTLYING = 6.0  # times the median reduced chi-square: with 18 degrees of freedom one in 10^14
GREATEST_BLOW = 3.0  # [m/s] change of the disc's velocity between two frames: a fall from half a metre
MOST_STRUCK = 0.2  # largest fraction of a frame's dots rejected as outliers: beyond, the good ones are not known


def unexpected_misfit(misfit: AnyArray, n_pixels: AnyArray) -> Array:
    """Factor (n, 2, m), at least 1, on the covariance of dots whose image is disturbed.

    misfit : (n, 2, m) reduced chi-square of the grey values about the template, NaN if there is no dot
    n_pixels : (n, 2, m) number of grey values
    Glare, a shadow's edge, dirt or a hand increase a dot's misfit over that of the same dot in the frames around; a
    lasting one, over twice that of the camera's other dots. The excess times the number of pixels is the square of the
    disturbance in sigmas; the square of the centre's shift may be HIDDEN_SHARE times as large. A disturbance may reach
    other dots of the image, and shift them by ten sigmas without a significant misfit: for these a small excess counts.
    """
    shown, pixels = np.asarray(misfit, float), np.asarray(n_pixels, float)
    own, spread = _usual(shown)
    others = _usual(_nanmedian(np.swapaxes(shown, 1, 2)))[0][..., None]
    expected = np.fmin(own, 2.0 * others)
    with np.errstate(invalid="ignore", divide="ignore"):
        chance = np.maximum(spread / own, np.sqrt(2.0 / pixels)) * expected
        above = (shown - expected) / chance
        disturbed = (above > SIGMAS).any(axis=2)
        # one sigma for the other dots of a disturbed image: glare is larger than a dot
        excess = np.where(above > np.where(disturbed, 1.0, SIGMAS)[..., None], shown - expected, 0.0)
        return 1.0 + HIDDEN_SHARE * np.nan_to_num(excess * pixels / np.maximum(shown, 1.0))


def _usual(values: Array) -> tuple[Array, Array]:
    """Running median over time and robust spread about it, of values (n, ...) with NaN; same shape, by blocks."""
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
    """Median along axis 1 without NaN; NaN if there is no value, without a warning."""
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):
        return np.asarray(np.nanmedian(values, axis=1))


def _middle(values: Array) -> float:
    """Median of the values (n,) without NaN, at least 1, also if there is none."""
    return float(np.fmax(_nanmedian(values[None])[0], 1.0))


def outlying_frames(residuals: Array) -> Mask:
    """(n,) True for frames whose residuals are far above the median: they are excluded from shared estimates.

    residuals : (n, 2, m, 2) of the dots about the tracked pose, in their sigmas; NaN if a dot was not seen
    Errors that all frames share (printed dots, lens, a camera moved earlier) vary slowly with the position of the disc.
    A fault of some frames starts from one frame to the next: the recording is divided where the residuals jump, and a
    part with a much larger misfit than the adjacent part is faulty, whatever its length. This detects an image that a
    camera dropped early on; a wrong calibration is not a fault of single frames.
    """
    seen: Mask = np.asarray(np.isfinite(residuals).all(-1))
    freedom = 2 * seen.sum((1, 2)) - 6
    square = np.sum(np.where(seen[..., None], residuals, 0.0) ** 2, axis=(1, 2, 3))
    reduced = np.where(freedom >= 2, square / np.maximum(freedom, 1), np.nan)
    late = _at_fault_since_a_jump(residuals, np.where((seen.sum(axis=2) >= 2).all(axis=1), reduced, np.nan))
    return late | (np.nan_to_num(reduced) > OUTLYING * _middle(np.where(late, np.nan, reduced)))


def _at_fault_since_a_jump(residuals: Array, reduced: Array) -> Mask:
    """(n,) True in parts of the recording that begin or end with a jump of the residuals, and have a large misfit.

    reduced : (n,) reduced chi-square of the frames in which both cameras see two dots at least, NaN in the others
    """
    rows = np.flatnonzero(np.isfinite(reduced))
    step = residuals[rows[1:]] - residuals[rows[:-1]]
    both: Mask = np.asarray(np.isfinite(step).all(-1))
    square = 0.5 * np.sum(np.where(both[..., None], step, 0.0) ** 2, axis=(1, 2, 3))
    change = square / np.maximum(2 * both.sum((1, 2)) - 6, 1)
    usual = np.fmax(_usual(change)[0], 1.0)
    pieces = np.split(rows, np.flatnonzero((change > OUTLYING * usual) & (np.diff(rows) <= BLOCK)) + 1)
    long = np.array([len(piece) >= 2 for piece in pieces])  # a single frame is no reference for the others
    if not long.any():
        return np.zeros(len(reduced), bool)
    first = np.array([np.median(reduced[piece[:FEW]]) for piece in pieces])
    last = np.array([np.median(reduced[piece[-FEW:]]) for piece in pieces])
    best = int(np.argmin(np.where(long, np.maximum(first, last), np.inf)))

    def as_usual(left: int, right: int, kept: int) -> bool:
        here, there = (last[left], first[right]) if kept == left else (first[right], last[left])
        return bool(there <= OUTLYING * max(1.0, here))

    return _unconnected(len(reduced), pieces, best, as_usual)


def _unconnected(n: int, pieces: list[Indices], best: int, fits: Callable[[int, int, int], bool]) -> Mask:
    """(n,) True in the pieces of a recording that are not connected with the best one by a chain of fitting pieces.

    fits(left, right, kept) compares a piece with the nearest one accepted, `kept`, which is one of the two.
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


def judge_poses(fits: PoseFits, repeated: Mask, outlying: Mask, period: float, radius: float) -> tuple[PoseFits, Codes]:
    """Test every pose by its residuals and by the motion of its neighbours.

    fits : with their final covariances and chi-squares; repeated (n,): both images equal those of an earlier frame;
    outlying (n,): frames excluded from medians; period [s] of the frames; radius [m] of the disc

    Returns the poses without the rejected ones, with covariances (altered in place) scaled by their residuals, and the
    status of n frames: MEASURED, or why the pose is rejected (REPEATED, CONTRADICTED or JUMPED).
    """
    struck = (np.isfinite(fits.residuals_px).all(-1) & ~fits.used).sum(axis=(1, 2))  # dots rejected as outliers
    status = np.full(len(struck), FrameStatus.MEASURED, np.uint8)
    freedom = fits.degrees_of_freedom
    reduced = np.where(outlying, np.nan, fits.reduced_chi_square)
    middle = _middle(reduced)
    # a lasting fault raises the local median, so that of the whole recording limits it
    usual = np.clip(np.nan_to_num(_usual(reduced)[0], nan=middle), 1.0, OUTLYING * middle)
    square = fits.chi_square / usual
    chance = np.where(freedom > 0, scipy.special.chdtrc(np.maximum(freedom, 1), square), 1.0)
    factor = np.where(chance < SUSPECT, square / np.maximum(freedom, 1), 1.0)
    total = fits.used.sum(axis=(1, 2)) + struck
    contradicted = (chance < CHANCE) | (struck > np.maximum(MOST_STRUCK * total, 1))
    rest = _at_rest(fits)
    lost = repeated & ~_repeats_at_rest(repeated, rest)
    good = replace(fits, converged=fits.converged & ~contradicted & ~lost)
    before, after, both = (departure(good, differences(*of)) for of in ((3, -3), (3, 0), (4, -2)))
    one_sided = np.fmin(before, after)
    nearest = np.fmin(one_sided, both)
    # next to an end or a gap only the quadratic is available, which is far less accurate at a low frame rate
    moved = np.where(np.isnan(both), one_sided / _quiet(one_sided, rest), nearest / _quiet(nearest, rest))
    jumped = moved > _of_six(CHANCE) * 2.0  # a factor 2, as the motion is not quite smooth
    status[jumped | disconnected_frames(good, period, radius)] = FrameStatus.JUMPED
    status[contradicted] = FrameStatus.CONTRADICTED
    status[lost] = FrameStatus.REPEATED
    status[~fits.converged] = FrameStatus.MEASURED  # no pose to test
    fits.covariance[...] *= np.maximum(np.nan_to_num(factor, nan=1.0), 1.0)[:, None, None]
    return replace(fits, converged=fits.converged & (status == FrameStatus.MEASURED)), status


def _of_six(chance: float) -> float:
    """Value that chi-square of six degrees of freedom exceeds with this probability."""
    return float(scipy.special.chdtri(6, chance))


def _quiet(moved: Array, rest: Mask) -> Array:
    """(n,) running median of squared departures over that of pure noise, at least 1."""
    # frames at rest are excluded, as they do not represent the motion
    return np.fmax(_usual(np.where(rest, np.nan, moved))[0] / _of_six(0.5), 1.0)


def departure(fits: PoseFits, weights: Mapping[int, float]) -> Array:
    """Squared length (n,), in sigmas, of a weighted sum of neighbouring poses; weights: offset (0: the pose) -> weight.

    The weights add up to 0, so that the sum is the distance of a pose from the prediction by the others. One-sided
    third differences predict by the quadratic through three neighbours on one side. A blow changes the velocity
    between two frames, and each of them still agrees with its own side; a pose that agrees with neither side is an
    outlier. Central fourth differences predict by the cubic through two neighbours on either side, which is far more
    accurate for fast motion. NaN if one of the poses is missing.
    """
    square = np.full(len(fits.converged), np.nan)
    rows, away, spread = sums_over_time(fits, weights)
    square[rows] = np.einsum("ni,ni->n", away, np.linalg.solve(spread, away[..., None])[..., 0])
    return square


def differences(order: int, first: int) -> dict[int, float]:
    """Weights of a finite difference of this order, from offset `first` on: offset -> weight."""
    return {first + k: (-1.0) ** k * comb(order, k) for k in range(order + 1)}


def sums_over_time(fits: PoseFits, weights: Mapping[int, float]) -> tuple[Indices, Array, Array]:
    """Weighted sums of neighbouring poses as in `departure`.

    returns : frames (k,); sums (k, 6) in POSE_COMPONENTS; their covariance (k, 6, 6) by noise
    """
    R, t, C, offsets = fits.R_world_body, fits.t_world_body, fits.covariance, np.array([*weights])
    rows = np.arange(max(-offsets.min(), 0), len(t) - max(offsets.max(), 0))
    rows = rows[fits.converged[rows[:, None] + offsets].all(axis=1)]
    back = np.swapaxes(R[rows + offsets[len(offsets) // 2]], 1, 2)
    away, spread = np.zeros((len(rows), 6)), np.zeros((len(rows), 6, 6))
    for offset, weight in weights.items():
        near = rows + offset
        turn = vector_from_rotation(R[near] @ back)  # small
        away += weight * np.concatenate([t[near], turn], axis=1)
        spread += weight**2 * C[near]
    return rows, away, spread


def disconnected_frames(fits: PoseFits, period: float, radius: float) -> Mask:
    """(n,) True for frames that are not connected with the longest piece of continuous motion, directly or by others.

    A blow may change the velocity of the disc's centre by GREATEST_BLOW between two frames, and the angular velocity by
    that over the radius. A pose farther than this from the predictions by the frames before and after starts another
    motion. Gaps without a pose are bridged: after a false motion the true one continues.
    """
    rows = np.flatnonzero(fits.converged)
    pieces = np.split(rows, np.flatnonzero(_broken(fits, rows[:-1], rows[1:], period, radius)) + 1)
    longest = int(np.argmax([len(piece) for piece in pieces]))

    def continues(left: int, right: int, kept: int) -> bool:
        return not _broken(fits, pieces[left][-1:], pieces[right][:1], period, radius)[0]

    return _unconnected(len(fits.converged), pieces, longest, continues)


def _broken(fits: PoseFits, last: Indices, first: Indices, period: float, radius: float) -> Mask:
    """(k,) True if no possible motion leads from frames `last` (k,) to the later frames `first` (k,).

    Neither with the velocity before the gap nor with that after it; False if neither is known.
    """
    miss = np.full((2, len(last)), np.nan)
    n, R, t = len(fits.converged), fits.R_world_body, fits.t_world_body
    diagonal = np.diagonal(fits.covariance, axis1=1, axis2=2)
    variance = np.stack([diagonal[:, :3].sum(axis=1), diagonal[:, 3:].sum(axis=1)])  # of positions, and of rotations
    gap = (first - last).astype(float)
    reach = GREATEST_BLOW * period * gap / np.array([[1.0], [radius]])
    for side, (here, there, beyond) in enumerate([(last, first, last - 1), (first, last, first + 1)]):
        known = (beyond >= 0) & (beyond < n) & fits.converged[np.clip(beyond, 0, n - 1)]
        here, there, beyond, g = here[known], there[known], beyond[known], gap[known]
        shift = t[there] - t[here] - g[:, None] * (t[here] - t[beyond])
        rate = vector_from_rotation(R[here] @ np.swapaxes(R[beyond], 1, 2))
        carried = rotation_from_vector(g[:, None] * rate) @ R[here]
        turn = vector_from_rotation(R[there] @ np.swapaxes(carried, 1, 2))
        noise = 6.0 * np.sqrt(variance[:, there] + (1 + g) ** 2 * variance[:, here] + g**2 * variance[:, beyond])
        away = np.linalg.norm([shift, turn], axis=2)
        miss[side, known] = np.max(away / (reach[:, known] + noise), axis=0)
    return np.asarray(np.nan_to_num(np.fmin(*miss)) > 1.0)


def _repeats_at_rest(repeated: Mask, rest: Mask) -> Mask:
    """(n,) True in repeats of a disc at rest; False if the recorder repeated images while the disc moved.

    A single repeat is at rest if the frames around it are. The frames within a longer run are equal in any case: the
    run is at rest if the disc rests, or the recording ends, on one side of it.
    """
    n = len(repeated)
    still = np.zeros(n, bool)
    for first, end in stretches(repeated):  # a handful, if any
        before, after = first - 2, end  # `rest` of a frame compares the frames on both sides of it
        alone = end - first == 1
        still[first:end] = rest[first] if alone else before < 0 or after >= n or rest[before] or rest[after]
    return still


def _at_rest(fits: PoseFits) -> Mask:
    """(n,) True if the poses before and after differ by no more than their noise: then a repeat is no fault."""
    rest = departure(fits, {-1: -1, 1: 1}) < _of_six(SUSPECT)
    if len(rest) > 1:
        rest[-1] = rest[-2]
    return np.asarray(rest)
