"""One sensor behind mirrors, or two images stored in one: the numbers are those of two cameras with their own files."""

import shutil
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest

from disctrack.calibrate.views import declared_views
from disctrack.cli import main
from disctrack.errors import RecordingError
from disctrack.first_look.sequences import Sequence, pair_cameras
from disctrack.recording.declaration import read_recording
from disctrack.recording.readers.blocks import iter_pair_blocks
from disctrack.track.measurement import open_pairs

FRAMES, VIEWS, SIZE = 24, 18, 272
HALVES = f"left_part = [0, 0, {SIZE}, {SIZE}]\nright_part = [{SIZE}, 0, {SIZE}, {SIZE}]"


def declaration(sample_clip: Path, parts: str = HALVES) -> str:
    """That of the sample, for images that hold both cameras'."""
    text = (sample_clip / "recording.toml").read_text()
    for old, new in (
        ('left = "left/*.png" ', f'{parts}\nleft = "frames/*.png"'),
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
    for source, target, n in ((sample_clip, "frames", FRAMES), (sample_clip / "calibration", "views", VIEWS)):
        (folder / target).mkdir()
        for left in sorted((source / "left").glob("*.png"))[:n]:
            both = [cv2.imread(str(f), cv2.IMREAD_UNCHANGED) for f in (left, source / "right" / left.name)]
            cv2.imwrite(str(folder / target / left.name), np.hstack(both))
    (folder / "recording.toml").write_text(declaration(sample_clip))
    return folder


def frames_of(folder: Path) -> np.ndarray:
    pairs = open_pairs(read_recording(folder), (0, FRAMES))
    return np.concatenate([b.images.copy() for b in iter_pair_blocks(pairs.left, pairs.right, 0, FRAMES)])


@pytest.mark.statistical
def test_rig_and_poses_are_those_of_two_cameras_to_the_last_bit(halves, sample_clip, tmp_path):
    np.testing.assert_array_equal(frames_of(halves), frames_of(sample_clip))
    for folder, result in ((halves, "one"), (sample_clip, "two")):
        asked = ["--frames", f"0:{FRAMES}", "--no-figures", "--no-video", "--output", str(tmp_path / result)]
        assert main(["run", str(folder), *asked]) == 0
    for name in ("rig.h5", "trajectory.h5"):
        with h5py.File(tmp_path / "one" / name) as one, h5py.File(tmp_path / "two" / name) as two:
            names: list[str] = []
            two.visit(names.append)
            numbers = [k for k in names if isinstance(two[k], h5py.Dataset) and two[k].dtype.kind in "fiu"]
            assert len(numbers) > 5
            for key in numbers:
                ours, theirs = one[key][()], two[key][()]  # a file of some frames keeps the recording's length
                theirs = theirs[:FRAMES] if theirs.shape[:1] == (300,) else theirs
                np.testing.assert_array_equal(ours, theirs, err_msg=f"{name} {key}")


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
    assert views[0].parts[1].of(cut) is cut
    np.testing.assert_array_equal(views[0].parts[1].of(np.hstack([cut.T, cut])), cut)


@pytest.mark.parametrize(
    ("parts", "told"),
    [
        ("left_part = [0, 0, 272]", r"\[cameras\] left_part is \[0, 0, 272\]; expected \[x, y, width, height\]"),
        ("left_part = [0, -1, 272, 272]", "left_part"),
        ("left_part = [0, 0, 0, 272]", "a width and a height above 0"),
        ("right_part = [300, 0, 272, 272]", r"right_part is \[300, 0, 272, 272\].*000000.png has 544 x 272 px"),
        ("right_part = [272, 0, 272, 272]", "left .* 544 x 272 px .* 272 x 272 px .*left_part and right_part"),
    ],
)  # fmt: skip
def test_a_wrong_part_is_told(parts, told, halves, sample_clip, tmp_path):
    shutil.copytree(halves / "frames", tmp_path / "frames")
    (tmp_path / "recording.toml").write_text(declaration(sample_clip, parts))
    with pytest.raises(RecordingError, match=told):
        open_pairs(read_recording(tmp_path))


@pytest.mark.statistical
def test_init_sees_two_views_in_each_image_and_only_there(halves, sample_clip, tmp_path, capsys):
    for name in ("frames", "views"):
        shutil.copytree(halves / name, tmp_path / "both" / name)
        shutil.copytree(sample_clip / {"frames": "left", "views": "calibration/left"}[name], tmp_path / "one" / name)
    assert main(["init", str(tmp_path / "both")]) == 0
    text = (tmp_path / "both" / "recording.toml").read_text()
    assert all(line.split("#")[0].strip() in text for line in HALVES.splitlines())
    assert 'right = "views/*.png"' in text
    assert "inner_corners = [9, 6]" in text
    assert main(["init", str(tmp_path / "one")]) != 0  # one camera: its halves do not show a board each
    assert "no two sequences" in capsys.readouterr().err
    for others, pairs in ((18, 0), (290, 1)):  # eighteen views are not the other camera of a motion
        named = (Sequence("frames/*.png", ".png", 300), Sequence("views/*.png", ".png", others))
        assert len(pair_cameras(named)) == pairs
