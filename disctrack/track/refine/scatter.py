"""How much the dots scatter about their poses, and the poses from frame to frame beside what their dots tell.

**Dots**, once everything that the frames share may be wrong: cameras, printed dots, clock. A camera that was moved or
that lags leaves residuals many times the noise. Taken for noise they would hide every effect that is smaller, the fault
itself included, and dots would be moved to make up for it. So the noise of the dots is what remains after a free
refinement of the two cameras, the dots' places and the delay of the right camera, with one pose per frame: nothing slow
or systematic can pass it, and it needs no model of the motion.

**Poses**, as dots that err alike leave no residual: a camera or table that trembles, an encoder that moves blocks of
the image together. The motion tells: it is smooth, and what it is not is noise, whatever the dots say. In sixth
differences of the poses white noise is 30 times itself, and what precesses by an angle a per frame is a^6 of itself: at
SLOW, 0.3 um of 5 mm. So only frames are counted between which the disc precesses by less.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from calibration.cameras.camera import INTRINSIC_PARAMETERS, N_RIG, PAIR_SHIFT
from calibration.kit.arrays import Array
from disctrack.analyse.derivatives import CHANNELS
from disctrack.track.judge.outlier_tests import differences, sums_over_time
from disctrack.track.pose import DotsInFrames, PoseFits, whitening
from disctrack.track.refine.self_calibration import DOT_SIGMA, AsBuilt, fit_shared
from disctrack.track.side_by_side import MIN_FRAMES, SHARED_FRAMES, evenly

LEAST_NOISE = 0.25  # of the variance that the templates leave: the rest may be the pixels' fixed pattern
# How far a camera may be off: far more than any that is still of use, and enough to bound what the disc does not tell.
# [px, 1]; rotations [rad] and translations [m]; the delay is free within a frame period.
_WIDE = {"fx": 20.0, "fy": 20.0, "cx": 10.0, "cy": 10.0, "k1": 0.05, "k2": 0.2, "k3": 0.5, "p1": 5e-3, "p2": 5e-3}
_WIDE_POSE = np.repeat([0.02, 0.01], 3)
SLOW = 0.2  # [rad] of precession from frame to frame
KEPT = 0.8  # of the squares: blows and smears are cut off with the largest
# Successive sixth differences are correlated by -0.86, 0.54, -0.24, ...: n tell as much as n / 3.2 independent ones
# (the sum of the squared correlations); without those that are cut off, n / 4.5 (4000 samples of white noise).
WORTH = 4.5


def without_shared_faults(frames: DotsInFrames) -> AsBuilt | None:
    """The dots refined together with cameras and delay, with a free pose for each of n successive frames.

    None if fewer than MIN_FRAMES frames, with both their neighbours, are complete.
    """
    rig, disc, pixels = frames.rig, frames.disc, frames.pixels
    complete = np.asarray(np.isfinite(pixels).all((1, 2, 3)) & frames.posed)
    rows = evenly(np.flatnonzero(complete[:-2] & complete[1:-1] & complete[2:]) + 1, SHARED_FRAMES)
    if len(rows) < MIN_FRAMES:
        return None
    by_delay = 0.5 * (pixels[rows + 1] - pixels[rows - 1])  # per frame period
    by_delay[:, 0] = 0.0

    m = disc.n_markers
    camera = [_WIDE[name] for name in INTRINSIC_PARAMETERS]
    wide = np.concatenate([camera, camera, _WIDE_POSE, _WIDE_POSE, np.full(2 * m, DOT_SIGMA), [1.0]])
    wide[:N_RIG] *= (np.diag(rig.covariance) > 0) & (np.arange(N_RIG) < PAIR_SHIFT.stop)
    shift, covariance, _, last = fit_shared(replace(frames.at(rows), further=by_delay[..., None]), wide)
    dots = slice(N_RIG, N_RIG + 2 * m)
    _, fits = last.fitted(shift, reject=True)
    spent = int(fits.degrees_of_freedom[fits.converged].sum())
    reduced = trimmed_reduced_chi_square(fits) * spent / max(spent - int(np.count_nonzero(wide)), 1)
    return AsBuilt.moved(rig, disc, shift[dots].reshape(m, 2), covariance[dots, dots], reduced)


@dataclass(frozen=True)
class Scatter:
    """Variance of the dots about the fitted poses over what the image noise predicts, and what it is made of."""

    whole: float  # at least 1
    free: float  # at least 1, where cameras, dots and delay are free
    noise: float  # from one frame to the next
    systematic: float  # the rest: repeats, or varies slowly
    systematic_px: tuple[float, float]  # rms of that rest per axis, left and right camera


def split_scatter(fits: PoseFits, markers_covariance_px2: Array, by_free_cameras: float | None) -> Scatter:
    """What the dots do not fit, as noise and as what repeats.

    by_free_cameras : reduced chi-square of `without_shared_faults`, if that is known
    Where no three successive frames are complete, all that passes a refinement of what frames share is noise.
    """
    whole = trimmed_reduced_chi_square(fits)
    free = max(1.0, whole if by_free_cameras is None else by_free_cameras)
    noise = frame_to_frame_chi_square(fits, markers_covariance_px2)
    if noise is None:
        whole = max(1.0, whole)
        noise = min(whole, free)
    noise = max(noise, LEAST_NOISE)
    # chance alone: both are means over n frames, the second differences of overlapping triples tell half as much
    freedom = float(np.sum(fits.degrees_of_freedom[fits.degrees_of_freedom >= 6]))
    by_chance = 3.0 * noise * np.sqrt(6.0 / max(freedom, 1.0))
    systematic = whole - noise if whole - noise > by_chance else 0.0
    systematic_px = 0.0, 0.0
    if systematic:
        share = systematic / whole * 2 * float(fits.used.sum()) / freedom  # the poses take their part of the residuals
        seen = (fits.residuals_px[:, camera][fits.used[:, camera]] for camera in (0, 1))  # nothing: it sees no dot
        # of a normal distribution the median square is 0.455 variances; smears and objects in view do not count
        left, right = (float(np.sqrt(np.median(one**2) / 0.455 * share)) if one.size else 0.0 for one in seen)
        systematic_px = left, right
    return Scatter(max(1.0, whole), free, noise, systematic, systematic_px)


def frame_to_frame_chi_square(fits: PoseFits, markers_covariance_px2: Array) -> float | None:
    """Reduced chi-square of the dots by what changes from one frame to the next alone; None where too few tell.

    Second differences in time of the residuals about the fitted poses, (r[i-1] - 2 r[i] + r[i+1]) / sqrt(6), hold the
    noise of single frames in full. What repeats, or changes slowly beside the frame rate, is not in them: the lens
    beyond its polynomial, misprinted dots, gradients of light. The motion is not either, as every frame has its pose.
    """
    same = (fits.used[:-2] & fits.used[1:-1] & fits.used[2:]).sum((1, 2)) * 2 - 6
    steady = (fits.used[:-2] == fits.used[1:-1]).all((1, 2)) & (fits.used[2:] == fits.used[1:-1]).all((1, 2))
    rows = np.flatnonzero(steady & (same >= 6))
    if len(rows) < MIN_FRAMES:
        return None
    used, r = fits.used[rows][..., None], fits.residuals_px
    bend = np.where(used, r[rows] - 2.0 * r[rows + 1] + r[rows + 2], 0.0)
    whitened = (whitening(markers_covariance_px2[rows + 1]) @ bend[..., None])[..., 0]
    return _trimmed_mean(np.sum(whitened**2, axis=(1, 2, 3)) / (6.0 * same[rows]))


def trimmed_reduced_chi_square(fits: PoseFits) -> float:
    """Mean reduced chi-square of the frames, without the twentieth that fits worst (smears, objects in view)."""
    reduced = fits.reduced_chi_square[fits.degrees_of_freedom >= 6]
    return 1.0 if len(reduced) < MIN_FRAMES else _trimmed_mean(reduced)


def _trimmed_mean(reduced: Array) -> float:
    kept = np.sort(reduced)[: int(0.95 * len(reduced))]
    # the 5 % that are cut hold more than 5 % of the sum: 18 degrees of freedom lose 4 % of their mean
    return float(kept.mean() / 0.96)


def scatter_of_poses(fits: PoseFits) -> tuple[Array, Array, Array]:
    """Variance of the poses from frame to frame over what their dots, as the covariances have it, tell.

    From sixth differences: (4,) found, by CHANNELS, NaN where no frames are slow enough; (4,) its sigma by chance;
    (6,) at least 1, for the variances of POSE_COMPONENTS: the part of the excess that is no chance.
    """
    found, sigma, factor = np.full(4, np.nan), np.full(4, np.nan), np.ones(6)
    rows, away, spread = sums_over_time(fits, differences(6, -3))
    slow = _precession(fits.R_world_body, rows) < SLOW
    square = away[slow] ** 2 / np.diagonal(spread[slow], axis1=1, axis2=2)
    if len(square) < 8 * WORTH:  # the variance of so few independent ones chance alone doubles now and then
        return found, sigma, factor
    # what is kept of chi-square with one degree of freedom has this mean
    mean = scipy.special.chdtr(3, scipy.special.chdtri(1, 1 - KEPT)) / KEPT
    kept = np.sort(square, axis=0)[: int(KEPT * len(square))].mean(axis=0) / mean
    for i, part in enumerate(CHANNELS.values()):
        found[i], sigma[i] = kept[part].mean(), np.sqrt(2 * WORTH / (len(square) * len(part)))
        excess = found[i] - 1.0
        # nothing below three sigmas, all of what is far above
        factor[part] = 1.0 + max(excess - (3.0 * sigma[i]) ** 2 / excess, 0.0) if excess > 0 else 1.0
    return found, sigma, factor


def _precession(R: Array, rows: NDArray[np.intp]) -> Array:
    """Largest angle [rad] per frame by which the disc's axis turns about the vertical, in the seven frames around."""
    axis = R[rows[:, None] + np.arange(-3, 4), :2, 2]
    tilt = np.linalg.norm(axis, axis=2)
    with np.errstate(divide="ignore", invalid="ignore"):
        # a disc that lies flat has no direction to precess in, and none is measured: it is not slow
        turn = 2.0 * np.linalg.norm(np.diff(axis, axis=1), axis=2) / (tilt[:, 1:] + tilt[:, :-1])
    return np.asarray(turn.max(axis=1))
