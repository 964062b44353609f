"""From stacks, videos, camera files, parts of images the measurement is that of PNG files of the same grey values."""

import shutil
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from calibration.rig_file import read_rig
from disctrack import find_views, open_pairs, read_recording, read_trajectory
from disctrack.calibrate.stage import declared_views
from disctrack.cli import main
from disctrack.errors import RecordingError
from disctrack.first_look.declare import Sequence, pair_cameras
from disctrack.recording.readers.base import cut_out
from disctrack.trajectory import part
from disctrack.trajectory.file import read_details
from tests.disctrack.recording.readers.written import write_hdf5
from tests.equality import assert_equal
from tests.oracles.camera_files import write_mraw
from tests.pipeline.conftest import QUICK, edit, grey_values, images_of, linked

CAMERAS = ("left", "right")
OURS = {"Record_Rate": "1000", "Shutter_Type2": "50000"}  # of a Photron header: as declared, and 50 µs


@pytest.fixture(scope="module")
def from_png(untouched_file):
    return read_trajectory(untouched_file)


@pytest.fixture(scope="module")
def from_png_of_50_us(short_recording, rig_file, tmp_path_factory):
    """With the exposure declared that the cameras' headers tell."""
    folder = linked(short_recording, tmp_path_factory.mktemp("png") / "recording")
    edit(folder, "[cameras]", "[cameras]\nexposure_us = 50")
    assert main(["track", str(folder), "--rig", str(rig_file), "-o", str(folder / "trajectory.h5"), *QUICK]) == 0
    return read_trajectory(folder / "trajectory.h5")


def use_files(recording: Path, left: str, right: str) -> None:
    """Let the recording name these instead of its PNG files, which are removed."""
    for name, pattern in zip(CAMERAS, (left, right), strict=True):
        edit(recording, f'{name} = "{name}/*.png"', f'{name} = "{pattern}"')
        shutil.rmtree(recording / name)


def run(recording: Path, *words: str) -> Path:
    assert main(["run", str(recording), *QUICK, *words]) == 0
    return recording / "results" / "trajectory.h5"


def said(capsys) -> str:
    return " ".join(capsys.readouterr().out.split())


def test_the_exposure_moves_poses_by_what_it_should(from_png, from_png_of_50_us):
    """Theta by g T^2 / (6 r) while the disc rolls (dot_shifts.py), within what a nutation of 0.04 deg changes."""
    moved = from_png_of_50_us.q[:, 4] - from_png.q[:, 4]
    assert np.mean(moved) == pytest.approx(9.81 * 50e-6**2 / (6 * 0.0375), rel=0.2)


def test_poses_from_mraw_of_8_bit_are_those_from_png_to_the_last_bit(recording, from_png_of_50_us, capsys):
    for name in CAMERAS:
        write_mraw(recording / "raw" / name, grey_values(recording / name), 8, kind="cihx", **OURS)
    use_files(recording, "raw/left.cihx", "raw/right.cihx")
    found = run(recording, "-v")
    assert "exposure 50 µs, trigger Start" in said(capsys)
    assert_array_equal(read_trajectory(found).q, from_png_of_50_us.q)
    headers = read_details(found)["camera_headers"]
    assert headers["right"]["exposure"] == pytest.approx(5e-5)
    run(recording)
    assert "reused" in said(capsys)


def test_both_cameras_and_their_times_in_one_hdf5_file(recording, from_png, capsys):
    """The right camera's clock runs 30 µs late; the times of the left one are those of the trajectory, gaps and all."""
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
    times[4:] += 3e-3  # three frames were lost before the part that is measured
    with h5py.File(recording / "both.h5", "a") as file:
        file["left/timestamps"][...] = file["right/timestamps"][...] = times
    part_of_it = read_trajectory(run(recording, "--frames", "6:16", "--overwrite"))
    assert_array_equal(part_of_it.time, times)
    assert part_of_it.measured.sum() == 10


@pytest.mark.statistical
def test_chessboard_views_in_one_file_per_camera_give_the_same_rig(short_recording, tmp_path, rig_file):
    text = (short_recording / "recording.toml").read_text()
    views = {name: grey_values(short_recording / "calibration" / name) for name in CAMERAS}
    write_mraw(tmp_path / "left", views["left"], 8)
    write_hdf5(tmp_path / "right.h5", views["right"], compression="gzip")
    text = text.replace("calibration/left/*.png", "left.cih").replace("calibration/right/*.png", "right.h5")
    (tmp_path / "recording.toml").write_text(text)
    assert main(["calibrate", str(tmp_path), "-o", str(tmp_path / "rig.h5"), "--no-figures"]) == 0
    assert_equal(read_rig(tmp_path / "rig.h5"), read_rig(rig_file))


def test_views_of_two_files_must_pair_up_and_not_be_a_whole_recording(tmp_path, rng):
    images = rng.integers(0, 256, (501, 8, 8), dtype=np.uint8)
    write_mraw(tmp_path / "left", images[:20], 8)
    write_mraw(tmp_path / "right", images[:19], 8)
    with pytest.raises(RecordingError, match=r"20 left and 19 right.*left frame 19"):
        find_views("left.cih", "right.cih", tmp_path)
    write_mraw(tmp_path / "right", images, 8)
    with pytest.raises(RecordingError, match="501 frames for the right camera, and every frame is a view"):
        find_views("left.cih", "right.cih", tmp_path)


FRAMES, SIZE = 24, 272
HALVES = f"left_part = [0, 0, {SIZE}, {SIZE}]\nright_part = [{SIZE}, 0, {SIZE}, {SIZE}]"


def declaration(sample_clip: Path, parts: str = HALVES) -> str:
    """That of the sample, for images that hold both cameras'."""
    text = (sample_clip / "recording.toml").read_text()
    for old, new in (
        ('left = "left/*.png"', f'{parts}\nleft = "frames/*.png"'),
        ('right = "right/*.png"', 'right = "frames/*.png"'),
        ('left = "calibration/left/*.png"', 'left = "views/*.png"'),
        ('right = "calibration/right/*.png"', 'right = "views/*.png"'),
    ):
        assert old in text
        text = text.replace(old, new)
    return text


@pytest.fixture(scope="module")
def halves(sample_clip, tmp_path_factory):
    """The sample recording's first frames and its views, left and right side by side in one image."""
    folder = tmp_path_factory.mktemp("halves")
    for source, target, n in ((sample_clip, "frames", FRAMES), (sample_clip / "calibration", "views", None)):
        (folder / target).mkdir()
        for left in sorted((source / "left").glob("*.png"))[:n]:
            both = [cv2.imread(str(f), cv2.IMREAD_UNCHANGED) for f in (left, source / "right" / left.name)]
            cv2.imwrite(str(folder / target / left.name), np.hstack(both))
    (folder / "recording.toml").write_text(declaration(sample_clip))
    return folder


@pytest.mark.statistical
def test_rig_and_poses_are_those_of_two_cameras_to_the_last_bit(halves, sample_clip, tmp_path):
    assert_array_equal(images_of(halves, FRAMES), images_of(sample_clip, FRAMES))
    for folder, result in ((halves, "one"), (sample_clip, "two")):
        asked = ["--frames", f"0:{FRAMES}", *QUICK, "--output", str(tmp_path / result)]
        assert main(["run", str(folder), *asked]) == 0
    assert_equal(*(read_rig(tmp_path / result / "rig.h5") for result in ("one", "two")))
    one, two = (read_trajectory(tmp_path / result / "trajectory.h5") for result in ("one", "two"))
    assert_equal(one, part(two, slice(FRAMES)))  # a file of some frames keeps the recording's length


def test_results_depend_on_the_parts_and_cut_views_are_taken_whole(halves, sample_clip, tmp_path):
    for parts, text in (("declared", HALVES), ("exchanged", HALVES.replace("left", "l").replace("right", "left"))):
        (tmp_path / parts).mkdir()
        text = text.replace("l_part", "right_part")
        (tmp_path / parts / "recording.toml").write_text(declaration(sample_clip, text))
        for name in ("frames", "views"):
            (tmp_path / parts / name).symlink_to(halves / name)
    declared, exchanged = (read_recording(tmp_path / name) for name in ("declared", "exchanged"))
    inputs = [open_pairs(recording).inputs() for recording in (declared, exchanged)]
    assert inputs[0]["left frames"] != inputs[0]["right frames"] == inputs[1]["left frames"]
    views = [declared_views(recording, recording.views) for recording in (declared, exchanged)]
    assert views[0].sha256() != views[1].sha256()
    cut = np.arange(SIZE * SIZE).reshape(SIZE, SIZE)
    assert cut_out(cut, views[0].parts[1], "view") is cut
    np.testing.assert_array_equal(cut_out(np.hstack([cut.T, cut]), views[0].parts[1], "view"), cut)
    with pytest.raises(RecordingError, match=r"view: 280 x 272 px do not hold the part \[272, 0, 272, 272\]"):
        cut_out(np.zeros((SIZE, SIZE + 8)), views[0].parts[1], "view")


@pytest.mark.parametrize(
    ("parts", "told"),
    [
        ("left_part = [0, 0, 272]", r"\[cameras\] left_part is \[0, 0, 272\]; expected \[x, y, width, height\]"),
        ("left_part = [0, -1, 272, 272]", "left_part"),
        ("left_part = [0, 0, 0, 272]", "a width and a height above 0"),
        ("right_part = [300, 0, 272, 272]", r"right_part is \[300, 0, 272, 272\].*000000.png.* has 544 x 272 px"),
        ("right_part = [272, 0, 272, 272]", "left .* 544 x 272 px .* 272 x 272 px .*left_part and right_part"),
    ],
)  # fmt: skip
def test_a_wrong_part_is_told(parts, told, halves, sample_clip, tmp_path):
    shutil.copytree(halves / "frames", tmp_path / "frames")
    (tmp_path / "recording.toml").write_text(declaration(sample_clip, parts))
    with pytest.raises(RecordingError, match=told):
        open_pairs(read_recording(tmp_path))


@pytest.mark.statistical
def test_init_sees_two_views_in_each_image_and_only_there(halves, sample_clip, tmp_path, cli):
    for name in ("frames", "views"):
        shutil.copytree(halves / name, tmp_path / "both" / name)
        shutil.copytree(sample_clip / {"frames": "left", "views": "calibration/left"}[name], tmp_path / "one" / name)
    cli("init", tmp_path / "both")
    text = (tmp_path / "both" / "recording.toml").read_text()
    assert all(line.split("#")[0].strip() in text for line in HALVES.splitlines())
    assert 'right = "views/*.png"' in text
    assert "inner_corners = [9, 6]" in text
    # one camera: its halves do not show a board each
    assert "no two sequences" in cli("init", tmp_path / "one", code=1).err
    for others, pairs in ((18, 0), (290, 1)):  # eighteen views are not the other camera of a motion
        named = [Sequence(tmp_path, f"{of}/*.png", ".png", n) for of, n in (("frames", 300), ("views", others))]
        assert len(pair_cameras(named)) == pairs
