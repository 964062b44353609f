"""Before the first run: a declaration is written, faults are named, printed sheets are true to scale."""

import os
import re
import tomllib

import cv2
import h5py
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from disctrack.cli import main
from disctrack.commands.options import PAPERS
from disctrack.disc import MA_2014
from disctrack.first_look.declare import find_sequences, pair_cameras
from disctrack.first_look.targets import PAPERS_MM, board_figure, dots_figure
from tests.calibration.test_chessboard import located
from tests.disctrack.batch.test_queue import touched
from tests.disctrack.recording.readers.written import write_sequence
from tests.pipeline.conftest import linked


@pytest.mark.statistical
def test_init_finds_cameras_views_and_board_and_leaves_only_what_no_file_tells(sample_clip, tmp_path, cli):
    folder = linked(sample_clip, tmp_path / "clip", os.symlink)
    declared = tomllib.loads((folder / "recording.toml").read_text())
    (folder / "recording.toml").unlink()
    told = cli("init", folder, "--frame-rate-hz", "1000").out
    written = tomllib.loads((folder / "recording.toml").read_text())
    for section, key in (
        ("cameras", "left"), ("cameras", "right"), ("cameras", "frame_rate_hz"),
        ("calibration", "left"), ("calibration", "right"), ("calibration", "inner_corners"), ("table", "view"),
    ):  # fmt: skip
        assert written[section][key] == declared[section][key], key
    missing = {
        key for key in ("radius_mm", "thickness_mm", "mass_g", "diameter_mm", "centres_mm", "square_mm") if key in told
    }
    assert len(missing) == 6
    said = cli("run", folder, code=1).err  # what is not known is refused, by name, all of it at once, and not guessed
    assert all(f"] {key}" in said for key in missing)
    assert "are missing" in said


def test_a_folder_of_any_name_gets_a_declaration_that_can_be_read(tmp_path):
    folder = tmp_path / 'two\nlines, "quoted" \\ and \x7f'
    for camera in ("left", "right"):
        write_sequence(folder / camera, np.full((3, 32, 32), 90, np.uint8))
    assert main(["init", str(folder)]) == 0
    assert tomllib.loads((folder / "recording.toml").read_text())["name"] == folder.name


@pytest.mark.statistical
def test_init_takes_the_rest_from_an_earlier_recording_of_the_same_disc(sample_clip, tmp_path):
    folder = linked(sample_clip, tmp_path / "clip", os.symlink)
    (folder / "recording.toml").unlink()
    assert main(["init", str(folder), "--like", str(sample_clip)]) == 0
    written, declared = (tomllib.loads((f / "recording.toml").read_text()) for f in (folder, sample_clip))
    declared["name"] = "clip"
    assert written == declared
    assert main(["init", str(folder)]) == 1  # and never replaces what is there


@pytest.mark.parametrize(
    ("names", "pairs"),
    [
        (["cam1/a_001.png", "cam1/a_002.png", "cam2/a_001.png", "cam2/a_002.png"], [("cam1/*.png", "cam2/*.png")]),
        (["R_7.tif", "R_8.tif", "L_7.tif", "L_8.tif"], [("L_*.tif", "R_*.tif")]),
        (["x_0001_right.bmp", "x_0002_right.bmp", "x_0001_left.bmp", "x_0002_left.bmp"],
         [("x_*_left.bmp", "x_*_right.bmp")]),
        (["f0001_cam1.png", "f0002_cam1.png", "f0001_cam2.png", "f0002_cam2.png"],
         [("f*_cam1.png", "f*_cam2.png")]),
        (["take_C001H001S0001.cihx", "take_C001H001S0001.mraw", "take_C002H001S0001.cihx", "take_C002H001S0001.mraw"],
         [("take_C001H001S0001.cihx", "take_C002H001S0001.cihx")]),
        (["camLeft.mkv", "camRight.mkv", "notes.txt"], [("camLeft.mkv", "camRight.mkv")]),
        (["results/left/1.png", "results/right/1.png"], []),
        (["left/1.png", "left/2.png", "notes.txt"], []),
    ],
)  # fmt: skip
def test_cameras_are_told_apart_by_their_names(names, pairs, tmp_path):
    touched(tmp_path, *names)
    found = pair_cameras(find_sequences(tmp_path))
    assert [(pair.left.pattern, pair.right.pattern) for pair in found] == pairs


def test_folders_behind_links_are_looked_into_once(tmp_path):
    folders = "kept/views/left", "kept/views/right", "take/left", "take/right"
    touched(tmp_path, *(f"{folder}/{i}.png" for folder in folders for i in range(2)))
    os.symlink(tmp_path / "kept/views", tmp_path / "take/calibration")
    os.symlink(tmp_path / "take", tmp_path / "take/again")  # leads back to where it lies
    found = {(pair.left.pattern, pair.right.pattern) for pair in pair_cameras(find_sequences(tmp_path / "take"))}
    assert found == {("left/*.png", "right/*.png"), ("calibration/left/*.png", "calibration/right/*.png")}


@pytest.mark.statistical
def test_check_names_the_file_of_a_view_that_is_not_used(sample_clip, tmp_path, capsys):
    folder = linked(sample_clip, tmp_path / "clip", os.symlink)
    views = sorted((folder / "calibration/right").glob("*.png"))
    blank = np.full_like(cv2.imread(str(views[-1]), cv2.IMREAD_UNCHANGED), 90)
    views[-1].unlink()
    cv2.imwrite(str(views[-1]), blank)
    main(["check", str(folder)])
    told = re.sub(r"\s+", " ", capsys.readouterr().out)
    assert f"{views[-1]}: left out" in told
    assert not re.search(r"view \d", told)  # a number among those that were looked at means nothing to a reader


def test_stacks_in_one_hdf5_file_are_the_two_cameras(tmp_path, rng):
    with h5py.File(tmp_path / "frames.h5", "w") as file:
        for name in ("right", "left"):
            stack = file.create_dataset(name, data=rng.integers(0, 255, (3, 40, 50), np.uint8))
            stack.attrs["frame_rate"] = 2000.0
    assert main(["init", str(tmp_path)]) == 0
    written = tomllib.loads((tmp_path / "recording.toml").read_text())
    assert written["cameras"] == {"frame_rate_hz": 2000.0, "left": "frames.h5:/left", "right": "frames.h5:/right"}


def drawn(figure, dpi=150):
    """Grey values of a sheet, and pixels per millimetre."""
    figure.set_dpi(dpi)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return cv2.cvtColor(np.asarray(canvas.buffer_rgba())[..., :3].copy(), cv2.COLOR_RGB2GRAY), dpi / 25.4


@pytest.mark.statistical
def test_printed_dots_lie_where_they_are_declared():
    assert set(PAPERS_MM) == set(PAPERS)
    image, scale = drawn(dots_figure(MA_2014))
    _, _, stats, centres = cv2.connectedComponentsWithStats((image < 100).astype(np.uint8))
    diameter = 1e3 * MA_2014.marker_diameter * scale
    dots = np.array(
        [c for s, c in zip(stats, centres, strict=True) if abs(s[4] / (np.pi * diameter**2 / 4) - 1) < 0.05]
    )
    assert len(dots) == 6 * MA_2014.n_markers  # six faces on a sheet
    distances = np.linalg.norm(dots[:, None] - dots[None], axis=-1) / scale
    declared = 1e3 * MA_2014.marker_centres_body[:, :2]
    # one face: the dots nearest to that of the upper left; half a pixel is 0.08 mm
    for a in range(len(declared)):
        for b in range(a):
            wanted = np.linalg.norm(declared[a] - declared[b])
            assert np.sum(abs(distances - wanted) < 0.08) >= 2 * 6


@pytest.mark.parametrize(("corners", "square"), [((9, 6), 20.0), ((6, 4), 15.0), ((8, 6), 10.0)])
def test_printed_board_is_the_one_that_is_declared(corners, square):
    sharp, scale = drawn(board_figure(corners, square))
    image = cv2.GaussianBlur(sharp, (0, 0), 1.0)  # as a scanner sees it
    grid = located(image, corners).points.reshape(corners[1], corners[0], 2)
    steps = np.concatenate([np.diff(grid, axis=0).reshape(-1, 2), np.diff(grid, axis=1).reshape(-1, 2)])
    assert np.linalg.norm(steps, axis=1) / scale == pytest.approx(square, abs=0.1)
    first, along_j = grid[0, 0], grid[1, 0]
    outside = np.rint(first - 0.5 * (grid[0, 1] - first) - 0.5 * (along_j - first)).astype(int)
    assert image[outside[1], outside[0]] < 50  # dark beside corner 0


@pytest.mark.statistical
def test_check_finds_nothing_to_put_right_in_the_sample(sample_clip, tmp_path, cli):
    told = cli("check", sample_clip, "-v", "-o", tmp_path / "check.png").out
    assert not re.search(r"^(refusal|doubt|warning) ", told, re.MULTILINE)
    for what in ("declaration", "frames", "chessboard", "light", "dots", "sharpness", "accuracy"):
        assert f"\n{what} " in told
    assert cv2.imread(str(tmp_path / "check.png")) is not None


def test_init_says_that_cameras_differ_in_number_and_views_are_missing_or_a_rig_is_there(
    sample_clip, rig_file, tmp_path, cli
):
    for camera, n in (("left", 5), ("right", 4)):
        (tmp_path / camera).mkdir()
        for file in sorted((sample_clip / camera).iterdir())[:n]:
            (tmp_path / camera / file.name).symlink_to(file)
    said = cli("init", tmp_path).out
    assert "left has 5 frames, right has 4" in said
    assert "no views of a chessboard" in said
    (tmp_path / "recording.toml").unlink()
    (tmp_path / "rig.h5").symlink_to(rig_file)
    assert "no views of a chessboard" not in cli("init", tmp_path).out
    written = tomllib.loads((tmp_path / "recording.toml").read_text())
    assert written["calibration"] == {"rig": "rig.h5"}
    assert "table" not in written
