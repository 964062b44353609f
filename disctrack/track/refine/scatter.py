"""Scatter of the dots about the fitted poses, and of the poses about a smooth motion.

**Dots**, with all shared parameters free: cameras, printed dots, clock. A camera that was moved or that lags causes
residuals many times the noise. If they counted as noise, they would hide every smaller effect and the fault itself, and
the dots would be displaced to compensate. So the noise of the dots is the residual of a free refinement of the two
cameras, the positions of the dots and the delay of the right camera, with one pose per frame. Slow or systematic errors
are absorbed, and no model of the motion is needed.

**Poses**, as common errors of the dots leave no residual: a vibrating camera or table, an encoder that moves blocks of
the image together. The motion is smooth, and any other part of the poses is noise, whatever the dots say. Sixth
differences amplify white noise by 30 (rms), and reduce a precession by an angle a per frame to a^6: at SLOW, 0.3 um of
5 mm. So only frames with slower precession are used.
"""

from dataclasses import dataclass

import numpy as np
import scipy

from calibration.cameras.camera import INTRINSIC_PARAMETERS, N_RIG, PAIR_SHIFT
from calibration.kit.types import Array, Indices
from disctrack.analyse.derivatives import CHANNELS
from disctrack.track.judge.outlier_tests import differences, sums_over_time
from disctrack.track.pose import DotsInFrames, PoseFits, whitening
from disctrack.track.refine.self_calibration import DOT_SIGMA, AsBuilt, fit_shared
from disctrack.track.side_by_side import MIN_FRAMES, SHARED_FRAMES, SURE, evenly

LEAST_NOISE = 0.25  # of the residual variance of the templates: the rest may be fixed-pattern noise
# Prior sigmas of the errors of a camera: far larger than in any useful rig, and small enough to bound what the dots do
# not determine. [px, 1]; rotations [rad] and translations [m]; the delay is free within a frame period.
_WIDE = {"fx": 20.0, "fy": 20.0, "cx": 10.0, "cy": 10.0, "k1": 0.05, "k2": 0.2, "k3": 0.5, "p1": 5e-3, "p2": 5e-3}
_WIDE_POSE = np.repeat([0.02, 0.01], 3)
SLOW = 0.2  # [rad] of precession from frame to frame
KEPT = 0.8  # fraction of the squares: the largest, with blows and motion blur, are trimmed
# Successive sixth differences are correlated by -0.86, 0.54, -0.24, ...: n of them are equivalent to n / 3.2
# independent ones (sum of the squared correlations); after trimming, to n / 4.5 (4000 samples of white noise).
WORTH = 4.5


def without_shared_faults(frames: DotsInFrames) -> AsBuilt | None:
    """The dots refined together with cameras and delay, with a free pose for each frame.

    None if fewer than MIN_FRAMES frames are complete together with both neighbours.
    """
    rig, disc = frames.rig, frames.disc
    complete = np.asarray(np.isfinite(frames.pixels).all((1, 2, 3)) & frames.posed)
    rows = evenly(np.flatnonzero(complete[:-2] & complete[1:-1] & complete[2:]) + 1, SHARED_FRAMES)
    if len(rows) < MIN_FRAMES:
        return None
    m = disc.n_markers
    camera = [_WIDE[name] for name in INTRINSIC_PARAMETERS]
    wide = np.concatenate([camera, camera, _WIDE_POSE, _WIDE_POSE, np.full(2 * m, DOT_SIGMA), [1.0]])
    wide[:N_RIG] *= (np.diag(rig.covariance) > 0) & (np.arange(N_RIG) < PAIR_SHIFT.stop)
    shift, covariance, _, last = fit_shared(frames.delayed(rows), wide)
    dots = slice(N_RIG, N_RIG + 2 * m)
    _, fits = last.fitted(True, shift)
    spent = int(fits.degrees_of_freedom[fits.converged].sum())
    reduced = trimmed_reduced_chi_square(fits) * spent / max(spent - int(np.count_nonzero(wide)), 1)
    return AsBuilt.moved(rig, disc, shift[dots].reshape(m, 2), covariance[dots, dots], reduced)


@dataclass(frozen=True)
class Scatter:
    """Variance of the dots about the fitted poses over the prediction by image noise, and its components."""

    whole: float  # at least 1
    free: float  # with free cameras, dots and delay; at least 1
    noise: float  # independent from frame to frame
    systematic: float  # the rest, which repeats or varies slowly
    systematic_px: tuple[float, float]  # rms of the rest per axis, left and right camera


def split_scatter(fits: PoseFits, markers_covariance_px2: Array, by_free_cameras: float | None) -> Scatter:
    """Split the residuals of the dots into noise and systematic misfit.

    by_free_cameras : reduced chi-square of `without_shared_faults`, if known
    Without complete triples of successive frames, all residuals of the free refinement count as noise.
    """
    whole = trimmed_reduced_chi_square(fits)
    free = max(1.0, whole if by_free_cameras is None else by_free_cameras)
    noise = frame_to_frame_chi_square(fits, markers_covariance_px2)
    if noise is None:
        whole = max(1.0, whole)
        noise = min(whole, free)
    noise = max(noise, LEAST_NOISE)
    # three sigmas of chance: both are means over n frames, but overlapping triples have half the information
    freedom = max(float(np.sum(fits.degrees_of_freedom[fits.degrees_of_freedom >= 6])), 1.0)
    by_chance = SURE * noise * np.sqrt(6.0 / freedom)
    systematic = whole - noise if whole - noise > by_chance else 0.0
    share = systematic / max(whole, noise) * 2 * float(fits.used.sum()) / freedom  # the poses absorb part of it
    seen = (fits.residuals_px[:, camera][fits.used[:, camera]] for camera in (0, 1))  # empty if it sees no dot
    # robust: the median square of a normal distribution is 0.455 times the variance
    left, right = (float(np.sqrt(np.median(one**2) / 0.455 * share)) if one.size else 0.0 for one in seen)
    return Scatter(max(1.0, whole), free, noise, systematic, (left, right))


def frame_to_frame_chi_square(fits: PoseFits, markers_covariance_px2: Array) -> float | None:
    """Reduced chi-square of the dots by changes from frame to frame alone; None if too few frames qualify.

    Second differences in time of the residuals about the fitted poses, (r[i-1] - 2 r[i] + r[i+1]) / sqrt(6), contain
    the full noise of single frames. They exclude errors that repeat or vary slowly (lens beyond its polynomial,
    misprinted dots, gradients of light), and the motion, as every frame has its own pose.
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
    """Mean reduced chi-square of the frames, without the worst 5 % (motion blur, objects in view)."""
    reduced = fits.reduced_chi_square[fits.degrees_of_freedom >= 6]
    return 1.0 if len(reduced) < MIN_FRAMES else _trimmed_mean(reduced)


def _trimmed_mean(reduced: Array) -> float:
    # trimming lowers the mean by 4 % (18 degrees of freedom)
    return float(np.sort(reduced)[: int(0.95 * len(reduced))].mean() / 0.96)


def scatter_of_poses(fits: PoseFits) -> tuple[Array, Array, Array]:
    """Variance of the poses from frame to frame over the prediction by their covariances, from sixth differences.

    returns : (4,) the ratio, by CHANNELS, NaN if too few frames are slow enough; (4,) its sigma by chance; (6,) factors
        on the variances of POSE_COMPONENTS, at least 1: the significant part of the excess
    """
    found, sigma, factor = np.full(4, np.nan), np.full(4, np.nan), np.ones(6)
    rows, away, spread = sums_over_time(fits, differences(6, -3))
    slow = _precession(fits.R_world_body, rows) < SLOW
    square = away[slow] ** 2 / np.diagonal(spread[slow], axis1=1, axis2=2)
    if len(square) < 8 * WORTH:  # with so few independent ones the variance doubles by chance now and then
        return found, sigma, factor
    # mean of the trimmed chi-square distribution with one degree of freedom
    mean = scipy.special.chdtr(3, scipy.special.chdtri(1, 1 - KEPT)) / KEPT
    kept = np.sort(square, axis=0)[: int(KEPT * len(square))].mean(axis=0) / mean
    for i, part in enumerate(CHANNELS.values()):
        found[i], sigma[i] = kept[part].mean(), np.sqrt(2 * WORTH / (len(square) * len(part)))
        excess = found[i] - 1.0
        # no excess below three sigmas, all of it far above
        factor[part] = 1.0 + max(excess - (SURE * sigma[i]) ** 2 / excess, 0.0) if excess > 0 else 1.0
    return found, sigma, factor


def _precession(R: Array, rows: Indices) -> Array:
    """Largest precession [rad per frame] in the seven frames around each of the rows."""
    axis = R[rows[:, None] + np.arange(-3, 4), :2, 2]
    tilt = np.linalg.norm(axis, axis=2)
    with np.errstate(divide="ignore", invalid="ignore"):
        # the precession of a disc that lies flat is not defined, and does not count as slow
        turn = 2.0 * np.linalg.norm(np.diff(axis, axis=1), axis=2) / (tilt[:, 1:] + tilt[:, :-1])
    return np.asarray(turn.max(axis=1))
