"""Speed of the whole measurement beside decoding alone and beside a plain OpenCV + SciPy script.

    python tests/benchmarks/bench_chain.py RECORDING [--rig RIG] [--pairs 3000] [--threads N] [--repeats N]

Takes a recording of image files, plays it forth and back until it has the pairs asked for, and measures it as the
command line does: first pass, reading, tracking, poses; from the compressed files, and from the same frames in
memory-mapped files. Elapsed and processor time are the shortest of the repeats; on a busy machine trust ratios of the
processor's time, and of two lines taken one after the other. Not a test: nothing fails here.
"""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
from bench_tracking import Timing, plain_script

from calibration.rig_file import read_rig
from disctrack.readers.blocks import default_threads
from disctrack.readers.file_numbers import NumberedFiles
from disctrack.readers.images import ImageSequence
from disctrack.recording.declaration import Recording, read_recording
from disctrack.track.stage import ImagePairs, measure, open_pairs


class MappedFrames:
    """Frames of one camera in a file that is mapped into memory; see disctrack.readers.FrameReader."""

    timestamps, notes, random_access = None, (), True

    def __init__(self, file: Path, frames: np.ndarray, order: np.ndarray) -> None:
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--rig", type=Path, help="default: RECORDING/results/rig.h5")
    parser.add_argument("--pairs", type=int, default=3000)
    parser.add_argument("--threads", type=int, default=default_threads())
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    recording = read_recording(arguments.recording)
    rig = read_rig(arguments.rig or recording.rig_file or recording.folder / "results" / "rig.h5")
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory() as folder:
        report(recording, rig, Path(folder), arguments)


def report(recording: Recording, rig, folder: Path, arguments: argparse.Namespace) -> None:
    short, n, threads = open_pairs(recording), arguments.pairs, arguments.threads
    k = len(short)
    order = np.resize(np.r_[0:k, k - 2 : 0 : -1], n)
    images = np.stack([[short.left.read(i), short.right.read(i)] for i in range(k)])
    files = [[str(reader.files[i]) for i in order] for reader in (short.left, short.right)]
    mapped = [MappedFrames(folder / name, images[:, camera], order) for camera, name in enumerate(("left", "right"))]

    def compressed() -> ImagePairs:  # anew, so that nothing is known of the files yet
        sequences = [
            ImageSequence(NumberedFiles(tuple(map(Path, names)), 0, 1), camera, reader.image_size, reader.dtype)
            for names, camera, reader in zip(files, ("left", "right"), (short.left, short.right), strict=True)
        ]
        return dataclasses.replace(short, left=sequences[0], right=sequences[1], start=0, stop=n)

    def chain(pairs: ImagePairs, workers: int):
        return measure(recording, rig, pairs, threads=workers)

    in_memory = dataclasses.replace(short, left=mapped[0], right=mapped[1], start=0, stop=n)
    first = chain(dataclasses.replace(in_memory, stop=k), 1)  # compiles
    lines: list[tuple[Timing, int]] = []

    def add(what: str, action, pairs: int = n, repeats: int = arguments.repeats) -> Timing:
        timing = Timing.of(what, action, repeats)
        lines.append((timing, pairs))
        return timing

    decode = add(f"decoding alone: cv2.imread, {threads} threads", lambda: decode_alone(files, threads))
    files_many = add(f"whole chain, files, {threads} threads", lambda: chain(compressed(), threads))
    files_one = add("whole chain, files, 1 thread", lambda: chain(compressed(), 1))
    mapped_one = add("whole chain, memory-mapped, 1 thread", lambda: chain(in_memory, 1))
    mapped_many = add(f"whole chain, memory-mapped, {threads} threads", lambda: chain(in_memory, threads))
    start = dataclasses.make_dataclass("Start", ["trajectory"])(first.trajectory)
    plain = add("plain OpenCV + SciPy, frames in memory", lambda: plain_script(recording, rig, images, start), k, 1)
    height, width = images.shape[2:]
    print(f"{recording.name}: {n} pairs of {width} x {height} px (plain script: {k})")
    for timing, pairs in lines:
        rate, processor = pairs / timing.wall, 1e3 * timing.processor / pairs
        print(f"  {timing.what:<46} {rate:7.0f} pairs/s  {processor:7.2f} ms of a core/pair")
    print(f"  {'ratios of time':<46} {'elapsed':>8} {'of a core':>10}")
    for what, a, b, scale in (
        ("files / decoding alone (aim: 1.25)", files_many, decode, 1.0),
        (f"files, 1 thread / {threads} threads", files_one, files_many, 1.0),
        (f"memory-mapped, 1 thread / {threads} threads (aim: 1.8)", mapped_one, mapped_many, 1.0),
        ("plain script / memory-mapped, 1 thread", plain, mapped_one, n / k),
    ):
        print(f"  {what:<46} {scale * a.wall / b.wall:8.2f} {scale * a.processor / b.processor:10.2f}")


def decode_alone(files: list[list[str]], threads: int) -> None:
    names = [file for two in zip(*files, strict=True) for file in two]
    with ThreadPoolExecutor(threads) as pool:
        for _ in pool.map(lambda file: cv2.imread(file, cv2.IMREAD_UNCHANGED), names):
            pass


if __name__ == "__main__":
    main()
