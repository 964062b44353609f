"""From pairs of images to the trajectory: acquisition, tracking by prediction, pose of every frame.

The loop over frames is one compiled call per block (`_kernels.track_frames`); here stands what happens at its ends:
finding the disc at the start and after a loss, measuring blur and noise, fitting all poses, and saying why a frame has
none.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from threading import Event, Lock
from typing import Protocol

import numpy as np
from numpy.typing import DTypeLike, NDArray

from calibration.camera import StereoRig
from calibration.grey_levels import saturation_level
from disctrack import frames
from disctrack.disc import Disc
from disctrack.errors import TrackingError
from disctrack.track import _kernels as kernels
from disctrack.track.acquisition import acquire, symmetry_order
from disctrack.track.as_printed import MIN_MARKER_SHIFT, AsBuilt, refine_as_built
from disctrack.track.dots import (
    TYPICAL_BLUR_PX,
    NoiseModel,
    TemplateLimits,
    dot_centres,
    face_edge,
    measure_noise,
    normalised_maps,
    typical_noise,
)
from disctrack.track.motion_span import StillScene
from disctrack.track.own_scatter import Scatter, SharedFaults, split_scatter, without_shared_faults
from disctrack.track.pose import PoseFits, fit_poses
from disctrack.track.table_contact import TableFromDisc, table_from_disc
from disctrack.trajectory import FrameStatus, MarkerStatus, Trajectory

Array = NDArray[np.float64]
Images = NDArray[np.uint8] | NDArray[np.uint16]


class PairBlock(Protocol):
    """Consecutive pairs as `readers.blocks.iter_pair_blocks` gives them; the images are not kept."""

    @property
    def frames(self) -> NDArray[np.int64]:
        """(n,) numbers of the pairs."""

    @property
    def images(self) -> Images:
        """(n, 2, height, width)."""

    @property
    def readable(self) -> NDArray[np.bool_]:
        """(n, 2)."""


# A pair whose dots disagree by more than this with any rigid motion is lost: a tenth of a dot, ten times a poor rig
MAX_PREDICTION_RMS_PX = 2.0
NOISE_FRAMES, NOISE_STEP = 12, 3  # frames that blur is taken from, and every third of them for the noise
MIN_GOOD_DOT_IMAGES = 6
MAX_TABLE_GAP = 20e-6  # [m] the thickness of a board on the table is known to some 10 um
FAULTY = 2.0  # times the noise that residuals must reach before cameras or clock are taken to be wrong
DISAGREE = 0.003  # chance that board and disc differ by that much: three standard deviations
ORDINARY_PX = 0.03  # rms of systematic misfit that good lenses have beyond their polynomial: no camera has moved
SHORTEST_SPLIT = 1000  # pairs; a stretch must outweigh its own search for the disc
MOST_STRETCHES = 16
MAX_EDGE_TURN = np.radians(25.0)  # by which the poses on both sides of an edge may miss each other's prediction
SEARCH_AGAIN = 50  # frames after which a disc that was not found is searched for though the scene has not changed
FITTED_AT_ONCE = 4096  # frames
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
    table: TableFromDisc | None  # the plane that the rim touched; None without a table, or a rim that touched it
    acquisitions: int  # times the disc had to be searched for without a prior and was found
    warnings: tuple[str, ...]


@dataclass
class _Tables:
    """What is kept of every pair until the poses are fitted: 0.7 kB with six dots."""

    pixels: Array  # (n, 2, m, 2)
    covariance_px2: Array  # (n, 2, m, 2, 2)
    status: NDArray[np.uint8]  # (n, 2, m)
    R: Array  # (n, 3, 3)
    t: Array  # (n, 3)
    frame_status: NDArray[np.uint8]  # (n,)


@dataclass
class _Rows:
    """What the loop over frames fills."""

    results: Array  # (n, 2, m, 12)
    status: NDArray[np.uint8]  # (n, 2, m)
    R: Array  # (n, 3, 3)
    t: Array  # (n, 3)

    def since(self, i: int) -> _Rows:
        """The rows from number i on."""
        return _Rows(self.results[i:], self.status[i:], self.R[i:], self.t[i:])


Law = tuple[list[NoiseModel], list[float]]  # noise and blur [px] of the left and the right camera


@dataclass
class _Follower:
    """The state of the compiled loop between blocks, in one stretch of the recording."""

    rig: StereoRig
    disc: Disc
    limits: TemplateLimits
    maps_x: Array
    maps_y: Array
    noise: list[NoiseModel]
    blur: list[float]
    last: tuple[Array, Array]
    before: tuple[Array, Array]
    tracking: bool = False
    measured: bool = False  # blur and noise known
    acquisitions: int = 0
    first_reason: str = ""
    saturated: tuple[int | None, int | None] = (None, None)  # grey value at which the dots' background is clipped
    given: Callable[[], Law | None] = lambda: None  # noise and blur that an earlier stretch has measured
    law: Future[Law | None] = field(default_factory=Future)  # what this stretch measured; None if it did not
    seen: _Seen | None = None  # what the images showed where the disc was last not found

    def keep_law(self) -> None:
        """Keep noise and blur as they are, and let later stretches have them."""
        self.measured = True
        self.law.set_result((list(self.noise), list(self.blur)))

    def finish(self) -> None:
        """Let nobody wait for a law that was never measured."""
        if not self.law.done():
            self.law.set_result(None)

    def run(self, images: Images, readable: NDArray[np.bool_], rows: _Rows) -> int:
        """Follow the disc through images; returns the number of frames before it was lost."""
        poses = self.rig.camera_poses()
        return int(
            kernels.track_frames(
                images,
                readable,
                self.maps_x,
                self.maps_y,
                np.stack([camera.parameters for camera in self.rig.cameras]),
                np.stack([R for R, _ in poses]),
                np.stack([t for _, t in poses]),
                np.ascontiguousarray(self.disc.marker_centres_body),
                0.5 * self.disc.marker_diameter,
                face_edge(self.disc),
                np.array(self.blur),
                np.stack([noise.parameters for noise in self.noise]),
                self.limits.array(),
                *self.last,
                *self.before,
                rows.results,
                rows.status,
                rows.R,
                rows.t,
                MAX_PREDICTION_RMS_PX,
            )
        )

    def start_from(self, pose: tuple[Array, Array], following: tuple[Array, Array] | None) -> None:
        """Set the last two poses so that the next prediction is `pose`, with the velocity that leads on to the next."""
        R, t = (np.ascontiguousarray(part) for part in pose)
        turn, shift = np.eye(3), np.zeros(3)
        if following is not None:
            turn, shift = following[0] @ R.T, following[1] - t
        self.last = (np.ascontiguousarray(turn.T @ R), t - shift)
        self.before = (np.ascontiguousarray(turn.T @ self.last[0]), t - 2 * shift)


def track(
    read_blocks: Callable[[int, int], Iterable[PairBlock]],
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
    tables = _empty_tables(n, disc.n_markers)
    with ThreadPoolExecutor(2) as pool:  # 0.1 s each
        maps = list(pool.map(normalised_maps, rig.cameras))
    maps_x, maps_y = (np.stack(part) for part in zip(*maps, strict=True))
    edges = stretch_edges(pairs, disc)
    followers = [
        _Follower(
            rig,
            disc,
            settings.limits,
            maps_x,
            maps_y,
            [NoiseModel(1.0, 0.02), NoiseModel(1.0, 0.02)],
            [TYPICAL_BLUR_PX, TYPICAL_BLUR_PX],
            (np.eye(3), np.zeros(3)),
            (np.eye(3), np.zeros(3)),
        )
        for _ in edges[1:]
    ]
    for number, follower in enumerate(followers):
        follower.given = partial(_first_law, followers[:number])

    given_up, telling = Event(), Lock()

    def follow(share: range) -> None:
        """Follow the disc through neighbouring stretches."""
        number = share.start
        try:
            for block in read_blocks(edges[share.start], edges[share.stop]):
                _check_images(block.images, rig)
                for part in _cut(block, edges):
                    while part.start >= edges[number + 1]:
                        followers[number].finish()
                        number += 1
                    rows = slice(part.start - int(block.frames[0]), part.stop - int(block.frames[0]))
                    at = part.start - pairs.start
                    _follow_block(followers[number], block.images[rows], block.readable[rows], tables, at)
                with telling:
                    progress(len(block.images))
                if given_up.is_set():
                    break
        finally:  # nobody may wait for what will not come
            for k in share:
                followers[k].finish()

    def carry_on(before: _Follower, stretch: _Follower, start: int, stop: int) -> None:
        """Follow a stretch again from where the one before it ended."""
        stretch.last, stretch.before = ((R.copy(), t.copy()) for R, t in (before.last, before.before))
        stretch.tracking = True
        stretch.noise, stretch.blur, stretch.measured = before.noise, before.blur, True
        _clear(tables, slice(start - pairs.start, stop - pairs.start))
        for block in read_blocks(start, stop):
            _follow_block(stretch, block.images, block.readable, tables, int(block.frames[0]) - pairs.start)

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
        raise TrackingError(
            f"the disc was found in none of the pairs {pairs.start}-{pairs.stop - 1}. First search: {reason}"
        )
    if timestamps is None:
        timestamps = np.array(pairs) / frame_rate
    return _assemble(followers, tables, settings, frame_rate, gravity, np.asarray(timestamps, float), pairs)


def stretch_edges(pairs: range, disc: Disc) -> list[int]:
    """First pairs of the stretches that a recording is followed in, and the end of the last.

    They depend on the length alone, so that the result does not depend on who follows them. Where the dots leave phi
    open by a symmetry, every new start could choose another branch: then there is one stretch.
    """
    n, count = len(pairs), 1
    while n >= SHORTEST_SPLIT * count**2 and count < MOST_STRETCHES and symmetry_order(disc) == 1:
        count *= 2
    return [pairs.start + k * n // count for k in range(count + 1)]


def _cut(block: PairBlock, edges: Sequence[int]) -> list[range]:
    """The block's frames without any edge inside."""
    first, stop = int(block.frames[0]), int(block.frames[-1]) + 1
    inside = [first, *(edge for edge in edges if first < edge < stop), stop]
    return [range(a, b) for a, b in pairwise(inside)]


def _first_law(earlier: Sequence[_Follower]) -> Law | None:
    """Noise and blur of the first stretch that could measure them; waits for those that are not done."""
    return next((law for follower in earlier if (law := follower.law.result()) is not None), None)


def _torn(tables: _Tables, edge: int) -> bool:
    """True where the poses before row `edge` do not lead to its own: two starts took different dots for the same."""
    rows = slice(edge - 2, edge + 1)
    if not (tables.frame_status[rows] == FrameStatus.MEASURED).all():
        return False
    before, last, here = tables.R[rows]
    miss = (last @ before.T @ last).T @ here
    return bool(np.arccos(np.clip((np.trace(miss) - 1) / 2, -1, 1)) > MAX_EDGE_TURN)


def prepare(dtype: DTypeLike = np.uint8) -> None:
    """Compile the inner loops for images of this type, or load them: 20 s once per installation, then nothing."""
    zeros = np.zeros
    kernels.track_frames(
        zeros((0, 2, 8, 8), dtype),
        zeros((0, 2), bool),
        zeros((2, 8, 8)),
        zeros((2, 8, 8)),
        zeros((2, 9)),
        zeros((2, 3, 3)),
        zeros((2, 3)),
        zeros((1, 3)),
        1.0,
        1.0,
        zeros(2),
        zeros((2, 3)),
        zeros(5),
        *(np.eye(3), zeros(3), np.eye(3), zeros(3)),
        zeros((0, 2, 1, kernels.N_RESULT)),
        zeros((0, 2, 1), np.uint8),
        zeros((0, 3, 3)),
        zeros((0, 3)),
        MAX_PREDICTION_RMS_PX,
    )


def _empty_tables(n: int, m: int) -> _Tables:
    return _Tables(
        pixels=np.full((n, 2, m, 2), np.nan),
        covariance_px2=np.full((n, 2, m, 2, 2), np.nan),
        status=np.full((n, 2, m), MarkerStatus.NOT_LOOKED_FOR, np.uint8),
        R=np.full((n, 3, 3), np.nan),
        t=np.full((n, 3), np.nan),
        frame_status=np.full(n, FrameStatus.NOT_PROCESSED, np.uint8),
    )


def _empty_rows(n: int, m: int) -> _Rows:
    tables = _empty_tables(n, m)
    return _Rows(np.full((n, 2, m, kernels.N_RESULT), np.nan), tables.status, tables.R, tables.t)


def _clear(tables: _Tables, rows: slice) -> None:
    empty = _empty_tables(1, tables.status.shape[2])
    tables.pixels[rows], tables.covariance_px2[rows], tables.status[rows] = np.nan, np.nan, empty.status
    tables.R[rows], tables.t[rows], tables.frame_status[rows] = empty.R, empty.t, empty.frame_status


def _check_images(images: Images, rig: StereoRig) -> None:
    height, width = images.shape[-2:]
    for name, camera in zip(frames.CAMERAS, rig.cameras, strict=True):
        if camera.image_size != (width, height):
            raise TrackingError(
                f"images are {width} x {height} px, but the rig's {name} camera was calibrated at "
                f"{camera.image_size[0]} x {camera.image_size[1]} px: calibrate with views of the recording's own "
                "size, or name the rig that belongs to it"
            )


def _follow_block(
    follower: _Follower, images: Images, readable: NDArray[np.bool_], tables: _Tables, start: int
) -> None:
    n, i = len(images), 0
    own = slice(start, start + n)
    results = np.full((n, 2, follower.disc.n_markers, kernels.N_RESULT), np.nan)
    rows = _Rows(results, tables.status[own], tables.R[own], tables.t[own])
    while i < n:
        if not readable[i].any():
            tables.frame_status[start + i] = FrameStatus.UNREADABLE
            follower.tracking = False
            i += 1
            continue
        fresh = not follower.tracking
        if fresh and (_as_before(follower, images[i], readable[i]) or not _acquire(follower, images[i:], readable[i:])):
            tables.frame_status[start + i] = FrameStatus.MARKERS_NOT_FOUND
            _remember(follower, images[i:], readable[i:])
            i += 1
            continue
        done = follower.run(images[i:], readable[i:], rows.since(i))
        tables.frame_status[start + i : start + i + done] = FrameStatus.MEASURED
        i += done
        if i < n:
            follower.tracking = False
            if fresh and done == 0:  # found by its blobs, but its dots are refused: this frame has no answer
                tables.frame_status[start + i] = FrameStatus.MARKERS_NOT_FOUND
                follower.first_reason = follower.first_reason or _refusals(tables.status[start + i])
                _remember(follower, images[i:], readable[i:])
                i += 1
    dots = dot_centres(results, rows.status)
    tables.pixels[own], tables.covariance_px2[own] = dots.pixels, dots.covariance_px2


@dataclass
class _Seen:
    """A pair in which the disc was not found."""

    scenes: tuple[StillScene, StillScene]
    good_for: int  # more frames


def _remember(follower: _Follower, images: Images, readable: NDArray[np.bool_]) -> None:
    """Keep the pair in which the disc was not found, with the noise that its neighbour tells."""
    if follower.seen is None and len(images) > 1 and readable[:2].all():
        left, right = (StillScene(images[0, camera], images[1, camera]) for camera in (0, 1))
        follower.seen = _Seen((left, right), SEARCH_AGAIN)


def _as_before(follower: _Follower, images: Images, readable: NDArray[np.bool_]) -> bool:
    """True where a pair shows what it showed when the disc was not found: a search costs fifty times as much."""
    seen = follower.seen
    if seen is None:
        return False
    seen.good_for -= 1
    if seen.good_for > 0 and readable.all() and not any(map(StillScene.differs, seen.scenes, images)):
        return True
    follower.seen = None
    return False


def _refusals(status: NDArray[np.uint8]) -> str:
    """Why the dots (2, m) of a pair were refused, in words."""
    kinds, counts = np.unique(status, return_counts=True)
    listed = ", ".join(f"{n} {MarkerStatus(k).name.lower()}" for k, n in zip(kinds, counts, strict=True))
    return f"blobs lie where the dots should be, but their grey values do not fit the dots of [markers]: {listed}"


def _acquire(follower: _Follower, images: Images, readable: NDArray[np.bool_]) -> bool:
    """Search the first pair (and the second, for the velocity); the first time also measure blur and noise."""
    found = [
        acquire(
            np.where(readable[k, 0], images[k, 0], 0),
            np.where(readable[k, 1], images[k, 1], 0),
            follower.rig,
            follower.disc,
        )
        for k in range(min(2, len(images)))
        if readable[k].any()
    ]
    first = found[0]
    if first.R_world_body is None or first.t_world_body is None:
        follower.first_reason = follower.first_reason or first.reason
        return False
    pose = (first.R_world_body, first.t_world_body)
    following = None
    if len(found) == 2 and found[1].R_world_body is not None and found[1].t_world_body is not None:
        following = (found[1].R_world_body, found[1].t_world_body)
    if not follower.measured and (law := follower.given()) is not None:
        follower.noise, follower.blur = list(law[0]), list(law[1])
        follower.keep_law()
    if not follower.measured:
        _measure_blur_and_noise(follower, images, readable, pose, following)
    follower.start_from(pose, following)
    follower.tracking = True
    follower.acquisitions += 1
    return True


def _measure_blur_and_noise(
    follower: _Follower,
    images: Images,
    readable: NDArray[np.bool_],
    pose: tuple[Array, Array],
    following: tuple[Array, Array] | None,
) -> None:
    n, m = min(NOISE_FRAMES, len(images)), follower.disc.n_markers
    for camera, (R_cw, t_cw) in enumerate(follower.rig.camera_poses()):
        # a first idea of the noise, or good dots of a noisy camera, or of more than 8 bits, would look like misfits;
        # the pose found by blobs is good to a fraction of a pixel, and the flat parts keep off the edges by more
        if readable[0, camera]:
            follower.noise[camera] = measure_noise(
                [images[0, camera]],
                follower.rig.cameras[camera],
                [(R_cw @ pose[0], R_cw @ pose[1] + t_cw)],
                follower.disc,
                (follower.maps_x[camera], follower.maps_y[camera]),
            )
        elif readable[:n, camera].any():
            follower.noise[camera] = typical_noise(images[int(np.argmax(readable[:n, camera])), camera])
    for blur_known in (False, True):  # the second time with the blur of the first
        follower.start_from(pose, following)
        trial = _empty_rows(n, m)
        done = follower.run(images[:n], readable[:n], trial)
        if done == 0:
            return
        for camera, (R_cw, t_cw) in enumerate(follower.rig.camera_poses()):
            good = trial.status[:done, camera] == MarkerStatus.MEASURED
            if not good.any():
                continue
            follower.blur[camera] = float(np.median(trial.results[:done, camera, :, kernels.FIT_SIGMA][good]))
            if not blur_known:
                continue
            sample = range(0, done, NOISE_STEP)
            follower.noise[camera] = measure_noise(
                [images[k, camera] for k in sample],
                follower.rig.cameras[camera],
                [(R_cw @ trial.R[k], R_cw @ trial.t[k] + t_cw) for k in sample],
                follower.disc,
                (follower.maps_x[camera], follower.maps_y[camera]),
                follower.blur[camera],
            )
    follower.saturated = (
        _saturated(images[:done, 0], trial.results[:done, 0], follower.noise[0]),
        _saturated(images[:done, 1], trial.results[:done, 1], follower.noise[1]),
    )
    follower.keep_law()


def _saturated(images: Images, results: Array, noise: NoiseModel) -> int | None:
    """Grey value at which the background of the dots (n, m, 12) is clipped; None where it is not."""
    saturation = saturation_level(images)
    light = results[..., kernels.FIT_LEVEL]
    if saturation is None or not np.isfinite(light).any():
        return None
    level = float(np.nanmedian(light))
    return saturation if saturation - level < 3.0 * np.sqrt(noise.variance(np.array(level))) else None


def _assemble(
    followers: list[_Follower],
    tables: _Tables,
    settings: TrackingSettings,
    frame_rate: float,
    gravity: float,
    time: Array,
    pairs: range,
) -> Tracking:
    first = next((follower for follower in followers if follower.measured), followers[0])
    field = first.rig.lens_field
    if field is not None:
        tables.pixels = field.corrected(tables.pixels)
    as_built = refine_as_built(
        tables.pixels,
        tables.covariance_px2,
        first.rig,
        first.disc,
        tables.R,
        tables.t,
        refine_markers=settings.refine_markers,
        refine_rig=settings.refine_rig,
        max_frames=SHARED_FRAMES,
    )
    faults = without_shared_faults(
        tables.pixels, tables.covariance_px2, first.rig, first.disc, tables.R, tables.t, max_frames=SHARED_FRAMES
    )
    if settings.refine_markers and faults is not None:
        as_built = _without_false_shifts(as_built, first.disc, faults)
    fits = _fit_all(tables, as_built, settings.reject_outliers)
    scatter = split_scatter(fits, tables.covariance_px2, faults)
    factor, noise_factor = scatter.whole, scatter.noise
    tables.covariance_px2 *= noise_factor  # in place: nobody else holds them
    systematic = fits.covariance * scatter.systematic
    fits.covariance[...] *= noise_factor
    fits = replace(fits, chi_square=fits.chi_square / factor)
    fits, systematic, rig, table = table_from_disc(fits, systematic, as_built.rig, as_built.disc, settings.table)
    as_built = replace(as_built, rig=replace(rig, lens_field=None))  # what the dots have been corrected by
    trajectory = _trajectory(fits, systematic, tables, as_built, time, pairs, frame_rate, gravity)
    return Tracking(
        trajectory=trajectory,
        noise=(first.noise[0], first.noise[1]),
        blur_px=(first.blur[0], first.blur[1]),
        as_built=as_built,
        variance_factor=factor,
        noise_factor=noise_factor,
        systematic_px=scatter.systematic_px,
        table=table,
        acquisitions=sum(f.acquisitions for f in followers),
        warnings=_warnings(first, factor, faults, scatter, table, trajectory),
    )


def _without_false_shifts(as_built: AsBuilt, declared: Disc, faults: SharedFaults) -> AsBuilt:
    """Where cameras and clock are wrong, dots refined alone would be moved to make up for that: take the joint ones."""
    if not as_built.reduced_chi_square_after > FAULTY * max(1.0, faults.reduced_chi_square):
        return as_built
    shift = faults.marker_shift
    if np.sqrt(np.mean(shift**2)) < MIN_MARKER_SHIFT:
        shift = np.zeros_like(shift)
    disc = replace(declared, marker_centres_body=declared.marker_centres_body + shift)
    return replace(as_built, disc=disc, marker_shift=shift, marker_shift_sigma=faults.marker_shift_sigma)


def _fit_all(tables: _Tables, as_built: AsBuilt, reject_outliers: bool) -> PoseFits:
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


def _trajectory(
    fits: PoseFits,
    systematic: Array,
    tables: _Tables,
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
    marker_status = tables.status.copy()
    seen = tables.status == MarkerStatus.MEASURED
    marker_status[seen & ~fits.used & fits.converged[:, None, None]] = MarkerStatus.REJECTED
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
    follower: _Follower,
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
            f"the dots of only one camera make sense in {one} of {one + both} measured frames: are left and right "
            "exchanged, does the rig belong to this recording, does one camera look at the underside?"
        )
    order = symmetry_order(follower.disc)
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
    if variance_factor > FAULTY * own and systematic_px > ORDINARY_PX:
        warnings.append(
            f"the dots miss their fitted places by {np.sqrt(variance_factor / own):.1f} times their own "
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
