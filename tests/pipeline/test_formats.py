"""The measurement from stacks and videos is the one from PNG files of the same grey values, to the last bit."""

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from calibration.rig_file import read_rig
from disctrack.cli import main
from disctrack.trajectory.file import read_trajectory

QUICK = ["--no-figures", "--no-video"]
CAMERAS = ("left", "right")


@pytest.fixture(scope="module")
def from_png(short_recording, rig_file, tmp_path_factory):
    """Trajectory from the PNG files, with the same rig."""
    path = tmp_path_factory.mktemp("png") / "trajectory.h5"
    assert main(["track", str(short_recording), "--rig", str(rig_file), "-o", str(path), *QUICK]) == 0
    return read_trajectory(path)


def frames_of(folder: Path) -> np.ndarray:
    return np.stack([cv2.imread(str(file), cv2.IMREAD_UNCHANGED) for file in sorted(folder.iterdir())])


def name_files(recording: Path, left: str, right: str) -> None:
    """Let the recording name these instead of its PNG files, which are removed."""
    text = (recording / "recording.toml").read_text()
    for camera, pattern in zip(CAMERAS, (left, right), strict=True):
        text = text.replace(f'{camera} = "{camera}/*.png"', f'{camera} = "{pattern}"')
        shutil.rmtree(recording / camera, ignore_errors=True)
    (recording / "recording.toml").write_text(text)


def write_video(path: Path, frames: np.ndarray, pixels: str) -> None:
    av = pytest.importorskip("av")
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=25)
        stream.width, stream.height, stream.pix_fmt = frames.shape[2], frames.shape[1], pixels
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format=pixels)))
        container.mux(stream.encode())


def write_pages(path: Path, frames: np.ndarray) -> None:
    assert cv2.imwritemulti(str(path), list(frames), [cv2.IMWRITE_TIFF_COMPRESSION, 1])


def write_mkv(path: Path, frames: np.ndarray) -> None:
    write_video(path, frames, "gray")


def write_hdf5(path: Path, frames: np.ndarray) -> None:
    with h5py.File(path, "w") as file:
        file.create_dataset("frames", data=frames, chunks=(1, *frames.shape[1:]), compression="gzip")


@pytest.mark.parametrize(("suffix", "write"), [("tif", write_pages), ("mkv", write_mkv), ("h5", write_hdf5)])
def test_poses_from_lossless_files_of_8_bit_are_those_from_png(
    recording, from_png, suffix: str, write: Callable[[Path, np.ndarray], None]
):
    for camera in CAMERAS:
        write(recording / f"{camera}.{suffix}", frames_of(recording / camera))
    name_files(recording, f"left.{suffix}", f"right.{suffix}")
    assert main(["run", str(recording), *QUICK]) == 0
    assert_array_equal(read_trajectory(recording / "results" / "trajectory.h5").q, from_png.q)


def test_both_cameras_and_their_times_in_one_hdf5_file(recording, from_png, capsys):
    """The right camera's clock runs 30 us late; the times of the left one are those of the trajectory."""
    times = 3.0 + np.arange(len(from_png.time)) * 1e-3
    with h5py.File(recording / "both.h5", "w") as file:
        for camera, later in zip(CAMERAS, (0.0, 3e-5), strict=True):
            file[f"{camera}/frames"] = frames_of(recording / camera)
            file[f"{camera}/timestamps"] = times + later
            file[camera].attrs["frame_rate"] = 1000.0
    name_files(recording, "both.h5:/left/frames", "both.h5:/right/frames")
    assert main(["run", str(recording), *QUICK, "-v"]) == 0
    assert "taken 30 us after the left one's" in " ".join(capsys.readouterr().out.split())
    found = recording / "results" / "trajectory.h5"
    assert_array_equal(read_trajectory(found).time, times)
    assert_array_equal(read_trajectory(found).q, from_png.q)
    assert any("30 us after" in finding.text for finding in read_trajectory(found).findings)


def test_deep_video_gives_the_poses_of_its_grey_values(recording, from_png):
    """12 bit, each value 16 times that of the PNG: the same picture in another unit."""
    for camera in CAMERAS:
        write_video(recording / f"{camera}.mkv", frames_of(recording / camera).astype(np.uint16) * 16, "gray12le")
    name_files(recording, "left.mkv", "right.mkv")
    assert main(["run", str(recording), *QUICK]) == 0
    found = read_trajectory(recording / "results" / "trajectory.h5")
    assert (np.abs(found.q - from_png.q) <= 1e-5 * from_png.coordinate_sigma).all()


@pytest.mark.statistical
def test_chessboard_views_in_one_file_per_camera_give_the_same_rig(short_recording, tmp_path):
    model = ["--distortion", "k1 k2 p1 p2", "--board", "flat", "--no-figures"]
    recording = tmp_path / "recording"
    recording.mkdir()
    shutil.copy(short_recording / "recording.toml", recording)
    for number, name in enumerate(CAMERAS):
        views = frames_of(short_recording / "calibration" / name)[:8]
        (recording / "calibration" / name).mkdir(parents=True)
        for i, view in enumerate(views):
            assert cv2.imwrite(str(recording / "calibration" / name / f"{i:02d}.png"), view)
        (write_pages, write_hdf5)[number](recording / f"views_{name}.{('tif', 'h5')[number]}", views)
    assert main(["calibrate", str(recording), "-o", str(tmp_path / "images.h5"), *model]) == 0
    text = (recording / "recording.toml").read_text()
    text = text.replace("calibration/left/*.png", "views_left.tif").replace("calibration/right/*.png", "views_right.h5")
    (recording / "recording.toml").write_text(text)
    shutil.rmtree(recording / "calibration")
    assert main(["calibrate", str(recording), "-o", str(tmp_path / "stacks.h5"), *model]) == 0
    one, other = (read_rig(tmp_path / f"{name}.h5") for name in ("images", "stacks"))
    for ours, theirs in zip(other.cameras, one.cameras, strict=True):
        assert_array_equal(ours.parameters, theirs.parameters)
    assert_array_equal(other.covariance, one.covariance)
