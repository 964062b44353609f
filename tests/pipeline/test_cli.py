"""The commands: one line runs the measurement, a second reuses it, the summary tells; bad input ends in one line."""

import contextlib
import csv
import errno
import json
import os
import re
import signal
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
from numpy.testing import assert_allclose

from disctrack import FrameStatus, open_pairs, read_trajectory
from disctrack.cli import COMMANDS, main
from disctrack.disc import MA_2014
from disctrack.synthetic.description import Scene, load_scene
from disctrack.validate.planted_faults import redrawn, reordered
from tests.pipeline.conftest import QUICK, contents, edit, linked


@pytest.mark.statistical
def test_run_calibrates_tracks_draws_and_tells(short_recording, tmp_path, cli):
    results = tmp_path / "results"
    output, errors = cli("run", short_recording, "-o", results, "--csv")
    assert len(output.splitlines()) <= 10
    for word in ("Frames: ", "Calibration: ", "sigma x", "summary.txt", "disctrack analyse"):
        assert word in output
    everything = (results / "summary.txt").read_text()
    files = ("trajectory.h5", "overlay.mp4")
    for word in ("views", "stereo misfit", "baseline", "measured", "sigma", "pairs/s", *files):
        assert word in everything
    # where stderr is no terminal: no bars, one line for each stage when it has ended, and how good the calibration is
    stages = "".join(line for line in errors.splitlines(True) if "inner loops" not in line)  # if compiled only now
    stage = r" *[0-9.]+ s  (calibrate|track|video): \d+ \w+\n"
    assert re.fullmatch(rf"{stage}Calibration: .+\n({stage}){{2}}", stages), errors
    trajectory = read_trajectory(results / "trajectory.h5")
    assert (trajectory.frame_status == FrameStatus.MEASURED).all()
    # the height of the centre follows from the nutation in rolling contact (z = r sin theta + h cos theta)
    theta, disc = trajectory.q[:, 4], trajectory.disc
    height = disc.radius * np.sin(theta) + disc.half_thickness * np.cos(theta)
    # lab frame within the paper's own claim of 5 um
    assert_allclose(trajectory.q[:, 2], height, atol=5e-6)
    assert len(list(csv.DictReader((results / "trajectory.csv").read_text().splitlines()))) == len(trajectory)
    for picture in ("coordinates", "reprojection", "dots", "calibration_residuals"):
        image = cv2.imread(str(results / f"{picture}.png"))
        assert image.std() > 5  # not blank
    video = cv2.VideoCapture(str(results / "overlay.mp4"))
    assert int(video.get(cv2.CAP_PROP_FRAME_COUNT)) == len(trajectory)
    video.release()

    before = {file.name: file.stat().st_mtime_ns for file in results.iterdir()}
    (results / "dots.png").unlink()
    output = cli("run", short_recording, "-o", results, "-v").out
    # a terminal wraps at its own width, and paths may be told from where one stands
    told, kept = ([w for w in text.split() if "/" not in w] for text in (output, (results / "summary.txt").read_text()))
    assert told == kept
    assert output.count("reused") == 3  # in the verdict, and which files
    assert (results / "dots.png").exists()
    after = {file.name: file.stat().st_mtime_ns for file in results.iterdir()}
    for name in ("rig.h5", "trajectory.h5", "overlay.mp4"):
        assert after[name] == before[name]


def test_results_go_into_the_recording_by_default(recording, cli):
    assert str(Path("results") / "trajectory.h5") in cli("run", recording, *QUICK).out
    assert (recording / "results" / "trajectory.h5").exists()
    for option, told in (("--quiet", ""), ("--json", "{")):
        assert cli("run", recording, option, *QUICK).out[:1] == told


def test_track_takes_a_range_of_frames_and_keeps_the_length(recording, rig_file, tmp_path, cli):
    cli("track", recording, "--rig", rig_file, "-o", tmp_path / "part.h5", "--frames", "5:19", *QUICK)
    trajectory = read_trajectory(tmp_path / "part.h5")
    assert len(trajectory) == 24
    assert (trajectory.frame_status[5:19] == FrameStatus.MEASURED).all()
    assert (np.delete(trajectory.frame_status, range(5, 19)) == FrameStatus.NOT_PROCESSED).all()
    assert np.isnan(np.delete(trajectory.q, range(5, 19), axis=0)).all()
    assert_allclose(trajectory.time, np.arange(24) / trajectory.frame_rate, rtol=1e-12)


@pytest.mark.statistical
def test_rest_before_and_after_the_motion_is_left_out_unless_asked_for(recording, cli):
    """100 frames of rest before and after it: its first and its last pair, over and over.

    It is said to be slow, so that it lasts longer than what is measured whole in any case; the margin is 32 frames.
    """
    edit(recording, "frame_rate_hz = 1000", "frame_rate_hz = 100")
    for camera in ("left", "right"):
        folder = recording / camera
        files = sorted(folder.iterdir())
        for i, file in reversed(list(enumerate(files))):
            file.rename(folder / f"{100 + i:06d}.png")
        last = 100 + len(files)
        for i in range(100):
            os.link(folder / "000100.png", folder / f"{i:06d}.png")
            os.link(folder / f"{last - 1:06d}.png", folder / f"{last + i:06d}.png")
    path = recording / "results" / "trajectory.h5"
    cli("run", recording, *QUICK)
    text = (recording / "results" / "summary.txt").read_text()
    assert "rest in frames 0-" in text
    assert "first pass" in text
    trajectory = read_trajectory(path)
    still = trajectory.frame_status == FrameStatus.STILL
    assert len(trajectory) == 224
    assert still[:25].all()
    assert still[-25:].all()
    assert (trajectory.frame_status[70:154] == FrameStatus.MEASURED).all()
    assert np.isnan(trajectory.q[still]).all()
    assert_allclose(trajectory.time, np.arange(224) / trajectory.frame_rate, rtol=1e-12)
    assert "reused" in cli("run", recording, *QUICK).out
    cli("run", recording, *QUICK, "--all", code=1)  # another setting: kept unless told
    cli("run", recording, *QUICK, "--all", "--overwrite")
    every = read_trajectory(path)
    assert (every.frame_status == FrameStatus.MEASURED).all()
    sigma = np.sqrt(np.diagonal(every.pose_covariance, axis1=1, axis2=2))
    change = np.abs(every.q - trajectory.q)[~still]
    assert (change[:, :3] < 0.5 * sigma[~still, :3]).all()  # noise laws measured on different frames
    with pytest.raises(SystemExit):
        main(["run", str(recording), "--all", "--frames", "0:5"])


@pytest.mark.statistical
def test_calibrate_without_a_recording(shared_data, tmp_path, cli):
    folder = shared_data / "opencv_stereo_chessboard"
    path = tmp_path / "rig.h5"
    words = "--left", folder / "left*.jpg", "--right", folder / "right*.jpg", "--corners", "9x6", "--square-mm", "25"
    output = cli("calibrate", *words, "-o", path, "--no-figures", "-v").out
    baseline = float(output.split("baseline")[1].split("mm")[0])
    assert 83.1 < baseline < 83.4  # reference.json beside the photographs: 83.2-83.3
    assert path.exists()


def test_help_is_there_for_every_command_and_comes_at_once():
    # each takes longer than all else here; and it is this command that tells NumPy how many threads it may have
    heavy = {"numpy", "cv2", "scipy", "h5py", "matplotlib", "numba", "skimage"}
    code = (
        "import sys, disctrack.cli\n"
        "for words in (['--help'], *([name, '--help'] for name in disctrack.cli.COMMANDS)):\n"
        "    try: disctrack.cli.main(words)\n"
        "    except SystemExit as stop: assert stop.code == 0\n"
        f"print('loaded', sorted({heavy!r} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    for name in COMMANDS:
        assert f"usage: disctrack {name} " in done.stdout
    assert done.stdout.rstrip().endswith("loaded []")


@pytest.mark.statistical
def test_the_sample_is_the_recording_of_the_repository(sample_clip, tmp_path):
    assert main(["sample", str(tmp_path / "clip"), "--quiet"]) == 0
    same = [file.relative_to(sample_clip) for file in sample_clip.rglob("*.png") if "results" not in file.parts]
    assert len(same) == 636
    assert all((tmp_path / "clip" / file).is_file() for file in same)
    first, last = (
        np.abs(np.subtract(*(cv2.imread(str(at / name), -1).astype(int) for at in (tmp_path / "clip", sample_clip))))
        for name in ("left/000000.png", "right/000299.png")
    )
    assert first.max() <= 1  # processors round differently
    assert last.mean() < 1  # and noise drawn anew differs by less than that
    assert (tmp_path / "clip/recording.toml").read_text() == (sample_clip / "recording.toml").read_text()


def test_open_shows_the_page_written_last(tmp_path, monkeypatch, cli):
    opened = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    assert "no page of results" in cli("open", tmp_path, code=1).err
    for age, name in ((20, "trajectory_diagnosis/diagnosis.html"), (10, "trajectory_analysis/report.html")):
        page = tmp_path / "results" / name
        page.parent.mkdir(parents=True)
        page.touch()
        os.utime(page, (1e9 - age, 1e9 - age))
    cli("open", tmp_path)
    assert opened == [page.as_uri()]


def test_a_range_that_is_cut_says_so(recording):
    (cut,) = open_pairs(recording, (5, 99)).findings
    assert cut.text == "--frames 5:99 is cut: the recording has the frames 0 to 23"
    assert not open_pairs(recording, (5, 24)).findings


def test_print_says_what_to_declare_of_its_sheets(tmp_path, cli):
    (centres,) = re.findall(r"centres_mm = (\[\[.*\]\])", cli("print", "-o", tmp_path).out)
    assert_allclose(json.loads(centres), 1e3 * MA_2014.marker_centres_body[:, :2], atol=1e-4)  # digits that it prints


def test_printed_defaults_are_the_default_scene(tmp_path, cli):
    (tmp_path / "scene.toml").write_text(cli("render", "--defaults").out)
    read = replace(load_scene(tmp_path / "scene.toml"), folder=Path())
    assert repr(read) == repr(Scene())  # to the last bit, and nan is nan


def failure(cli, *words) -> str:
    """The one line that a failing command prints."""
    ended = re.compile(r" *[0-9.]+ s  |compiling the inner loops")  # what went before the failure
    errors = "".join(line for line in cli(*words, code=1).err.splitlines(keepends=True) if not ended.match(line))
    assert errors.startswith("disctrack: ")
    assert errors.count("\n") == 1
    assert "Traceback" not in errors
    return errors


def change_images(recording: Path, change, cameras=("left", "right")) -> None:
    for camera in cameras:
        reordered(recording / camera, partial(redrawn, change=lambda image, share: change(image)))


def in_colour(image: np.ndarray) -> np.ndarray:
    return np.random.default_rng(1).integers(0, 255, (64, 64, 3), dtype=np.uint8)


def another_file(recording: Path) -> None:
    with h5py.File(recording / "other.h5", "w") as file:
        file["x"] = 1.0


def another_scene(recording: Path) -> None:
    (recording / "left.toml").write_text("[cameras]\nn_frames = 3\n")  # whose folder would be `left`


def nothing(recording: Path) -> None:
    pass


PATTERNS = "calibrate --left {r}/l*.png --right {r}/r*.png --corners 9x6 --square-mm 8"


@pytest.mark.parametrize(
    ("spoil", "words", "said"),
    [
        (nothing, "run {r}/nowhere", "nowhere/recording.toml: not found"),
        (nothing, "analyse {r}", r"no results/trajectory.h5 in this folder; 'disctrack run .*recording' makes it"),
        (lambda r: edit(r, '"left/*.png"', '"left/*.tif"'), "run {r}", r"no image matched for the left .*000000\.png"),
        (lambda r: edit(r, '"left/*.png"', '"lfet/*.png"'), "run {r}", "There is no folder"),
        (lambda r: (r / "right" / "000023.png").unlink(), "run {r}", "left has 24 frames.*right has 23"),
        (lambda r: change_images(r, lambda i: i[:200], ["right"]), "run {r}", r"(\d+) x \1 px.*\1 x 200 px"),
        (lambda r: change_images(r, in_colour), "run {r}", "colour"),
        (lambda r: change_images(r, lambda i: np.full_like(i, 90)), "run {r}", "found in none"),
        (lambda r: change_images(r, lambda i: i[:200]), "track {r}", r"000\.png, frame 0: .* 272 x 200.*272 x 272"),
        (another_file, "track {r} --rig {r}/other.h5", "other.h5"),
        (another_file, "analyse {r}/other.h5", "other.h5.*not a trajectory"),
        (lambda r: (r / "mine.h5").write_text("dear"), "track {r} -o {r}/mine.h5", "--overwrite"),
        (nothing, "track {r} --frames 30:40", "holds no frame; the recording has 24"),
        (nothing, "track {r} --frames 9:5", "holds no frame; the recording has 24"),
        (nothing, "calibrate", "--left, --right, --corners, --square-mm missing"),
        (nothing, PATTERNS, "no image matched for the left camera"),
        (another_scene, "render {r}/left.toml --quiet", "not an empty folder"),
        (nothing, "simulate {r}/nowhere.toml", "nowhere.toml"),
        (nothing, "calibrate {r} --table-view 2", "--table-view.*recording.toml says this"),
        (nothing, "calibrate {r} --left l*.png --square-mm 8", "--left.*recording.toml says this"),
    ],
)
def test_what_cannot_be_done_is_said_in_one_line(recording, cli, spoil, words, said):
    spoil(recording)
    before = contents(recording)
    assert re.search(said, failure(cli, *words.format(r=recording).split()))
    assert contents(recording) == before


@pytest.mark.statistical
def test_a_terminal_without_the_letters_of_a_name_does_not_end_the_work(tmp_path):
    """A scheduled job or an old log in ASCII: the name is told as escapes, the file is written."""
    scene = tmp_path / "scene.toml"
    scene.write_text('name = "Münze"\n[cameras]\nn_frames = 5\n[motion]\nkind = "rolling"\n')
    command = [sys.executable, "-m", "disctrack", "simulate", str(scene), "-o", str(tmp_path / "Münze.h5")]
    ascii_only = os.environ | {"PYTHONIOENCODING": "ascii", "PYTHONPATH": str(Path(__file__).parents[2])}
    done = subprocess.run(command, env=ascii_only, capture_output=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert rb"M\xfcnze.h5" in done.stdout
    assert (tmp_path / "Münze.h5").is_file()


@pytest.mark.parametrize(
    "words",
    [
        ["track"],
        ["measure", "x"],
        ["track", "x", "--frames", "abc"],
        ["calibrate", "--corners", "9"],
        ["calibrate", "--square-mm", "-3"],
        ["validate", "--imperfect", "-1"],
        ["validate", "--seed", "-5"],
        ["init", "x", "--radius-mm", "nan"],
        ["init", "x", "--frame-rate-hz", "0"],
        ["init", "x", "--board-thickness-mm", "-1"],
        ["convert", "rig.yml", "rig.h5", "--unit-mm", "nan"],
        ["convert", "rig.yml", "rig.h5", "--image-size", "0", "200"],
        ["analyse", "x", "--frobnicate"],
        ["batch"],
        ["batch", "x", "--shard", "0/3"],
        ["batch", "x", "--shard", "4/3"],
        ["batch", "x", "--shard", "x"],
        ["batch", "x", "-j", "0"],
    ],
)
def test_wrong_usage_is_explained_with_exit_code_2(words, capsys):
    with pytest.raises(SystemExit) as stop:
        main(words)
    assert stop.value.code == 2
    assert "usage:" in capsys.readouterr().err


def empty(file: Path) -> None:
    file.unlink()
    file.touch()


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda r: (r / "calibration" / "right" / "04.png").unlink(), "18 left and 17 right.*left 04.png"),
        (lambda r: edit(r, "view = 0", "view = 20"), "there are 18 calibration views"),
        (lambda r: empty(r / "calibration" / "left" / "00.png"), "00.png.*table view|table view.*00.png"),
        pytest.param(
            lambda r: edit(r, "[9, 6]", "[10, 7]"),
            r"(?=.*inner_corners = \[9, 6\])(?!(.*a board of 10 x 7){2}).*a board of 10 x 7 inner corners is not in it",
            marks=pytest.mark.statistical,
        ),
    ],
)
def test_views_that_cannot_be_used_are_named(short_recording, tmp_path, cli, spoil, said):
    spoil(linked(short_recording, tmp_path))
    assert re.search(said, failure(cli, "calibrate", tmp_path))


@pytest.mark.parametrize(("code", "word"), [(errno.EROFS, "Read-only"), (errno.EACCES, "Permission")])
def test_a_recording_folder_that_is_read_only(recording, monkeypatch, cli, code, word):
    """Simulated: the superuser may write everywhere."""

    def refuse(self, *arguments, **named):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(Path, "mkdir", refuse)
    message = failure(cli, "run", recording)
    assert word in message
    assert "-o" in message


@pytest.fixture
def run_doing(monkeypatch, capsys):
    """Exit code and errors of `disctrack run` that does this instead, where a signal is handled so beforehand."""

    def run(what, kind, handler):
        monkeypatch.setattr("disctrack.commands.run.run", what)
        before = signal.signal(kind, handler)
        try:
            code, told = main(["run", "x"]), capsys.readouterr().err
            assert signal.getsignal(kind) is handler
        finally:
            signal.signal(kind, before)
        return code, told

    return run


@pytest.mark.skipif(sys.platform == "win32", reason="signals are POSIX")
@pytest.mark.parametrize("struck", [True, False])
def test_ctrl_c_that_a_library_turns_into_its_own_error_is_told_as_ctrl_c(run_doing, struck):
    def loaded(arguments):
        with contextlib.suppress(KeyboardInterrupt):
            if struck:
                signal.raise_signal(signal.SIGINT)
        raise ImportError("initialization failed")

    code, told = run_doing(loaded, signal.SIGINT, signal.default_int_handler)  # a job in the background has it ignored
    assert (code == 128 + signal.SIGINT) == ("interrupted" in told) == struck
    assert ("internal error" in told) == (not struck)


@pytest.mark.skipif(sys.platform == "win32", reason="signals are POSIX")
@pytest.mark.parametrize("kind", [signal.SIGTERM, signal.SIGHUP])
@pytest.mark.parametrize("ignored", [False, True])
def test_what_queueing_systems_and_closed_terminals_send_ends_in_order(run_doing, kind, ignored):
    """In one line and with the code of a shell; not where the caller ignores it, as nohup does."""
    ended: list[str] = []

    def going_on(arguments):
        try:
            signal.raise_signal(kind)
        finally:
            ended.append("cleared up")
        return 0

    code, told = run_doing(going_on, kind, signal.SIG_IGN if ignored else signal.SIG_DFL)
    assert ended == ["cleared up"]
    assert code == (0 if ignored else 128 + kind)
    assert told.count("\n") == (not ignored)
    assert (kind.name in told) == (not ignored)


def test_a_name_cannot_steer_the_terminal(tmp_path, cli):
    told = cli("run", tmp_path / "\x1b]0;a title\x07", code=1).err
    assert "\\x1b]0;a title\\x07" in told
    assert told.rstrip("\n").isprintable()
