"""Frames in every format that is read, as independent libraries and the formats' descriptions have them."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from disctrack.errors import RecordingError
from disctrack.recording.readers import FrameReader, open_frames
from tests.oracles.camera_files import write_cine, write_mraw

N, HEIGHT, WIDTH = 30, 18, 22


def frames_of(bits: int, seed: int = 0, n: int = N) -> np.ndarray:
    frames = np.random.default_rng(seed).integers(0, 2**bits, (n, HEIGHT, WIDTH))
    return frames.astype(np.uint8 if bits == 8 else np.uint16)


def lost_of(reader: FrameReader, frames: np.ndarray) -> dict[int, str]:
    """Why a frame cannot be read, by its index; all others are these frames (n, height, width)."""
    lost = {}
    for index in range(len(reader)):
        try:
            assert_array_equal(reader.read(index), frames[index])
        except RecordingError as error:
            lost[index] = str(error)
    return lost


def assert_refused(folder: Path, pattern: str, said: str) -> None:
    """Files of a left camera that cannot be opened, for a reason that is told."""
    with pytest.raises(RecordingError, match=said):
        open_frames(pattern, folder, "left")


def write_sequence(folder: Path, images, suffix: str = "png", names=None) -> list[Path]:
    """A file for each image."""
    folder.mkdir(parents=True, exist_ok=True)
    files = [folder / f"{names[i] if names else f'{i:06d}'}.{suffix}" for i in range(len(images))]
    for file, image in zip(files, images, strict=True):
        assert cv2.imwrite(str(file), image)
    return files


def write_images(path: Path, frames: np.ndarray) -> None:
    """A file for each frame in the folder PATH without its suffix."""
    write_sequence(path.with_suffix(""), frames, path.suffix[1:], [f"shot_{i}" for i in range(len(frames))])


def write_tiff(path: Path, frames: np.ndarray, **options) -> None:
    tifffile = pytest.importorskip("tifffile")
    tifffile.imwrite(path, frames, **{"photometric": "minisblack", **options})


def write_pages_by_opencv(path: Path, frames: np.ndarray, compression: int) -> None:
    assert cv2.imwritemulti(str(path), list(frames), [cv2.IMWRITE_TIFF_COMPRESSION, compression])


def write_hdf5(path: Path, frames: np.ndarray, attributes: dict | None = None, **options) -> None:
    with h5py.File(path, "w", userblock_size=1024) as file:
        stack = file.create_dataset("camera/frames", data=frames, **options)
        stack.attrs.update(attributes or {})


def write_photron(path: Path, frames: np.ndarray, bits: int) -> None:
    write_mraw(path.with_suffix(""), frames, bits, kind=path.suffix[1:])


def write_video(path: Path, frames: np.ndarray, pixels: str, codec: str, **options) -> None:
    pytest.importorskip("av")
    write_pictures(path, [picture_of(frame, pixels) for frame in frames], codec, **options)


def write_pictures(path: Path, pictures: list, codec: str, **options) -> None:
    av = pytest.importorskip("av")
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=25, options=options)
        stream.width, stream.height, stream.pix_fmt = pictures[0].width, pictures[0].height, pictures[0].format.name
        for picture in pictures:
            container.mux(stream.encode(picture))
        container.mux(stream.encode())


BETWEEN_CHROMA = ("yuyv422", "uyvy422")  # of cameras with a standard interface: every other byte is luma


def picture_of(frame: np.ndarray, pixels: str):
    """A picture whose luma is `frame`, byte for byte; no conversion by the library."""
    import av

    picture = av.VideoFrame(frame.shape[1], frame.shape[0], pixels)
    neutral = 128 if frame.dtype == np.uint8 else 512
    between = pixels in BETWEEN_CHROMA
    for number, plane in enumerate(picture.planes):
        rows = np.full((plane.height, plane.line_size // frame.itemsize), neutral, frame.dtype)
        if number == 0:
            rows[:, pixels == "uyvy422" :: 1 + between][:, : frame.shape[1]] = frame
        plane.update(rows.tobytes())
    return picture


@dataclass(frozen=True)
class Format:
    suffix: str
    bits: int
    write: Callable[..., object]
    options: dict = field(default_factory=dict)

    def __str__(self) -> str:
        return "-".join(map(str, (self.suffix, self.bits, self.write.__name__, *self.options.values())))

    def written(self, folder: Path, frames: np.ndarray, camera: str = "left") -> str:
        """Write the frames of a camera; the pattern that names them."""
        self.write(folder / f"{camera}.{self.suffix}", frames, **self.options)
        return f"{camera}/*.{self.suffix}" if self.write is write_images else f"{camera}.{self.suffix}"


IMAGES = [Format(s, b, write_images) for s, b in (("png", 8), ("png", 16), ("tif", 8), ("tif", 16), ("bmp", 8))]
LAYOUTS = [{}, {"bigtiff": True, "byteorder": ">"}, {"imagej": True}]
LAYOUTS += [{"rowsperstrip": 5}, {"compression": "zlib", "predictor": True}, {"tile": (16, 16), "compression": "zlib"}]
TIFFS = [
    *(Format("tif", bits, write_tiff, options) for bits in (8, 16) for options in LAYOUTS),
    *(Format("tiff", bits, write_pages_by_opencv, {"compression": c}) for bits in (8, 16) for c in (1, 5, 8, 32773)),
]
EACH = {"chunks": (1, HEIGHT, WIDTH), "compression": "gzip"}
STACKS = [
    Format("h5", 8, write_hdf5),
    Format("h5", 16, write_hdf5, {**EACH, "shuffle": True}),
    Format("h5", 8, write_hdf5, EACH),
    Format("h5", 16, write_hdf5, {**EACH, "fletcher32": True}),
    Format("h5", 16, write_hdf5, {"dtype": ">u2"}),
    Format("h5", 16, write_hdf5, {**EACH, "shuffle": True, "dtype": ">u2"}),
    Format("h5", 8, write_hdf5, {"chunks": (7, 10, WIDTH), "compression": "lzf", "fletcher32": True}),
]
VIDEOS = [
    Format(suffix, bits, write_video, {"pixels": pixels, "codec": codec, **options})
    for suffix, bits, pixels, codec, options in (
        ("mkv", 8, "gray", "ffv1", {}),
        ("mkv", 10, "gray10le", "ffv1", {}),
        ("mkv", 12, "gray12le", "ffv1", {}),
        ("avi", 16, "gray16le", "ffv1", {"g": "1"}),
        ("mp4", 8, "gray", "ffv1", {}),
        ("avi", 8, "gray", "rawvideo", {}),
        ("mkv", 8, "gray", "rawvideo", {}),
        ("mkv", 8, "yuv420p", "ffv1", {}),
        ("mkv", 10, "yuv420p10le", "ffv1", {}),
        ("avi", 8, "yuv420p", "rawvideo", {}),
        ("mp4", 8, "yuv420p", "libx264", {"qp": "0", "g": "10", "bf": "2"}),
        *(("avi", 8, pixels, "rawvideo", {}) for pixels in BETWEEN_CHROMA),
    )
]
CAMERAS = [
    *(Format(kind, bits, write_photron, {"bits": bits}) for kind in ("cih", "cihx") for bits in (8, 10, 12, 16)),
    *(Format("cine", bits, write_cine, {"bits": bits}) for bits in (8, 10, 12, 16)),
    Format("cine", 12, write_cine, {"bits": 12, "packed_pixels": True}),
]
FORMATS = [*IMAGES, *TIFFS, *STACKS, *VIDEOS, *CAMERAS]
