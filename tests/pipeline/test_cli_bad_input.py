"""Bad input: one line that says where, what and what to do; an exit code; nothing lost, nothing half-written."""

import errno
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest

from disctrack.cli import main
from disctrack.commands import INTERRUPTED
from disctrack.files import whole as whole_files
from disctrack.trajectory.file import read_trajectory
from tests.pipeline.conftest import linked

QUICK = ["--no-figures", "--no-video"]


def failure(capsys, *words) -> str:
    """The one line that a failing command prints."""
    assert main([str(word) for word in words]) == 1
    ended = re.compile(r" *[0-9.]+ s  ")  # stages that ended before the failure
    errors = "".join(line for line in capsys.readouterr().err.splitlines(keepends=True) if not ended.match(line))
    assert errors.startswith("disctrack: ")
    assert errors.count("\n") == 1
    assert "Traceback" not in errors
    return errors


def edit(recording: Path, written: str, found: str) -> None:
    text = (recording / "recording.toml").read_text()
    assert written in text
    (recording / "recording.toml").write_text(text.replace(written, found, 1))


def replace(file: Path, image: np.ndarray) -> None:
    """Write another image; the file is linked to the original, which must stay."""
    file.unlink()
    assert cv2.imwrite(str(file), image)


def test_a_folder_that_is_not_there(tmp_path, capsys):
    assert "no such folder" in failure(capsys, "run", tmp_path / "nowhere")


def test_a_folder_without_a_trajectory(recording, capsys):
    assert f"no results/trajectory.h5 in this folder; 'disctrack run {recording}' makes it" in failure(
        capsys, "analyse", recording
    )


def change_images(recording: Path, change, cameras=("left", "right")) -> None:
    for camera in cameras:
        for file in (recording / camera).iterdir():
            replace(file, change(cv2.imread(str(file), cv2.IMREAD_UNCHANGED)))


def in_colour(image: np.ndarray) -> np.ndarray:
    return np.random.default_rng(1).integers(0, 255, (64, 64, 3), dtype=np.uint8)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda r: edit(r, "frame_rate_hz", "framerate_hz"), r"Did you mean 'frame_rate_hz'\?"),
        (lambda r: edit(r, "mass_g = 209.69", ""), r"\[disc\] mass_g is missing"),
        (lambda r: edit(r, '"left/*.png"', '"left/*.tif"'), r"no image matched for the left camera.*000000\.png"),
        (lambda r: (r / "right" / "000023.png").unlink(), "left has 24 frames.*right has 23"),
        (lambda r: change_images(r, lambda i: i[:200], ["right"]), r"(\d+) x \1 px.*\1 x 200 px"),
        (lambda r: change_images(r, in_colour), "colour"),
        (lambda r: change_images(r, lambda i: np.full_like(i, 90)), "found in none"),
    ],
)
def test_a_recording_that_cannot_be_measured(recording, capsys, spoil, words):
    spoil(recording)
    assert re.search(words, failure(capsys, "run", recording))
    assert not (recording / "results" / "trajectory.h5").exists()


def test_a_rig_of_another_image_size(recording, rig_file, tmp_path, capsys):
    change_images(recording, lambda image: image[:200])
    message = failure(capsys, "track", recording, "--rig", rig_file, "-o", tmp_path / "t.h5")
    assert "272 x 200 px" in message
    assert "272 x 272 px" in message


def test_a_rig_file_that_is_none(recording, tmp_path, capsys):
    assert "no such rig file" in failure(capsys, "track", recording, "--rig", tmp_path / "nowhere.h5")
    (tmp_path / "bad.h5").write_bytes(b"nothing")
    assert "bad.h5" in failure(capsys, "track", recording, "--rig", tmp_path / "bad.h5")
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["x"] = 1.0
    assert "other.h5" in failure(capsys, "track", recording, "--rig", tmp_path / "other.h5")


def test_an_output_that_exists(recording, tmp_path, capsys):
    path = tmp_path / "mine.h5"
    path.write_text("something dear")
    assert "--overwrite" in failure(capsys, "track", recording, "-o", path)
    assert path.read_text() == "something dear"


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


@pytest.mark.parametrize("range_", ["30:40", "9:5"])
def test_a_range_without_frames(recording, capsys, range_):
    assert "holds no frame; the recording has 24" in failure(capsys, "track", recording, "--frames", range_)


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
    ],
)
def test_wrong_usage_is_explained_with_exit_code_2(words, capsys):
    with pytest.raises(SystemExit) as stop:
        main(words)
    assert stop.value.code == 2
    assert "usage:" in capsys.readouterr().err


def test_calibrate_without_anything_to_calibrate_from(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert "--left, --right, --corners, --square-mm missing" in failure(capsys, "calibrate")
    words = ("calibrate", "--left", "l*.png", "--right", "r*.png", "--corners", "9x6", "--square-mm", "8")
    assert "no image matched for the left camera" in failure(capsys, *words)


@pytest.mark.parametrize("words", [("--table-view", 2), ("--left", "l*.png", "--square-mm", 8)])
def test_what_recording_toml_says_is_not_said_beside_it(short_recording, capsys, words):
    assert f"{words[0]}" in (told := failure(capsys, "calibrate", short_recording, *words))
    assert "recording.toml says this" in told


def test_a_calibration_view_without_its_partner(short_recording, tmp_path, capsys):
    linked(short_recording, tmp_path)
    (tmp_path / "calibration" / "right" / "04.png").unlink()
    message = failure(capsys, "calibrate", tmp_path)
    assert "18 left and 17 right" in message
    assert "left 04.png" in message


@pytest.mark.statistical
def test_other_corners_than_declared_are_named_once_for_all_views(short_recording, tmp_path, capsys):
    linked(short_recording / "calibration", tmp_path / "calibration")
    shutil.copy(short_recording / "recording.toml", tmp_path)
    edit(tmp_path, "[9, 6]", "[10, 7]")
    message = failure(capsys, "calibrate", tmp_path)
    assert message.count("a board of 10 x 7 inner corners is not in it") == 1
    assert "inner_corners = [9, 6]" in message


def test_a_table_view_that_is_damaged_or_not_there(short_recording, tmp_path, capsys):
    linked(short_recording / "calibration", tmp_path / "calibration")
    text = (short_recording / "recording.toml").read_text()
    (tmp_path / "recording.toml").write_text(text.replace("view = 0", "view = 20"))
    assert "there are 18 calibration views" in failure(capsys, "calibrate", tmp_path)
    (tmp_path / "recording.toml").write_text(text)
    (tmp_path / "calibration" / "left" / "00.png").unlink()
    (tmp_path / "calibration" / "left" / "00.png").write_bytes(b"")
    message = failure(capsys, "calibrate", tmp_path)
    assert "00.png" in message
    assert "table view" in message


@pytest.mark.statistical
@pytest.mark.parametrize("corners", ["8x6", "12x9"])
def test_a_wrong_board_geometry(short_recording, tmp_path, capsys, corners):
    views = short_recording / "calibration"
    words = ["--left", views / "left" / "0[0-4].png", "--right", views / "right" / "0[0-4].png"]
    message = failure(capsys, "calibrate", *words, "--corners", corners, "--square-mm", 8, "-o", tmp_path / "rig.h5")
    assert "board" in message
    assert "00.png" in message or "view 0" in message
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("code", "word"), [(errno.EROFS, "read-only"), (errno.EACCES, "permission")])
def test_a_recording_folder_that_is_read_only(recording, monkeypatch, capsys, code, word):
    """Simulated: the superuser may write everywhere."""

    def refuse(self, *arguments, **named):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(Path, "mkdir", refuse)
    message = failure(capsys, "run", recording)
    assert word in message
    assert "-o" in message


@pytest.mark.skipif(sys.platform == "win32", reason="signals are POSIX")
@pytest.mark.parametrize("struck", [True, False])
def test_ctrl_c_that_a_library_turns_into_its_own_error_is_told_as_ctrl_c(recording, monkeypatch, capsys, struck):
    from disctrack.commands import run as command

    def loaded(arguments):
        try:
            if struck:
                signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            pass
        raise ImportError("initialization failed")

    monkeypatch.setattr(command, "run", loaded)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background has it ignored
    try:
        code, told = main(["run", str(recording)]), capsys.readouterr().err
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)
    assert (code == INTERRUPTED) == ("interrupted" in told) == struck
    assert ("internal error" in told) == (not struck)


@pytest.mark.skipif(sys.platform == "win32", reason="signals are POSIX")
@pytest.mark.parametrize("kind", [signal.SIGTERM, signal.SIGHUP])
@pytest.mark.parametrize("ignored", [False, True])
def test_what_queueing_systems_and_closed_terminals_send_ends_in_order(recording, monkeypatch, capsys, kind, ignored):
    """In one line and with the code of a shell; not where the caller ignores it, as nohup does."""
    from disctrack.commands import run as command

    ended: list[str] = []

    def going_on(arguments):
        try:
            signal.raise_signal(kind)
        finally:
            ended.append("cleared up")
        return 0

    monkeypatch.setattr(command, "run", going_on)
    chosen = signal.SIG_IGN if ignored else signal.SIG_DFL
    before = signal.signal(kind, chosen)
    try:
        code, told = main(["run", str(recording)]), capsys.readouterr().err
        assert signal.getsignal(kind) is chosen
    finally:
        signal.signal(kind, before)
    assert ended == ["cleared up"]
    assert code == (0 if ignored else 128 + kind)
    assert told.count("\n") == (not ignored)
    assert (kind.name in told) == (not ignored)


def test_a_name_cannot_steer_the_terminal(tmp_path, capsys):
    assert main(["run", str(tmp_path / "\x1b]0;a title\x07")]) == 1
    told = capsys.readouterr().err
    assert "\\x1b]0;a title\\x07" in told
    assert told.rstrip("\n").isprintable()


def test_a_disk_that_fills_up_while_the_result_is_written(recording, monkeypatch, capsys):
    written = whole_files.os.fsync

    def full(descriptor):
        if ".part" in os.readlink(f"/proc/self/fd/{descriptor}"):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        written(descriptor)

    if not Path("/proc/self/fd").exists():
        pytest.skip("needs /proc to tell one file from another")
    monkeypatch.setattr(whole_files.os, "fsync", full)
    assert "disk is full" in failure(capsys, "run", recording, *QUICK)
    assert os.listdir(recording / "results") == []
    monkeypatch.undo()
    assert main(["run", str(recording), *QUICK]) == 0


def start(*words, **environment) -> subprocess.Popen:
    return subprocess.Popen(
        [sys.executable, "-m", "disctrack", *map(str, words)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), **environment},
    )


@pytest.mark.statistical
@pytest.mark.skipif(sys.platform == "win32", reason="signals are POSIX")
@pytest.mark.parametrize(
    "delay", [1.0, pytest.param(0.3, marks=pytest.mark.slow), pytest.param(2.0, marks=pytest.mark.slow)]
)
@pytest.mark.parametrize("kind", [signal.SIGINT, signal.SIGKILL])
def test_a_run_that_is_stopped_leaves_nothing_half_and_the_next_completes(recording, capsys, kind, delay):
    process = start("run", recording, "--no-video")
    time.sleep(delay)
    process.send_signal(kind)  # harmless where the run was done before
    _, errors = process.communicate(timeout=60)
    # before 0.5 s the interpreter itself may still be starting
    if process.returncode != 0 and kind == signal.SIGINT and delay > 0.5:
        assert "interrupted" in errors
        assert "Traceback" not in errors
    results = recording / "results"
    if (results / "trajectory.h5").exists():
        read_trajectory(results / "trajectory.h5")  # whole
    assert main(["run", str(recording), *QUICK]) == 0
    assert len(read_trajectory(results / "trajectory.h5")) == 24
    assert not list(results.glob("*.part*"))
