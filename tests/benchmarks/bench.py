"""Speed of the whole measurement in one table: python tests/benchmarks/bench.py RECORDING [--json FILE]

    [--rig RIG] [--pairs 3000] [--repeats 3] [--grow 1 10 100 1000 10000 100000] [--no-starts]

Takes a recording of image files, plays it forth and back until it has the pairs asked for, and measures it as the
command line does (first look at the images, reading, tracking, poses), from its files, from memory-mapped files and
from one array in memory (`measure_pairs`), on one core and on two; beside it a copy of the frames' bytes, decoding
alone, a plain OpenCV + SciPy script; what the machine could do at most (roofline); how time and memory grow with the
number of pairs; and the command line from its first start, with nothing compiled, to a later one.

Elapsed and processor time are the shortest of the repeats; on a busy machine trust ratios of the processor's time. With
--json the figures are kept, and a file that is there is compared with first. Not a test: nothing fails here.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numba
import numpy as np
from scipy.optimize import least_squares

from calibration.camera import StereoRig
from calibration.rig_file import read_rig
from disctrack.files.software import software_version
from disctrack.frames import rotation_from_quaternion, rotation_from_vector, vector_from_rotation
from disctrack.readers.file_numbers import NumberedFiles
from disctrack.readers.images import ImageSequence
from disctrack.recording.declaration import Recording, read_recording
from disctrack.track.arrays import measure_pairs
from disctrack.track.stage import ImagePairs, Measurement, measure, open_pairs
from disctrack.trajectory import Trajectory

# Counted in track/_kernels.py: +, -, *, / and roots for a pixel of a dot, each time its model and the normal equations
# are evaluated (edge distance 40, profile 25, model and derivatives 55, sums 90); and how often that is, about.
OPERATIONS, EVALUATIONS = 210, 4
FEW = 20  # frames that are played where memory is measured
DOT_MARGIN_PX = 6  # of a dot's window beyond its rim

Figures = dict[str, float]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--rig", type=Path, help="default: RECORDING/results/rig.h5")
    parser.add_argument("--pairs", type=int, default=3000)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--grow", type=int, nargs="*", default=[1, 10, 100, 1000, 10_000, 100_000], metavar="PAIRS")
    parser.add_argument("--no-starts", action="store_true", help="without the command line's first and later starts")
    parser.add_argument("--json", type=Path, help="keep the figures here; compared with what is there")
    parser.add_argument("--one", type=int, help=argparse.SUPPRESS)  # so many pairs in this process, told as JSON
    arguments = parser.parse_args()
    recording = read_recording(arguments.recording)
    rig_file = arguments.rig or recording.rig_file or recording.folder / "results" / "rig.h5"
    rig = read_rig(rig_file)
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory() as folder:
        played = Played(recording, Path(folder), FEW if arguments.one else None)
        if arguments.one:
            print(json.dumps(one_run(recording, rig, played, arguments.one)))
            return
        figures = rates(recording, rig, played, arguments.pairs, arguments.repeats)
    figures |= growth(arguments.recording, rig_file, arguments.grow)
    figures |= {} if arguments.no_starts else starts(arguments.recording)
    if arguments.json:
        compare_and_keep(arguments.json, figures)


def rates(recording: Recording, rig: StereoRig, played: Played, n: int, repeats: int) -> Figures:
    """Time of a pair, by several ways in turn."""
    images = played.images
    k, (height, width) = len(images), images.shape[2:]
    target = images.copy()
    trajectory = measure(recording, rig, played.mapped(k), threads=1).trajectory  # compiles
    memory = images[played.order(n)]  # each pair in a place of its own, as a camera would leave them

    def in_memory(threads: int) -> Measurement:
        return measure_pairs(memory, rig, recording.disc, recording.frame_rate, threads=threads)

    ways: dict[str, tuple[Callable[[], object], int]] = {
        "a copy of the frames' bytes in memory": (lambda: np.copyto(target, images), k),
        "decoding alone: cv2.imread, 1 core": (lambda: decode_alone(played.files(n), 1), n),
        "decoding alone: cv2.imread, 2 cores": (lambda: decode_alone(played.files(n), 2), n),
        "measured from files, 1 core": (lambda: measure(recording, rig, played.compressed(n), threads=1), n),
        "measured from files, 2 cores": (lambda: measure(recording, rig, played.compressed(n), threads=2), n),
        "measured from mapped files, 1 core": (lambda: measure(recording, rig, played.mapped(n), threads=1), n),
        "measured from memory, 1 core": (lambda: in_memory(1), n),
        "measured from memory, 2 cores": (lambda: in_memory(2), n),
        "plain OpenCV + SciPy, frames in memory": (lambda: plain_script(recording, rig, images, trajectory), k),
    }
    print(f"{recording.name}: {n} pairs of {width} x {height} px, of {k} different ones")
    times: dict[str, Timing] = {}
    for what, (action, pairs) in ways.items():
        timing = Timing.of(what, action, 1 if "plain" in what else repeats)
        times[what] = Timing(what, timing.wall / pairs, timing.processor / pairs)
        print(
            f"  {what:<46} {1 / times[what].wall:8.0f} pairs/s {1e6 * times[what].processor:9.1f} us of a core",
            flush=True,
        )
    print(f"  {'ratios of time':<46} {'elapsed':>8} {'of a core':>10}")
    for a, b in (
        ("measured from files, 2 cores", "decoding alone: cv2.imread, 2 cores"),
        ("measured from files, 1 core", "measured from files, 2 cores"),
        ("measured from memory, 1 core", "measured from memory, 2 cores"),
        ("plain OpenCV + SciPy, frames in memory", "measured from memory, 1 core"),
        ("measured from memory, 1 core", "a copy of the frames' bytes in memory"),
    ):
        ratio = times[a].wall / times[b].wall, times[a].processor / times[b].processor
        print(f"  {a} / {b}: {ratio[0]:.2f} {ratio[1]:.2f}")
    figures = {f"{what}: us of a core per pair": 1e6 * timing.processor for what, timing in times.items()}
    figures |= {f"{what}: us elapsed per pair": 1e6 * timing.wall for what, timing in times.items()}
    return figures | roofline(trajectory, images, times["measured from memory, 1 core"].processor)


def roofline(trajectory: Trajectory, images: np.ndarray, processor: float) -> Figures:
    """What memory and arithmetic of this machine need for a pair at least, beside what it takes."""
    bandwidth, speed = bytes_per_second(), operations_per_second()
    pair = images[0].nbytes
    pixels = dot_pixels(trajectory)
    operations = pixels * OPERATIONS * EVALUATIONS
    by_bytes, by_operations = pair / bandwidth, operations / speed
    least = max(by_bytes, by_operations)
    print(f"  one core moves {bandwidth / 1e9:.1f} GB/s and does {speed / 1e9:.0f} G operations/s (single precision)")
    millions = operations / 1e6
    print(f"  a pair: {pair / 1e3:.0f} kB, {pixels:.0f} pixels round its dots, about {millions:.1f} M operations")
    print(f"  at least {1e6 * by_bytes:.0f} us to read each byte once, {1e6 * by_operations:.0f} us of arithmetic;")
    print(f"  it takes {1e6 * processor:.0f} us from memory: {processor / least:.1f} times the larger")
    return {
        "bandwidth, GB/s": bandwidth / 1e9,
        "operations, G/s": speed / 1e9,
        "least for the bytes: us per pair": 1e6 * by_bytes,
        "least for the arithmetic: us per pair": 1e6 * by_operations,
    }


def bytes_per_second() -> float:
    """That one core reads, by copying far more than the caches hold (each byte is read and written)."""
    source, target = np.ones(1 << 25), np.zeros(1 << 25)
    return 2 * source.nbytes / Timing.of("copy", lambda: np.copyto(target, source), 5).processor


@numba.njit(fastmath=True)
def _fused(values: np.ndarray, rounds: int) -> None:
    a, b = np.float32(0.999), np.float32(1e-3)
    for _ in range(rounds):
        for i in range(values.size):
            values[i] = values[i] * a + b


def operations_per_second() -> float:
    """Single precision, multiplications and additions in vectors that stay in the nearest cache."""
    values = np.ones(2048, np.float32)
    _fused(values, 1)
    rounds = 20_000
    return 2 * rounds * values.size / Timing.of("arithmetic", lambda: _fused(values, rounds), 5).processor


def dot_pixels(trajectory: Trajectory) -> float:
    """Pixels of the windows of a pair's dots, all cameras; the median of the frames."""
    disc, rig = trajectory.disc, trajectory.rig
    angle = np.linspace(0, 2 * np.pi, 32, endpoint=False)
    circle = 0.5 * disc.marker_diameter * np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1)
    found = []
    for row in np.flatnonzero(trajectory.measured)[::10]:
        R, t = rotation_from_quaternion(trajectory.quaternion[row]), trajectory.q[row, :3]
        seen = rig.project(((disc.marker_centres_body[:, None] + circle) @ R.T + t).reshape(-1, 3))
        size = np.ptp(seen.reshape(2, disc.n_markers, len(angle), 2), axis=2) + 2 * DOT_MARGIN_PX
        found.append(np.nansum(size.prod(axis=-1)))
    return float(np.median(found))


def one_run(recording: Recording, rig: StereoRig, played: Played, n: int) -> Figures:
    """Time and memory of measuring n pairs, after a few that load what is compiled."""
    measure(recording, rig, played.mapped(min(n, len(played.images))), threads=1)
    timing = Timing.of("", lambda: measure(recording, rig, played.mapped(n), threads=1), 1)
    return {"seconds": timing.wall, "processor": timing.processor, "MB": peak_memory()}


def peak_memory() -> float:
    """Most memory [MB] of this process; on Linux `getrusage` has that of the parent in it."""
    status = Path("/proc/self/status")
    if status.exists():
        return float(status.read_text().split("VmHWM:")[1].split()[0]) / 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def growth(recording: Path, rig: Path, numbers: list[int]) -> Figures:
    """Cost and memory of 1, 10, ... pairs, each in a process of its own."""
    figures = {}
    for n in numbers:
        words = [sys.executable, __file__, str(recording), "--rig", str(rig), "--one", str(n)]
        found = json.loads(subprocess.run(words, check=True, capture_output=True, text=True).stdout.splitlines()[-1])
        print(
            f"  {n:7d} pairs: {found['processor']:8.2f} s of a core, {1e6 * found['processor'] / n:9.1f} us a pair, "
            f"{found['MB']:6.0f} MB at most",
            flush=True,
        )
        figures |= {f"{n} pairs: us of a core per pair": 1e6 * found["processor"] / n, f"{n} pairs: MB": found["MB"]}
    return figures


def starts(recording: Path) -> Figures:
    """Processor time of the command line: nothing compiled, a later run, and that without pictures."""
    figures = {}
    with tempfile.TemporaryDirectory() as folder:
        environment = os.environ | {"NUMBA_CACHE_DIR": f"{folder}/kept"}
        run = ["run", str(recording), "-o", f"{folder}/results", "--overwrite"]
        trajectory = f"{folder}/results/trajectory.h5"
        for what, words in (
            ("first run", run),
            ("later run", run),
            ("later run, no pictures", [*run, "--no-figures", "--no-video"]),
            ("analyse", ["analyse", trajectory]),
            ("first diagnose", ["diagnose", trajectory]),
            ("later diagnose", ["diagnose", trajectory, "--overwrite"]),
        ):
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            command = [sys.executable, "-m", "disctrack", *words]
            subprocess.run(command, env=environment, check=True, capture_output=True)
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
            print(f"  {what:<46} {seconds:8.1f} s of a core", flush=True)
            figures[f"{what}: s of a core"] = seconds
    return figures


def compare_and_keep(file: Path, figures: Figures) -> None:
    """The figures beside those of an earlier run, then in its place."""
    if file.exists():
        earlier = json.loads(file.read_text())
        print(f"  now / earlier ({earlier['version']})")
        for what, now in figures.items():
            if earlier["figures"].get(what):
                before = earlier["figures"][what]
                print(f"  {what:<70} {now:10.1f} {before:10.1f} {now / before:6.2f}")
    file.write_text(json.dumps({"version": software_version(), "figures": figures}, indent=1) + "\n")


class Played:
    """A recording of image files, played forth and back to any length."""

    def __init__(self, recording: Recording, folder: Path, most: int | None = None) -> None:
        self.pairs = open_pairs(recording)
        k = min(len(self.pairs), most or len(self.pairs))
        self.images = np.stack([[self.pairs.left.read(i), self.pairs.right.read(i)] for i in range(k)])
        self._folder = folder

    def order(self, n: int) -> np.ndarray:
        """Numbers of n pairs, forth and back."""
        k = len(self.images)
        return np.resize(np.r_[0:k, k - 2 : 0 : -1], n)

    def mapped(self, n: int) -> ImagePairs:
        """Frames in memory-mapped files."""
        left, right = (
            MappedFrames(self._folder / name, self.images[:, camera], self.order(n))
            for camera, name in enumerate(("left", "right"))
        )
        return dataclasses.replace(self.pairs, left=left, right=right, start=0, stop=n)

    def files(self, n: int) -> list[list[str]]:
        """Of each camera."""
        return [[str(reader.files[i]) for i in self.order(n)] for reader in (self.pairs.left, self.pairs.right)]

    def compressed(self, n: int) -> ImagePairs:
        """The files, opened anew, so that nothing is known of them yet."""
        left, right = (
            ImageSequence(NumberedFiles(tuple(map(Path, names)), 0, 1), camera, reader.image_size, reader.dtype)
            for names, camera, reader in zip(
                self.files(n), ("left", "right"), (self.pairs.left, self.pairs.right), strict=True
            )
        )
        return dataclasses.replace(self.pairs, left=left, right=right, start=0, stop=n)


class MappedFrames:
    """Frames of one camera in a file that is mapped into memory; see disctrack.readers.FrameReader."""

    timestamps, notes, random_access = None, (), True

    def __init__(self, file: Path, frames: np.ndarray, order: np.ndarray) -> None:
        if not file.exists():
            file.write_bytes(frames.tobytes())
        self._frames = np.memmap(file, frames.dtype, "r", shape=frames.shape)
        self._order = order
        self.image_size = frames.shape[2], frames.shape[1]
        self.bit_depth = 8 * frames.dtype.itemsize

    def __len__(self) -> int:
        return len(self._order)

    def describe(self, index: int) -> str:
        return f"mapped frame {index}"

    def read(self, index: int, out: np.ndarray | None = None) -> np.ndarray:
        frame = self._frames[self._order[index]]
        if out is None:
            return np.array(frame)
        out[...] = frame
        return out

    def content_sha256(self, start: int, stop: int) -> str:
        return f"{start}-{stop}"


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


def decode_alone(files: list[list[str]], threads: int) -> None:
    names = [file for two in zip(*files, strict=True) for file in two]
    with ThreadPoolExecutor(threads) as pool:
        for _ in pool.map(lambda file: cv2.imread(file, cv2.IMREAD_UNCHANGED), names):
            pass


def plain_script(recording: Recording, rig: StereoRig, memory: np.ndarray, trajectory: Trajectory) -> np.ndarray:
    """What one writes in an afternoon: threshold, contours, moments, least squares per frame; start pose given."""
    disc = recording.disc
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
