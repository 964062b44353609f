"""Following the disc through blocks of pairs, and recovery after a loss.

The loop over frames is one compiled call per block (`_kernels.track_frames`). This module does the rest: it finds the
disc at the start, extrapolates its motion while it is hidden, searches at growing intervals if that fails, follows it
backwards from where it was found again, and measures blur and noise.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from calibration.cameras.camera import StereoRig, normalised_maps
from calibration.kit.grey_levels import saturation_level
from calibration.kit.types import AnyArray, Array, Codes, Image, Mask
from disctrack.disc import Disc, symmetry_order
from disctrack.frames import rotation_from_vector, rotation_z, vector_from_rotation
from disctrack.track.dots import _kernels as kernels
from disctrack.track.dots.acquisition import Pose, acquire
from disctrack.track.dots.template import Edge, NoiseModel, face_of, residual_noise, rough_noise
from disctrack.track.pose import stacked
from disctrack.trajectory import FrameStatus, MarkerStatus, part

# rms residual of a pair above which the disc is lost: a tenth of a dot, ten times that of a poor rig
MAX_PREDICTION_RMS_PX = 2.0
SAMPLE = 12  # pairs from which blur, noise and stuck pixels are measured, and the cause if the disc is not found
MIN_TO_BEGIN = 5  # dot images that a newly found pose needs: three fit any pose
# Frames over which the last motion is extrapolated, each at the cost of one fit of the dots; also the longest wait
# between searches, each of which costs as much as some 600 fits
PATIENCE = 60
LIMITS = kernels.Limits()
MOST_USUAL = 0.1  # largest rms residual of declared dots, over the contrast
REPEAT_REACH = 4  # preceding frames with which an image is compared: recorders repeat from buffers of a few


class Heading(NamedTuple):
    """The last three poses, the latest last, from which the next is predicted (`_kernels.track_frames`)."""

    R: Array  # (3, 3, 3)
    t: Array  # (3, 3) [m]

    @classmethod
    def steady(cls, last: Pose, before: Pose) -> "Heading":
        """Heading of constant velocity: the turn and shift between these poses are repeated."""
        turn = last[0] @ before[0].T
        R, t = np.stack([turn.T @ before[0], before[0], last[0]]), [2 * before[1] - last[1], before[1], last[1]]
        return cls(R, np.stack(t))

    def carried_on(self, steps: int) -> "Heading":
        """Heading after so many more frames with constant velocity."""
        (R_before, R_last), (t_before, t_last) = self.R[1:], self.t[1:]
        turn = rotation_from_vector(steps * vector_from_rotation(R_last @ R_before.T))
        shift = steps * (t_last - t_before)
        return Heading.steady((turn @ R_last, t_last + shift), (turn @ R_before, t_before + shift))


def maps_of(rig: StereoRig) -> tuple[Array, Array]:
    """Undistorted normalised coordinates x and y (2, height, width) of the cameras' pixels; slow to compute."""
    maps_x, maps_y = zip(*map(normalised_maps, rig.cameras), strict=True)
    return np.stack(maps_x), np.stack(maps_y)


@dataclass
class Tables:
    """Results of every pair, kept until the poses are fitted: 1.2 kB per pair with six dots."""

    results: AnyArray  # (n, 2, m) of `_kernels.DOT`
    status: Codes  # (n, 2, m)
    R: Array  # (n, 3, 3)
    t: Array  # (n, 3)
    frame_status: Codes  # (n,)
    digest: AnyArray  # (n, 2) checksum of some rows of each image; 0 if there is no image


@dataclass
class Follower:
    """State of the tracking of one stretch of the recording, between its blocks."""

    rig: StereoRig
    disc: Disc
    maps: tuple[Array, Array]  # as from `maps_of`
    edges: tuple[Edge, ...] = (Edge(), Edge())  # of the dots in each camera
    heading: Heading | None = None
    lost: int | None = 0  # frames since the last pose; None while the disc is followed
    failures: int = 0  # failed searches in a row
    waited: int = 0  # frames since the last of them
    measured: bool = False  # blur and noise are known
    acquisitions: int = 0
    first_reason: str = ""  # why the first search failed
    first_row: int = 0  # of the stretch in the tables


def run(
    follower: Follower, heading: Heading, images: Image, readable: Mask, rows: Tables, limits: kernels.Limits = LIMITS
) -> tuple[int, Heading]:
    """Follow the disc through images (n, 2, height, width).

    limits : beyond which a dot is refused
    returns : number of frames until the disc was lost, and the heading there
    """
    blur, noise = np.array([edge.blur_px for edge in follower.edges]), np.array([edge.noise for edge in follower.edges])
    fixed = follower.maps, stacked(follower.rig), face_of(follower.disc), blur, noise, limits
    R, t = (np.concatenate([before, after]) for before, after in zip(heading, (rows.R, rows.t), strict=True))
    done = int(kernels.track_frames(images, readable, *fixed, rows.results, rows.status, R, t, MAX_PREDICTION_RMS_PX))
    rows.R[:done], rows.t[:done] = R[3 : 3 + done], t[3 : 3 + done]
    return done, Heading(R[done : done + 3], t[done : done + 3])


def empty_tables(n: int, m: int) -> Tables:
    """Tables of n pairs and m dots before any search."""
    return Tables(
        results=np.full((n, 2, m), np.nan, kernels.DOT),
        status=np.full((n, 2, m), MarkerStatus.NOT_LOOKED_FOR, np.uint8),
        R=np.full((n, 3, 3), np.nan),
        t=np.full((n, 3), np.nan),
        frame_status=np.full(n, FrameStatus.NOT_PROCESSED, np.uint8),
        digest=np.zeros((n, 2), np.uint64),
    )


def follow_block(follower: Follower, images: Image, readable: Mask, tables: Tables, start: int) -> None:
    """Fill n rows of the tables, from `start` on; images (n, 2, height, width), readable (n, 2)."""
    n, i = len(images), 0
    rows = part(tables, slice(start, start + n))  # views
    # a copy of an earlier image in one camera is a fault, as noise makes all images differ. If both cameras repeat,
    # the disc may be at rest: that is decided later, from the motion
    rows.digest[...] = np.where(readable, _digests(images), 0)
    repeated = repeats(tables.digest[max(follower.first_row, start - REPEAT_REACH) : start + n])[-n:]
    readable = readable & (~repeated | repeated.all(axis=1, keepdims=True))
    while i < n:
        anew = follower.lost is not None
        seen = bool(readable[i].any())
        if not seen:  # earlier failures do not predict what comes after a gap
            follower.failures = 0
        if not seen or (anew and not recover(follower, images[i:], readable[i:])):
            rows.frame_status[i] = FrameStatus.MARKERS_NOT_FOUND if seen else FrameStatus.UNREADABLE
            follower.lost, follower.waited = (follower.lost or 0) + 1, follower.waited + 1
            i += 1
            continue
        assert follower.heading is not None
        done, follower.heading = run(follower, follower.heading, images[i:], readable[i:], part(rows, slice(i, None)))
        rows.frame_status[i : i + done] = FrameStatus.MEASURED
        if anew and done > 1:
            _go_back(follower, images, readable, rows, i)
        i += done
        follower.failures = 0
        follower.lost = 0 if i < n else None


def _digests(images: Image) -> AnyArray:
    """(n, 2) checksums of images (n, 2, height, width), never 0: sums of words over some rows, which differ by noise.

    The cost is that of reading the rows from memory: fewer of large images suffice.
    """
    rows = np.ascontiguousarray(images[:, :, :: 16 if images.shape[2] < 512 else 32])
    words = rows.reshape(*rows.shape[:2], -1).view(np.uint8)
    words = words[..., : words.shape[-1] // 8 * 8].view(np.uint64)
    return np.maximum(words.sum(axis=-1), 1)


def repeats(digest: AnyArray) -> Mask:
    """(n, 2) True if an image equals one of the REPEAT_REACH before it; digest (n, 2), 0 if there is no image."""
    repeated = np.zeros(digest.shape, bool)
    for back in range(1, min(REPEAT_REACH, len(digest) - 1) + 1):
        repeated[back:] |= (digest[back:] == digest[:-back]) & (digest[back:] != 0)
    return repeated


def recover(follower: Follower, images: Image, readable: Mask) -> bool:
    """Set a heading that predicts the disc in the first of the pairs; False if it is not found.

    First the last motion is extrapolated, at the cost of one frame. Velocity is constant, as one bad pose would spoil
    an acceleration. Then the whole images are searched, after waits that grow by a frame with each failure.
    """
    heading, lost = follower.heading, follower.lost or 0
    if heading is not None and lost <= PATIENCE and _resumed(follower, heading.carried_on(lost), images, readable):
        return True
    if follower.waited < min(follower.failures, PATIENCE):
        return False
    if _search(follower, images, readable):
        follower.acquisitions += 1
        return True
    follower.failures, follower.waited = follower.failures + 1, 0
    return False


def _resumed(follower: Follower, heading: Heading, images: Image, readable: Mask) -> bool:
    """Set the heading, and return True, if enough dots are measured in the first of the pairs at its prediction."""
    trial = empty_tables(1, follower.disc.n_markers)
    done, _ = run(follower, heading, images[:1], readable[:1], trial)
    if done and _enough(trial.status[0]):
        follower.heading = heading
        return True
    if not follower.first_reason:
        kinds, counts = np.unique(trial.status, return_counts=True)
        listed = ", ".join(f"{n} {MarkerStatus(k).name.lower()}" for k, n in zip(kinds, counts, strict=True))
        follower.first_reason = (
            f"blobs lie where the dots should be, but their grey values do not fit the dots of [markers]: {listed}"
        )
    return False


def _enough(status: Codes) -> bool:
    """True if a pose with dots of this status (2, m) cannot be due to chance."""
    return int(np.sum(status == MarkerStatus.MEASURED)) >= min(MIN_TO_BEGIN, status.shape[-1])


def _go_back(follower: Follower, images: Image, readable: Mask, rows: Tables, found: int) -> None:
    """Follow the disc backwards from frame `found`, through preceding frames of the block without a pose."""
    first = found
    while first > 0 and rows.frame_status[first - 1] == FrameStatus.MARKERS_NOT_FOUND:
        first -= 1
    trial = empty_tables(found - first, follower.disc.n_markers)
    heading = Heading.steady((rows.R[found], rows.t[found]), (rows.R[found + 1], rows.t[found + 1]))
    pairs: Image = np.ascontiguousarray(images[first:found][::-1])  # type: ignore[assignment]  # the stubs forget it
    usable = np.ascontiguousarray(readable[first:found][::-1])
    done, _ = run(follower, heading, pairs, usable, trial)
    good = next((k for k in range(done) if not _enough(trial.status[k])), done)
    rows.frame_status[found - good : found] = FrameStatus.MEASURED
    for name in ("results", "status", "R", "t"):
        getattr(rows, name)[found - good : found] = getattr(trial, name)[:good][::-1]


def _search(follower: Follower, images: Image, readable: Mask) -> bool:
    """Search the whole images of the first pair; the first time also measure blur and noise.

    The velocity is that from the pose of the pair before, or zero if there is none.
    """
    pose, _, reason = acquire(np.where(readable[0, :, None, None], images[0], 0), follower.rig, follower.disc)
    follower.first_reason = follower.first_reason or reason
    if pose is None:
        return False
    before = pose if follower.heading is None or follower.lost != 0 else (follower.heading.R[2], follower.heading.t[2])
    heading = Heading.steady(_nearest_alike(before, pose, follower.disc), before).carried_on(-1)
    if not follower.measured:
        _measure_blur_and_noise(follower, images, readable, heading)
    return _resumed(follower, heading, images, readable)


def _nearest_alike(pose: Pose, following: Pose, disc: Disc) -> Pose:
    """Of the poses equivalent to `following` by symmetry of the dots, the one with the least turn from `pose`."""
    R, t = following
    order = symmetry_order(disc)
    alike = R @ rotation_z(2 * np.pi * np.arange(order) / order)
    return alike[np.argmax(np.einsum("ij,nij->n", pose[0], alike))], t


def _measure_blur_and_noise(follower: Follower, images: Image, readable: Mask, heading: Heading) -> None:
    """Measure noise and blur of the cameras; `measured` stays False if the disc is not seen."""
    n = min(SAMPLE, len(images))
    edges = [Edge(noise=rough_noise(images[seen.argmax(), camera])) for camera, seen in enumerate(readable[:n].T)]
    # the second time with the blur and the residual noise of the first
    for limits in (kernels.Limits(blur=np.inf, share=MOST_USUAL), LIMITS):
        # kept also if the fit fails: the status of the dots depends on the noise assumed
        follower.edges, trial = tuple(edges), empty_tables(n, follower.disc.n_markers)
        done, _ = run(follower, heading, images[:n], readable[:n], trial, limits)
        if done == 0 or not _enough(trial.status[0]):
            return
        for camera in range(2):
            fits = trial.results[:done, camera][trial.status[:done, camera] == MarkerStatus.MEASURED]
            if len(fits):
                noise = residual_noise(edges[camera].noise, fits)
                blur, level, contrast = (float(np.median(fits[name])) for name in ("sigma", "level", "contrast"))
                edges[camera] = Edge(blur, level, contrast, noise, _saturated(images[:done, camera], fits, noise))
    follower.edges, follower.measured = tuple(edges), True


def _saturated(images: Image, fits: AnyArray, noise: NoiseModel) -> int | None:
    """Grey value at which the brighter side of the edges of dots (k,) of DOT is clipped; None if it is not."""
    saturation = saturation_level(images)
    level = float(np.median(fits["level"] * (1.0 - np.minimum(fits["contrast"], 0.0))))
    clipped = saturation is not None and saturation - level < 3.0 * np.sqrt(noise.variance(np.array(level)))
    return saturation if clipped else None
