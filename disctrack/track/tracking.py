"""From pairs of images to the trajectory: stretches that are followed side by side, then the pose of every frame.

The disc is followed through each stretch in `following`; here the stretches are joined, what all frames share is
refined, all poses are fitted and judged, and it is said why a frame has none.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from threading import Event, Lock
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from calibration.arrays import Array, Mask
from calibration.camera import StereoRig
from calibration.causes import causes
from disctrack import frames
from disctrack.disc import Disc, symmetry_order
from disctrack.errors import TrackingError
from disctrack.track.arrangement import arrangement_found
from disctrack.track.as_printed import MIN_MARKER_SHIFT, AsBuilt, refine_as_built
from disctrack.track.dots import NoiseModel, TemplateLimits, normalised_maps
from disctrack.track.following import (
    Follower,
    Image,
    Law,
    Search,
    Tables,
    TrackingSetup,
    clear,
    empty_tables,
    follow_block,
    repeats,
)
from disctrack.track.following import prepare as prepare
from disctrack.track.judging import Verdicts, judge_poses, outlying_frames, unexpected_misfit
from disctrack.track.own_scatter import Scatter, SharedFaults, split_scatter, without_shared_faults
from disctrack.track.pose import PoseFits, fit_poses, marker_pixels, whitening
from disctrack.track.slips import slips_in_words
from disctrack.track.table_contact import TableFromDisc, table_from_disc
from disctrack.trajectory import FrameStatus, MarkerStatus, Trajectory

MIN_GOOD_DOT_IMAGES = 6
MAX_TABLE_GAP = 20e-6  # [m] the thickness of a board on the table is known to some 10 um
FAULTY = 2.0  # times the noise that residuals must reach before cameras or clock are taken to be wrong
DISAGREE = 0.003  # chance that board and disc differ by that much: three standard deviations
ORDINARY_PX = 0.03  # rms of systematic misfit that good lenses have beyond their polynomial: no camera has moved
SHORTEST_SPLIT = 1000  # pairs; a stretch must outweigh its own search for the disc
MOST_STRETCHES = 16
MAX_EDGE_TURN = np.radians(25.0)  # by which the poses on both sides of an edge may miss each other's prediction
HOPELESS = 25.0  # times the variance of the noise: no result of such dots is right within its sigmas
FITTED_AT_ONCE = 4096  # frames
SHARED_FRAMES = 400  # that enter the refinement of what all frames share: SYSTEMATIC_PX bounds what more could add


class BlockOfPairs(Protocol):
    """Consecutive pairs as `readers.blocks.iter_pair_blocks` gives them; the images are not kept."""

    @property
    def frames(self) -> NDArray[np.int64]:
        """(n,) numbers of the pairs."""

    @property
    def images(self) -> Image:
        """(n, 2, height, width)."""

    @property
    def readable(self) -> Mask:
        """(n, 2)."""


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
    systematic_px: tuple[float, float]  # rms per axis of what repeats in the dots' misfit, left and right camera
    shared_sigma: tuple[tuple[float, str], ...]  # x, y, z [m], turns [rad]: what frames share, most of it from what
    table: TableFromDisc | None  # the plane that the rim touched; None without a table, or a rim that touched it
    acquisitions: int  # times the disc had to be searched for without a prior and was found
    warnings: tuple[str, ...]
    doubts: tuple[str, ...] = ()  # what puts the result in question: images that are copies of others


def track(
    read_blocks: Callable[[int, int], Iterable[BlockOfPairs]],
    pairs: range,
    rig: StereoRig,
    disc: Disc,
    frame_rate: float,
    *,
    gravity: float = 9.81,
    settings: TrackingSettings | None = None,
    timestamps: Array | None = None,
    workers: int = 1,
    progress: Callable[[int], object] = lambda n: None,
) -> Tracking:
    """Measure the disc's pose in every pair of a recording.

    read_blocks(start, stop) gives the pairs start..stop-1 in blocks, in order; pairs: which to measure (step 1).
    frame_rate [Hz]; timestamps (len(pairs),) [s] where the camera wrote them. workers: threads that follow stretches
    of a long recording side by side; the result is the same to the last bit for any number of them, if the reader
    begins a block at each of `stretch_edges`. progress(n) is called when n more pairs are done, from any thread but one
    at a time.
    Raises TrackingError if the images do not belong to the rig or if the disc is found in no pair at all.
    """
    settings = settings or TrackingSettings()
    n = len(pairs)
    spread = disc.marker_centres_body - disc.marker_centres_body.mean(axis=0)
    if disc.n_markers < 3 or np.linalg.matrix_rank(spread, tol=0.1 * disc.marker_diameter) < 2:
        raise TrackingError(
            f"[markers] declares {disc.n_markers} dots"
            + (" on one line" if disc.n_markers > 2 else "")
            + ": a pose needs at least three dots that are not on one line"
        )
    tables = empty_tables(n, disc.n_markers)
    with ThreadPoolExecutor(2) as pool:  # 0.1 s each
        maps = list(pool.map(normalised_maps, rig.cameras))
    maps_x, maps_y = (np.stack(part) for part in zip(*maps, strict=True))
    edges = stretch_edges(pairs, disc)
    setup = TrackingSetup(rig, disc, settings.limits, maps_x, maps_y)
    followers = [Follower(setup, search=Search(always=settings.search_always)) for _ in edges[1:]]
    for number, follower in enumerate(followers):
        follower.given = partial(_first_law, followers[:number])

    given_up, telling = Event(), Lock()

    def follow(share: range) -> None:
        """Follow the disc through neighbouring stretches."""
        number = share.start
        try:
            for block in read_blocks(edges[share.start], edges[share.stop]):
                check_images(block.images, rig)
                for part in _cut(block, edges):
                    while part.start >= edges[number + 1]:
                        followers[number].finish()
                        number += 1
                    rows = slice(part.start - int(block.frames[0]), part.stop - int(block.frames[0]))
                    at = part.start - pairs.start
                    follow_block(followers[number], block.images[rows], block.readable[rows], tables, at)
                with telling:
                    progress(len(block.images))
                if given_up.is_set():
                    break
        finally:  # nobody may wait for what will not come
            for k in share:
                followers[k].finish()

    def carry_on(before: Follower, stretch: Follower, start: int, stop: int) -> None:
        """Follow a stretch again from where the one before it ended."""
        stretch.heading, stretch.lost = before.heading, None
        stretch.law, stretch.measured = before.law, True
        clear(tables, slice(start - pairs.start, stop - pairs.start))
        for block in read_blocks(start, stop):
            follow_block(stretch, block.images, block.readable, tables, int(block.frames[0]) - pairs.start)

    workers = max(1, min(workers, len(followers)))
    shares = [range(k * len(followers) // workers, (k + 1) * len(followers) // workers) for k in range(workers)]
    if workers == 1:
        follow(shares[0])
    else:
        with ThreadPoolExecutor(workers, thread_name_prefix="track") as pool:
            running = [pool.submit(follow, share) for share in shares]
            try:
                for share in running:
                    share.result()
            except BaseException:  # an interrupt must not wait for the end of the recording
                given_up.set()
                raise
    for k in range(1, len(followers)):
        if _torn(tables, edges[k] - pairs.start):  # another branch of phi was found: go on from the stretch before
            carry_on(followers[k - 1], followers[k], edges[k], edges[k + 1])
    if not np.isfinite(tables.t).any():
        reason = next((f.first_reason for f in followers if f.first_reason), "no image could be read")
        arranged = _arrangement(read_blocks, rig, disc, pairs)
        raise TrackingError(
            f"the disc was found in none of the pairs {pairs.start}-{pairs.stop - 1}. "
            + (f"It is there if {arranged}" if arranged else f"First search: {reason}")
        )
    if timestamps is None:
        timestamps = np.array(pairs) / frame_rate
    tracking = _assemble(followers, tables, settings, frame_rate, gravity, np.asarray(timestamps, float), pairs)
    if any(doubt.startswith(_ONE_SIDED) for doubt in tracking.doubts):
        one_sided = np.flatnonzero(tracking.trajectory.frame_status == FrameStatus.ONE_CAMERA)
        if arranged := _arrangement(read_blocks, rig, disc, pairs[one_sided[0] :]):
            told = f"the dots of both cameras make sense if {arranged}: no pose of this run is right"
            tracking = replace(tracking, doubts=(told, *tracking.doubts))
    return tracking


def _arrangement(
    read_blocks: Callable[[int, int], Iterable[BlockOfPairs]], rig: StereoRig, disc: Disc, pairs: range
) -> str:
    """Whether the images are mirrored or exchanged, in words: by the first of the pairs, and by one in their middle."""
    for pair in dict.fromkeys([pairs[0], pairs[len(pairs) // 2]]):
        for block in read_blocks(pair, pair + 1):
            if block.readable.all() and (told := arrangement_found(block.images[0], rig, disc)):
                return told
    return ""


def stretch_edges(pairs: range, disc: Disc) -> list[int]:
    """First pairs of the stretches that a recording is followed in, and the end of the last.

    They depend on the length alone, so that the result does not depend on who follows them. Where the dots leave phi
    open by a symmetry, every new start could choose another branch: then there is one stretch.
    """
    n, count = len(pairs), 1
    while n >= SHORTEST_SPLIT * count**2 and count < MOST_STRETCHES and symmetry_order(disc) == 1:
        count *= 2
    return [pairs.start + k * n // count for k in range(count + 1)]


def _cut(block: BlockOfPairs, edges: Sequence[int]) -> list[range]:
    """The block's frames without any edge inside."""
    first, stop = int(block.frames[0]), int(block.frames[-1]) + 1
    inside = [first, *(edge for edge in edges if first < edge < stop), stop]
    return [range(a, b) for a, b in pairwise(inside)]


def _first_law(earlier: Sequence[Follower]) -> Law | None:
    """Noise and blur of the first stretch that could measure them; waits for those that are not done."""
    return next((law for follower in earlier if (law := follower.told.result()) is not None), None)


def _torn(tables: Tables, edge: int) -> bool:
    """True where the poses before row `edge` do not lead to its own: two starts took different dots for the same."""
    rows = slice(edge - 2, edge + 1)
    if not (tables.frame_status[rows] == FrameStatus.MEASURED).all():
        return False
    before, last, here = tables.R[rows]
    miss = (last @ before.T @ last).T @ here
    return bool(np.arccos(np.clip((np.trace(miss) - 1) / 2, -1, 1)) > MAX_EDGE_TURN)


def check_images(images: Image, rig: StereoRig) -> None:
    """Raise TrackingError unless the images have the size that the rig was calibrated at."""
    height, width = images.shape[-2:]
    for name, camera in zip(frames.CAMERAS, rig.cameras, strict=True):
        if camera.image_size != (width, height):
            raise TrackingError(
                f"images are {width} x {height} px, but the rig's {name} camera was calibrated at "
                f"{camera.image_size[0]} x {camera.image_size[1]} px: calibrate with views of the recording's own "
                "size, or name the rig that belongs to it"
            )


def _assemble(
    followers: list[Follower],
    tables: Tables,
    settings: TrackingSettings,
    frame_rate: float,
    gravity: float,
    time: Array,
    pairs: range,
) -> Tracking:
    first = next((follower for follower in followers if follower.measured), followers[0])
    repeated = repeats(tables.digest)
    alone = repeated & ~repeated.all(axis=1, keepdims=True)
    tables.pixels[alone] = np.nan  # over the edges of stretches, too
    tables.status[alone] = MarkerStatus.NOT_LOOKED_FOR
    tables.covariance_px2 *= unexpected_misfit(tables.misfit, tables.n_pixels)[..., None, None]
    field = first.setup.rig.lens_field
    if field is not None:
        tables.pixels = field.corrected(tables.pixels)
    outlying = _outlying(tables, first.setup)
    R, t = (np.where(outlying.reshape(-1, *[1] * (part.ndim - 1)), np.nan, part) for part in (tables.R, tables.t))
    as_built = refine_as_built(
        tables.pixels,
        tables.covariance_px2,
        first.setup.rig,
        first.setup.disc,
        R,
        t,
        refine_markers=settings.refine_markers,
        refine_rig=settings.refine_rig,
        max_frames=SHARED_FRAMES,
    )
    faults = without_shared_faults(
        tables.pixels,
        tables.covariance_px2,
        first.setup.rig,
        first.setup.disc,
        R,
        t,
        max_frames=SHARED_FRAMES,
    )
    if settings.refine_markers and faults is not None:
        as_built = _without_false_shifts(as_built, first.setup.rig, first.setup.disc, faults)
    fits = _fit_all(tables, as_built, settings.reject_outliers)
    ordinary = replace(
        fits,
        degrees_of_freedom=np.where(outlying, 0, fits.degrees_of_freedom),
        used=fits.used & ~outlying[:, None, None],
    )
    scatter = split_scatter(ordinary, tables.covariance_px2, faults)
    factor, noise_factor = scatter.whole, scatter.noise
    tables.covariance_px2 *= noise_factor  # in place: nobody else holds them
    systematic = fits.covariance * scatter.systematic
    fits.covariance[...] *= noise_factor
    fits = replace(fits, chi_square=fits.chi_square / factor)
    struck = (np.isfinite(tables.pixels).all(-1) & ~fits.used).sum(axis=(1, 2)) * fits.converged
    verdicts = judge_poses(
        fits, np.asarray(repeated.all(axis=1)), struck, outlying, 1 / frame_rate, as_built.disc.radius
    )
    contradicted = verdicts.status == FrameStatus.CONTRADICTED
    slips = slips_in_words(
        contradicted, fits, tables.pixels, tables.covariance_px2, as_built.rig, as_built.disc.marker_centres_body, pairs
    )
    fits.covariance[...] *= verdicts.factor[:, None, None]
    fits = replace(fits, converged=fits.converged & (verdicts.status == FrameStatus.MEASURED))
    fits, systematic, rig, table = table_from_disc(fits, systematic, as_built.rig, as_built.disc, settings.table)
    shared = _shared_sigma(fits, systematic, rig)
    # what the dots have been corrected by, and what has gone into the covariance
    as_built = replace(as_built, rig=replace(rig, lens_field=None, allowances=()))
    trajectory = _trajectory(fits, verdicts, systematic, tables, as_built, time, pairs, frame_rate, gravity)
    warnings = _warnings(first, factor, faults, scatter, table, trajectory)
    return Tracking(
        trajectory=trajectory,
        noise=first.law.noise,
        blur_px=first.law.blur,
        as_built=as_built,
        variance_factor=factor,
        noise_factor=noise_factor,
        shared_sigma=shared,
        systematic_px=scatter.systematic_px,
        table=table,
        acquisitions=sum(f.acquisitions for f in followers),
        warnings=warnings,
        doubts=(
            *_repeats_in_words(repeated, pairs),
            *slips,
            *(text for text in warnings if text.startswith((_MISFIT, _ONE_SIDED))),
        ),
    )


def _outlying(tables: Tables, setup: TrackingSetup) -> Mask:
    """(n,) True where the dots miss the pose that was tracked by far more than in the other frames."""
    n = len(tables.t)
    residuals = np.full(tables.pixels.shape, np.nan)
    for first in range(0, n, FITTED_AT_ONCE):
        rows = slice(first, first + FITTED_AT_ONCE)
        pixels, _ = marker_pixels(tables.R[rows], tables.t[rows], setup.rig, setup.disc.marker_centres_body)
        W = whitening(tables.covariance_px2[rows])
        known: Mask = np.asarray(np.isfinite(tables.covariance_px2[rows]).all((-1, -2)))
        residuals[rows] = np.where(known[..., None], (W @ (tables.pixels[rows] - pixels)[..., None])[..., 0], np.nan)
    return outlying_frames(residuals)


_ONE_SIDED = "the dots of only one camera make sense"
_MISFIT = "the dots miss their fitted places"


def _repeats_in_words(repeated: Mask, pairs: range) -> tuple[str, ...]:
    """Images that are copies of earlier ones, as (n, 2)."""
    said = []
    for camera, copies in zip(frames.CAMERAS, (repeated & ~repeated.all(axis=1, keepdims=True)).T, strict=True):
        rows = np.flatnonzero(copies)
        if len(rows):
            shown = ", ".join(str(pairs[row]) for row in rows[:5]) + (", ..." if len(rows) > 5 else "")
            said.append(
                f"{camera} camera: {len(rows)} image(s) are copies of earlier ones (frame {shown}): the camera or its "
                "recorder lost these; the frames are measured without them"
            )
    return tuple(said)


def _without_false_shifts(as_built: AsBuilt, rig: StereoRig, declared: Disc, faults: SharedFaults) -> AsBuilt:
    """Where cameras and clock are wrong, dots refined alone would be moved to make up for that: take the joint ones."""
    if not as_built.reduced_chi_square_after > FAULTY * max(1.0, faults.reduced_chi_square):
        return as_built
    shift = faults.marker_shift
    if np.sqrt(np.mean(shift**2)) < MIN_MARKER_SHIFT:
        shift = np.zeros_like(shift)
    disc = replace(declared, marker_centres_body=declared.marker_centres_body + shift)
    sigma = faults.marker_shift_sigma
    return replace(as_built, rig=rig, disc=disc, marker_shift=shift, marker_shift_sigma=sigma, size_share=0.0)


def _fit_all(tables: Tables, as_built: AsBuilt, reject_outliers: bool) -> PoseFits:
    """The poses of all frames, some thousands at a time: what a fit needs beside its result is five times as large."""
    n, whole = len(tables.t), dict[str, NDArray]()
    for first in range(0, n, FITTED_AT_ONCE):
        rows = slice(first, first + FITTED_AT_ONCE)
        part = fit_poses(
            tables.pixels[rows],
            tables.covariance_px2[rows],
            as_built.rig,
            as_built.disc.marker_centres_body,
            tables.R[rows],
            tables.t[rows],
            reject_outliers=reject_outliers,
        )
        for name, value in vars(part).items():
            if name not in whole:
                whole[name] = np.empty((n, *value.shape[1:]), value.dtype)
            whole[name][rows] = value
    return PoseFits(**whole)


def _shared_sigma(fits: PoseFits, systematic: Array, rig: StereoRig) -> tuple[tuple[float, str], ...]:
    """Of the pose's components: the part of sigma that frames share, over the recording, and most of it from what."""
    rows = np.flatnonzero(fits.converged & np.isfinite(systematic).all(axis=(1, 2)))
    if not rows.size:
        return ()
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, min(SHARED_FRAMES, len(rows))).astype(int))]
    repeats = np.mean(np.diagonal(systematic[rows], axis1=1, axis2=2), axis=0)
    sigma, most = causes(rig, fits.sensitivity[rows], {"what repeats in the dots": repeats})
    return tuple((float(value), cause) for value, cause in zip(sigma, most, strict=True))


def _trajectory(
    fits: PoseFits,
    verdicts: Verdicts,
    systematic: Array,
    tables: Tables,
    as_built: AsBuilt,
    time: Array,
    pairs: range,
    frame_rate: float,
    gravity: float,
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
        time=time,
        frame=np.array(pairs, dtype=np.int64),
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
        frame_rate=frame_rate,
        gravity=gravity,
    )


def _table_gap(trajectory: Trajectory) -> Array:
    """Height of the disc's lowest point above the table [m] in the frames that have a pose; empty without a table."""
    if not trajectory.rig.world_is_table:
        return np.empty(0)
    z, theta = trajectory.q[trajectory.measured][:, [2, 4]].T
    return z - trajectory.disc.resting_height(theta)


def _warnings(
    follower: Follower,
    variance_factor: float,
    faults: SharedFaults | None,
    scatter: Scatter,
    table: TableFromDisc | None,
    trajectory: Trajectory,
) -> tuple[str, ...]:
    warnings = []
    own = variance_factor if faults is None else max(1.0, faults.reduced_chi_square)
    systematic_px = max(scatter.systematic_px)
    one, both = (int(np.sum(trajectory.frame_status == s)) for s in (FrameStatus.ONE_CAMERA, FrameStatus.MEASURED))
    if one > both:
        warnings.append(
            f"{_ONE_SIDED} in {one} of {one + both} measured frames: are left and right "
            "exchanged, does the rig belong to this recording, does one camera look at the underside?"
        )
    order = symmetry_order(follower.setup.disc)
    if order > 1:
        warnings.append(
            f"the layout of the dots repeats every {360 / order:.0f} deg: the spin angle phi is known only up to "
            "multiples of that (its rate is not affected)"
        )
    for camera, saturation in zip(frames.CAMERAS, follower.saturated, strict=True):
        if saturation is not None:
            warnings.append(
                f"{camera} camera: the light round the dots is clipped at grey value {saturation}, which hides part of "
                "their edges and of the noise: positions may be off by a micrometre. Expose for a shorter time"
            )
    if variance_factor > min(FAULTY * own, HOPELESS) and systematic_px > ORDINARY_PX:
        warnings.append(
            f"{_MISFIT} by {np.sqrt(variance_factor / own):.1f} times their own "
            f"scatter ({systematic_px:.3f} px): a camera moved, was refocused or lags since the calibration. "
            "disctrack diagnose tells which; calibrate again, or check the synchronisation"
        )
    elif scatter.noise > 4.0:
        warnings.append(
            f"the dots scatter {np.sqrt(scatter.noise):.1f} times more than the image noise explains: they are not "
            "round, or their edges are not sharp, or the images were processed"
        )
    if table is not None and table.probability < DISAGREE:
        warnings.append(
            f"the disc's lowest point does not roll on the board's table: {table.sentence}. They differ by more than "
            "their tolerances allow: the board is bowed or its thickness is another, the disc's radius or thickness "
            "is, or the cameras moved together since the table view"
        )
    gap = _table_gap(trajectory)
    if gap.size and max(abs(np.median(gap)), 1.4826 * np.median(np.abs(gap - np.median(gap)))) > MAX_TABLE_GAP:
        warnings.append(
            f"the disc's lowest point lies {np.median(gap) * 1e6:+.0f} um from the table (scatter "
            f"{gap.std() * 1e6:.0f} um): thickness of the board or of the disc, radius, or the table view do not fit "
            "this recording, the cameras moved together, or the disc is in the air"
        )
    return tuple(warnings)
