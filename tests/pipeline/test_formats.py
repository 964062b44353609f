"""The measurement from stacks, videos and the cameras' own files is the one from PNG files of the same grey values."""

import shutil
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from calibration.rig_file import read_rig
from disctrack.calibrate.views import find_views
from disctrack.cli import main
from disctrack.errors import RecordingError
from disctrack.trajectory.file import read_details, read_trajectory
from tests.disctrack.recording.readers.written import write_hdf5
from tests.oracles.camera_files import write_cine, write_mraw

QUICK = ["--no-figures", "--no-video"]
CAMERAS = ("left", "right")
OURS = {"Record_Rate": "1000", "Shutter_Type2": "50000"}  # of a Photron header: as declared, and 50 µs


def tracked(source, rig_file, folder, declared=""):
    """Trajectory from the PNG files, with the same rig."""
    shutil.copytree(source, folder)
    file = folder / "recording.toml"
    file.write_text(file.read_text().replace("[cameras]", f"[cameras]\n{declared}", 1))
    path = folder / "trajectory.h5"
    assert main(["track", str(folder), "--rig", str(rig_file), "-o", str(path), *QUICK]) == 0
    return read_trajectory(path)


@pytest.fixture(scope="module")
def from_png(short_recording, rig_file, tmp_path_factory):
    return tracked(short_recording, rig_file, tmp_path_factory.mktemp("png") / "recording")


@pytest.fixture(scope="module")
def from_png_of_50_us(short_recording, rig_file, tmp_path_factory):
    """With the exposure declared that the cameras' headers tell."""
    return tracked(short_recording, rig_file, tmp_path_factory.mktemp("png") / "recording", "exposure_us = 50")


def grey_values(folder: Path) -> np.ndarray:
    return np.stack([cv2.imread(str(file), cv2.IMREAD_UNCHANGED) for file in sorted(folder.iterdir())])


def use_files(recording: Path, left: str, right: str) -> None:
    """Let the recording name these instead of its PNG files, which are removed."""
    file = recording / "recording.toml"
    text = file.read_text()
    for name, pattern in zip(CAMERAS, (left, right), strict=True):
        assert f'{name} = "{name}/*.png"' in text
        text = text.replace(f'{name} = "{name}/*.png"', f'{name} = "{pattern}"')
        shutil.rmtree(recording / name)
    file.write_text(text)


def use_mraw(recording: Path, kind: str = "cih", right: dict | None = None, **entries) -> None:
    """Both cameras' frames as Photron writes them. right : what its header says otherwise"""
    for name in CAMERAS:
        own = OURS | entries | ((right or {}) if name == "right" else {})
        write_mraw(recording / "raw" / name, grey_values(recording / name), 8, kind=kind, **own)
    use_files(recording, f"raw/left.{kind}", f"raw/right.{kind}")


def run(recording: Path, *words: str) -> Path:
    assert main(["run", str(recording), *QUICK, *words]) == 0
    return recording / "results" / "trajectory.h5"


def said(capsys) -> str:
    return " ".join(capsys.readouterr().out.split())


def test_the_exposure_moves_poses_by_what_it_should(from_png, from_png_of_50_us):
    """Theta by g T^2 / (6 r) while the disc rolls (exposure.py), within what a nutation of 0.04 deg changes."""
    moved = from_png_of_50_us.q[:, 4] - from_png.q[:, 4]
    assert np.mean(moved) == pytest.approx(9.81 * 50e-6**2 / (6 * 0.0375), rel=0.2)


def test_poses_from_mraw_of_8_bit_are_those_from_png_to_the_last_bit(recording, from_png_of_50_us, capsys):
    use_mraw(recording, "cihx")
    found = run(recording, "-v")
    assert "exposure 50 µs, trigger Start" in said(capsys)
    assert_array_equal(read_trajectory(found).q, from_png_of_50_us.q)
    headers = read_details(found)["camera_headers"]
    assert headers["right"]["exposure"] == pytest.approx(5e-5)
    assert headers["left"]["saturation"] == 255
    run(recording)
    assert "reused" in said(capsys)


def test_both_cameras_and_their_times_in_one_hdf5_file(recording, from_png, capsys):
    """The right camera's clock runs 30 µs late; the times of the left one are those of the trajectory."""
    times = 3.0 + np.arange(len(from_png.time)) * 1e-3
    with h5py.File(recording / "both.h5", "w") as file:
        for camera, later in zip(CAMERAS, (0.0, 3e-5), strict=True):
            file[f"{camera}/frames"] = grey_values(recording / camera)
            file[f"{camera}/timestamps"] = times + later
            file[camera].attrs["frame_rate"] = 1000.0
    use_files(recording, "both.h5:/left/frames", "both.h5:/right/frames")
    found = read_trajectory(run(recording, "-v"))
    assert "taken 30 µs after the left one's" in said(capsys)
    assert_array_equal(found.time, times)
    assert_array_equal(found.q, from_png.q)
    assert any("30 µs after" in finding.text for finding in found.findings)


def test_doubts_about_the_headers_are_told_and_kept(recording, capsys):
    use_mraw(recording, right={"Shutter_Type2": "90000"})
    file = recording / "recording.toml"
    file.write_text(file.read_text().replace("[cameras]", "[cameras]\nexposure_us = 500", 1))
    found = run(recording, "-v")
    told = said(capsys)
    assert "the cameras exposed for different times" in told
    assert "exposure_us is 500, the left camera's header says 50 µs" in told
    assert "left 50 µs" in "".join(finding.text for finding in read_trajectory(found).findings)


def test_a_part_of_a_recording_keeps_the_time_of_every_frame(recording):
    """Three frames were lost before the part that is measured: time goes on after it as before."""
    times = np.delete(np.arange(27), [4, 5, 6]) / 1000
    for name in CAMERAS:
        write_cine(recording / f"{name}.cine", grey_values(recording / name), 8, rate=1000, times=times)
    use_files(recording, "left.cine", "right.cine")
    found = read_trajectory(run(recording, "--frames", "6:16"))
    assert_allclose(found.time, times, atol=2**-29)
    assert found.measured.sum() == 10


@pytest.mark.statistical
def test_chessboard_views_in_one_file_per_camera_give_the_same_rig(short_recording, tmp_path, rig_file):
    text = (short_recording / "recording.toml").read_text()
    views = {name: grey_values(short_recording / "calibration" / name) for name in CAMERAS}
    write_mraw(tmp_path / "left", views["left"], 8)
    write_hdf5(tmp_path / "right.h5", views["right"], compression="gzip")
    text = text.replace("calibration/left/*.png", "left.cih").replace("calibration/right/*.png", "right.h5")
    (tmp_path / "recording.toml").write_text(text)
    model = ["--distortion", "k1 k2 p1 p2", "--board", "flat", "--no-figures"]
    assert main(["calibrate", str(tmp_path), "-o", str(tmp_path / "rig.h5"), *model]) == 0
    one, other = read_rig(tmp_path / "rig.h5"), read_rig(rig_file)
    for ours, theirs in zip(one.cameras, other.cameras, strict=True):
        assert_array_equal(ours.parameters, theirs.parameters)
    assert_array_equal(one.covariance, other.covariance)


def test_views_of_two_files_must_pair_up_and_not_be_a_whole_recording(tmp_path, rng):
    images = rng.integers(0, 256, (501, 8, 8), dtype=np.uint8)
    write_mraw(tmp_path / "left", images[:20], 8)
    write_mraw(tmp_path / "right", images[:19], 8)
    with pytest.raises(RecordingError, match=r"20 left and 19 right.*left frame 19"):
        find_views("left.cih", "right.cih", tmp_path)
    write_mraw(tmp_path / "right", images, 8)
    with pytest.raises(RecordingError, match="501 frames for the right camera, and every frame is a view"):
        find_views("left.cih", "right.cih", tmp_path)
