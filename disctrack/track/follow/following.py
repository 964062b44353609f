"""Following the disc through blocks of pairs: by its motion while it is seen, by what is known of it after a loss.

The loop over frames is one compiled call per block (`_kernels.track_frames`); here stands what happens at its ends:
finding the disc at the start, carrying its motion on while it is hidden, searching at growing intervals where that
fails, going back over the frames before it was found again, and measuring blur and noise.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
from numpy.typing import DTypeLike, NDArray

from calibration.cameras.camera import StereoRig
from calibration.kit.arrays import Array, Array32, Image, Mask
from calibration.kit.grey_levels import saturation_level
from disctrack.disc import Disc
from disctrack.track.dots import _kernels as kernels
from disctrack.track.dots.acquisition import acquire
from disctrack.track.dots.template import (
    TYPICAL_BLUR_PX,
    NoiseModel,
    TemplateLimits,
    dot_centres,
    face_edge,
    measure_noise,
    no_more_than_left,
    typical_noise,
)
from disctrack.track.follow.motion_span import StillScene
from disctrack.trajectory import FrameStatus, MarkerStatus

Pose = tuple[Array, Array]  # R_world_body (3, 3), t_world_body (3,) [m]

# A pair whose dots disagree by more than this with any rigid motion is lost: a tenth of a dot, ten times a poor rig
MAX_PREDICTION_RMS_PX = 2.0
NOISE_FRAMES, NOISE_STEP = 12, 3  # frames that blur is taken from, and every third of them for the noise
MIN_TO_BEGIN = 5  # dot images that must be measured where the disc is found anew: three fit anything
MOST_CARRIED = 60  # frames over which the last motion is carried on; each costs one look at the dots
FRAMES_PER_SEARCH = 60  # a search that fails costs as much as some 600 frames: ten frames' time each on average
UNUSUAL = 2.0  # times the usual misfit; of dots in compressed video, one in twenty leaves 1.25 times the median
MOST_USUAL = 0.1  # of the contrast: dots that leave more than this are not the declared ones
DIGESTED_AT_ONCE = 8  # pairs, whose rows stay in a core's cache
REPEAT_REACH = 4  # frames back that an image is compared with: recorders repeat from buffers of a few


@dataclass(frozen=True)
class Law:
    """Noise and blur [px] of the left and the right camera, and how well dots fit."""

    noise: tuple[NoiseModel, NoiseModel] = (NoiseModel(1.0, 0.02), NoiseModel(1.0, 0.02))
    blur: tuple[float, float] = (TYPICAL_BLUR_PX, TYPICAL_BLUR_PX)
    light: tuple[tuple[float, float], tuple[float, float]] = ((200.0, 0.85), (200.0, 0.85))  # paper's grey, contrast
    misfit: float = 1.0  # rms residual over the noise that dots usually leave: compressed edges leave 4 and more

    def limits(self, limits: TemplateLimits) -> TemplateLimits:
        """A dot is refused for a misfit that is unusual in this recording."""
        return replace(limits, misfit=max(limits.misfit, UNUSUAL * self.misfit))


@dataclass(frozen=True)
class Heading:
    """The last three poses, from which the next is predicted (`_kernels.track_frames`)."""

    last: Pose
    before: Pose
    older: Pose

    @classmethod
    def steady(cls, last: Pose, before: Pose) -> Heading:
        """The next prediction makes their turn and shift once more, as if they had been made before, too."""
        turn = last[0] @ before[0].T
        return cls(last, before, (turn.T @ before[0], 2 * before[1] - last[1]))

    @classmethod
    def leading_to(cls, pose: Pose, following: Pose | None) -> Heading:
        """The next prediction is `pose`, the one after it `following`, or the same where that is not known."""
        R, t = pose
        turn, shift = np.eye(3), np.zeros(3)
        if following is not None:
            turn, shift = following[0] @ R.T, following[1] - t
        last = (turn.T @ R, t - shift)
        return cls.steady(last, (turn.T @ last[0], t - 2 * shift))

    def carried_on(self, steps: int) -> Heading:
        """As after so many more frames of the same motion."""
        turn, shift = self.last[0] @ self.before[0].T, self.last[1] - self.before[1]
        last, before = self.last, self.before
        for _ in range(steps):
            last, before = (turn @ last[0], last[1] + shift), last
        return Heading.steady(last, before)


@dataclass(frozen=True)
class Search:
    """What may be spent on searching for the disc, and what the images showed where it was not found."""

    credit: int = 8  # searches that may be made
    always: bool = False  # whatever it costs
    earned: int = 0  # frames towards the next
    failures: int = 0  # in succession
    since: int = 0  # frames since the last of them
    scenes: tuple[StillScene, StillScene] | None = None

    def frames_later(self, n: int) -> Search:
        """With what n more frames have earned."""
        earned = self.earned + n
        return replace(
            self, credit=self.credit + earned // FRAMES_PER_SEARCH, earned=earned % FRAMES_PER_SEARCH,
            since=self.since + n,
        )  # fmt: skip

    def is_due(self, pair: Image, readable: Mask, seen: bool) -> bool:
        """True where there is credit, and reason to hope.

        A disc that was seen before comes out from behind a hand after some frames: the wait grows by one with every
        failure. Where none was seen yet, the pair (2, height, width) must show something new, or the wait doubles.
        """
        if self.always:
            return True
        if self.credit == 0 or (self.failures and self.since < self.failures):
            return False
        if seen or self.scenes is None or self.since >= min(2**self.failures, FRAMES_PER_SEARCH) or not readable.all():
            return True
        return any(map(StillScene.differs, self.scenes, pair))

    def failed(self, images: Image, readable: Mask) -> Search:
        """After a search of the first of the pairs; the second tells how pixels scatter without anything new."""
        scenes = None
        if len(images) > 1 and readable[:2].all():
            scenes = StillScene(images[0, 0], images[1, 0]), StillScene(images[0, 1], images[1, 1])
        return replace(self, credit=self.credit - 1, failures=self.failures + 1, since=0, scenes=scenes)


@dataclass(frozen=True)
class TrackingSetup:
    """What does not change while a recording is followed."""

    rig: StereoRig
    disc: Disc
    limits: TemplateLimits
    maps_x: Array  # (2, height, width) undistorted normalised coordinates of every pixel
    maps_y: Array


@dataclass
class Tables:
    """What is kept of every pair until the poses are fitted: 0.9 kB with six dots."""

    pixels: Array  # (n, 2, m, 2)
    covariance_px2: Array  # (n, 2, m, 2, 2)
    status: NDArray[np.uint8]  # (n, 2, m)
    misfit: Array32  # (n, 2, m) reduced chi-square of the grey values round each dot
    n_pixels: Array32  # (n, 2, m) grey values that it was taken over
    blur_px: Array32  # (n, 2, m) sigma of each dot's edge, smear of its motion included
    contrast: Array32  # (n, 2, m) of each dot with its paper
    R: Array  # (n, 3, 3)
    t: Array  # (n, 3)
    frame_status: NDArray[np.uint8]  # (n,)
    digest: NDArray[np.uint32]  # (n, 2) of some of each image's rows; 0 where there is no image


@dataclass
class Rows:
    """What the loop over frames fills."""

    results: Array  # (n, 2, m, 12)
    status: NDArray[np.uint8]  # (n, 2, m)
    R: Array  # (n, 3, 3)
    t: Array  # (n, 3)

    def part(self, start: int, stop: int | None = None) -> Rows:
        """Views of the rows start..stop-1."""
        rows = slice(start, stop)
        return Rows(self.results[rows], self.status[rows], self.R[rows], self.t[rows])


@dataclass
class Follower:
    """One stretch of the recording: what is known of the disc between its blocks."""

    setup: TrackingSetup
    law: Law = field(default_factory=Law)
    heading: Heading | None = None
    lost: int | None = 0  # frames since the last pose; None while the disc is followed
    search: Search = field(default_factory=Search)
    measured: bool = False  # blur and noise known
    acquisitions: int = 0
    first_reason: str = ""
    saturated: tuple[int | None, int | None] = (None, None)  # grey value at which the dots' brighter side is clipped
    given: Callable[[], Law | None] = lambda: None  # noise and blur that an earlier stretch has measured
    told: Future[Law | None] = field(default_factory=Future)  # what this stretch measured; None if it did not
    first_row: int | None = None  # of the tables

    def keep_law(self, law: Law) -> None:
        """Keep noise and blur as they are, and let later stretches have them."""
        self.law, self.measured = law, True
        self.told.set_result(law)

    def finish(self) -> None:
        """Let nobody wait for a law that was never measured."""
        if not self.told.done():
            self.told.set_result(None)


def run(
    setup: TrackingSetup, law: Law, heading: Heading, images: Image, readable: Mask, rows: Rows
) -> tuple[int, Heading]:
    """Follow the disc through images (n, 2, height, width); returns the frames before it was lost, and the heading."""
    poses = setup.rig.camera_poses()
    # the loop moves them on
    known = [np.array(part, float, order="C") for part in (*heading.last, *heading.before, *heading.older)]
    done = kernels.track_frames(
        images,
        readable,
        setup.maps_x,
        setup.maps_y,
        np.stack([camera.parameters for camera in setup.rig.cameras]),
        np.stack([R for R, _ in poses]),
        np.stack([t for _, t in poses]),
        np.ascontiguousarray(setup.disc.marker_centres_body),
        0.5 * setup.disc.marker_diameter,
        face_edge(setup.disc),
        np.array(law.blur),
        np.stack([noise.parameters for noise in law.noise]),
        law.limits(setup.limits).array(),
        *known,
        rows.results,
        rows.status,
        rows.R,
        rows.t,
        MAX_PREDICTION_RMS_PX,
    )
    R_last, t_last, R_before, t_before, R_older, t_older = known
    return int(done), Heading((R_last, t_last), (R_before, t_before), (R_older, t_older))


def prepare(dtype: DTypeLike = np.uint8) -> None:
    """Compile the loop over frames for images of this type, or load it."""
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
        *(np.eye(3), zeros(3)) * 3,
        zeros((0, 2, 1, kernels.N_RESULT)),
        zeros((0, 2, 1), np.uint8),
        zeros((0, 3, 3)),
        zeros((0, 3)),
        MAX_PREDICTION_RMS_PX,
    )


def empty_tables(n: int, m: int) -> Tables:
    """Tables of n pairs and m dots in which nothing was looked for."""
    return Tables(
        pixels=np.full((n, 2, m, 2), np.nan),
        covariance_px2=np.full((n, 2, m, 2, 2), np.nan),
        status=np.full((n, 2, m), MarkerStatus.NOT_LOOKED_FOR, np.uint8),
        misfit=np.full((n, 2, m), np.nan, np.float32),
        n_pixels=np.full((n, 2, m), np.nan, np.float32),
        blur_px=np.full((n, 2, m), np.nan, np.float32),
        contrast=np.full((n, 2, m), np.nan, np.float32),
        R=np.full((n, 3, 3), np.nan),
        t=np.full((n, 3), np.nan),
        frame_status=np.full(n, FrameStatus.NOT_PROCESSED, np.uint8),
        digest=np.zeros((n, 2), np.uint32),
    )


def clear(tables: Tables, rows: slice) -> None:
    """Make the rows as if nothing had been looked for."""
    empty = empty_tables(1, tables.status.shape[2])
    for name, value in vars(empty).items():
        getattr(tables, name)[rows] = value[0]


def empty_rows(n: int, m: int) -> Rows:
    """Rows of n pairs and m dots that nothing has filled."""
    tables = empty_tables(n, m)
    return Rows(np.full((n, 2, m, kernels.N_RESULT), np.nan), tables.status, tables.R, tables.t)


def follow_block(follower: Follower, images: Image, readable: Mask, tables: Tables, start: int) -> None:
    """Fill the tables' rows from `start` on with what n pairs show; images (n, 2, height, width), readable (n, 2)."""
    n, i = len(images), 0
    own = slice(start, start + n)
    if follower.first_row is None:
        follower.first_row = start
    readable = readable & ~_repeated_alone(images, readable, tables, start, follower.first_row)
    results = np.full((n, 2, follower.setup.disc.n_markers, kernels.N_RESULT), np.nan)
    rows = Rows(results, tables.status[own], tables.R[own], tables.t[own])
    status = tables.frame_status[own]
    while i < n:
        if not readable[i].any():
            status[i] = FrameStatus.UNREADABLE
            follower.lost = (follower.lost or 0) + 1
            i += 1
            continue
        anew = follower.lost is not None
        if anew and not recover(follower, images[i:], readable[i:]):
            status[i] = FrameStatus.MARKERS_NOT_FOUND
            follower.lost = (follower.lost or 0) + 1
            follower.search = follower.search.frames_later(1)
            i += 1
            continue
        assert follower.heading is not None
        done, follower.heading = run(
            follower.setup, follower.law, follower.heading, images[i:], readable[i:], rows.part(i)
        )
        status[i : i + done] = FrameStatus.MEASURED
        if anew and done > 1:
            _go_back(follower, images, readable, rows, status, i)
        i += done
        follower.search = replace(follower.search.frames_later(done), failures=0, scenes=None)
        follower.lost = 0 if i < n else None
    dots = dot_centres(results, rows.status)
    tables.pixels[own], tables.covariance_px2[own] = dots.pixels, dots.covariance_px2
    tables.misfit[own], tables.n_pixels[own] = dots.misfit, results[..., kernels.N_PIXELS]
    tables.blur_px[own] = dots.blur_px
    tables.contrast[own] = dots.contrast


def _repeated_alone(images: Image, readable: Mask, tables: Tables, start: int, first: int) -> Mask:
    """(n, 2) True where one camera repeats an earlier image and the other does not; the tables keep the digests.

    No two images of a camera are equal, by their noise. Where both repeat, nothing may have moved: that is judged by
    the motion. first : row at which the stretch begins; those before it may not be filled yet.
    """
    n = len(images)
    tables.digest[start : start + n] = np.where(readable, _digests(images), 0)
    repeated = repeats(tables.digest[max(first, start - REPEAT_REACH) : start + n])[-n:]
    return repeated & ~repeated.all(axis=1, keepdims=True)


def _digests(images: Image) -> NDArray[np.uint32]:
    """(n, 2) of rows enough of each image (n, 2, height, width) to tell noise from noise; not 0.

    A weighted sum: four times as fast as a CRC. What it costs is fetching the rows: of large images fewer will do.
    """
    digests = np.empty(images.shape[:2], np.uint32)
    step = 16 if images.shape[2] < 512 else 32
    for first in range(0, len(images), DIGESTED_AT_ONCE):
        some = slice(first, first + DIGESTED_AT_ONCE)
        rows = np.ascontiguousarray(images[some, :, ::step])
        words = rows.reshape(*rows.shape[:2], -1).view(np.uint8)
        words = words[..., : words.shape[-1] // 8 * 8].view(np.uint64)
        digests[some] = words @ _odd_numbers(words.shape[-1]) >> np.uint64(32)
    return np.maximum(digests, 1)


@cache
def _odd_numbers(n: int) -> NDArray[np.uint64]:
    """(n,) of 64 bits that look like chance, each invertible: no change of one word leaves the sum as it is."""
    return np.random.default_rng(0).integers(0, 2**64, n, np.uint64) | np.uint64(1)


def repeats(digest: NDArray[np.uint32]) -> Mask:
    """(n, 2) True where a camera's image is one of those REPEAT_REACH frames before; digest (n, 2), 0 for no image."""
    repeated = np.zeros(digest.shape, bool)
    for back in range(1, min(REPEAT_REACH, len(digest) - 1) + 1):
        repeated[back:] |= (digest[back:] == digest[:-back]) & (digest[back:] != 0)
    return repeated


def recover(follower: Follower, images: Image, readable: Mask) -> bool:
    """Set a heading that leads to the disc in the first of the pairs; False where it is not found.

    First its last motion is carried on, with no acceleration, which one bad pose would have spoilt: that costs no more
    than any other frame; then, now and then, it is searched for in the whole images.
    """
    if follower.heading is not None and follower.lost is not None and follower.lost <= MOST_CARRIED:
        carried = follower.heading.carried_on(follower.lost)
        if _holds(follower, carried, images, readable):
            follower.heading = carried
            return True
    if not follower.search.is_due(images[0], readable[0], follower.heading is not None):
        return False
    if _search(follower, images, readable):
        follower.acquisitions += 1
        return True
    follower.search = follower.search.failed(images, readable)
    return False


def _holds(follower: Follower, heading: Heading, images: Image, readable: Mask) -> bool:
    """True where the first of the pairs shows dots enough at the place where the heading leads."""
    trial = empty_rows(1, follower.setup.disc.n_markers)
    done, _ = run(follower.setup, follower.law, heading, images[:1], readable[:1], trial)
    if done and _enough(trial.status):
        return True
    follower.first_reason = follower.first_reason or _refusals(trial.status[0])
    return False


def _enough(status: NDArray[np.uint8]) -> bool:
    """True where a pose with dots of this status (1, 2, m) is not chance."""
    found = int(np.sum(status == MarkerStatus.MEASURED))
    return found >= min(MIN_TO_BEGIN, status.shape[-1])


def _go_back(
    follower: Follower,
    images: Image,
    readable: Mask,
    rows: Rows,
    status: NDArray[np.uint8],
    found: int,
) -> None:
    """Follow the disc backwards from where it was found anew, through frames of the block that have no pose."""
    first = found
    while first > 0 and status[first - 1] == FrameStatus.MARKERS_NOT_FOUND:
        first -= 1
    if first == found:
        return
    back = slice(first, found)
    trial = empty_rows(found - first, follower.setup.disc.n_markers)
    heading = Heading.steady((rows.R[found], rows.t[found]), (rows.R[found + 1], rows.t[found + 1]))
    pairs: Image = np.ascontiguousarray(images[back][::-1])  # type: ignore[assignment]  # the stubs forget the depth
    usable = np.ascontiguousarray(readable[back][::-1])
    done, _ = run(follower.setup, follower.law, heading, pairs, usable, trial)
    for k in range(done):
        if not _enough(trial.status[k : k + 1]):
            break
        i = found - 1 - k
        rows.results[i], rows.status[i], rows.R[i], rows.t[i] = (
            trial.results[k], trial.status[k], trial.R[k], trial.t[k],
        )  # fmt: skip
        status[i] = FrameStatus.MEASURED


def _refusals(status: NDArray[np.uint8]) -> str:
    """Why the dots (2, m) of a pair were refused, in words."""
    kinds, counts = np.unique(status, return_counts=True)
    listed = ", ".join(f"{n} {MarkerStatus(k).name.lower()}" for k, n in zip(kinds, counts, strict=True))
    return f"blobs lie where the dots should be, but their grey values do not fit the dots of [markers]: {listed}"


def _search(follower: Follower, images: Image, readable: Mask) -> bool:
    """Search the whole of the first pair (and of the second, for the velocity); at first also measure blur, noise."""
    pose = _found(follower, images[0], readable[0])
    if pose is None:
        return False
    following = None
    if len(images) > 1 and readable[1].any():
        following = _found(follower, images[1], readable[1])
    heading = Heading.leading_to(pose, following)
    if not follower.measured and (law := follower.given()) is not None:
        follower.keep_law(law)
    if not follower.measured:
        _measure_blur_and_noise(follower, images, readable, pose, heading)
    if not _holds(follower, heading, images, readable):
        return False
    follower.heading = heading
    return True


def _found(follower: Follower, pair: Image, readable: Mask) -> Pose | None:
    setup = follower.setup
    found = acquire(np.where(readable[0], pair[0], 0), np.where(readable[1], pair[1], 0), setup.rig, setup.disc)
    if found.R_world_body is None or found.t_world_body is None:
        follower.first_reason = follower.first_reason or found.reason
        return None
    return found.R_world_body, found.t_world_body


def _measure_blur_and_noise(follower: Follower, images: Image, readable: Mask, pose: Pose, heading: Heading) -> None:
    """Measure the law of the cameras' noise and blur; where the disc is not there after all, nothing is kept."""
    setup, law = follower.setup, Law()
    n, m = min(NOISE_FRAMES, len(images)), setup.disc.n_markers
    noise, blur, light = list(law.noise), list(law.blur), list(law.light)
    views = list(enumerate(setup.rig.camera_poses()))
    for camera, (R_cw, t_cw) in views:
        # a first idea of the noise, or good dots of a noisy camera, or of more than 8 bits, would look like misfits;
        # the pose found by blobs is good to a fraction of a pixel, and the flat parts keep off the edges by more
        if readable[0, camera]:
            noise[camera] = measure_noise(
                [images[0, camera]],
                setup.rig.cameras[camera],
                [(R_cw @ pose[0], R_cw @ pose[1] + t_cw)],
                setup.disc,
                (setup.maps_x[camera], setup.maps_y[camera]),
            )
        elif readable[:n, camera].any():
            noise[camera] = typical_noise(images[int(np.argmax(readable[:n, camera])), camera])
    misfit = 1.0
    for blur_known in (False, True):  # the second time with the blur of the first, and the misfit that is usual
        law = Law((noise[0], noise[1]), (blur[0], blur[1]), misfit=misfit)
        trial = empty_rows(n, m)
        limits = setup.limits if blur_known else replace(setup.limits, blur=np.inf, share=MOST_USUAL)
        done, _ = run(replace(setup, limits=limits), law, heading, images[:n], readable[:n], trial)
        if done == 0 or not _enough(trial.status[:1]):
            follower.law = law  # how the noise was taken to be tells why the dots are refused
            return
        good = trial.status[:done] == MarkerStatus.MEASURED
        for camera, (R_cw, t_cw) in views:
            fits = trial.results[:done, camera][good[:, camera]]
            if not len(fits):
                continue
            blur[camera] = float(np.median(fits[:, kernels.FIT_SIGMA]))
            light[camera] = tuple(np.median(fits[:, (kernels.FIT_LEVEL, kernels.FIT_CONTRAST)], axis=0).tolist())
            misfit = max(misfit, float(np.sqrt(np.median(fits[:, kernels.CHI_SQUARE]))))
            if not blur_known:
                continue
            sample = range(0, done, NOISE_STEP)
            flat = measure_noise(
                [images[k, camera] for k in sample],
                setup.rig.cameras[camera],
                [(R_cw @ trial.R[k], R_cw @ trial.t[k] + t_cw) for k in sample],
                setup.disc,
                (setup.maps_x[camera], setup.maps_y[camera]),
                blur[camera],
            )
            noise[camera] = no_more_than_left(flat, noise[camera], fits)
    follower.saturated = (
        _saturated(images[:done, 0], trial.results[:done, 0], noise[0]),
        _saturated(images[:done, 1], trial.results[:done, 1], noise[1]),
    )
    follower.keep_law(Law((noise[0], noise[1]), (blur[0], blur[1]), (light[0], light[1]), misfit))


def _saturated(images: Image, results: Array, noise: NoiseModel) -> int | None:
    """Grey value at which the brighter side of the edges of dots (n, m, 12) is clipped; None where it is not."""
    saturation = saturation_level(images)
    light = results[..., kernels.FIT_LEVEL] * (1.0 - np.minimum(results[..., kernels.FIT_CONTRAST], 0.0))
    if saturation is None or not np.isfinite(light).any():
        return None
    level = float(np.nanmedian(light))
    return saturation if saturation - level < 3.0 * np.sqrt(noise.variance(np.array(level))) else None
