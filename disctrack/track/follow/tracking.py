"""From pairs of images to the trajectory: stretches of the recording are followed in parallel, and joined.

The disc is followed through each stretch in `following`; the trajectory is assembled in `assembly`.
"""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from threading import Event, Lock

import numpy as np
from numpy.typing import DTypeLike

from calibration.cameras.camera import Camera, StereoRig
from calibration.kit.grey_levels import mosaic_gains
from calibration.kit.stuck_pixels import repair, stuck_pixels
from calibration.kit.types import AnyArray, Mask
from disctrack import frames
from disctrack.disc import MA_2014, Disc, symmetry_order
from disctrack.errors import TrackingError
from disctrack.findings import Finding, Kind, Severity, Subject, in_doubt
from disctrack.recording.readers.blocks import PairBlock
from disctrack.track.follow.following import SAMPLE, Follower, Heading, Tables, empty_tables, follow_block, maps_of, run
from disctrack.track.judge.cameras import frames_ahead, left_out
from disctrack.track.judge.disc_not_seen import MEETING_PX, why_not_seen
from disctrack.track.judge.doubts import MOVED
from disctrack.track.pose import DotsInFrames, fit_poses
from disctrack.track.refine.assembly import Measurement, Taken, assemble
from disctrack.track.side_by_side import evenly, stretches
from disctrack.trajectory import FrameStatus, MarkerStatus, part

SHORTEST_SPLIT = 1000  # pairs; shorter stretches do not repay the search for the disc and the noise measurement
# [m] displacement of a dot from its declared position above which all dots are located again. Wrong positions give the
# template a wrong attitude: an rms displacement of 0.1 mm shifts centres by 0.3e-3 to 2e-3 px, in all frames alike.
LOOK_AGAIN = 60e-6
DECLARED = (Kind.DOTS_MISPLACED, Kind.TABLE_DISAGREES)  # findings about declared numbers, not about images
APART, PAIRED = 10, 60  # frames: contradictory ones in a row that start a test for dropped frames; length of the test
MAX_EDGE_TURN = np.radians(25.0)  # largest error of the prediction across the edge of two stretches

ReadBlocks = Callable[[int, int], Iterable[PairBlock]]  # pairs start ... stop-1, in order
Progress = Callable[[int], object]  # called with the number of further pairs that are done


def prepare(dtype: DTypeLike = np.uint8) -> None:
    """Compile the inner loops for images of this type, or load them: some seconds once per installation."""
    camera, still = Camera(1.0, 1.0, 0.0, 0.0, (0.0,) * 5, (8, 8)), (np.eye(3), np.zeros(3))
    rig = StereoRig(camera, camera, *still, *still)
    rows, nothing, m = empty_tables(0, MA_2014.n_markers), np.zeros((0, 2, 8, 8), dtype), MA_2014.n_markers
    run(Follower(rig, MA_2014, maps_of(rig)), Heading.steady(still, still), nothing, np.zeros((0, 2), bool), rows)
    unseen = np.full((1, 2, m, 2), np.nan), np.zeros((1, 2, m, 2, 2)), np.eye(3)[None], np.zeros((1, 3))
    fit_poses(DotsInFrames(rig, MA_2014, *unseen), with_sensitivity=False)


def silent(n: int) -> None:
    """Progress that is not shown."""


def track(
    read_blocks: ReadBlocks, taken: Taken, rig: StereoRig, disc: Disc, workers: int = 1, progress: Progress = silent
) -> Measurement:
    """Measure the disc's pose in every pair of a recording.

    read_blocks(start, stop) yields the pairs start..stop-1 in blocks, in order; taken: the pairs to measure (step 1).
    workers: threads that follow stretches of a long recording in parallel; the result does not depend on their number,
    to the last bit. progress(n) is called when n more pairs are done, from any thread but one at a time.
    Raises TrackingError if the images do not belong to the rig or if the disc is found in no pair.
    """
    pairs = taken.pairs
    _check_dots(disc)
    read_blocks, stuck = _as_one_sensor(read_blocks, pairs)
    begin = Follower(rig, disc, maps_of(rig))
    edges = stretch_edges(pairs, disc)

    def measured(expected: Disc, progress: Progress) -> Measurement:
        """With the dots expected at the positions of a disc."""
        followers, tables = _followed(read_blocks, edges, replace(begin, disc=expected), workers, progress)
        if not np.isfinite(tables.t).any():
            raise _not_found(followers, pairs, why_not_seen(_some(read_blocks, pairs), rig, disc, taken.board))
        return assemble([replace(follower, disc=disc) for follower in followers], tables, taken, workers)

    tracking = measured(disc, progress)
    dropped = _dropped(tracking, read_blocks, pairs, begin)
    for finding in dropped:
        read_blocks = _without(read_blocks, frames.CAMERAS.index(finding.subject.camera), finding.subject.frames[0][0])
        tracking = measured(disc, silent)
    found = tracking.trajectory.disc
    off = np.abs(found.marker_centres_body - disc.marker_centres_body).max()
    if off > LOOK_AGAIN and not _faulty(tracking.trajectory.findings):
        tracking = measured(found, silent)
    noticed = (*dropped, *tracking.trajectory.findings)
    arranged = why_not_seen(_conflicts(tracking, noticed, read_blocks, pairs), rig, disc, taken.board)
    return replace(tracking, trajectory=replace(tracking.trajectory, findings=(*arranged, *noticed, *stuck)))


def _faulty(noticed: Iterable[Finding]) -> bool:
    """Whether the images are in doubt."""
    return in_doubt(f for f in noticed if f.kind not in DECLARED)


def _check_dots(disc: Disc) -> None:
    """Raise TrackingError unless the dots determine a pose."""
    spread = disc.marker_centres_body - disc.marker_centres_body.mean(axis=0)
    if disc.n_markers < 3 or np.linalg.matrix_rank(spread, tol=0.1 * disc.marker_diameter) < 2:
        declared = f"[markers] declares {disc.n_markers} dots{' on one line' if disc.n_markers > 2 else ''}"
        raise TrackingError(f"{declared}: a pose needs at least three dots that are not on one line")


def _dropped(tracking: Measurement, read_blocks: ReadBlocks, pairs: range, begin: Follower) -> tuple[Finding, ...]:
    """Images left out by one camera, from the pairing that fits the frames after the gap."""
    apart = _apart(tracking) | (max(tracking.details["systematic_px"]) > MEETING_PX / 2)
    long = stretches(apart, APART)
    if not len(long) or Kind.DELAY in {finding.kind for finding in tracking.trajectory.findings}:
        return ()
    first = int(long[0, 0])
    start = pairs[first]
    edges = [start, min(start + PAIRED, pairs.stop)]
    alone = (_without(read_blocks, other, start) for other in (1, 0))
    ahead = frames_ahead(*(_followed(one, edges, begin, 1, silent)[1].R for one in alone))
    return (left_out(ahead, pairs, first),) if ahead else ()


def _apart(tracking: Measurement) -> Mask:
    """(n,) frames that were searched in both images, and whose dots contradict each other."""
    status = tracking.trajectory.frame_status
    looked = (tracking.trajectory.marker_status != MarkerStatus.NOT_LOOKED_FOR).any(axis=2).all(axis=1)
    return looked & np.isin(status, [FrameStatus.ONE_CAMERA, FrameStatus.CONTRADICTED])


def _without(read_blocks: ReadBlocks, camera: int, since: int) -> ReadBlocks:
    """The same blocks without a camera's images from frame `since` on."""

    def without(block: PairBlock) -> PairBlock:
        gone = {(int(frame), camera): "of another instant" for frame in block.frames if frame >= since}
        return replace(block, unreadable=block.unreadable | gone)

    return lambda start, stop: map(without, read_blocks(start, stop))


def _conflicts(tracking: Measurement, noticed: tuple[Finding, ...], read_blocks: ReadBlocks, pairs: range) -> AnyArray:
    """(k, 2, height, width) images whose dots contradict the declaration; none if the recording agrees with it."""
    kinds = {finding.kind for finding in noticed}
    status = tracking.trajectory.frame_status
    contradicted = Kind.ONE_SIDED in kinds or 2 * np.sum(status == FrameStatus.CONTRADICTED) > len(status)
    far = _faulty(noticed) and max(tracking.details["systematic_px"]) > MEETING_PX
    if not (contradicted or far) or Kind.DROPPED_FRAMES in kinds:  # dropped frames explain the contradiction
        return _some(read_blocks, pairs[:0])
    rows = np.flatnonzero(_apart(tracking) | (far & (status == FrameStatus.MEASURED)))
    return _some(read_blocks, pairs[rows[0] :] if len(rows) else pairs[:0])


def _not_found(followers: list[Follower], pairs: range, why: tuple[Finding, ...]) -> TrackingError:
    """Error if the disc was found in no pair."""
    reason = next((f.first_reason for f in followers if f.first_reason), "")
    end = "" if reason.endswith("?") else "."
    text = f"First search: {reason.rstrip('.')}{end} {MOVED}" if reason else "No image could be read"
    return TrackingError(f"the disc was found in none of the pairs {pairs.start}-{pairs.stop - 1}", text, why)


def _followed(
    read_blocks: ReadBlocks, edges: list[int], begin: Follower, workers: int, progress: Progress
) -> tuple[list[Follower], Tables]:
    """Follow the disc through the stretches between the edges; other arguments as for `track`."""
    first = edges[0]
    tables = empty_tables(edges[-1] - first, begin.disc.n_markers)
    followers = [replace(begin, first_row=edge - first) for edge in edges[:-1]]
    given_up, reporting = Event(), Lock()

    def follow(k: int, report: Progress) -> None:
        """Follow the disc through one of the stretches."""
        for block in read_blocks(edges[k], edges[k + 1]):
            if given_up.is_set():
                break
            check_images(block.images.shape[:1:-1], begin.rig)
            follow_block(followers[k], block.images, block.readable, tables, int(block.frames[0]) - first)
            with reporting:
                report(len(block.images))

    with ThreadPoolExecutor(max(1, workers), thread_name_prefix="track") as pool:
        try:
            list(pool.map(lambda k: follow(k, progress), range(len(followers))))
        except BaseException:  # an interrupt must not wait for the end of the recording
            given_up.set()
            raise
    for k in range(1, len(followers)):
        start, before = edges[k] - first, followers[k - 1]
        if _discontinuous(tables, start):  # another branch of phi was found: continue from the stretch before
            followers[k] = replace(before, lost=None, first_row=start)
            stretch = part(tables, slice(start, edges[k + 1] - first))
            for name, empty in vars(empty_tables(1, begin.disc.n_markers)).items():
                getattr(stretch, name)[...] = empty
            follow(k, silent)
    return followers, tables


def _some(read_blocks: ReadBlocks, pairs: range) -> AnyArray:
    """(k, 2, height, width) images of some of the pairs, evenly spread, that can be read."""
    chosen = evenly(np.array(pairs), SAMPLE).tolist()
    found = [block.images[block.readable.all(axis=1)].copy() for i in chosen for block in read_blocks(i, i + 1)]
    return np.concatenate(found) if found else np.zeros((0, 2, 1, 1), np.uint8)


def stretch_edges(pairs: range, disc: Disc) -> list[int]:
    """First pairs of the stretches into which a recording is divided, and the end of the last.

    They depend on the length alone, so that the result does not depend on the number of threads. If phi is ambiguous
    by a symmetry of the dots, every new start could choose another branch: then there is one stretch.
    """
    n, count = len(pairs), 1
    while n >= SHORTEST_SPLIT * count**2 and symmetry_order(disc) == 1:
        count *= 2
    return [pairs.start + round(k * n / count) for k in range(count + 1)]


def _as_one_sensor(read_blocks: ReadBlocks, pairs: range) -> tuple[ReadBlocks, list[Finding]]:
    """Blocks corrected for a colour filter's pattern and stuck pixels, and both as findings."""
    # evenly spread: within a millisecond the disc moves by less than a pixel, and its edges would look stuck, too
    images = _some(read_blocks, pairs)
    corrections: list[tuple[int, Callable[[AnyArray, AnyArray], None], AnyArray]] = []
    said = []
    for camera, name in enumerate(frames.CAMERAS):
        if (gains := mosaic_gains(images[:, camera])) is not None:
            _divide_by_mosaic(images[:, camera], gains)
            corrections.append((camera, _divide_by_mosaic, gains))
            listed = " ".join(f"{gain:.2f}" for gain in gains.ravel())
            what = "they are divided by it, which is right for grey discs only; a monochrome camera sees more"
            said.append((name, f"a colour filter lies on the sensor (gains of neighbouring pixels {listed}): {what}"))
        if (stuck := stuck_pixels(images[:, camera])) is not None:
            corrections.append((camera, repair, stuck))
            said.append((name, f"{stuck.sum()} pixels show one value whatever passes; their neighbours stand in"))
    if not said:
        return read_blocks, []

    def repaired(block: PairBlock) -> PairBlock:
        images = block.images.copy()  # they may be the caller's own
        for camera, correct, by in corrections:
            correct(images[:, camera], by)
        return replace(block, images=images)

    return lambda start, stop: map(repaired, read_blocks(start, stop)), [
        Finding(Kind.SENSOR, Severity.WARNING, f"{name} camera: {text}", Subject("track", name)) for name, text in said
    ]


def _divide_by_mosaic(images: AnyArray, gains: AnyArray) -> None:
    """Divide, in place, images (..., height, width), uint8 or uint16, by the gains (2, 2) of the colour filter."""
    height, width = images.shape[-2:]
    pattern = np.tile(gains, (height // 2 + 1, width // 2 + 1))[:height, :width]
    images[...] = np.clip(np.rint(images / pattern), 0, np.iinfo(images.dtype).max)


def _discontinuous(tables: Tables, edge: int) -> bool:
    """True if the poses before row `edge` do not predict its pose: the two searches numbered the dots differently."""
    rows = slice(edge - 2, edge + 1)
    if not (tables.frame_status[rows] == FrameStatus.MEASURED).all():
        return False
    before, last, here = tables.R[rows]
    miss = (last @ before.T @ last).T @ here
    return bool(np.arccos(np.clip((np.trace(miss) - 1) / 2, -1, 1)) > MAX_EDGE_TURN)


def check_images(size: tuple[int, ...], rig: StereoRig, which: str = "images") -> None:
    """Raise TrackingError unless this width and height [px] is the image size at which the rig was calibrated."""
    for name, camera in zip(frames.CAMERAS, rig.cameras, strict=True):
        if camera.image_size != size:
            raise TrackingError(
                f"{which} are {size[0]} x {size[1]} px, but the rig's {name} camera was calibrated at "
                f"{camera.image_size[0]} x {camera.image_size[1]} px: calibrate with views of the recording's own "
                "size, or name the rig that belongs to it"
            )
