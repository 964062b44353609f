"""The complete measurement: a recording's files, or frames in memory, become a trajectory with its provenance."""

import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from calibration.cameras.camera import StereoRig
from calibration.kit.threads import one_blas_thread
from calibration.kit.types import AnyArray, FrameRate, Gravity, Threads, Times, checked, grey_values
from disctrack.analyse.declaration import Boards, contradictions
from disctrack.disc import Disc
from disctrack.errors import RecordingError, TrackingError
from disctrack.files.json_text import json_sha256
from disctrack.findings import Finding, Kind, Severity, of_kind, warn_of_doubts
from disctrack.frames import CAMERAS
from disctrack.progress import compiling
from disctrack.recording.declaration import Recording
from disctrack.recording.readers import open_frames
from disctrack.recording.readers.base import FrameReader, frames_in_parts
from disctrack.recording.readers.blocks import NotRead, PairBlock, check_pair, default_threads, iter_pair_blocks
from disctrack.recording.readers.flat_field import flat_fielded, flat_fields
from disctrack.recording.readers.same_instants import check_headers, check_same_numbers, check_time_stamps, usable_times
from disctrack.track.follow.motion_span import MotionSpan, find_motion
from disctrack.track.follow.tracking import Progress, ReadBlocks, check_images, prepare, silent, stretch_edges, track
from disctrack.track.refine.assembly import Measurement, Taken, TrackingSettings
from disctrack.trajectory import FrameStatus, at_full_length
from disctrack.trajectory.file import Provenance

Images = AnyArray  # of any real type; uint8 and uint16 are not copied

WHOLE_BELOW = 2.0  # [s] shorter recordings were cut by the user, and are measured including rest
BLOCK = 64  # pairs in memory


@dataclass(frozen=True)
class ImagePairs:
    """The frames of a recording that are to be measured: both cameras, checked to belong together."""

    left: FrameReader
    right: FrameReader
    start: int
    stop: int
    findings: tuple[Finding, ...] = ()  # about reading the frames, and assumptions about their times

    def __len__(self) -> int:
        return self.stop - self.start

    def reading(self, not_read: NotRead, threads: int | None = None) -> ReadBlocks:
        """Function that yields pairs start..stop-1 in blocks; images that cannot be read are added to `not_read`."""

        def read_blocks(start: int, stop: int) -> Iterator[PairBlock]:
            for block in iter_pair_blocks(self.left, self.right, start, stop, threads=threads):
                not_read.update(block.unreadable)
                yield block

        return read_blocks

    def camera_headers(self) -> dict[str, Any]:
        """Settings that the cameras wrote (exposure, trigger, ...) under "camera_headers", if any."""
        both = zip(CAMERAS, (self.left.header, self.right.header), strict=True)
        headers = {name: header.as_dict() for name, header in both if header is not None}
        return {"camera_headers": headers} if headers else {}

    def inputs(self) -> dict[str, str]:
        """SHA-256 of each camera's frames."""
        with ThreadPoolExecutor(2) as pool:  # hashing a gigabyte takes a second
            digests = pool.map(lambda reader: reader.content_sha256(self.start, self.stop), (self.left, self.right))
            return {f"{name} frames": digest for name, digest in zip(CAMERAS, digests, strict=True)}


@checked
def open_pairs(recording: Recording, frames: tuple[int | None, int | None] = (None, None)) -> ImagePairs:
    """Open both cameras. frames: first and one past the last frame to measure, None for the recording's ends.

    Raises RecordingError if images are missing or do not belong together, if the range contains no frame, or if the
    header of a camera contradicts that of the other or the declared frame rate.

        >>> len(open_pairs("clip", frames=(100, 200)))
        100
    """
    readers = [open_frames(getattr(recording, camera), recording.folder, camera) for camera in CAMERAS]
    readers = flat_fielded(readers, flat_fields(recording.folder, recording.sensors))
    left, right = frames_in_parts(readers, recording.parts, str(recording.file))
    headers = [*check_headers(left, right, recording.frame_rate, recording.exposure, str(recording.file))]
    check_pair(left, right)
    findings = (
        *of_kind(Kind.READING, Severity.DOUBT, (*left.doubts, *right.doubts, *check_same_numbers(left, right))),
        *check_time_stamps(left, right, recording.frame_rate),
        *of_kind(Kind.HEADERS, Severity.WARNING, headers),
        *of_kind(Kind.READING, Severity.NOTE, (*left.notes, *right.notes)),
    )
    start, stop, _ = slice(*frames).indices(len(left))
    if frames[1] is not None and frames[1] > len(left):
        cut = f"--frames {frames[0] or 0}:{frames[1]} is cut: the recording has the frames 0 to {len(left) - 1}"
        findings += (Finding(Kind.READING, Severity.NOTE, cut),)
    if stop <= start:
        raise RecordingError(
            f"{recording.folder}: --frames {frames[0]}:{frames[1]} holds no frame; the recording has {len(left)}."
        )
    return ImagePairs(left, right, start, stop, findings)


def check_rig(rig: StereoRig, pairs: ImagePairs) -> None:
    """Raise TrackingError, with the file's name, unless the rig was calibrated at the recording's image size."""
    for reader in (pairs.left, pairs.right):
        check_images(reader.image_size, rig, f"{reader.describe(pairs.start)}: {reader.camera} images")


@one_blas_thread
@checked
def measure(
    recording: Recording,
    rig: StereoRig,
    pairs: ImagePairs,
    settings: TrackingSettings | None = None,
    threads: Threads | None = None,
    progress: Progress = silent,
    boards: Boards | None = None,
) -> Measurement:
    """Track the disc through the pairs; the trajectory has the length of the recording.

    Images that cannot be read are lost, and listed in the result. progress is called with the number of pairs done.
    boards : of the calibration's views, with its findings
    Raises TrackingError if the disc is found in no frame.

        >>> measurement = measure("clip", "clip/results/rig.h5", open_pairs("clip"))
        >>> int(measurement.trajectory.measured.sum())
        300
    """
    check_rig(rig, pairs)
    settings, headers = as_declared(settings or TrackingSettings(), recording, pairs)
    stamps = usable_times(pairs.left, recording.frame_rate)
    with compiling("tracking", 15):  # once per installation, not counted as measuring time
        prepare(np.uint8 if pairs.left.bit_depth == 8 else np.uint16)
    began = time.perf_counter()
    span = _span(pairs, recording.frame_rate, settings)
    frames = range(span.start, span.stop)
    progress(len(pairs) - len(frames))
    taken = Taken(frames, recording.frame_rate, recording.gravity, stamps, settings, recording.chessboard)
    found = _tracked(recording, rig, pairs, taken, threads or default_threads(), progress)
    seconds = time.perf_counter() - began
    findings = (
        *pairs.findings,
        *of_kind(Kind.EXPOSURE, Severity.NOTE, headers),
        *images_lost(found.unreadable),
        *found.trajectory.findings,
        *(() if boards is None else boards.findings),
    )
    reading = {"unreadable": [*found.unreadable.values()], "first_pass": asdict(span)}
    details = {**found.details, **reading, **pairs.camera_headers()}
    trajectory = at_full_length(found.trajectory, len(pairs.left), span.start, stamps)
    for still in (slice(pairs.start, span.start), slice(span.stop, pairs.stop)):
        trajectory.frame_status[still] = FrameStatus.STILL
    findings = contradictions(trajectory, recording.disc, recording, findings, boards, details["blur_px"])
    trajectory = replace(trajectory, air_density=recording.air_density, findings=findings)
    warn_of_doubts(findings)
    return Measurement(trajectory, details, found.unreadable, seconds)


@one_blas_thread
@checked
def measure_pairs(
    images: tuple[Images, Images] | Images,
    rig: StereoRig,
    disc: Disc,
    frame_rate: FrameRate,
    *,
    gravity: Gravity = 9.81,
    settings: TrackingSettings | None = None,
    timestamps: Times | None = None,
    threads: Threads = 1,
) -> Measurement:
    """Measure the disc's pose in every pair; every frame is measured (no rest is left out).

    images     : (n, 2, height, width) grey values, left and right; or the pair of arrays (n, height, width)
    rig, disc  : or objects with them: the path of a rig file, a calibration, a recording
    frame_rate : [Hz]; timestamps (n,) [s], increasing, if the camera wrote them
    gravity    : [m/s^2], stored with the trajectory for the analysis
    Raises TrackingError if the arrays are not such images, do not belong to the rig, or show the disc in no pair.

        >>> pairs = open_pairs("clip")
        >>> images = np.array([[pairs.left.read(i), pairs.right.read(i)] for i in range(20)])
        >>> len(measure_pairs(images, "clip/results/rig.h5", read_recording("clip"), 1000.0).trajectory)
        20
    """
    if not isinstance(images, tuple | list):
        images = grey_values(images, "images")
    left, right = _sides(images)
    n = len(left)
    times = None if timestamps is None else np.asarray(timestamps, float)
    if times is not None and (times.shape != (n,) or not np.all(np.diff(times) > 0)):
        raise TrackingError(f"timestamps of shape {times.shape} for {n} pairs; expected ({n},), increasing, in seconds")
    prepare(left.dtype)

    def read_blocks(start: int, stop: int) -> Iterator[PairBlock]:
        for first in range(start, stop, BLOCK):
            rows = slice(first, min(first + BLOCK, stop))
            # a contiguous array is not copied: only the pixels of the dots are read
            together = isinstance(images, np.ndarray) and images.flags.carray
            pair = images[rows] if together else np.stack([left[rows], right[rows]], axis=1)
            yield PairBlock(np.arange(rows.start, rows.stop), pair)

    began = time.perf_counter()
    taken = Taken(range(n), frame_rate, gravity, times, settings or TrackingSettings())
    found = track(read_blocks, taken, rig, disc, threads, silent)
    seconds = time.perf_counter() - began
    findings = contradictions(found.trajectory, disc, noticed=found.trajectory.findings)
    warn_of_doubts(findings)
    return Measurement(replace(found.trajectory, findings=findings), found.details, seconds=seconds)


def _sides(images: Images | tuple[Images, Images]) -> tuple[Images, Images]:
    expected = "expected (n, 2, height, width), or two arrays (n, height, width) of one type"
    if isinstance(images, tuple | list) and len(images) == 2:
        left, right = (grey_values(side, f"{name} images") for side, name in zip(images, CAMERAS, strict=True))
    else:
        whole = np.asarray(images)
        if whole.ndim != 4 or whole.shape[1] != 2:
            raise TrackingError(f"images of shape {whole.shape}; {expected}")
        left, right = whole[:, 0], whole[:, 1]
    if left.shape != right.shape or left.ndim != 3 or left.dtype != right.dtype:
        raise TrackingError(f"images of shape {left.shape} {left.dtype} and {right.shape} {right.dtype}; {expected}")
    if not len(left):
        raise TrackingError("no image in the arrays")
    return left, right


def _tracked(
    recording: Recording, rig: StereoRig, pairs: ImagePairs, taken: Taken, threads: int, progress: Progress
) -> Measurement:
    """Track the disc through the pairs taken."""
    not_read: NotRead = {}  # a dictionary, as some images are read twice
    # stretches followed in parallel: one per core, if frames can be read in any order
    stretches = len(stretch_edges(taken.pairs, recording.disc)) - 1
    workers = min(threads, stretches) if pairs.left.random_access and pairs.right.random_access else 1
    reading = pairs.reading(not_read, max(1, threads // workers))  # each worker has its own three blocks
    try:
        found = track(reading, taken, rig, recording.disc, workers, progress)
    except TrackingError as error:
        refuse_unreadable(recording, not_read, 2 * len(taken.pairs), error)
        raise
    return replace(found, unreadable=dict(sorted(not_read.items())))


def images_lost(not_read: NotRead) -> Iterator[Finding]:
    """Finding about images that could not be read."""
    if n := len(not_read):
        where = "their frames rest on one camera or none"
        text = f"{n} image{'s' * (n > 1)} could not be read; {where}. The first: {not_read[min(not_read)]}"
        yield Finding(Kind.UNREADABLE, Severity.WARNING, text, explains=(Kind.FRAMES_LOST,))


def refuse_unreadable(recording: Recording, lost: NotRead, n: int, error: TrackingError) -> None:
    """Raise RecordingError if most of n images cannot be read, as this explains why no disc was found."""
    if 2 * len(lost) > n:
        raise RecordingError(
            f"{recording.folder}: the files cannot be read: {len(lost)} of {n} images, the first: {lost[min(lost)]} "
            "Is the disk still there?"
        ) from error


def as_declared(
    settings: TrackingSettings, recording: Recording, pairs: ImagePairs
) -> tuple[TrackingSettings, tuple[str, ...]]:
    """The settings with what determines the table, and the exposures if they are stated; a note on their source."""
    table = settings.table if recording.table is None else recording.table.source
    settings = replace(settings, table=table, exposure=None)
    if recording.exposure is not None:
        return replace(settings, exposure=(recording.exposure, recording.exposure)), ()
    headers = pairs.left.header, pairs.right.header
    left, right = (None if header is None else header.exposure for header in headers)
    if left is None or right is None:
        return settings, ()
    said = f"exposure {1e6 * left:g} and {1e6 * right:g} µs (left, right) as the cameras' headers say"
    return replace(settings, exposure=(left, right)), (said,)


def _span(pairs: ImagePairs, frame_rate: float, settings: TrackingSettings) -> MotionSpan:
    """Pairs that are tracked."""
    if not settings.first_pass:
        return MotionSpan(pairs.start, pairs.stop, 0, "every frame, as requested")
    if len(pairs) < WHOLE_BELOW * frame_rate:
        return MotionSpan(pairs.start, pairs.stop, 0, f"every frame of a recording below {WHOLE_BELOW:g} s")
    if not (pairs.left.random_access and pairs.right.random_access):
        return MotionSpan(pairs.start, pairs.stop, 0, "every frame: these files can only be read in order")
    return find_motion(pairs.left, pairs.right, pairs.start, pairs.stop, frame_rate)


@checked
def trajectory_provenance(
    recording: Recording, rig: StereoRig, pairs: ImagePairs, settings: TrackingSettings | None
) -> Provenance:
    """Inputs and settings of the trajectory; reads the images.

    >>> recording, rig = read_recording("clip"), read_rig("clip/results/rig.h5")
    >>> sorted(trajectory_provenance(recording, rig, open_pairs(recording), None).inputs)
    ['left frames', 'rig', 'right frames']
    """
    return Provenance(
        recording=recording.name,
        inputs={**pairs.inputs(), "rig": json_sha256(rig)},
        settings={
            "recording": dict(recording.declared),
            "frames": [pairs.start, pairs.stop],
            "tracking": asdict(settings or TrackingSettings()),
            **pairs.camera_headers(),
        },
    )
