"""From what was followed to the trajectory: what all frames share is refined, all poses are fitted and judged."""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from calibration.cameras.camera import StereoRig
from calibration.cameras.causes import causes
from calibration.kit.arrays import Array, Mask
from disctrack import frames
from disctrack.disc import Disc
from disctrack.findings import Finding
from disctrack.track.dots.template import DotCentres, NoiseModel, dot_centres
from disctrack.track.dots.template_response import Pull
from disctrack.track.follow.following import Follower, Tables, TrackingSetup, repeats
from disctrack.track.judge.doubts import FAULTY, doubts_of, repeated_images
from disctrack.track.judge.dropped_frames import delay_of_right, dropped_frames
from disctrack.track.judge.outlier_tests import judge_poses, outlying_frames, unexpected_misfit
from disctrack.track.pose import PoseFits, fit_poses, whitening
from disctrack.track.refine.exposure import Exposure, exposure_by_smear, exposure_of, shift_by_exposure
from disctrack.track.refine.glare import shift_by_gleam
from disctrack.track.refine.intrinsic_scatter import Scatter, SharedFaults, split_scatter, without_shared_faults
from disctrack.track.refine.pose_scatter import PoseScatter, scatter_of_poses
from disctrack.track.refine.self_calibration import (
    SHARED_FRAMES,
    AsBuilt,
    by_pattern,
    refine_as_built,
    share_of_places,
)
from disctrack.track.refine.table_contact import OF_PATTERN, TableFromDisc, table_from_disc
from disctrack.track.side_by_side import evenly, side_by_side
from disctrack.trajectory import FrameStatus, MarkerStatus, Trajectory

MIN_GOOD_DOT_IMAGES = 6
FITTED_AT_ONCE = 512  # frames, whose numbers stay in a core's cache


@dataclass(frozen=True)
class TrackingSettings:
    """What a user may choose; the whole of it is written into the result."""

    refine_markers: bool = True  # the dots' places on the disc, over the whole sequence
    table: str = "both"  # board, disc or both: what tells where the table is (table_contact.py)
    search_always: bool = False  # at every frame where the disc is lost, whatever it costs: for single, unrelated poses
    exposure: tuple[float, float] | None = None  # [s] of the left and the right camera; None: as the dots' smear tells
    first_pass: bool = True  # leave out what lies still before the motion starts and after it ends (motion_span.py)


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
    repeated, dots = repeats(tables.digest), dot_centres(tables.results, tables.status)
    exposure = _as_they_were(tables, dots, first, settings, taken)
    _clean(tables, dots, repeated, first.setup.rig)
    as_built, faults, outlying = _shared(tables, dots, first.setup, settings, workers)
    fits = _fit_all(tables, dots, as_built.rig, as_built.disc, workers)
    fits, systematic, scatter = _scattered(fits, dots, faults, outlying)
    delay = partial(
        delay_of_right,
        fits,
        dots.pixels,
        dots.covariance_px2,
        as_built.rig,
        as_built.disc.marker_centres_body,
        np.flatnonzero(fits.converged),
    )
    fits, verdicts, slips = _judged(fits, dots, as_built, repeated, outlying, taken)
    fits, systematic, as_built, table = _on_the_table(fits, systematic, as_built, settings.table)
    # after the table: what poses scatter beside their dots need not be white, and frames do not average it there
    poses = scatter_of_poses(fits)
    fits.covariance[...] *= np.sqrt(np.outer(poses.factor, poses.factor))
    shared = _shared_sigma(fits, systematic, as_built)
    trajectory = _trajectory(fits, verdicts, systematic, tables, dots, as_built, taken)
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


def _as_they_were(
    tables: Tables, dots: DotCentres, first: Follower, settings: TrackingSettings, taken: Taken
) -> Exposure:
    """Move the dots to where they were in the middle of the exposure but for gleams, and tell by which exposure."""
    where, rig, disc = (tables.R, tables.t, taken.time), first.setup.rig, first.setup.disc
    found = exposure_by_smear(*where, dots.blur_px, rig, disc)
    exposure = exposure_of(found, settings.exposure, 1 / taken.frame_rate)
    law = first.law
    left, right = (Pull(*seen) for seen in zip(law.blur, law.light, law.noise, strict=True))
    dots.pixels[...] -= shift_by_gleam(tables.R, tables.t, dots.contrast, rig, disc, (left, right))
    if any(exposure.seconds):
        dots.pixels[...] -= shift_by_exposure(*where, np.array(exposure.seconds), rig, disc, (left, right))
    return exposure


def _clean(tables: Tables, dots: DotCentres, repeated: Mask, rig: StereoRig) -> None:
    """Take out dots of images (n, 2) that are copies of others, state misfits beyond noise, take off the lens field."""
    alone = repeated & ~repeated.all(axis=1, keepdims=True)
    dots.pixels[alone] = np.nan  # over the edges of stretches, too
    tables.status[alone] = MarkerStatus.NOT_LOOKED_FOR
    dots.covariance_px2[...] *= unexpected_misfit(dots.misfit, dots.n_pixels)[..., None, None]
    if rig.lens_field is not None:
        dots.pixels[...] = rig.lens_field.corrected(dots.pixels)


def _shared(
    tables: Tables, dots: DotCentres, setup: TrackingSetup, settings: TrackingSettings, workers: int
) -> tuple[AsBuilt, SharedFaults | None, Mask]:
    """What the frames share, what is wrong with it, and which frames (n,) are outlying and do not enter."""
    rig, disc = setup.rig, setup.disc
    outlying = _outlying(tables, dots, rig, disc, workers)
    faults = without_shared_faults(*_but(outlying, tables, dots, setup))
    if faults is not None:  # misprinted dots raise the misfit of all frames, and hide faults of some
        centres = disc.marker_centres_body + faults.marker_shift
        more = _outlying(tables, dots, rig, replace(disc, marker_centres_body=centres), workers) & ~outlying
        if more.any():
            outlying |= more
            faults = without_shared_faults(*_but(outlying, tables, dots, setup))
    if not settings.refine_markers:
        return AsBuilt.as_declared(rig, disc), faults, outlying
    as_built = refine_as_built(*_but(outlying, tables, dots, setup))
    if faults is not None:
        as_built = _without_false_shifts(as_built, rig, disc, faults)
    return as_built, faults, outlying


def _but(
    outlying: Mask, tables: Tables, dots: DotCentres, setup: TrackingSetup
) -> tuple[Array, Array, StereoRig, Disc, Array, Array]:
    """Dots and poses of frames as `pose.fit_poses` takes them, no pose for those that are outlying (n,)."""
    R = np.where(outlying[:, None, None], np.nan, tables.R)
    t = np.where(outlying[:, None], np.nan, tables.t)
    return dots.pixels, dots.covariance_px2, setup.rig, setup.disc, R, t


def _scattered(
    fits: PoseFits, dots: DotCentres, faults: SharedFaults | None, outlying: Mask
) -> tuple[PoseFits, Array, Scatter]:
    """Poses and dots with covariances of the noise they have, the part (n, 6, 6) that repeats, and what was found."""
    ordinary = replace(
        fits,
        degrees_of_freedom=np.where(outlying, 0, fits.degrees_of_freedom),
        used=fits.used & ~outlying[:, None, None],
    )
    scatter = split_scatter(ordinary, dots.covariance_px2, faults)
    dots.covariance_px2[...] *= scatter.noise  # in place: nobody else holds them
    systematic = fits.covariance * scatter.systematic
    fits.covariance[...] *= scatter.noise
    return replace(fits, chi_square=fits.chi_square / scatter.whole), systematic, scatter


def _judged(
    fits: PoseFits, dots: DotCentres, as_built: AsBuilt, repeated: Mask, outlying: Mask, taken: Taken
) -> tuple[PoseFits, NDArray[np.uint8], tuple[Finding, ...]]:
    """Poses without those that are refused, what each is worth, and exchanged images in words."""
    struck = (np.isfinite(dots.pixels).all(-1) & ~fits.used).sum(axis=(1, 2)) * fits.converged
    status, factor = judge_poses(
        fits, np.asarray(repeated.all(axis=1)), struck, outlying, 1 / taken.frame_rate, as_built.disc.radius
    )
    slips = dropped_frames(
        status == FrameStatus.CONTRADICTED,
        fits,
        dots.pixels,
        dots.covariance_px2,
        as_built.rig,
        as_built.disc.marker_centres_body,
        taken.pairs,
    )
    fits.covariance[...] *= factor[:, None, None]
    return replace(fits, converged=fits.converged & (status == FrameStatus.MEASURED)), status, slips


def _on_the_table(
    fits: PoseFits, systematic: Array, as_built: AsBuilt, source: str
) -> tuple[PoseFits, Array, AsBuilt, TableFromDisc | None]:
    """Poses, rig and what frames share (n, 6, 6) in the axes of the table that the rim touched, and that table."""
    moved = by_pattern(as_built, fits.R_world_body)
    fits, systematic, rig, table = table_from_disc(fits, systematic, as_built.rig, as_built.disc, source, moved)
    systematic += moved @ moved.swapaxes(1, 2)
    return fits, systematic, replace(as_built, rig=rig), table


def _outlying(tables: Tables, dots: DotCentres, rig: StereoRig, disc: Disc, workers: int) -> Mask:
    """(n,) True where the dots miss the pose that fits best by far more than in others."""
    fits = _fit_all(tables, dots, rig, disc, workers, judged=False)
    return outlying_frames((whitening(dots.covariance_px2) @ fits.residuals_px[..., None])[..., 0])


def _without_false_shifts(as_built: AsBuilt, rig: StereoRig, declared: Disc, faults: SharedFaults) -> AsBuilt:
    """Where cameras and clock are wrong, dots refined alone would be moved to make up for that: take the joint ones."""
    if not as_built.reduced_chi_square > FAULTY * max(1.0, faults.reduced_chi_square):
        return as_built
    sigma = faults.marker_shift_sigma
    shift = share_of_places(declared, faults.marker_shift[:, :2], sigma) * faults.marker_shift
    disc = replace(declared, marker_centres_body=declared.marker_centres_body + shift)
    return replace(as_built, rig=rig, disc=disc, marker_shift=shift, marker_shift_sigma=sigma, size_share=0.0)


def _fit_all(
    tables: Tables, dots: DotCentres, rig: StereoRig, disc: Disc, workers: int = 1, judged: bool = True
) -> PoseFits:
    """The poses of all frames, some hundreds at a time: what a fit needs beside its result is five times as large."""

    def fitted(rows: slice) -> PoseFits:
        seen = dots.pixels[rows], dots.covariance_px2[rows]
        return fit_poses(
            *seen,
            rig,
            disc.marker_centres_body,
            tables.R[rows],
            tables.t[rows],
            reject_outliers=judged,
            with_sensitivity=judged,
        )

    n, one = len(tables.t), vars(fitted(slice(0, 1)))
    whole = {name: np.empty((n, *value.shape[1:]), value.dtype) for name, value in one.items()}

    def fill(rows: slice) -> None:
        for name, value in vars(fitted(rows)).items():
            whole[name][rows] = value

    side_by_side(fill, n, FITTED_AT_ONCE, workers)
    return PoseFits(**whole)


def _shared_sigma(fits: PoseFits, systematic: Array, as_built: AsBuilt) -> tuple[tuple[float, str], ...]:
    """Of the pose's components: the part of sigma that frames share, over the recording, and most of it from what."""
    rows = evenly(np.flatnonzero(fits.converged & np.isfinite(systematic).all(axis=(1, 2))), SHARED_FRAMES)
    if not rows.size:
        return ()
    whole = np.mean(np.diagonal(systematic[rows], axis1=1, axis2=2), axis=0)
    of_pattern = np.mean(np.sum(by_pattern(as_built, fits.R_world_body[rows]) ** 2, axis=2), axis=0)
    further = {"what repeats in the dots": whole - of_pattern, OF_PATTERN: of_pattern}
    sigma, most = causes(as_built.rig, fits.sensitivity[rows], further)
    return tuple((float(value), cause) for value, cause in zip(sigma, most, strict=True))


def _trajectory(
    fits: PoseFits,
    verdicts: NDArray[np.uint8],
    systematic: Array,
    tables: Tables,
    dots: DotCentres,
    as_built: AsBuilt,
    taken: Taken,
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
    refused = verdicts != FrameStatus.MEASURED
    status[refused] = verdicts[refused]
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
        markers_px=dots.pixels,
        markers_covariance_px2=dots.covariance_px2,
        markers_residual_px=fits.residuals_px,
        marker_status=marker_status,
        disc=as_built.disc,
        rig=as_built.rig,
        frame_rate=taken.frame_rate,
        gravity=taken.gravity,
    )
