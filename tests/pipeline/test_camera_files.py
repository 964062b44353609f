"""The measurement from the cameras' own files is the one from PNG files of the same grey values."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from calibration.rig_file import read_rig
from disctrack.calibrate.views import find_views
from disctrack.cli import main
from disctrack.errors import RecordingError
from disctrack.trajectory.file import read_details, read_trajectory
from tests.oracles.camera_files import write_cine, write_mraw

QUICK = ["--no-figures", "--no-video"]


def grey_values(folder: Path) -> np.ndarray:
    return np.stack([cv2.imread(str(file), cv2.IMREAD_UNCHANGED) for file in sorted(folder.iterdir())])


def use_files(recording: Path, left: str, right: str) -> None:
    """Let the recording name these instead of its PNG files, which are removed."""
    file = recording / "recording.toml"
    text = file.read_text()
    for name, pattern in (("left", left), ("right", right)):
        assert f'{name} = "{name}/*.png"' in text
        text = text.replace(f'{name} = "{name}/*.png"', f'{name} = "{pattern}"')
        shutil.rmtree(recording / name)
    file.write_text(text)


@pytest.fixture(scope="module")
def from_png(short_recording, rig_file, tmp_path_factory):
    """Trajectory from the PNG files, with the same rig."""
    path = tmp_path_factory.mktemp("png") / "trajectory.h5"
    assert main(["track", str(short_recording), "--rig", str(rig_file), "-o", str(path), *QUICK]) == 0
    return read_trajectory(path)


@pytest.fixture(scope="module")
def from_png_of_50_us(short_recording, rig_file, tmp_path_factory):
    """The same with the exposure declared that the cameras' headers tell."""
    folder = tmp_path_factory.mktemp("png_50_us") / "recording"
    shutil.copytree(short_recording, folder)
    file = folder / "recording.toml"
    file.write_text(file.read_text().replace("[cameras]", "[cameras]\nexposure_us = 50", 1))
    path = folder / "trajectory.h5"
    assert main(["track", str(folder), "--rig", str(rig_file), "-o", str(path), *QUICK]) == 0
    return read_trajectory(path)


def test_the_exposure_moves_poses_by_what_it_should(from_png, from_png_of_50_us):
    """Theta by g T^2 / (6 r) while the disc rolls (exposure.py), within what a nutation of 0.04 deg changes."""
    moved = from_png_of_50_us.q[:, 4] - from_png.q[:, 4]
    assert np.mean(moved) == pytest.approx(9.81 * 50e-6**2 / (6 * 0.0375), rel=0.2)


def test_poses_from_mraw_of_8_bit_are_those_from_png_to_the_last_bit(recording, from_png_of_50_us, capsys):
    for name in ("left", "right"):
        images = grey_values(recording / name)
        write_mraw(recording / "raw" / name, images, 8, kind="cihx", Record_Rate="1000", Shutter_Type2="50000")
    use_files(recording, "raw/left.cihx", "raw/right.cihx")
    assert main(["run", str(recording), "-v", *QUICK]) == 0
    output = " ".join(capsys.readouterr().out.split())
    assert "exposure 50 us, trigger Start" in output
    found = recording / "results" / "trajectory.h5"
    assert_array_equal(read_trajectory(found).q, from_png_of_50_us.q)
    headers = read_details(found)["camera_headers"]
    assert headers["right"]["exposure"] == pytest.approx(5e-5)
    assert headers["left"]["saturation"] == 255
    assert main(["run", str(recording), *QUICK]) == 0
    assert "reused" in capsys.readouterr().out


def test_poses_do_not_depend_on_the_unit_of_grey(recording, from_png_of_50_us):
    """12 bits packed, each value 16 times that of the PNG; rounding to 1/16 of a PNG's grey value leaves no trace."""
    for name in ("left", "right"):
        images = grey_values(recording / name).astype(np.uint16) << 4
        write_mraw(recording / name, images, 12, Record_Rate="1000", Shutter_Type2="50000")
    use_files(recording, "left.cih", "right.mraw")
    assert main(["run", str(recording), *QUICK]) == 0
    found = read_trajectory(recording / "results" / "trajectory.h5")
    assert (np.abs(found.q - from_png_of_50_us.q) <= 1e-5 * from_png_of_50_us.coordinate_sigma).all()


@pytest.mark.parametrize("bits", [8, 16])
def test_poses_and_times_from_cine_are_those_from_png(recording, from_png, bits):
    """Of 8 bit to the last bit, with the camera's own times; of 16 bit 257 times the grey values."""
    for name in ("left", "right"):
        images = grey_values(recording / name).astype(np.uint16) * (1 if bits == 8 else 257)
        # without its exposure: times differ by the stamps' rounding, and with them the last bits of what it shifts
        write_cine(recording / f"{name}.cine", images, bits, rate=1000, first_image=-5, exposure_ns=0)
    use_files(recording, "left.cine", "right.cine")
    assert main(["run", str(recording), *QUICK]) == 0
    found = recording / "results" / "trajectory.h5"
    trajectory = read_trajectory(found)
    if bits == 8:
        assert_array_equal(trajectory.q, from_png.q)
    else:  # as for 12 bit above
        assert (np.abs(trajectory.q - from_png.q) <= 1e-5 * from_png.coordinate_sigma).all()
    assert_allclose(trajectory.time, from_png.time, atol=2**-29)  # stamps have 2**-30 s
    assert read_details(found)["camera_headers"]["left"]["first_frame"] == -5


def test_a_declared_exposure_that_no_header_confirms_is_told(recording, capsys):
    for name in ("left", "right"):
        write_mraw(
            recording / "raw" / name, grey_values(recording / name), 8, Record_Rate="1000", Shutter_Type2="50000"
        )
    use_files(recording, "raw/left.cih", "raw/right.cih")
    file = recording / "recording.toml"
    file.write_text(file.read_text().replace("[cameras]", "[cameras]\nexposure_us = 500", 1))
    assert main(["run", str(recording), "-v", *QUICK]) == 0
    assert "exposure_us is 500, the left camera's header says 50 us" in " ".join(capsys.readouterr().out.split())


@pytest.mark.statistical
def test_calibration_views_may_be_frames_of_one_file(short_recording, tmp_path, rig_file):
    """The same views as PNG files and as MRAW give the same rig."""
    text = (short_recording / "recording.toml").read_text()
    for name in ("left", "right"):
        write_mraw(tmp_path / name, grey_values(short_recording / "calibration" / name), 8)
        text = text.replace(f"calibration/{name}/*.png", f"{name}.cih")
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


def test_headers_that_contradict_the_recording_stop_it_before_any_work(recording, capsys):
    for name in ("left", "right"):
        write_mraw(recording / "raw" / name, grey_values(recording / name), 8, Record_Rate="2000")
    use_files(recording, "raw/left.cih", "raw/right.cih")
    assert main(["run", str(recording), *QUICK]) == 1
    message = capsys.readouterr().err
    assert "frame_rate_hz is 1000" in message
    assert "recorded with 2000 Hz" in message
    assert not (recording / "results" / "trajectory.h5").exists()


def test_doubts_about_the_headers_are_told_and_kept(recording, capsys):
    for name, exposure in (("left", "50000"), ("right", "90000")):
        write_mraw(
            recording / "raw" / name, grey_values(recording / name), 8, Record_Rate="1000", Shutter_Type2=exposure
        )
    use_files(recording, "raw/left.cih", "raw/right.cih")
    assert main(["run", str(recording), *QUICK, "-v"]) == 0
    assert "the cameras exposed for different times" in " ".join(capsys.readouterr().out.split())
    assert "left 50 us" in "".join(f.text for f in read_trajectory(recording / "results" / "trajectory.h5").findings)


def test_a_part_of_a_recording_keeps_the_time_of_every_frame(recording):
    """Three frames were lost before the part that is measured: time goes on after it as before."""
    times = np.delete(np.arange(27), [4, 5, 6]) / 1000
    for name in ("left", "right"):
        write_cine(recording / f"{name}.cine", grey_values(recording / name), 8, rate=1000, times=times)
    use_files(recording, "left.cine", "right.cine")
    assert main(["run", str(recording), *QUICK, "--frames", "6:16"]) == 0
    found = read_trajectory(recording / "results" / "trajectory.h5")
    assert_allclose(found.time, times, atol=2**-29)
    assert found.measured.sum() == 10
