"""Blocks of image pairs, read ahead by several threads with bounded memory."""

import os
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from calibration.kit.types import AnyArray, Mask, Threads, checked
from disctrack.errors import RecordingError
from disctrack.frames import CAMERAS
from disctrack.recording.readers.base import FrameReader, in_words

BLOCK_BYTES = 16 << 20  # of a block: large enough for a negligible overhead, small enough for six blocks in 100 MB


NotRead = dict[tuple[int, int], str]  # why an image could not be read, by frame and camera (0 left, 1 right)


@dataclass(frozen=True)
class PairBlock:
    """Consecutive image pairs.

    `images` may be a buffer that is reused: it is valid until the next block is requested; copy it to keep it.
    """

    frames: NDArray[np.int64]  # (n,)
    images: AnyArray  # (n, 2 cameras, height, width) uint8 or uint16; 0 if not readable
    unreadable: NotRead = field(default_factory=dict)

    @property
    def readable(self) -> Mask:
        """(n, 2) True if the image could be read."""
        good = np.ones(self.images.shape[:2], bool)
        for frame, camera in self.unreadable:
            good[frame - self.frames[0], camera] = False
        return good


def check_pair(left: FrameReader, right: FrameReader) -> None:
    """Raise RecordingError unless both sequences have the same number of frames and size, and 8 bit or more."""
    if len(left) != len(right):
        short = CAMERAS[int(len(right) < len(left))]
        said = f"left has {len(left)} frames ({left.describe(0)} ...), right has {len(right)} ({right.describe(0)} ...)"
        remedy = f"Frame i of both must belong together: bring the missing {short} images, or move surplus ones away."
        notes = "".join(f" Note: {note}." for reader in (left, right) for note in reader.notes)
        raise RecordingError(f"{said}. {remedy}{notes}")
    if left.image_size != right.image_size or (left.bit_depth > 8) != (right.bit_depth > 8):
        ours, theirs = (in_words(reader.image_size, reader.bit_depth) for reader in (left, right))
        said = f"left images ({left.describe(0)}) have {ours}, right images ({right.describe(0)}) have {theirs}"
        remedy = "Export both cameras alike; what differs in size may be cut: [cameras] left_part and right_part"
        raise RecordingError(f"{said}. {remedy}.")


def default_threads() -> int:
    """Cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@checked
def iter_pair_blocks(
    left: FrameReader,
    right: FrameReader,
    start: int = 0,
    stop: int | None = None,
    block: int | None = None,
    threads: Threads | None = None,
) -> Iterator[PairBlock]:
    """Pairs start..stop-1 in blocks of `block` pairs; two blocks are read ahead while the caller processes a third.

    An image that cannot be read is listed in the block's `unreadable`. The default block has BLOCK_BYTES, so that the
    memory does not depend on the recording's length or the image size.
    Raises RecordingError if the two sequences do not belong together (`check_pair`).

        >>> pairs = open_pairs("clip")
        >>> sum(len(block.images) for block in iter_pair_blocks(pairs.left, pairs.right))
        300
    """
    check_pair(left, right)
    stop = len(left) if stop is None else min(stop, len(left))
    width, height = left.image_size
    dtype = np.uint8 if left.bit_depth == 8 else np.uint16
    block = block or int(np.clip(BLOCK_BYTES // (2 * width * height * np.dtype(dtype).itemsize), 1, 256))
    parts = [range(first, min(first + block, stop)) for first in range(start, stop, block)]
    ring = [np.empty((min(block, stop - start), 2, height, width), dtype) for _ in parts[:3]]
    pool = ThreadPoolExecutor(threads or default_threads(), thread_name_prefix="read")
    # a file that is read fastest in order has its own thread: reading two blocks at once would seek back and forth
    readers = left, right
    pools = [pool if r.random_access else ThreadPoolExecutor(1, thread_name_prefix="read") for r in readers]

    def submitted(number: int) -> list[Future[NotRead]]:
        """Tasks that read a few frames of a block each."""
        images, frames, tasks = ring[number % 3], parts[number], []
        for camera, reader in enumerate(readers):
            for i in range(0, len(frames), 4):
                part = images[i : i + 4, camera], reader, camera, frames[i : i + 4]
                tasks.append(pools[camera].submit(_fill, *part))
        return tasks

    try:
        pending = [submitted(number) for number, _ in enumerate(parts[:2])]
        for number, frames in enumerate(parts):
            if number + 2 < len(parts):
                pending.append(submitted(number + 2))
            unreadable = {place: why for future in pending.pop(0) for place, why in future.result().items()}
            yield PairBlock(np.array(frames), ring[number % 3][: len(frames)], unreadable)
    finally:
        for threads_of_one in {pool, *pools}:
            threads_of_one.shutdown(wait=True, cancel_futures=True)


def _fill(images: AnyArray, reader: FrameReader, camera: int, frames: range) -> NotRead:
    """Fill images (n, height, width) with the reader's frames; those that could not be read are 0 and returned."""
    failed: NotRead = {}
    for image, frame in zip(images, frames, strict=False):
        try:
            reader.read(frame, image)
        except RecordingError as error:
            image[...] = 0
            failed[frame, camera] = str(error)
    return failed
