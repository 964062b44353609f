"""Every way of keeping frames, read by `open_frames` and by what one writes without it.

pytest -m slow -p benchmark --dist=no tests/benchmarks/bench_formats.py [-k PNG]

Files are written by libraries that share nothing with the readers, with a sensor's noise.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from disctrack.recording.readers import open_frames
from tests.oracles import camera_files

pytestmark = pytest.mark.slow
Frames = np.ndarray  # (n, height, width) uint8 or uint16
N_FRAMES, SIZE = 64, 512
Writer = Callable[[Path, Frames], str]  # into a folder; returns the pattern that recording.toml would name
Plain = Callable[[Path, str, Frames], None]  # reads all frames of folder and pattern into the array


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


@pytest.mark.parametrize("name", [row[0] for row in FORMATS])
@pytest.mark.parametrize("way", ["disctrack", "plain"])
def test_reading(benchmark: Any, tmp_path: Path, name: str, way: str) -> None:
    (bits, write, plain, needs) = next(row[1:] for row in FORMATS if row[0] == name)
    if needs:
        pytest.importorskip(needs)
    frames = frames_with_noise(bits)
    pattern, out = write(tmp_path, frames), np.empty_like(frames)
    benchmark.group = f"{name}, {N_FRAMES} frames; plain is {plain.__name__}"
    benchmark.pedantic(opened_and_read if way == "disctrack" else plain, (tmp_path, pattern, out), rounds=5)
    if way == "disctrack":
        assert np.array_equal(out, frames)


def opened_and_read(folder: Path, pattern: str, out: Frames) -> None:
    """Opened anew every time: an open file's chunks stay decompressed, for others that read it, too."""
    reader = open_frames(pattern, folder, "left")
    for index in range(len(reader)):
        reader.read(index, out[index])
