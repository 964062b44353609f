"""Speed of every reader beside the plain way of reading the same file.

    python tests/benchmarks/bench_readers.py [--frames N] [--size 512] [--repeats N] [--threads N] [--processor-time]
                                            [FORMAT ...]

Writes frames with a sensor's noise in every format, reads them through `open_frames` and through what one writes
without it (cv2.imread, cv2.VideoCapture, a copy out of np.memmap, h5py), and prints frames/s, GB/s of grey values and
the ratio. Every figure is the best of the repeats, files in the system's cache. Not a test: nothing fails here but a
frame that does not come back as it was written.
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from disctrack.readers import open_frames
from disctrack.readers.base import FrameReader
from tests.oracles import camera_files

Frames = NDArray[np.uint8] | NDArray[np.uint16]


@dataclass(frozen=True)
class Format:
    """One way of keeping frames, written by a library that shares nothing with the reader."""

    name: str
    bits: int
    write: Callable[[Path, Frames], str]  # into a folder; returns the pattern that recording.toml would name
    plain_name: str
    plain: Callable[[Path, str, Frames], None]  # reads all frames of folder and pattern into the array
    needs: str = ""  # a module that must be installed


FORMATS: list[Format] = []


def frames_with_noise(n: int, size: int, bits: int) -> Frames:
    """(n, size, size) a dark scene with light spots and a sensor's noise, as a camera sees the disc."""
    rng = np.random.default_rng(1)
    y, x = np.mgrid[:size, :size] / size
    scene = 40 + 160 * (np.hypot(x - 0.5, y - 0.5) < 0.35) * (1 - 0.8 * (np.hypot(x - 0.4, y - 0.6) < 0.06))
    grey = scene + rng.standard_normal((min(n, 16), size, size)) * np.sqrt(1 + scene / 50)
    grey = np.clip(np.rint(grey * (2**bits - 1) / 255), 0, 2**bits - 1)
    return grey.astype(np.uint8 if bits == 8 else np.uint16)[np.arange(n) % len(grey)]


def shortest(actions: list[Callable[[], object]], repeats: int, clock: Callable[[], float]) -> list[float]:
    """Shortest time [s] of each action; they take turns, so that a busy moment of the machine strikes all alike."""
    times = np.full((repeats, len(actions)), np.inf)
    for row in times:
        for k, action in enumerate(actions):
            began = clock()
            action()
            row[k] = clock() - began
    return [float(best) for best in times.min(axis=0)]


def read_in_order(reader: FrameReader, out: Frames) -> None:
    for index in range(len(reader)):
        reader.read(index, out[index])


def read_by_threads(reader: FrameReader, out: Frames, threads: int) -> None:
    with ThreadPoolExecutor(threads) as pool:
        for _ in pool.map(lambda first: [reader.read(i, out[i]) for i in range(first, min(first + 8, len(out)))],
                          range(0, len(out), 8)):  # fmt: skip
            pass


def measure(kind: Format, arguments: argparse.Namespace, place: Path) -> str:
    frames = frames_with_noise(arguments.frames, arguments.size, kind.bits)
    folder = place / kind.name.replace(" ", "_").replace("/", "_")
    folder.mkdir()
    pattern = kind.write(folder, frames)
    out = np.empty_like(frames)
    reader = open_frames(pattern, folder, "left")
    threads = arguments.threads if reader.random_access else 1
    read_in_order(reader, out)
    assert np.array_equal(out, frames), f"{kind.name}: frames differ from what was written"
    ours, side_by_side, plain = shortest(
        [
            lambda: read_in_order(reader, out),
            lambda: read_by_threads(reader, out, threads),
            lambda: kind.plain(folder, pattern, out),
        ],
        arguments.repeats,
        time.process_time if arguments.processor_time else time.perf_counter,
    )
    n, gigabytes = len(frames), frames.nbytes / 1e9
    return (
        f"{kind.name:<26} {n / ours:8.0f} {gigabytes / ours:7.2f} {n / side_by_side:10.0f} {n / plain:8.0f} "
        f"{plain / ours:7.2f}  {kind.plain_name}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("formats", nargs="*", help="parts of the names of formats (default: all)")
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--processor-time", action="store_true", help="not elapsed time: for a machine that is shared")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    wanted = [f for f in FORMATS if not arguments.formats or any(part in f.name for part in arguments.formats)]
    print(f"{arguments.frames} frames of {arguments.size} x {arguments.size}")
    print(f"{'':<26} {'1 thread':>16} {f'{arguments.threads} threads':>10} {'plain':>8} {'plain/':>7}")
    print(f"{'format':<26} {'frames/s':>8} {'GB/s':>7} {'frames/s':>10} {'frames/s':>8} {'ours':>7}  plain way")
    for kind in wanted:
        if kind.needs and importlib.util.find_spec(kind.needs) is None:
            print(f"{kind.name:<26} {kind.needs} is not installed")
            continue
        with tempfile.TemporaryDirectory() as place:
            print(measure(kind, arguments, Path(place)), flush=True)


# -- image sequences ---------------------------------------------------------------------------------------------------


def image_writer(suffix: str) -> Callable[[Path, Frames], str]:
    def write(folder: Path, frames: Frames) -> str:
        for i, frame in enumerate(frames):
            cv2.imwrite(str(folder / f"{i:06d}.{suffix}"), frame)
        return f"*.{suffix}"

    return write


def plain_images(folder: Path, pattern: str, out: Frames) -> None:
    for i, file in enumerate(sorted(folder.glob(pattern))):
        out[i] = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)


for suffix, bits in (("png", 8), ("png", 16), ("bmp", 8), ("tif", 8), ("tif", 16)):
    FORMATS.append(Format(f"{suffix.upper()} files {bits} bit", bits, image_writer(suffix), "cv2.imread", plain_images))


# -- TIFF stacks -------------------------------------------------------------------------------------------------------


def stack_writer(**options: object) -> Callable[[Path, Frames], str]:
    def write(folder: Path, frames: Frames) -> str:
        import tifffile

        tifffile.imwrite(folder / "stack.tif", frames, photometric="minisblack", **options)
        return "stack.tif"

    return write


def plain_tiff_map(folder: Path, pattern: str, out: Frames) -> None:
    import tifffile

    mapped = tifffile.memmap(folder / pattern, mode="r")
    for i in range(len(out)):
        out[i] = mapped[i]


def plain_tiff_pages(folder: Path, pattern: str, out: Frames) -> None:
    _, pages = cv2.imreadmulti(str(folder / pattern), flags=cv2.IMREAD_UNCHANGED)
    for image, page in zip(out, pages, strict=True):
        image[...] = page


FORMATS += [
    Format("TIFF stack 8 bit", 8, stack_writer(), "copy of tifffile.memmap", plain_tiff_map, "tifffile"),
    Format("TIFF stack 12 bit", 12, stack_writer(), "copy of tifffile.memmap", plain_tiff_map, "tifffile"),
    Format("TIFF stack deflate 8 bit", 8, stack_writer(compression="zlib"), "cv2.imreadmulti", plain_tiff_pages,
           "tifffile"),
]  # fmt: skip

# -- HDF5 --------------------------------------------------------------------------------------------------------------


def hdf5_writer(**options: object) -> Callable[[Path, Frames], str]:
    def write(folder: Path, frames: Frames) -> str:
        import h5py

        with h5py.File(folder / "stack.h5", "w") as file:
            file.create_dataset("frames", data=frames, **options)
        return "stack.h5:/frames"

    return write


def plain_hdf5(folder: Path, pattern: str, out: Frames) -> None:
    import h5py

    with h5py.File(folder / "stack.h5") as file:
        for i in range(len(out)):
            out[i] = file["frames"][i]


FORMATS += [
    Format("HDF5 8 bit", 8, hdf5_writer(), "h5py, frame by frame", plain_hdf5),
    Format("HDF5 gzip 8 bit", 8, hdf5_writer(chunks=(1, 512, 512), compression="gzip", compression_opts=1),
           "h5py, frame by frame", plain_hdf5),
    Format("HDF5 gzip 16 frames 8 bit", 8, hdf5_writer(chunks=(16, 64, 512), compression="gzip", compression_opts=1),
           "h5py, frame by frame", plain_hdf5),
]  # fmt: skip

# -- video -------------------------------------------------------------------------------------------------------------


def video_writer(name: str, codec: str, pixels: str, **options: str) -> Callable[[Path, Frames], str]:
    def write(folder: Path, frames: Frames) -> str:
        import av

        with av.open(str(folder / name), "w") as container:
            stream = container.add_stream(codec, rate=1000, options=options)
            stream.width, stream.height, stream.pix_fmt = frames.shape[2], frames.shape[1], pixels
            for frame in frames:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format=pixels)))
            container.mux(stream.encode())
        return name

    return write


def plain_capture(folder: Path, pattern: str, out: Frames) -> None:
    capture = cv2.VideoCapture(str(folder / pattern))
    for image in out:
        _, colour = capture.read()
        image[...] = colour[..., 0]


FORMATS += [
    Format(name, bits, video_writer(f"v.{suffix}", codec, pixels), "cv2.VideoCapture, 8 bit", plain_capture, "av")
    for name, bits, suffix, codec, pixels in (
        ("raw video AVI 8 bit", 8, "avi", "rawvideo", "gray"),
        ("raw video MKV 8 bit", 8, "mkv", "rawvideo", "gray"),
        ("FFV1 MKV 8 bit", 8, "mkv", "ffv1", "gray"),
        ("FFV1 MKV 12 bit", 12, "mkv", "ffv1", "gray12le"),
    )
]

# -- cameras' own files ------------------------------------------------------------------------------------------------


def mraw_writer(bits: int) -> Callable[[Path, Frames], str]:
    def write(folder: Path, frames: Frames) -> str:
        return camera_files.write_mraw(folder / "frames", frames, bits).name

    return write


def cine_writer(bits: int, packed: bool) -> Callable[[Path, Frames], str]:
    def write(folder: Path, frames: Frames) -> str:
        return camera_files.write_cine(folder / "frames.cine", frames, bits, packed_pixels=packed).name

    return write


def plain_map(folder: Path, pattern: str, out: Frames) -> None:
    """The bytes of the frames as they are stored, packed ones not unpacked: what memory alone would take."""
    size = min(max(file.stat().st_size for file in folder.iterdir()) // len(out), out[0].nbytes)
    (file,) = (file for file in folder.iterdir() if file.suffix in (".mraw", ".cine"))
    mapped = np.memmap(file, np.uint8, "r")
    for i, image in enumerate(out):
        image.reshape(-1).view(np.uint8)[:size] = mapped[i * size : i * size + size]


for name, bits, write in (
    ("MRAW 8 bit", 8, mraw_writer(8)),
    ("MRAW 12 bit packed", 12, mraw_writer(12)),
    ("MRAW 16 bit", 16, mraw_writer(16)),
    ("cine 8 bit", 8, cine_writer(8, packed=False)),
    ("cine 12 bit packed", 12, cine_writer(12, packed=True)),
    ("cine 16 bit", 16, cine_writer(16, packed=False)),
):
    FORMATS.append(Format(name, bits, write, "copy of np.memmap, bytes as stored", plain_map))


if __name__ == "__main__":
    main()
