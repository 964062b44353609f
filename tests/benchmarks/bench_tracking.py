"""Speed of reading and tracking beside decoding alone and beside a plain OpenCV + SciPy script.

    python tests/benchmarks/bench_tracking.py RECORDING [--rig RIG] [--threads N] [--repeats N] [--json FILE]

Prints pairs per second, processor time per pair and ratios. Every figure is the best of the repeats; on a busy machine
trust the processor's time. With --json the figures are kept, and a file that is there is compared with first. Not a
test: nothing fails here.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.optimize import least_squares

from calibration.camera import StereoRig
from calibration.rig_file import read_rig
from disctrack.frames import rotation_from_quaternion, rotation_from_vector, vector_from_rotation
from disctrack.readers.blocks import PairBlock, default_threads, iter_pair_blocks
from disctrack.recording.declaration import Recording, read_recording
from disctrack.track.stage import ImagePairs, open_pairs
from disctrack.track.tracking import Tracking, track


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--rig", type=Path, help="default: RECORDING/results/rig.h5")
    parser.add_argument("--threads", type=int, default=default_threads())
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--json", type=Path, help="keep the figures here; compared with what is there")
    arguments = parser.parse_args()
    recording = read_recording(arguments.recording)
    rig = read_rig(arguments.rig or recording.rig_file or recording.folder / "results" / "rig.h5")
    pairs = open_pairs(recording)
    cv2.setNumThreads(1)
    timings = report(recording, rig, pairs, arguments.threads, arguments.repeats)
    if arguments.json:
        compare_and_keep(arguments.json, {t.what: 1e3 * t.processor / len(pairs) for t in timings})


def report(recording: Recording, rig: StereoRig, pairs: ImagePairs, threads: int, repeats: int) -> list[Timing]:
    n = len(pairs)
    memory = np.stack([[pairs.left.read(i), pairs.right.read(i)] for i in range(n)])
    from_memory: list[Tracking] = []

    def track_memory(workers: int) -> None:
        from_memory[:] = [run_track(recording, rig, n, lambda a, b: memory_blocks(memory, a, b), workers)]

    def track_files() -> None:
        run_track(recording, rig, n, lambda a, b: iter_pair_blocks(pairs.left, pairs.right, a, b, threads=threads), 1)

    track_memory(1)  # compiles
    track_files()
    target = np.empty_like(memory)
    copy, decode, reader, files, one, many, plain = (
        Timing.of("a copy of the frames' bytes in memory", lambda: np.copyto(target, memory), repeats),
        Timing.of(f"decode alone: cv2.imread, {threads} threads", lambda: decode_alone(pairs, threads), repeats),
        Timing.of(f"our reader alone, {threads} threads", lambda: read_alone(pairs, threads), repeats),
        Timing.of(f"reading + tracking, {threads} reading threads", track_files, repeats),
        Timing.of("tracking, frames in memory, 1 worker", lambda: track_memory(1), repeats),
        Timing.of(f"tracking, frames in memory, {threads} workers", lambda: track_memory(threads), repeats),
        Timing.of(
            "plain OpenCV + SciPy, frames in memory", lambda: plain_script(recording, rig, memory, from_memory[0]), 1
        ),
    )
    print(f"{recording.name}: {n} pairs of {memory.shape[3]} x {memory.shape[2]} px, {threads} threads")
    timings = [copy, decode, reader, files, one, many, plain]
    for timing in timings:
        print(
            f"  {timing.what:<46} {n / timing.wall:7.0f} pairs/s  {1e3 * timing.processor / n:7.2f} ms of a core/pair"
        )
    print(f"  {'ratios of time':<46} {'elapsed':>8} {'of a core':>10}")
    for what, a, b in (
        ("our reader / decode alone", reader, decode),
        ("reading + tracking / decode alone (aim: 1.25)", files, decode),
        ("plain script / ours, frames in memory", plain, one),
        (f"1 worker / {threads} workers", one, many),
        ("tracking, frames in memory / a copy of the bytes", one, copy),
    ):
        print(f"  {what:<46} {a.wall / b.wall:8.2f} {a.processor / b.processor:10.2f}")
    return timings


def compare_and_keep(file: Path, figures: dict[str, float]) -> None:
    """Milliseconds of a core per pair beside those of an earlier run, then in its place."""
    if file.exists():
        earlier = json.loads(file.read_text())
        print(f"  {'ms of a core/pair, now / earlier':<46}")
        for what, now in figures.items():
            if what in earlier:
                print(f"  {what:<46} {now:8.3f} {earlier[what]:8.3f} {now / earlier[what]:8.2f}")
    file.write_text(json.dumps(figures, indent=2) + "\n")


@dataclass(frozen=True)
class Timing:
    """Shortest elapsed and shortest processor time [s] of some repeats; the latter is blind to a busy machine."""

    what: str
    wall: float
    processor: float

    @classmethod
    def of(cls, what: str, action: Callable[[], object], repeats: int) -> Timing:
        walls, processors = [], []
        for _ in range(repeats):
            wall, processor = time.perf_counter(), time.process_time()
            action()
            walls.append(time.perf_counter() - wall)
            processors.append(time.process_time() - processor)
        return cls(what, min(walls), min(processors))


def run_track(recording: Recording, rig: StereoRig, n: int, read_blocks: Callable, workers: int) -> Tracking:
    return track(read_blocks, range(n), rig, recording.disc, recording.frame_rate, workers=workers)


def memory_blocks(memory: np.ndarray, start: int, stop: int, block: int = 64):
    for first in range(start, stop, block):
        last = min(first + block, stop)
        yield PairBlock(np.arange(first, last), memory[first:last], ())


def decode_alone(pairs: ImagePairs, threads: int) -> None:
    files = [str(file) for two in zip(pairs.left.files, pairs.right.files, strict=True) for file in two]
    with ThreadPoolExecutor(threads) as pool:
        for _ in pool.map(lambda file: cv2.imread(file, cv2.IMREAD_UNCHANGED), files):
            pass


def read_alone(pairs: ImagePairs, threads: int) -> None:
    for _ in iter_pair_blocks(pairs.left, pairs.right, threads=threads):
        pass


def plain_script(recording: Recording, rig: StereoRig, memory: np.ndarray, start: Tracking) -> np.ndarray:
    """What one writes in an afternoon: threshold, contours, moments, least squares per frame; start pose given."""
    disc = recording.disc
    trajectory = start.trajectory
    R = rotation_from_quaternion(trajectory.quaternion[0])
    p = np.concatenate([trajectory.q[0, :3], vector_from_rotation(R)])
    poses = np.full((len(memory), 6), np.nan)

    def projected(p: np.ndarray) -> np.ndarray:
        return rig.project(disc.marker_centres_body @ rotation_from_vector(p[3:]).T + p[:3])

    velocity = np.zeros(6)
    for i, images in enumerate(memory):
        expected = projected(p + velocity)
        observed = np.full_like(expected, np.nan)
        for camera in (0, 1):
            _, dark = cv2.threshold(images[camera], 0, 255, cv2.THRESH_BINARY_INV | cv2.THRESH_OTSU)
            contours, _ = cv2.findContours(dark, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
            blobs = []
            for contour in contours:
                moments = cv2.moments(contour)
                if 50 < moments["m00"] < 5000:
                    blobs.append((moments["m10"] / moments["m00"], moments["m01"] / moments["m00"]))
            if blobs:
                distance = np.linalg.norm(expected[camera][:, None] - np.array(blobs), axis=-1)
                nearest = distance.argmin(axis=1)
                close = distance[np.arange(len(nearest)), nearest] < 8
                observed[camera][close] = np.array(blobs)[nearest[close]]
        seen = np.isfinite(observed)
        if seen.sum() < 6:
            continue
        fit = least_squares(lambda p, o=observed, s=seen: (projected(p) - o)[s], p + velocity)
        velocity = fit.x - p if i else velocity
        p = poses[i] = fit.x
    return poses


if __name__ == "__main__":
    main()
