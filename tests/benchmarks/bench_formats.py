"""Every way of keeping frames, read by `open_frames` and by what one writes without it.

pytest -m slow -p benchmark --dist=no tests/benchmarks/bench_formats.py [-k PNG]

Files are written by libraries that share nothing with the readers, with a sensor's noise.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest

from disctrack.recording.readers import open_frames
from tests.disctrack.recording.readers.written import (
    CAMERAS,
    Format,
    write_hdf5,
    write_images,
    write_tiff,
    write_video,
)

pytestmark = pytest.mark.slow
Frames = np.ndarray  # (n, height, width) uint8 or uint16
N_FRAMES, SIZE = 64, 512
Plain = Callable[[Path, str, Frames], None]  # reads all frames of folder and pattern into the array


def frames_with_noise(bits: int) -> Frames:
    """A dark scene with light spots, as a camera sees the disc."""
    rng = np.random.default_rng(1)
    y, x = np.mgrid[:SIZE, :SIZE] / SIZE
    scene = 40 + 160 * (np.hypot(x - 0.5, y - 0.5) < 0.35) * (1 - 0.8 * (np.hypot(x - 0.4, y - 0.6) < 0.06))
    grey = scene + rng.standard_normal((16, SIZE, SIZE)) * np.sqrt(1 + scene / 50)
    grey = np.clip(np.rint(grey * (2**bits - 1) / 255), 0, 2**bits - 1)
    return grey.astype(np.uint8 if bits == 8 else np.uint16)[np.arange(N_FRAMES) % 16]


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
    with h5py.File(folder / pattern) as file:
        for i in range(len(out)):
            out[i] = file["camera/frames"][i]


def capture(folder: Path, pattern: str, out: Frames) -> None:
    """8 bits alone."""
    opened = cv2.VideoCapture(str(folder / pattern))
    for image in out:
        image[...] = opened.read()[1][..., 0]


GZIP = {"compression": "gzip", "compression_opts": 1}
FORMATS: list[tuple[str, Plain, Format]] = [  # name, plain reader
    *((f"{kind} files {bits} bit", imread, Format(kind[:3].lower(), bits, write_images))
      for kind, bits in (("PNG", 8), ("PNG", 16), ("BMP", 8), ("TIFF LZW", 8), ("TIFF LZW", 16))),
    ("TIFF stack 8 bit", memmap, Format("tif", 8, write_tiff)),
    ("TIFF stack 12 bit", memmap, Format("tif", 12, write_tiff)),
    ("TIFF stack deflate 8 bit", imreadmulti, Format("tif", 8, write_tiff, {"compression": "zlib"})),
    ("HDF5 8 bit", h5py_frames, Format("h5", 8, write_hdf5)),
    ("HDF5 gzip 8 bit", h5py_frames, Format("h5", 8, write_hdf5, {"chunks": (1, SIZE, SIZE), **GZIP})),
    ("HDF5 gzip 16 frames 8 bit", h5py_frames, Format("h5", 8, write_hdf5, {"chunks": (16, 64, SIZE), **GZIP})),
    *((f"{codec} {suffix} {bits} bit", capture, Format(suffix, bits, write_video, {"pixels": grey, "codec": codec}))
      for codec, suffix, bits, grey in (("rawvideo", "avi", 8, "gray"), ("rawvideo", "mkv", 8, "gray"),
                                        ("ffv1", "mkv", 8, "gray"), ("ffv1", "mkv", 12, "gray12le"))),
    *((str(kind), memmap, kind) for kind in CAMERAS if kind.suffix != "cihx" and kind.bits != 10),
]  # fmt: skip


@pytest.mark.parametrize(("name", "plain", "kind"), FORMATS, ids=[name for name, *_ in FORMATS])
@pytest.mark.parametrize("way", ["disctrack", "plain"])
def test_reading(benchmark: Any, tmp_path: Path, name: str, plain: Plain, kind: Format, way: str) -> None:
    frames = frames_with_noise(kind.bits)
    pattern, out = kind.written(tmp_path, frames), np.empty_like(frames)
    benchmark.group = f"{name}, {N_FRAMES} frames; plain is {plain.__name__}"
    benchmark.pedantic(opened_and_read if way == "disctrack" else plain, (tmp_path, pattern, out), rounds=5)
    if way == "disctrack":
        assert np.array_equal(out, frames)


def opened_and_read(folder: Path, pattern: str, out: Frames) -> None:
    """Opened anew every time: an open file's chunks stay decompressed, for others that read it, too."""
    reader = open_frames(pattern, folder, "left")
    for index in range(len(reader)):
        reader.read(index, out[index])
