"""Speed of everything in one table: python -m tests.benchmarks.bench RECORDING [--json FILE] [--seconds 900]

    [--only tracking formats growth starts batch] [--rig RIG] [--pairs 3000] [--repeats 3] [--grow 1 10 ... 100000]

A line is one way of doing something, by processor time and elapsed time of one piece (a pair, a frame, a run), and as a
ratio to another way of the same part; the ways of a part take turns, so that a busy moment strikes all alike.
  tracking  RECORDING (image files) played forth and back to so many pairs, measured as the command line does it, from
            its files, from memory-mapped files and from one array in memory (`measure_pairs`), on one core and on two;
            beside it a copy of the frames' bytes, decoding alone, a plain OpenCV + SciPy script, and what the machine
            could do at most (roofline)
  formats   every way of keeping frames, read by `open_frames` and by what one writes without it
  growth    processor time and memory of 1 to 100 000 pairs, each in a process of its own
  starts    the command line from its first start, with nothing compiled, to a later one
  batch     four copies of RECORDING by one process, by two, and by two that know nothing of each other
Each part ends at its share of --seconds, at the end of what it is doing (processes are stopped), and names what it left
out. With --json the figures are kept, and compared with those that are there. Times are the shortest of the repeats; on
a busy machine trust ratios of the processor's time. Not a test: nothing fails here but a frame that comes back wrong.
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib.util
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import cv2
import numba
import numpy as np
from scipy.optimize import least_squares

from calibration.cameras.camera import StereoRig
from calibration.rig_file import read_rig
from disctrack.files.software import software_version
from disctrack.frames import rotation_from_quaternion, rotation_from_vector, vector_from_rotation
from disctrack.processes import ONE_THREAD
from disctrack.recording.declaration import Recording, read_recording
from disctrack.recording.readers import open_frames
from disctrack.recording.readers.images import ImageSequence
from disctrack.track.in_memory import measure_pairs
from disctrack.track.measurement import ImagePairs, measure, open_pairs
from disctrack.trajectory import Trajectory
from tests.oracles import camera_files

PACKAGE = Path(__file__).resolve().parents[2]
# Counted in track/_kernels.py: +, -, *, / and roots for a pixel of a dot, each time its model and the normal equations
# are evaluated (edge distance 40, profile 25, model and derivatives 55, sums 90); and how often that is, about.
OPERATIONS, EVALUATIONS = 210, 4
FEW = 20  # frames that are played where memory is measured
SCRIPTED = 100  # frames of the plain script: more take minutes
DOT_MARGIN_PX = 6  # of a dot's window beyond its rim
COPIES = 4  # of the recording in a batch
NOTABLY = 1.15  # times the processor time of an earlier run: a busy machine makes 0.95 to 1.08 of it
PARTS = ("tracking", "formats", "growth", "starts", "batch")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--rig", type=Path, help="default: RECORDING/results/rig.h5")
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--formats", nargs="+", default=[""], help="parts of the names of formats (default: all)")
    parser.add_argument("--pairs", type=int, default=3000)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--grow", type=int, nargs="*", default=[1, 10, 100, 1000, 10_000, 100_000], metavar="PAIRS")
    parser.add_argument("--seconds", type=float, default=900.0, help="after which the whole is at its end")
    parser.add_argument("--json", type=Path, help="keep the figures here; compared with what is there")
    parser.add_argument("--one", type=int, help=argparse.SUPPRESS)  # so many pairs in this process, told as JSON
    arguments = parser.parse_args()
    recording = read_recording(arguments.recording)
    rig_file = arguments.rig or recording.rig_file or recording.folder / "results" / "rig.h5"
    if not rig_file.exists():
        parser.error(f"{rig_file}: no such rig; `disctrack run {arguments.recording}` makes it, or give --rig FILE")
    cv2.setNumThreads(1)
    if arguments.one:
        with tempfile.TemporaryDirectory() as folder:
            print(
                json.dumps(one_run(recording, read_rig(rig_file), Played(recording, Path(folder), FEW), arguments.one))
            )
        return
    table = Table(arguments.repeats)
    for number, part in enumerate(arguments.only):
        left = arguments.seconds - (time.monotonic() - table.began)
        table.ends = time.monotonic() + left / (len(arguments.only) - number)
        with tempfile.TemporaryDirectory() as folder:
            try:
                if part == "tracking":
                    tracking(table, recording, read_rig(rig_file), Played(recording, Path(folder)), arguments.pairs)
                elif part == "formats":
                    formats(table, Path(folder), arguments.formats)
                elif part == "growth":
                    growth(table, arguments.recording.resolve(), rig_file.resolve(), arguments.grow)
                elif part == "starts":
                    starts(table, arguments.recording.resolve(), Path(folder))
                else:
                    batch(table, recording, rig_file, Path(folder))
            except TimeIsUp as left_out:
                print(f"  (time is up: left out {left_out}, and what follows)", flush=True)
    if arguments.json:
        compare_and_keep(arguments.json, table.figures)


class TimeIsUp(Exception):
    """What was to be measured, in words."""


@dataclass(frozen=True)
class Timing:
    """Shortest elapsed and shortest processor time [s] of a piece; the latter is blind to a busy machine."""

    wall: float = float("inf")
    processor: float = float("inf")

    def or_better(self, other: Timing) -> Timing:
        return Timing(min(self.wall, other.wall), min(self.processor, other.processor))


def timed(action: Callable[[], object], pieces: int = 1) -> Timing:
    """One round, with the processes that it starts and waits for."""
    wall, processor = time.perf_counter(), processor_seconds()
    action()
    return Timing((time.perf_counter() - wall) / pieces, (processor_seconds() - processor) / pieces)


def processor_seconds() -> float:
    """Of this process and of those that have ended."""
    own, ended = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return own.ru_utime + own.ru_stime + ended.ru_utime + ended.ru_stime


@dataclass
class Table:
    """What is printed as it is found, and kept."""

    repeats: int
    began: float = field(default_factory=time.monotonic)
    ends: float = float("inf")  # of the part at hand
    figures: dict[str, float] = field(default_factory=dict)

    @property
    def seconds_left(self) -> float:
        return self.ends - time.monotonic()

    def title(self, what: str) -> None:
        print(f"\n{what:<58} {'a second':>9} {'of a core':>13} {'elapsed':>13}   to", flush=True)

    def keep(self, what: str, timing: Timing, beside: tuple[str, Timing] | None = None) -> None:
        """One line; beside: what it is compared with."""
        ratio = f"   {timing.processor / beside[1].processor:.2f} {beside[0]}" if beside else ""
        told = [f"{1e6 * t:.1f} us" if t < 0.1 else f"{t:.2f} s " for t in (timing.processor, timing.wall)]
        rate = f"{1 / timing.wall:9.{0 if timing.wall < 0.1 else 2}f}"
        print(f"  {what:<56} {rate} {told[0]:>13} {told[1]:>13}{ratio}", flush=True)
        self.figures |= {f"{what}: us of a core": 1e6 * timing.processor, f"{what}: us elapsed": 1e6 * timing.wall}

    def compare(self, ways: dict[str, tuple[Callable[[], object], int]], reference: str = "") -> dict[str, Timing]:
        """Ways of the same, each (action, pieces), in turn as often as time allows, at least once; then their lines."""
        best = {what: Timing() for what in ways}
        for number in range(self.repeats):
            for what, (action, pieces) in ways.items():
                if number == 0 or self.seconds_left > 0:
                    best[what] = best[what].or_better(timed(action, pieces))
        for what, timing in best.items():
            beside = (reference, best[reference]) if reference and what != reference else None
            self.keep(what, timing, beside)
        return best

    def command(self, words: list[str], **environment: str) -> str:
        """What a process of this Python prints; raises TimeIsUp where it does not end in time."""
        process = subprocess.Popen(
            [sys.executable, *words], env=os.environ | environment, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
            text=True, cwd=PACKAGE, start_new_session=True,
        )  # fmt: skip
        try:
            told, _ = process.communicate(timeout=max(self.seconds_left, 0.1))
        except BaseException as reason:  # an interrupt, too: with the processes that it started
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            if isinstance(reason, subprocess.TimeoutExpired):
                raise TimeIsUp(" ".join(Path(word).name for word in words[1:])) from None
            raise
        if process.returncode:
            raise SystemExit(f"{' '.join(words)} failed")
        return told


# -- tracking ----------------------------------------------------------------------------------------------------------


def tracking(table: Table, recording: Recording, rig: StereoRig, played: Played, n: int) -> None:
    images = played.images
    k, (height, width) = len(images), images.shape[2:]
    target, few = images.copy(), min(k, SCRIPTED)
    trajectory = measure(recording, rig, played.mapped(k), threads=1).trajectory  # compiles
    memory = images[played.order(n)]  # each pair in a place of its own, as a camera would leave them

    def in_memory(threads: int) -> Callable[[], object]:
        return lambda: measure_pairs(memory, rig, recording.disc, recording.frame_rate, threads=threads)

    table.title(f"{recording.name}: a pair of {width} x {height} px, {n} of {k} different ones")
    found = table.compare(
        {
            "measured from memory, 1 core": (in_memory(1), n),
            "measured from memory, 2 cores": (in_memory(2), n),
            "measured from mapped files, 1 core": (lambda: measure(recording, rig, played.mapped(n), threads=1), n),
            "measured from files, 1 core": (lambda: measure(recording, rig, played.compressed(n), threads=1), n),
            "measured from files, 2 cores": (lambda: measure(recording, rig, played.compressed(n), threads=2), n),
            "decoding alone, cv2.imread, 1 core": (lambda: decode_alone(played.files(n), 1), n),
            "decoding alone, cv2.imread, 2 cores": (lambda: decode_alone(played.files(n), 2), n),
            "a copy of the frames' bytes in memory": (lambda: np.copyto(target, images), k),
        },
        "measured from memory, 1 core",
    )
    memory_1 = found["measured from memory, 1 core"]
    roofline(table, trajectory, images, memory_1.processor)
    two_cores(table, in_memory(2), n, memory_1.processor)
    if table.seconds_left < 0:
        raise TimeIsUp("the plain script")
    script = timed(lambda: plain_script(recording, rig, images[:few], trajectory), few)
    table.keep("plain OpenCV + SciPy, frames in memory", script, ("measured from memory, 1 core", memory_1))


def roofline(table: Table, trajectory: Trajectory, images: np.ndarray, processor: float) -> None:
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
    table.figures |= {
        "bandwidth, GB/s": bandwidth / 1e9,
        "operations, G/s": speed / 1e9,
        "least for the bytes: us per pair": 1e6 * by_bytes,
        "least for the arithmetic: us per pair": 1e6 * by_operations,
    }


def two_cores(table: Table, action: Callable[[], object], n: int, processor: float) -> None:
    """What two free cores reach, by processor time: one thread alone puts the poses together, the others follow."""
    alone, all_threads = [], []
    for _ in range(table.repeats):
        began = time.thread_time(), time.process_time()
        action()
        alone.append((time.thread_time() - began[0]) / n)
        all_threads.append((time.process_time() - began[1]) / n - alone[-1])
    serial, shared = min(alone), min(all_threads)
    rate = 1 / (serial + shared / 2)
    print(f"  two threads: {1e6 * serial:.0f} us by one of them alone, {1e6 * shared:.0f} us shared; on two free cores")
    print(f"  at most {rate:.0f} pairs/s, by two processes that know nothing of each other {2 / processor:.0f}")
    table.figures |= {"two cores, by one thread alone: us": 1e6 * serial, "two cores, shared: us": 1e6 * shared}


def bytes_per_second() -> float:
    """That one core reads, by copying far more than the caches hold (each byte is read and written)."""
    source, target = np.ones(1 << 25), np.zeros(1 << 25)
    return 2 * source.nbytes / min(timed(lambda: np.copyto(target, source)).processor for _ in range(5))


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
    return 2 * rounds * values.size / min(timed(lambda: _fused(values, rounds)).processor for _ in range(5))


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
            ImageSequence(files=list(map(Path, names)), camera=camera, image_size=reader.image_size, dtype=reader.dtype)
            for names, camera, reader in zip(
                self.files(n), ("left", "right"), (self.pairs.left, self.pairs.right), strict=True
            )
        )
        return dataclasses.replace(self.pairs, left=left, right=right, start=0, stop=n)


class MappedFrames:
    """Frames of one camera in a file that is mapped into memory; see disctrack.recording.readers.FrameReader."""

    timestamps, notes, doubts, header, random_access = None, (), (), None, True

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


# -- growth, starts, batch ---------------------------------------------------------------------------------------------


def one_run(recording: Recording, rig: StereoRig, played: Played, n: int) -> dict[str, float]:
    """Time and memory of measuring n pairs, after a few that load what is compiled."""
    measure(recording, rig, played.mapped(min(n, len(played.images))), threads=1)
    timing = timed(lambda: measure(recording, rig, played.mapped(n), threads=1))
    return {"wall": timing.wall, "processor": timing.processor, "MB": peak_memory()}


def peak_memory() -> float:
    """Most memory [MB] of this process; on Linux `getrusage` has that of the parent in it."""
    status = Path("/proc/self/status")
    if status.exists():
        return float(status.read_text().split("VmHWM:")[1].split()[0]) / 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def growth(table: Table, recording: Path, rig: Path, numbers: list[int]) -> None:
    """Cost and memory of 1, 10, ... pairs from mapped files, each in a process of its own."""
    table.title("a pair from mapped files, 1 core, of so many")
    for n in numbers:
        told = table.command(["-m", "tests.benchmarks.bench", str(recording), "--rig", str(rig), "--one", str(n)])
        found = json.loads(told.splitlines()[-1])
        table.keep(f"{n} pairs, {found['MB']:.0f} MB at most", Timing(found["wall"] / n, found["processor"] / n))
        table.figures[f"{n} pairs: MB"] = found["MB"]


def starts(table: Table, recording: Path, folder: Path) -> None:
    """The command line: nothing compiled, a later run, and that without pictures."""
    table.title("a command")
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
        command = partial(table.command, ["-m", "disctrack", *words], NUMBA_CACHE_DIR=f"{folder}/kept")
        table.keep(what, timed(command))


def batch(table: Table, recording: Recording, rig: Path, folder: Path) -> None:
    """Links to the recording's frames, in two halves of one folder, all with one rig."""
    text = recording.file.read_text(encoding="utf-8")
    start, end = text.index("[calibration]"), text.index("[gravity]")
    text = f'{text[:start]}[calibration]\nrig = "{rig.resolve().as_posix()}"\n\n{text[end:]}'
    for i in range(COPIES):
        copy = folder / "day" / f"half {i % 2}" / f"copy {i}"
        copy.mkdir(parents=True)
        for camera in ("left", "right"):
            (copy / camera).symlink_to(recording.folder.resolve() / camera, target_is_directory=True)
        (copy / "recording.toml").write_text(text, encoding="utf-8")
    day = folder / "day"

    def run(roots: list[Path], side_by_side: int) -> None:
        for results in day.rglob("*results"):
            shutil.rmtree(results)
        words = ["-j", str(side_by_side), "--no-report"]
        with ThreadPoolExecutor(len(roots)) as pool:
            list(
                pool.map(
                    lambda root: table.command(["-m", "disctrack", "batch", str(root), *words], **ONE_THREAD), roots
                )
            )

    table.title(f"a recording of a batch of {COPIES}")
    table.compare(
        {
            "disctrack batch -j 1": (lambda: run([day], 1), COPIES),
            "disctrack batch -j 2": (lambda: run([day], 2), COPIES),
            "two independent processes": (lambda: run([day / "half 0", day / "half 1"], 1), COPIES),
        },
        "disctrack batch -j 1",
    )


def compare_and_keep(file: Path, figures: dict[str, float]) -> None:
    """The figures beside those of an earlier run, then in its place."""
    if file.exists():
        earlier = json.loads(file.read_text())
        print(f"  now / earlier ({earlier['version']})")
        for what, now in figures.items():
            if before := earlier["figures"].get(what):
                # elapsed times tell of the machine's other work; processor time of the same work moves by less
                slower = "   slower" if what.endswith("of a core") and now > NOTABLY * before else ""
                print(f"  {what:<70} {now:10.1f} {before:10.1f} {now / before:6.2f}{slower}")
    file.write_text(json.dumps({"version": software_version(), "figures": figures}, indent=1) + "\n")


# -- formats -----------------------------------------------------------------------------------------------------------

Frames = np.ndarray  # (n, height, width) uint8 or uint16
N_FRAMES, SIZE = 64, 512
Writer = Callable[[Path, Frames], str]  # into a folder; returns the pattern that recording.toml would name
Plain = Callable[[Path, str, Frames], None]  # reads all frames of folder and pattern into the array


def formats(table: Table, place: Path, wanted: list[str]) -> None:
    """Written by libraries that share nothing with the readers, with a sensor's noise."""
    table.title(f"a frame of {SIZE} x {SIZE}")
    for number, (name, bits, write, plain, needs) in enumerate(FORMATS):
        if not any(part in name for part in wanted) or (needs and importlib.util.find_spec(needs) is None):
            continue
        if table.seconds_left < 0:
            raise TimeIsUp(name)
        frames, folder = frames_with_noise(bits), place / str(number)
        folder.mkdir()
        pattern = write(folder, frames)
        out = np.empty_like(frames)

        ours = partial(open_and_read, folder, pattern, out)
        ours()
        assert np.array_equal(out, frames), f"{name}: frames differ from what was written"
        beside = f"{name}, by {plain.__name__}"
        table.compare({name: (ours, N_FRAMES), beside: (partial(plain, folder, pattern, out), N_FRAMES)}, beside)
        shutil.rmtree(folder)


def open_and_read(folder: Path, pattern: str, out: Frames) -> None:
    """Opened anew every time: an open file's chunks stay decompressed, for others that read it, too."""
    reader = open_frames(pattern, folder, "left")
    for index in range(len(reader)):
        reader.read(index, out[index])


def frames_with_noise(bits: int) -> Frames:
    """A dark scene with light spots, as a camera sees the disc."""
    rng = np.random.default_rng(1)
    y, x = np.mgrid[:SIZE, :SIZE] / SIZE
    scene = 40 + 160 * (np.hypot(x - 0.5, y - 0.5) < 0.35) * (1 - 0.8 * (np.hypot(x - 0.4, y - 0.6) < 0.06))
    grey = scene + rng.standard_normal((16, SIZE, SIZE)) * np.sqrt(1 + scene / 50)
    grey = np.clip(np.rint(grey * (2**bits - 1) / 255), 0, 2**bits - 1)
    return grey.astype(np.uint8 if bits == 8 else np.uint16)[np.arange(N_FRAMES) % 16]


def image_files(suffix: str) -> Writer:
    def write(folder: Path, frames: Frames) -> str:
        for i, frame in enumerate(frames):
            cv2.imwrite(str(folder / f"{i:06d}.{suffix}"), frame)
        return f"*.{suffix}"

    return write


def tiff_stack(**options: object) -> Writer:
    def write(folder: Path, frames: Frames) -> str:
        import tifffile

        tifffile.imwrite(folder / "stack.tif", frames, photometric="minisblack", **options)
        return "stack.tif"

    return write


def hdf5(**options: object) -> Writer:
    def write(folder: Path, frames: Frames) -> str:
        import h5py

        with h5py.File(folder / "stack.h5", "w") as file:
            file.create_dataset("frames", data=frames, **options)
        return "stack.h5:/frames"

    return write


def video(name: str, codec: str, pixels: str) -> Writer:
    def write(folder: Path, frames: Frames) -> str:
        import av

        with av.open(str(folder / name), "w") as container:
            stream = container.add_stream(codec, rate=1000)
            stream.width, stream.height, stream.pix_fmt = frames.shape[2], frames.shape[1], pixels
            for frame in frames:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format=pixels)))
            container.mux(stream.encode())
        return name

    return write


def imread(folder: Path, pattern: str, out: Frames) -> None:
    for i, file in enumerate(sorted(folder.glob(pattern))):
        out[i] = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)


def imreadmulti(folder: Path, pattern: str, out: Frames) -> None:
    out[...] = cv2.imreadmulti(str(folder / pattern), flags=cv2.IMREAD_UNCHANGED)[1]


def memmap(folder: Path, pattern: str, out: Frames) -> None:
    """The bytes of the frames as they are stored, packed ones not unpacked: what memory alone would take."""
    file = max(folder.iterdir(), key=lambda file: file.stat().st_size)
    size = min(file.stat().st_size // len(out), out[0].nbytes)
    mapped = np.memmap(file, np.uint8, "r")
    for i, image in enumerate(out):
        image.reshape(-1).view(np.uint8)[:size] = mapped[i * size : i * size + size]


def h5py_frames(folder: Path, pattern: str, out: Frames) -> None:
    import h5py

    with h5py.File(folder / "stack.h5") as file:
        for i in range(len(out)):
            out[i] = file["frames"][i]


def capture(folder: Path, pattern: str, out: Frames) -> None:
    """8 bits alone."""
    opened = cv2.VideoCapture(str(folder / pattern))
    for image in out:
        image[...] = opened.read()[1][..., 0]


def mraw(bits: int) -> Writer:
    return lambda folder, frames: camera_files.write_mraw(folder / "frames", frames, bits).name


def cine(bits: int, packed: bool = False) -> Writer:
    return lambda folder, frames: (
        camera_files.write_cine(folder / "frames.cine", frames, bits, packed_pixels=packed).name
    )


GZIP = {"compression": "gzip", "compression_opts": 1}
FORMATS: list[tuple[str, int, Writer, Plain, str]] = [  # name, bits, writer, plain reader, a module that it needs
    *((f"{kind} files {bits} bit", bits, image_files(kind[:3].lower()), imread, "")
      for kind, bits in (("PNG", 8), ("PNG", 16), ("BMP", 8), ("TIFF LZW", 8), ("TIFF LZW", 16))),
    ("TIFF stack 8 bit", 8, tiff_stack(), memmap, "tifffile"),
    ("TIFF stack 12 bit", 12, tiff_stack(), memmap, "tifffile"),
    ("TIFF stack deflate 8 bit", 8, tiff_stack(compression="zlib"), imreadmulti, "tifffile"),
    ("HDF5 8 bit", 8, hdf5(), h5py_frames, ""),
    ("HDF5 gzip 8 bit", 8, hdf5(chunks=(1, SIZE, SIZE), **GZIP), h5py_frames, ""),
    ("HDF5 gzip 16 frames 8 bit", 8, hdf5(chunks=(16, 64, SIZE), **GZIP), h5py_frames, ""),
    ("raw video AVI 8 bit", 8, video("v.avi", "rawvideo", "gray"), capture, "av"),
    ("raw video MKV 8 bit", 8, video("v.mkv", "rawvideo", "gray"), capture, "av"),
    ("FFV1 MKV 8 bit", 8, video("v.mkv", "ffv1", "gray"), capture, "av"),
    ("FFV1 MKV 12 bit", 12, video("v.mkv", "ffv1", "gray12le"), capture, "av"),
    ("MRAW 8 bit", 8, mraw(8), memmap, ""),
    ("MRAW 12 bit packed", 12, mraw(12), memmap, ""),
    ("MRAW 16 bit", 16, mraw(16), memmap, ""),
    ("cine 8 bit", 8, cine(8), memmap, ""),
    ("cine 12 bit packed", 12, cine(12, packed=True), memmap, ""),
    ("cine 16 bit", 16, cine(16), memmap, ""),
]  # fmt: skip


if __name__ == "__main__":
    main()
