"""Which dots and poses are to be believed: each by its own residuals, by its neighbours, by the other camera.

A fault of the measurement (a gleam, a shadow, a repeated or exchanged image) is found where it does what noise does
not. Levels are those of chi-square distributions; what is usual, in a recording whose dots or lens are not perfect, is
taken from the frames around, so that a frame is judged by its neighbours and by nothing far away.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc, chdtri  # scipy.stats would take a second to import

from calibration.arrays import Array, Mask
from disctrack.frames import vector_from_rotation
from disctrack.track.pose import PoseFits
from disctrack.trajectory import FrameStatus

BLOCK = 16  # frames whose median is what is usual, with those of the blocks on both sides: half may be at fault
SIGMAS = 4.0  # beyond which a dot's misfit is hardly chance (6e-5): such a dot loses its weight, and no frame is lost
# Square of a centre's shift over that of the misfit, both in sigmas: a disturbance is taken for a shift in one part and
# shows in the other. Of random gleams, shadows, dirt and edges of a hand over dots the largest ratio was 1.96.
HIDDEN_SHARE = 2.0
CHANCE = 1e-6  # of a frame without fault to be refused by its chi-square: one in a thousand recordings of a thousand
SUSPECT = 1e-3  # below this chance a frame's covariance follows its residuals
OUTLYING = 6.0  # times the median reduced chi-square: of 18 degrees of freedom one in 10^14
GREATEST_BLOW = 3.0  # [m/s] by which the disc's velocity may change between two frames: a fall from half a metre
MOST_STRUCK = 0.2  # part of a frame's dots that may be struck as outliers: more, and it is open which are right
_USUAL_MEDIAN = {d: float(chdtri(d, 0.5)) for d in (6, 18)}


def unexpected_misfit(misfit: NDArray[np.floating], n_pixels: NDArray[np.floating]) -> Array:
    """Factor (n, 2, m), at least 1, on the covariance of dots whose surroundings are not as declared.

    misfit : (n, 2, m) reduced chi-square of the grey values about the template, NaN where there is no dot
    n_pixels : (n, 2, m) grey values that it was taken over
    A gleam, a shadow's edge, dirt or a hand raise a dot's misfit over that of the same dot in the frames around (and
    over twice that of the camera's other dots, for what stays). The excess times the number of pixels is the square of
    the disturbance in sigmas; HIDDEN_SHARE times that may be the square of the centre's shift.
    """
    shown, pixels = np.asarray(misfit, float), np.asarray(n_pixels, float)
    own, spread = _usual(shown)
    others = _usual(_nanmedian(np.swapaxes(shown, 1, 2)))[0][..., None]
    expected = np.fmin(own, 2.0 * others)
    with np.errstate(invalid="ignore", divide="ignore"):
        chance = np.maximum(spread / own, np.sqrt(2.0 / pixels)) * expected
        excess = np.where(shown > expected + SIGMAS * chance, shown - expected, 0.0)
        return 1.0 + HIDDEN_SHARE * np.nan_to_num(excess * pixels / np.maximum(shown, 1.0))


def _usual(values: Array) -> tuple[Array, Array]:
    """Running median over time and its robust spread, of values (n, ...) with NaN; same shape, by blocks of frames."""
    n, shape = len(values), values.shape[1:]
    blocks = max(1, int(np.ceil(n / BLOCK)))
    padded = np.full((blocks * BLOCK, int(np.prod(shape, dtype=int))), np.nan)
    padded[:n] = values.reshape(n, -1)
    cut = padded.reshape(blocks, BLOCK, -1)
    with np.errstate(all="ignore"):
        before, after = np.arange(blocks) - 1, np.minimum(np.arange(blocks) + 1, blocks - 1)
        around = np.concatenate([cut[np.maximum(before, 0)], cut, cut[after]], axis=1)
        middle = _nanmedian(around)
        spread = 1.4826 * _nanmedian(np.abs(around - middle[:, None]))
    rows = np.arange(n) // BLOCK
    return middle[rows].reshape(n, *shape), spread[rows].reshape(n, *shape)


def _nanmedian(values: Array) -> Array:
    """Median along axis 1 without NaN; NaN where there is nothing, without a warning."""
    ordered = np.sort(values, axis=1)  # NaN last
    count = np.isfinite(ordered).sum(axis=1)
    low, high = np.maximum(count - 1, 0) // 2, count // 2
    high = np.minimum(high, values.shape[1] - 1)
    take = [np.take_along_axis(ordered, k[:, None], axis=1)[:, 0] for k in (low, high)]
    return np.where(count > 0, 0.5 * (take[0] + take[1]), np.nan)


def outlying_frames(residual_square: Array, dots: NDArray[np.int64]) -> Mask:
    """(n,) True where a frame's dots miss the tracked pose by far more than is usual: it must not teach the others.

    residual_square : (n,) squared residuals of the dots in their sigmas; dots (n,) how many
    What all frames share (printed dots, cameras) shows in all of them; a fault of some frames stands out of the rest.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        reduced = np.where(dots >= 4, residual_square / np.maximum(2 * dots - 6, 1), np.nan)
    if not np.isfinite(reduced).any():
        return np.zeros(len(dots), bool)
    return np.nan_to_num(reduced) > OUTLYING * max(1.0, float(np.nanmedian(reduced)))


@dataclass(frozen=True)
class Verdicts:
    """What the poses of n frames are worth."""

    status: NDArray[np.uint8]  # (n,) MEASURED, or why the pose is refused: REPEATED, CONTRADICTED or JUMPED
    factor: Array  # (n,) on the pose's covariance, at least 1


def judge_poses(fits: PoseFits, repeated: Mask, struck: NDArray[np.int64], period: float, radius: float) -> Verdicts:
    """Judge every pose by its residuals and by the motion of its neighbours.

    fits : with the covariances and chi-squares scaled as they will be told; repeated (n,): both images are those of a
    frame before; struck (n,): dots left out as outliers; period [s] of the frames; radius [m] of the disc
    """
    status = np.full(len(struck), FrameStatus.MEASURED, np.uint8)
    freedom = fits.degrees_of_freedom
    reduced = fits.reduced_chi_square
    # a fault that lasts is usual where it is, but not in the rest of the recording
    most = OUTLYING * max(1.0, float(np.nanmedian(reduced))) if np.isfinite(reduced).any() else 1.0
    usual = np.clip(_usual(reduced[:, None])[0][:, 0], 1.0, most)
    with np.errstate(invalid="ignore"):
        square = fits.chi_square / usual
        chance = np.where(freedom > 0, chdtrc(np.maximum(freedom, 1), square), 1.0)
        factor = np.where(chance < SUSPECT, square / np.maximum(freedom, 1), 1.0)
    left, right = one_sided_jumps(fits)
    moved = np.fmin(np.fmin(left, right), between_neighbours(fits))
    rest = _at_rest(fits)
    # a disc at rest does not tell how smooth its motion will be
    usual_move = _usual(np.where(rest, np.nan, moved)[:, None])[0][:, 0]
    quiet = np.fmax(usual_move / _USUAL_MEDIAN[6], 1.0)
    with np.errstate(invalid="ignore"):
        jumped = moved / quiet > chdtri(6, CHANCE) * 2.0  # the smaller of two, in motion that is not quite steady
    total = fits.used.sum(axis=(1, 2)) + struck
    status[jumped | torn_off(fits, period, radius)] = FrameStatus.JUMPED
    status[(chance < CHANCE) | (struck > np.maximum(MOST_STRUCK * total, 1))] = FrameStatus.CONTRADICTED
    status[repeated & ~_still_over_the_repeats(repeated, rest)] = FrameStatus.REPEATED
    status[~fits.converged] = FrameStatus.MEASURED  # nothing to judge
    return Verdicts(status, np.maximum(np.nan_to_num(factor, nan=1.0), 1.0))


def one_sided_jumps(fits: PoseFits) -> tuple[Array, Array]:
    """Squared distance (n,) of each pose, in its sigmas, from where its predecessors and its successors lead.

    The quadratic through three neighbours on one side is carried on by a frame. A blow changes the velocity between two
    frames, so each of them agrees with its own side; a pose that agrees with neither lies on no motion. NaN where there
    is no pose, or no three neighbours on that side.
    """
    return _jumps_from(fits, -1), _jumps_from(fits, 1)


def between_neighbours(fits: PoseFits) -> Array:
    """Squared distance (n,) of each pose, in its sigmas, from the cubic through two neighbours on either side.

    It follows a motion that changes quickly from frame to frame far better than what is carried on from one side; only
    a blow within these five frames is not smooth enough. NaN where a neighbour has no pose.
    """
    n, R, t, C = len(fits.converged), fits.R_world_body, fits.t_world_body, fits.covariance
    square = np.full(n, np.nan)
    rows = np.arange(2, n - 2)
    near = rows[:, None] + np.array([-2, -1, 1, 2])
    good = fits.converged[near].all(axis=1) & fits.converged[rows]
    rows, near = rows[good], near[good]
    if not len(rows):
        return square
    weights = np.array([-1.0, 4.0, 4.0, -1.0]) / 6.0
    turn = vector_from_rotation(R[near] @ np.swapaxes(R[rows], 1, 2)[:, None])  # from the frame itself
    shift = t[near] - t[rows][:, None]
    away = np.einsum("k,nki->ni", weights, np.concatenate([shift, turn], axis=2))
    spread = C[rows] + np.einsum("k,nkij->nij", weights**2, C[near])
    square[rows] = np.einsum("ni,ni->n", away, np.linalg.solve(spread, away[..., None])[..., 0])
    return square


def _jumps_from(fits: PoseFits, side: int) -> Array:
    """(n,) as `one_sided_jumps`, from the neighbours before (side -1) or after (1); NaN where three are not there."""
    n, R, t, C = len(fits.converged), fits.R_world_body, fits.t_world_body, fits.covariance
    square = np.full(n, np.nan)
    rows = np.arange(3, n) if side < 0 else np.arange(n - 3)
    near = rows[:, None] + side * np.arange(4)  # (k, 4): the frame itself, and three on the side
    rows, near = (part[fits.converged[near].all(axis=1)] for part in (rows, near))
    if not len(rows):
        return square
    i, a, b, c = near.T
    turn = vector_from_rotation(R[near] @ np.swapaxes(R[a], 1, 2)[:, None])  # from the nearest neighbour
    away = np.concatenate([t[i] - (3 * t[a] - 3 * t[b] + t[c]), turn[:, 0] + 3 * turn[:, 2] - turn[:, 3]], axis=1)
    spread = C[i] + 9 * C[a] + 9 * C[b] + C[c]
    square[rows] = np.einsum("ni,ni->n", away, np.linalg.solve(spread, away[..., None])[..., 0])
    return square


def torn_off(fits: PoseFits, period: float, radius: float) -> Mask:
    """(n,) True for frames that no motion joins to their neighbours, where the neighbours are the more.

    Between two frames the disc may be hit: its centre's velocity changes by GREATEST_BLOW, its turn by that over the
    radius. A pose farther than that from where the two frames before lead begins another motion; of two motions that
    meet, one is false: the shorter one.
    """
    n, R, t = len(fits.converged), fits.R_world_body, fits.t_world_body
    good = fits.converged
    near = np.arange(2, n)
    near = near[good[near] & good[near - 1] & good[near - 2]]
    torn = np.zeros(n + 1, bool)
    if len(near):
        a, b = near - 1, near - 2
        shift = np.linalg.norm(t[near] - 2 * t[a] + t[b], axis=1)
        carried = R[a] @ np.swapaxes(R[b], 1, 2) @ R[a]
        turn = np.linalg.norm(vector_from_rotation(R[near] @ np.swapaxes(carried, 1, 2)), axis=1)
        noise = 6.0 * np.sqrt(np.trace(fits.covariance[near, :3, :3], axis1=1, axis2=2))
        reach = GREATEST_BLOW * period
        torn[near] = (shift > reach + noise) | (turn > reach / radius + noise / radius)
    # the frame after a tear has no velocity yet: what leads on from it is not held against the motion before the tear
    starts = np.flatnonzero(torn[:-1] & ~np.r_[False, torn[:-2]])
    edges = np.unique(np.r_[0, starts, n])
    length = np.diff(edges)
    refused = np.zeros(n, bool)
    for start in starts:  # a handful, if any
        piece = int(np.searchsorted(edges, start))
        shorter = piece if length[piece] < length[piece - 1] else piece - 1
        refused[edges[shorter] : edges[shorter + 1]] = True
    return refused & good


def _still_over_the_repeats(repeated: Mask, rest: Mask) -> Mask:
    """(n,) True in repeats of a disc that lies still; False where a recorder stuck while the disc moved.

    One repeat is still where the frames around it are. In a longer run the frames in between are alike whatever the
    disc did: it is still where rest, or the recording's end, lies on one side of it.
    """
    n = len(repeated)
    edges = np.flatnonzero(np.diff(np.r_[False, repeated, False].astype(int)))
    still = np.zeros(n, bool)
    for first, end in edges.reshape(-1, 2):  # a handful, if any
        before, after = first - 2, end  # `rest` of a frame is about the frames on both sides of it
        alone = end - first == 1
        still[first:end] = rest[first] if alone else before < 0 or after >= n or rest[before] or rest[after]
    return still


def _at_rest(fits: PoseFits) -> Mask:
    """(n,) True where the poses before and after differ by no more than their noise: then a repeat shows no fault."""
    n, rest = len(fits.t_world_body), np.zeros(len(fits.t_world_body), bool)
    if n < 3:
        return rest
    t, R, C = fits.t_world_body, fits.R_world_body, fits.covariance
    step = np.column_stack([t[2:] - t[:-2], vector_from_rotation(R[2:] @ np.swapaxes(R[:-2], 1, 2))])
    good = np.isfinite(step).all(axis=1)
    square = np.einsum("ni,ni->n", step[good], np.linalg.solve((C[2:] + C[:-2])[good], step[good][..., None])[..., 0])
    rest[np.flatnonzero(good) + 1] = square < chdtri(6, SUSPECT)
    rest[-1] = rest[-2]
    return rest
