"""From what was followed to the trajectory: what all frames share is refined, all poses are fitted and judged."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from calibration.cameras.camera import StereoRig
from calibration.cameras.causes import causes
from calibration.kit.arrays import Array, Mask
from calibration.kit.least_squares import normal_of_rows
from disctrack import frames
from disctrack.disc import Disc
from disctrack.findings import Finding
from disctrack.track.dots.template import NoiseModel, TemplateLimits
from disctrack.track.dots.template_response import Pull
from disctrack.track.follow.following import Follower, Tables, TrackingSetup, repeats
from disctrack.track.judge.doubts import FAULTY, doubts_of, repeated_images
from disctrack.track.judge.dropped_frames import delay_of_right, dropped_frames
from disctrack.track.judge.outlier_tests import Verdicts, judge_poses, outlying_frames, unexpected_misfit
from disctrack.track.pose import PoseFits, fit_poses, misses
from disctrack.track.refine.exposure import Exposure, exposure_by_smear, exposure_of, shift_by_exposure
from disctrack.track.refine.glare import shift_by_gleam
from disctrack.track.refine.intrinsic_scatter import Scatter, SharedFaults, split_scatter, without_shared_faults
from disctrack.track.refine.pose_scatter import PoseScatter, scatter_of_poses
from disctrack.track.refine.self_calibration import (
    AsBuilt,
    motions_of_pattern,
    pattern_place,
    refine_as_built,
    share_of_places,
)
from disctrack.track.refine.table_contact import OF_PATTERN, TableFromDisc, table_from_disc
from disctrack.track.side_by_side import side_by_side
from disctrack.trajectory import FrameStatus, MarkerStatus, Trajectory

MIN_GOOD_DOT_IMAGES = 6
FITTED_AT_ONCE = 512  # frames, whose numbers stay in a core's cache
SHARED_FRAMES = 400  # that enter the refinement of what all frames share: SYSTEMATIC_PX bounds what more could add


@dataclass(frozen=True)
class TrackingSettings:
    """What a user may choose; the whole of it is written into the result."""

    limits: TemplateLimits = field(default_factory=TemplateLimits)
    refine_markers: bool = True  # the dots' places on the disc, over the whole sequence
    refine_rig: bool = (
        False  # the rig within its own calibration covariance; hides a camera that moved, so not by default
    )
    reject_outliers: bool = True
    table: str = "both"  # board, disc or both: what tells where the table is (table_contact.py)
    search_always: bool = False  # at every frame where the disc is lost, whatever it costs: for single, unrelated poses
    exposure: tuple[float, float] | None = None  # [s] of the left and the right camera; None: as the dots' smear tells
    first_pass: bool = True  # leave out what lies still before the motion starts and after it ends (first_pass.py)


@dataclass(frozen=True)
class Tracking:
    """A trajectory and what the run found out on the way."""

    trajectory: Trajectory
    noise: tuple[NoiseModel, NoiseModel]  # left, right
    blur_px: tuple[float, float]
    as_built: AsBuilt
    variance_factor: float  # scatter of the dots about the fitted poses over what the image noise predicts, squared
    noise_factor: float  # the part of it that changes from frame to frame (`own_scatter`), by which the covariances of
    # dots and poses are multiplied; what is left of the other makes `Trajectory.systematic_covariance`
    pose_scatter: PoseScatter  # of the poses about a smooth motion, beyond what the dots tell
    systematic_px: tuple[float, float]  # rms per axis of what repeats in the dots' misfit, left and right camera
    shared_sigma: tuple[tuple[float, str], ...]  # x, y, z [m], turns [rad]: what frames share, most of it from what
    table: TableFromDisc | None  # the plane that the rim touched; None without a table, or a rim that touched it
    exposure: Exposure  # that the dots were moved by
    acquisitions: int  # times the disc had to be searched for without a prior and was found
    findings: tuple[Finding, ...]


@dataclass(frozen=True)
class Taken:
    """When the pairs were taken, and under which gravity."""

    pairs: range
    time: Array  # (n,) [s]
    frame_rate: float  # [Hz]
    gravity: float  # [m/s^2]


def assemble(
    followers: list[Follower], tables: Tables, settings: TrackingSettings, taken: Taken, workers: int = 1
) -> Tracking:
    """Trajectory of frames that were followed in one piece or in several; alters `tables`, which nobody else holds.

    workers : threads; the result is the same to the last bit for any number of them
    """
    first = next((follower for follower in followers if follower.measured), followers[0])
    repeated = repeats(tables.digest)
    exposure = _as_they_were(tables, first, settings, taken, workers)
    _clean(tables, repeated, first.setup.rig)
    as_built, faults, outlying = _shared(tables, first.setup, settings, workers)
    fits = _fit_all(tables, as_built, settings.reject_outliers, workers)
    fits, systematic, scatter = _scattered(fits, tables, faults, outlying)
    seen = fits, tables.pixels, tables.covariance_px2, as_built.rig, as_built.disc.marker_centres_body
    delay = partial(delay_of_right, *seen, np.flatnonzero(fits.converged))
    fits, verdicts, slips = _judged(fits, tables, as_built, repeated, outlying, taken, workers)
    fits, systematic, as_built, table = _on_the_table(fits, systematic, as_built, settings.table)
    # after the table: what poses scatter beside their dots need not be white, and frames do not average it there
    poses = scatter_of_poses(fits)
    fits.covariance[...] *= np.sqrt(np.outer(poses.factor, poses.factor))
    shared = _shared_sigma(fits, systematic, as_built)
    trajectory = _trajectory(fits, verdicts, systematic, tables, as_built, taken)
    if table is not None:
        trajectory = replace(trajectory, table_moved=table.beyond)
    doubts = doubts_of(first, faults, scatter, poses, table, trajectory, delay)
    return Tracking(
        trajectory=trajectory,
        noise=first.law.noise,
        blur_px=first.law.blur,
        as_built=as_built,
        variance_factor=scatter.whole,
        noise_factor=scatter.noise,
        pose_scatter=poses,
        shared_sigma=shared,
        systematic_px=scatter.systematic_px,
        table=table,
        exposure=exposure,
        acquisitions=sum(f.acquisitions for f in followers),
        findings=(*repeated_images(repeated, taken.pairs), *slips, *exposure.findings, *doubts),
    )


def _as_they_were(tables: Tables, first: Follower, settings: TrackingSettings, taken: Taken, workers: int) -> Exposure:
    """Move the dots to where they were in the middle of the exposure but for gleams, and tell by which exposure."""
    where, rig, disc = (tables.R, tables.t, taken.time), first.setup.rig, first.setup.disc
    found = exposure_by_smear(*where, tables.blur_px, rig, disc, workers)
    exposure = exposure_of(found, settings.exposure, 1 / taken.frame_rate)
    law = first.law
    left, right = (Pull(*seen) for seen in zip(law.blur, law.light, law.noise, strict=True))
    tables.pixels -= shift_by_gleam(tables.R, tables.t, tables.contrast, rig, disc, (left, right))
    if any(exposure.seconds):
        tables.pixels -= shift_by_exposure(*where, np.array(exposure.seconds), rig, disc, (left, right))
    return exposure


def _clean(tables: Tables, repeated: Mask, rig: StereoRig) -> None:
    """Take out dots of images (n, 2) that are copies of others, state misfits beyond noise, take off the lens field."""
    alone = repeated & ~repeated.all(axis=1, keepdims=True)
    tables.pixels[alone] = np.nan  # over the edges of stretches, too
    tables.status[alone] = MarkerStatus.NOT_LOOKED_FOR
    tables.covariance_px2 *= unexpected_misfit(tables.misfit, tables.n_pixels)[..., None, None]
    if rig.lens_field is not None:
        tables.pixels = rig.lens_field.corrected(tables.pixels)


def _shared(
    tables: Tables, setup: TrackingSetup, settings: TrackingSettings, workers: int
) -> tuple[AsBuilt, SharedFaults | None, Mask]:
    """What the frames share, what is wrong with it, and which frames (n,) are outlying and do not enter."""
    outlying = _outlying(tables, setup.rig, setup.disc, workers)
    as_built, faults = _refined(tables, setup, settings, outlying, workers)
    if faults is not None:  # misprinted dots raise the misfit of all frames, and hide faults of some
        centres = setup.disc.marker_centres_body + faults.marker_shift
        more = _outlying(tables, setup.rig, replace(setup.disc, marker_centres_body=centres), workers) & ~outlying
        if more.any():
            outlying |= more
            as_built, faults = _refined(tables, setup, settings, outlying, workers)
    if settings.refine_markers and faults is not None:
        as_built = _without_false_shifts(as_built, setup.rig, setup.disc, faults)
    return as_built, faults, outlying


def _refined(
    tables: Tables, setup: TrackingSetup, settings: TrackingSettings, outlying: Mask, workers: int
) -> tuple[AsBuilt, SharedFaults | None]:
    """Dots and rig as built, and the faults that frames share, from those that are not outlying (n,)."""
    R, t = (np.where(outlying.reshape(-1, *[1] * (part.ndim - 1)), np.nan, part) for part in (tables.R, tables.t))
    seen = tables.pixels, tables.covariance_px2, setup.rig, setup.disc, R, t
    as_built = partial(refine_as_built, refine_markers=settings.refine_markers, refine_rig=settings.refine_rig)
    faults = partial(without_shared_faults, workers=workers)
    refinements: tuple[Callable[..., Any], ...] = (faults, as_built)  # the longer one first
    found, built = side_by_side(lambda refine: refine(*seen, max_frames=SHARED_FRAMES), refinements, workers)
    return built, found


def _scattered(
    fits: PoseFits, tables: Tables, faults: SharedFaults | None, outlying: Mask
) -> tuple[PoseFits, Array, Scatter]:
    """Poses and dots with covariances of the noise they have, the part (n, 6, 6) that repeats, and what was found."""
    ordinary = replace(
        fits,
        degrees_of_freedom=np.where(outlying, 0, fits.degrees_of_freedom),
        used=fits.used & ~outlying[:, None, None],
    )
    scatter = split_scatter(ordinary, tables.covariance_px2, faults)
    tables.covariance_px2 *= scatter.noise  # in place: nobody else holds them
    systematic = fits.covariance * scatter.systematic
    fits.covariance[...] *= scatter.noise
    return replace(fits, chi_square=fits.chi_square / scatter.whole), systematic, scatter


def _judged(
    fits: PoseFits, tables: Tables, as_built: AsBuilt, repeated: Mask, outlying: Mask, taken: Taken, workers: int
) -> tuple[PoseFits, Verdicts, tuple[Finding, ...]]:
    """Poses without those that are refused, what each is worth, and exchanged images in words."""
    struck = (np.isfinite(tables.pixels).all(-1) & ~fits.used).sum(axis=(1, 2)) * fits.converged
    verdicts = judge_poses(
        fits, np.asarray(repeated.all(axis=1)), struck, outlying, 1 / taken.frame_rate, as_built.disc.radius, workers
    )
    contradicted = verdicts.status == FrameStatus.CONTRADICTED
    centres = as_built.disc.marker_centres_body
    slips = dropped_frames(contradicted, fits, tables.pixels, tables.covariance_px2, as_built.rig, centres, taken.pairs)
    fits.covariance[...] *= verdicts.factor[:, None, None]
    return replace(fits, converged=fits.converged & (verdicts.status == FrameStatus.MEASURED)), verdicts, slips


def _on_the_table(
    fits: PoseFits, systematic: Array, as_built: AsBuilt, source: str
) -> tuple[PoseFits, Array, AsBuilt, TableFromDisc | None]:
    """Poses, rig and what frames share (n, 6, 6) in the axes of the table that the rim touched, and that table."""
    misplaced = pattern_place(as_built.disc, as_built.marker_shift, as_built.marker_shift_sigma)[0] > 0
    by_pattern = _by_pattern(as_built, fits.R_world_body) if misplaced else None
    fits, systematic, rig, table = table_from_disc(fits, systematic, as_built.rig, as_built.disc, source, by_pattern)
    if by_pattern is not None:
        for first_row in range(0, len(systematic), FITTED_AT_ONCE):
            part = by_pattern[first_row : first_row + FITTED_AT_ONCE]
            systematic[first_row : first_row + FITTED_AT_ONCE] += part @ part.swapaxes(1, 2)
    return fits, systematic, replace(as_built, rig=rig), table


def _outlying(tables: Tables, rig: StereoRig, disc: Disc, workers: int) -> Mask:
    """(n,) True where the dots miss the pose that was tracked, after one more step, by far more than in others."""
    n = len(tables.t)
    residuals = np.full(tables.pixels.shape, np.nan)

    def fill(first: int) -> None:
        rows = slice(first, first + FITTED_AT_ONCE)
        r, J, known = misses(
            tables.pixels[rows],
            tables.covariance_px2[rows],
            rig,
            disc.marker_centres_body,
            tables.R[rows],
            tables.t[rows],
        )
        rows_of_each = np.concatenate([J, r[..., None]], axis=-1).reshape(len(r), -1, 7)
        # a trace of damping costs a tenth of the pseudo-inverse where data leave a combination open
        step = normal_of_rows(rows_of_each, 6).step(1e-10)[1]
        residuals[rows] = np.where(known[..., None], r - (J @ step[:, None, None, :, None])[..., 0], np.nan)

    side_by_side(fill, range(0, n, FITTED_AT_ONCE), workers)
    return outlying_frames(residuals)


def _without_false_shifts(as_built: AsBuilt, rig: StereoRig, declared: Disc, faults: SharedFaults) -> AsBuilt:
    """Where cameras and clock are wrong, dots refined alone would be moved to make up for that: take the joint ones."""
    if not as_built.reduced_chi_square_after > FAULTY * max(1.0, faults.reduced_chi_square):
        return as_built
    sigma = faults.marker_shift_sigma
    shift = share_of_places(declared, faults.marker_shift[:, :2], sigma) * faults.marker_shift
    disc = replace(declared, marker_centres_body=declared.marker_centres_body + shift)
    return replace(as_built, rig=rig, disc=disc, marker_shift=shift, marker_shift_sigma=sigma, size_share=0.0)


def _fit_all(tables: Tables, as_built: AsBuilt, reject_outliers: bool, workers: int = 1) -> PoseFits:
    """The poses of all frames, some hundreds at a time: what a fit needs beside its result is five times as large."""

    def fitted(rows: slice) -> PoseFits:
        return fit_poses(
            tables.pixels[rows],
            tables.covariance_px2[rows],
            as_built.rig,
            as_built.disc.marker_centres_body,
            tables.R[rows],
            tables.t[rows],
            reject_outliers=reject_outliers,
        )

    n, one = len(tables.t), vars(fitted(slice(0, 1)))
    whole = {name: np.empty((n, *value.shape[1:]), value.dtype) for name, value in one.items()}

    def fill(first: int) -> None:
        rows = slice(first, first + FITTED_AT_ONCE)
        for name, value in vars(fitted(rows)).items():
            whole[name][rows] = value

    side_by_side(fill, range(0, n, FITTED_AT_ONCE), workers)
    return PoseFits(**whole)


def _by_pattern(as_built: AsBuilt, R: Array) -> Array:
    """(n, 6, 3) change of poses whose dots are misplaced, as far as seen, as a whole, too: by one sigma of each way."""
    place, turn = pattern_place(as_built.disc, as_built.marker_shift, as_built.marker_shift_sigma)
    return np.asarray(motions_of_pattern(R, as_built.disc) * np.sqrt([place, place, turn]))


def _shared_sigma(fits: PoseFits, systematic: Array, as_built: AsBuilt) -> tuple[tuple[float, str], ...]:
    """Of the pose's components: the part of sigma that frames share, over the recording, and most of it from what."""
    rows = np.flatnonzero(fits.converged & np.isfinite(systematic).all(axis=(1, 2)))
    if not rows.size:
        return ()
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, min(SHARED_FRAMES, len(rows))).astype(int))]
    whole = np.mean(np.diagonal(systematic[rows], axis1=1, axis2=2), axis=0)
    by_pattern = np.mean(np.sum(_by_pattern(as_built, fits.R_world_body[rows]) ** 2, axis=2), axis=0)
    further = {"what repeats in the dots": whole - by_pattern, OF_PATTERN: by_pattern}
    sigma, most = causes(as_built.rig, fits.sensitivity[rows], further)
    return tuple((float(value), cause) for value, cause in zip(sigma, most, strict=True))


def _trajectory(
    fits: PoseFits, verdicts: Verdicts, systematic: Array, tables: Tables, as_built: AsBuilt, taken: Taken
) -> Trajectory:
    euler = frames.unwrap_euler(frames.euler_from_rotation(fits.R_world_body))
    euler[~fits.converged] = np.nan
    status = tables.frame_status.copy()
    followed = status == FrameStatus.MEASURED
    per_camera = fits.used.sum(axis=2)
    total = per_camera.sum(axis=1)
    status[followed & (total < MIN_GOOD_DOT_IMAGES)] = FrameStatus.FEW_MARKERS
    status[followed & (per_camera == 0).any(axis=1)] = FrameStatus.ONE_CAMERA
    status[followed & (total < 3)] = FrameStatus.MARKERS_NOT_FOUND
    status[followed & (total >= 3) & ~fits.converged] = FrameStatus.NOT_CONVERGED
    refused = verdicts.status != FrameStatus.MEASURED
    status[refused] = verdicts.status[refused]
    marker_status = tables.status.copy()
    seen = tables.status == MarkerStatus.MEASURED
    kept = fits.used & ~refused[:, None, None]
    marker_status[seen & ~kept & (fits.converged | refused)[:, None, None]] = MarkerStatus.REJECTED
    for without_answer in (euler, fits.t_world_body, fits.R_world_body, fits.covariance, fits.sensitivity, systematic):
        without_answer[refused] = np.nan
    squared = np.where(fits.used, np.sum(fits.residuals_px**2, axis=-1), 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        rms = np.sqrt(squared.sum(axis=2) / per_camera)
        quaternion = frames.continuous_quaternions(frames.quaternion_from_rotation(fits.R_world_body))
    return Trajectory(
        time=taken.time,
        frame=np.array(taken.pairs, dtype=np.int64),
        q=np.column_stack([fits.t_world_body, euler]),
        pose_covariance=fits.covariance,
        calibration_sensitivity=fits.sensitivity,
        systematic_covariance=systematic,
        quaternion=quaternion,
        frame_status=status,
        reprojection_rms_px=rms,
        reduced_chi_square=fits.reduced_chi_square,
        markers_px=tables.pixels,
        markers_covariance_px2=tables.covariance_px2,
        markers_residual_px=fits.residuals_px,
        marker_status=marker_status,
        disc=as_built.disc,
        rig=as_built.rig,
        frame_rate=taken.frame_rate,
        gravity=taken.gravity,
    )
