"""From the dots of the followed frames to the trajectory: shared parameters are refined, poses fitted and tested."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from calibration.board.target import Board
from calibration.cameras.camera import StereoRig, causes
from calibration.kit.brief import Brief
from calibration.kit.types import AnyArray, Array, Codes, Mask
from disctrack import frames
from disctrack.findings import Finding
from disctrack.recording.readers.blocks import NotRead
from disctrack.track.dots.template import dot_centres
from disctrack.track.follow.following import Follower, Tables, repeats
from disctrack.track.judge.cameras import camera_motion
from disctrack.track.judge.doubts import FAULTY, doubts_of, poses_scatter, repeated_images, table_disagrees
from disctrack.track.judge.outlier_tests import judge_poses, outlying_frames, unexpected_misfit
from disctrack.track.pose import MIN_DOTS, DotsInFrames, PoseFits, dots_at, fit_poses, whitening
from disctrack.track.refine.dot_shifts import exposure_by_smear, exposure_of, shift_by_exposure, shift_by_glare
from disctrack.track.refine.scatter import Scatter, scatter_of_poses, split_scatter, without_shared_faults
from disctrack.track.refine.self_calibration import AsBuilt, by_pattern, refine_as_built
from disctrack.track.refine.table_contact import OF_PATTERN, off_centre, table_from_disc
from disctrack.track.side_by_side import SHARED_FRAMES, evenly, parts
from disctrack.trajectory import FrameStatus, MarkerStatus, Trajectory, joined


@dataclass(frozen=True)
class TrackingSettings:
    """Options of the tracking; all are stored with the result."""

    table: str = "both"  # board, disc or both: what determines the table (table_contact.py)
    exposure: tuple[float, float] | None = None  # [s] of the left and the right camera; None: from motion blur
    first_pass: bool = True  # leave out the rest before and after the motion (motion_span.py)


@dataclass(frozen=True, repr=False)
class Measurement(Brief):
    """A tracked recording; problems are in `trajectory.findings`.

    >>> measurement = measure("clip", "clip/results/rig.h5", open_pairs("clip", (0, 40)))
    >>> measurement.trajectory.q.shape, measurement.unreadable
    ((300, 6), {})
    """

    trajectory: Trajectory
    details: dict[str, Any]  # blur, noise, ...: of JSON's types, stored with the result
    unreadable: NotRead = field(default_factory=dict)
    seconds: float = 0.0  # spent on reading and tracking

    def facts(self) -> dict[str, str]:
        """Facts for a short representation (`Brief`)."""
        facts = self.trajectory.facts()
        return facts | {"unreadable images": f"{len(self.unreadable)}"} if self.unreadable else facts


@dataclass(frozen=True)
class Taken:
    """Which pairs are measured, their times, gravity, the options, and the board of the calibration."""

    pairs: range
    frame_rate: float  # [Hz]
    gravity: float = 9.81  # [m/s^2]
    stamps: Array | None = None  # [s] of all frames, written by the camera
    settings: TrackingSettings = TrackingSettings()
    board: Board | None = None  # as declared: its square may be wrong if the dots contradict it

    @property
    def time(self) -> Array:
        """(n,) [s]."""
        frames = np.array(self.pairs)
        return frames / self.frame_rate if self.stamps is None else np.asarray(self.stamps[frames], float)


def assemble(followers: list[Follower], tables: Tables, taken: Taken, workers: int = 1) -> Measurement:
    """Trajectory of frames that were followed in one stretch or in several; alters `tables`.

    workers : threads; the result does not depend on their number, to the last bit
    """
    first = next((follower for follower in followers if follower.measured), followers[0])
    rig, disc = first.rig, first.disc
    repeated = repeats(tables.digest)  # across the edges of stretches, too
    tables.status[repeated & ~repeated.all(axis=1, keepdims=True)] = MarkerStatus.NOT_LOOKED_FOR
    dots, pixels, covariance = dot_centres(tables.results, tables.status)
    seen = DotsInFrames(rig, disc, pixels, covariance, tables.R, tables.t)
    exposure, of_exposure = _correct_dots(seen, dots, first, taken)
    as_built, faults, outlying = _shared(seen, workers)
    seen = replace(seen, rig=as_built.rig, disc=as_built.disc)
    fits = fit_all(seen, workers)
    fits, systematic, scatter = _scattered(fits, seen.covariance, faults, outlying)
    seen = replace(seen, R=fits.R_world_body, t=fits.t_world_body)
    again = np.asarray(repeated.all(axis=1))
    fits, verdicts = judge_poses(fits, again, outlying, 1 / taken.frame_rate, disc.radius)
    status = np.where(verdicts == FrameStatus.MEASURED, status_of(tables.frame_status, seen, fits), verdicts)
    by_motion, of_motion = camera_motion(seen, fits, taken.pairs)
    systematic += by_motion
    moved = by_pattern(as_built, fits.R_world_body)
    fits, systematic, rig, table = table_from_disc(fits, systematic, as_built.rig, disc, taken.settings.table, moved)
    moved = by_pattern(as_built, fits.R_world_body, off_centre(table, np.arccos(fits.R_world_body[:, 2, 2]), disc))
    systematic += moved @ moved.swapaxes(1, 2)
    # after the table: the excess scatter of the poses may be correlated, and would not average out in its fit
    *_, shaken = scatter_of_poses(fits)
    fits.covariance[...] *= np.sqrt(np.outer(shaken, shaken))
    seen = replace(seen, rig=rig)
    trajectory = trajectory_of(seen, fits, systematic, status, tables.status, taken)
    details = {
        "exposure_s": list(exposure),  # for which the dots were corrected
        "blur_px": [edge.blur_px for edge in first.edges],
        "noise": [edge.noise._asdict() for edge in first.edges],
        "pose_variance_factor": shaken.round(3).tolist(),  # scatter about a smooth motion over that by the dots
        "shared_sigma": _shared_sigma(fits, systematic, rig, moved),
        "acquisitions": sum(f.acquisitions for f in followers),  # number of successful searches
        "variance_factor": scatter.whole,
        "noise_factor": scatter.noise,
        "systematic_px": list(scatter.systematic_px),
        "size": {"by_dots": as_built.size, "sigma": as_built.size_sigma, "share": as_built.size_share},
        "marker_shift_um": (1e6 * as_built.marker_shift[:, :2]).round(3).tolist(),
        "marker_shift_sigma_um": (1e6 * as_built.marker_shift_sigma).round(3).tolist(),
    }
    if table is not None:
        trajectory = replace(trajectory, table_moved=table.beyond)
        details["table"] = table.details(trajectory.q[:, 4], seen.disc)
    doubts = [*doubts_of(first, scatter, trajectory, seen), *poses_scatter(shaken, trajectory)]
    of_table = table_disagrees(table, trajectory)
    findings = (*repeated_images(repeated, trajectory), *of_exposure, *of_motion, *doubts, *of_table)
    return Measurement(replace(trajectory, findings=findings), details)


def _correct_dots(
    seen: DotsInFrames, dots: AnyArray, first: Follower, taken: Taken
) -> tuple[tuple[float, float], tuple[Finding, ...]]:
    """Correct the dots for exposure, glare and lens field; returns the exposure [s] and findings about it.

    seen : altered; covariances are increased for misfit beyond noise.  dots (n, 2, m) of `_kernels.DOT`
    """
    where, of = dots_at(seen.R, seen.t, seen.rig, seen.disc), (0.5 * seen.disc.marker_diameter, first.edges)
    found = exposure_by_smear(*where, taken.time, dots["sigma"])
    exposure, findings = exposure_of(found, taken.settings.exposure, 1 / taken.frame_rate)
    seen.pixels[...] -= shift_by_glare(*where, dots["contrast"], *of)
    if any(exposure):
        seen.pixels[...] -= shift_by_exposure(*where, taken.time, np.array(exposure), *of)
    seen.covariance[...] *= unexpected_misfit(dots["chi_square"], dots["n_pixels"])[..., None, None]
    if seen.rig.lens_field is not None:
        seen.pixels[...] = seen.rig.lens_field.corrected(seen.pixels)
    return exposure, findings


def _shared(seen: DotsInFrames, workers: int) -> tuple[AsBuilt, AsBuilt | None, Mask]:
    """Rig and disc as refined, the same with free cameras and delay, and outlying frames (n,), which are excluded."""
    # frames whose dots are much farther from the best pose than in others
    fits = fit_all(seen, workers, judged=False)
    outlying = outlying_frames((whitening(seen.covariance) @ fits.residuals_px[..., None])[..., 0])
    ordinary = replace(seen, t=np.where(outlying[:, None], np.nan, seen.t))
    faults, as_built = without_shared_faults(ordinary), refine_as_built(ordinary)
    if faults is not None and as_built.reduced_chi_square > FAULTY * max(1.0, faults.reduced_chi_square):
        as_built = faults  # dots refined alone would absorb the errors of the cameras
    return as_built, faults, outlying


def _scattered(
    fits: PoseFits, covariance: Array, faults: AsBuilt | None, outlying: Mask
) -> tuple[PoseFits, Array, Scatter]:
    """Poses with covariances scaled to the noise found, systematic covariance (n, 6, 6), and the scatter."""
    freedom = np.where(outlying, 0, fits.degrees_of_freedom)
    ordinary = replace(fits, degrees_of_freedom=freedom, used=fits.used & ~outlying[:, None, None])
    scatter = split_scatter(ordinary, covariance, None if faults is None else faults.reduced_chi_square)
    covariance[...] *= scatter.noise  # in place
    systematic = fits.covariance * scatter.systematic
    fits.covariance[...] *= scatter.noise
    return replace(fits, chi_square=fits.chi_square / scatter.whole), systematic, scatter


def fit_all(seen: DotsInFrames, workers: int = 1, judged: bool = True) -> PoseFits:
    """Poses of all frames, some hundred at a time: temporary arrays are five times as large as the result."""

    def fitted(rows: slice) -> PoseFits:
        return fit_poses(seen.at(rows), reject_outliers=judged, with_sensitivity=judged)

    # NumPy releases the GIL for large arrays: parts of some hundred frames run in parallel
    with ThreadPoolExecutor(workers, thread_name_prefix="part") as pool:
        return joined(pool.map(fitted, parts(max(len(seen.t), 1))))


def _shared_sigma(fits: PoseFits, systematic: Array, rig: StereoRig, moved: Array) -> list[list[object]]:
    """Shared part of the sigma of each component of the pose, over the recording, and its largest cause.

    moved : (n, 6, 3) of `by_pattern`
    """
    rows = evenly(np.flatnonzero(fits.converged & np.isfinite(systematic).all(axis=(1, 2))), SHARED_FRAMES)
    if not rows.size:
        return []
    whole = np.mean(np.diagonal(systematic[rows], axis1=1, axis2=2), axis=0)
    of_pattern = np.mean(np.sum(moved[rows] ** 2, axis=2), axis=0)
    further = {"what repeats in the dots": whole - of_pattern, OF_PATTERN: of_pattern}
    sigma, most = causes(rig, fits.sensitivity[rows], further)
    return [[float(value), cause] for value, cause in zip(sigma, most, strict=True)]


def status_of(followed: Codes, seen: DotsInFrames, fits: PoseFits) -> Codes:
    """(n,) status by the fits of frames in which the disc was followed; the others keep their status."""
    status, was = followed.copy(), followed == FrameStatus.MEASURED
    per_camera = fits.used.sum(axis=2)
    total = per_camera.sum(axis=1)
    status[was & (total < 2 * MIN_DOTS)] = FrameStatus.FEW_MARKERS
    status[was & (per_camera == 0).any(axis=1)] = FrameStatus.ONE_CAMERA
    found = np.isfinite(seen.pixels).all(axis=-1).sum(axis=(1, 2))
    status[was & (total < MIN_DOTS)] = FrameStatus.NOT_CONVERGED
    status[was & (found < MIN_DOTS)] = FrameStatus.MARKERS_NOT_FOUND
    return status


def trajectory_of(
    seen: DotsInFrames, fits: PoseFits, systematic: Array, status: Codes, located: Codes, taken: Taken
) -> Trajectory:
    """The trajectory of the fitted poses; rejected poses become NaN in the arrays of `fits`, too.

    systematic : (n, 6, 6) covariance of errors that repeat; status (n,) FrameStatus; located (n, 2, m) MarkerStatus
    """
    euler = frames.unwrap_euler(frames.euler_from_rotation(fits.R_world_body))
    euler[~fits.converged] = np.nan
    marker_status = located.copy()
    struck = np.isfinite(fits.residuals_px).all(axis=-1) & ~(fits.used & fits.converged[:, None, None])
    marker_status[struck] = MarkerStatus.REJECTED
    for without_answer in (euler, fits.t_world_body, fits.R_world_body, fits.covariance, fits.sensitivity, systematic):
        without_answer[~fits.converged] = np.nan
    squared = np.where(fits.used, np.sum(fits.residuals_px**2, axis=-1), 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        rms = np.sqrt(squared.sum(axis=2) / fits.used.sum(axis=2))
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
        markers_px=seen.pixels,
        markers_covariance_px2=seen.covariance,
        markers_residual_px=fits.residuals_px,
        marker_status=marker_status,
        disc=seen.disc,
        rig=seen.rig,
        frame_rate=taken.frame_rate,
        gravity=taken.gravity,
    )
