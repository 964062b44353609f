"""Bad input: one line that says where, what and what to do; an exit code; nothing lost, nothing half-written."""

import errno
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest

from disctrack.cli import main
from disctrack.commands import INTERRUPTED
from tests.pipeline.conftest import linked

QUICK = ["--no-figures", "--no-video"]


def failure(capsys, *words) -> str:
    """The one line that a failing command prints."""
    assert main([str(word) for word in words]) == 1
    ended = re.compile(r" *[0-9.]+ s  |compiling the inner loops")  # what went before the failure
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


def change_images(recording: Path, change, cameras=("left", "right")) -> None:
    for camera in cameras:
        for file in (recording / camera).iterdir():
            replace(file, change(cv2.imread(str(file), cv2.IMREAD_UNCHANGED)))


def in_colour(image: np.ndarray) -> np.ndarray:
    return np.random.default_rng(1).integers(0, 255, (64, 64, 3), dtype=np.uint8)


def another_file(recording: Path) -> None:
    with h5py.File(recording / "other.h5", "w") as file:
        file["x"] = 1.0


def another_scene(recording: Path) -> None:
    (recording / "wrong.toml").write_text("[cameras]\nframes = 3\n")
    (recording / "left.toml").write_text("[cameras]\nn_frames = 3\n")  # whose folder would be `left`


def effect(name: str, value: str):
    scene = f'[motion]\nkind = "rolling"\n[motion.rolling.effects.{name}]\n{value}\n'
    return lambda recording: (recording / "scene.toml").write_text(scene)


def nothing(recording: Path) -> None:
    pass


PATTERNS = "calibrate --left {r}/l*.png --right {r}/r*.png --corners 9x6 --square-mm 8"


@pytest.mark.parametrize(
    ("spoil", "words", "said"),
    [
        (nothing, "run {r}/nowhere", "no such folder"),
        (nothing, "analyse {r}", r"no results/trajectory.h5 in this folder; 'disctrack run .*recording' makes it"),
        (lambda r: edit(r, "frame_rate_hz", "framerate_hz"), "run {r}", r"Did you mean 'frame_rate_hz'\?"),
        (lambda r: edit(r, "mass_g = 209.69", ""), "run {r}", r"\[disc\] mass_g is missing"),
        (lambda r: edit(r, '"left/*.png"', '"left/*.tif"'), "run {r}", r"no image matched for the left .*000000\.png"),
        (lambda r: (r / "right" / "000023.png").unlink(), "run {r}", "left has 24 frames.*right has 23"),
        (lambda r: change_images(r, lambda i: i[:200], ["right"]), "run {r}", r"(\d+) x \1 px.*\1 x 200 px"),
        (lambda r: change_images(r, in_colour), "run {r}", "colour"),
        (lambda r: change_images(r, lambda i: np.full_like(i, 90)), "run {r}", "found in none"),
        (lambda r: change_images(r, lambda i: i[:200]), "track {r}", "272 x 200 px.*272 x 272 px"),
        (nothing, "track {r} --rig {r}/nowhere.h5", "no such rig file"),
        (lambda r: (r / "bad.h5").write_bytes(b"nothing"), "track {r} --rig {r}/bad.h5", "bad.h5"),
        (another_file, "track {r} --rig {r}/other.h5", "other.h5"),
        (another_file, "analyse {r}/other.h5", "other.h5.*not a trajectory"),
        (lambda r: (r / "mine.h5").write_text("dear"), "track {r} -o {r}/mine.h5", "--overwrite"),
        (nothing, "track {r} --frames 30:40", "holds no frame; the recording has 24"),
        (nothing, "track {r} --frames 9:5", "holds no frame; the recording has 24"),
        (nothing, "calibrate", "--left, --right, --corners, --square-mm missing"),
        (nothing, PATTERNS, "no image matched for the left camera"),
        (another_scene, "render {r}/wrong.toml --quiet", "nearest known key is 'n_frames'"),
        (another_scene, "render {r}/left.toml --quiet", "not an empty folder"),
        (nothing, "simulate {r}/nowhere.toml", "nowhere.toml"),
        (effect("kz", "k_z = -6e-5"), "simulate {r}/scene.toml", "a passive effect cannot feed the disc with energy"),
        (effect("kx", "k_z = 6e-5"), "simulate {r}/scene.toml", "there is no effect 'kx'"),
        (nothing, "calibrate {r} --table-view 2", "--table-view.*recording.toml says this"),
        (nothing, "calibrate {r} --left l*.png --square-mm 8", "--left.*recording.toml says this"),
    ],
)
def test_what_cannot_be_done_is_said_in_one_line(recording, capsys, spoil, words, said):
    spoil(recording)
    before = {file for file in recording.rglob("*") if file.is_file()}
    assert re.search(said, failure(capsys, *words.format(r=recording).split()))
    assert {file for file in recording.rglob("*") if file.is_file()} == before
    assert not (recording / "mine.h5").exists() or (recording / "mine.h5").read_text() == "dear"


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
def test_views_that_cannot_be_used_are_named(short_recording, tmp_path, capsys, spoil, said):
    spoil(linked(short_recording, tmp_path))
    assert re.search(said, failure(capsys, "calibrate", tmp_path))


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
