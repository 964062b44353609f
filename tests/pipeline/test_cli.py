"""The commands on a real recording: one line runs the measurement, a second run reuses it, and the summary tells."""

import csv
import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose

from disctrack import open_pairs
from disctrack.cli import COMMANDS, main
from disctrack.disc import MA_2014
from disctrack.synthetic.description import Scene, load_scene
from disctrack.trajectory import FrameStatus
from disctrack.trajectory.file import read_details, read_trajectory

QUICK = ["--no-figures", "--no-video"]


@pytest.mark.statistical
def test_run_calibrates_tracks_draws_and_tells(short_recording, tmp_path, capsys):
    results = tmp_path / "results"
    assert main(["run", str(short_recording), "-o", str(results), "--csv"]) == 0
    output, errors = capsys.readouterr()
    assert len(output.splitlines()) <= 10
    for word in ("Frames: ", "Calibration: ", "sigma x", "summary.txt", "disctrack analyse"):
        assert word in output
    everything = (results / "summary.txt").read_text()
    files = ("trajectory.h5", "overlay.mp4", "times.json")
    for word in ("views", "stereo misfit", "baseline", "measured", "sigma", "pairs/s", *files):
        assert word in everything
    # where stderr is no terminal: no bars, one line for each stage when it has ended, and how good the calibration is
    stages = "".join(line for line in errors.splitlines(True) if "inner loops" not in line)  # if compiled only now
    stage = r" *[0-9.]+ s  (calibrate|track|figures|video): \d+ \w+\n"
    assert re.fullmatch(rf"{stage}Calibration: .+\n({stage}){{3}}", stages), errors
    trajectory = read_trajectory(results / "trajectory.h5")
    assert (trajectory.frame_status == FrameStatus.MEASURED).all()
    # the height of the centre follows from the nutation in rolling contact (z = r sin theta + h cos theta)
    theta, disc = trajectory.q[:, 4], trajectory.disc
    height = disc.radius * np.sin(theta) + disc.half_thickness * np.cos(theta)
    # lab frame within the paper's own claim of 5 um
    assert_allclose(trajectory.q[:, 2], height, atol=5e-6)
    with (results / "trajectory.csv").open() as stream:
        assert len(list(csv.DictReader(stream))) == len(trajectory)
    for picture in ("coordinates", "reprojection", "dots", "calibration_residuals"):
        image = cv2.imread(str(results / f"{picture}.png"))
        assert image.std() > 5  # not blank
    video = cv2.VideoCapture(str(results / "overlay.mp4"))
    assert int(video.get(cv2.CAP_PROP_FRAME_COUNT)) == len(trajectory)
    video.release()

    times = json.loads((results / "times.json").read_text())["run"]
    assert [stage["stage"] for stage in times["stages"]] == ["calibrate", "track", "figures", "video"]
    assert times["stages"][1]["count"] == len(trajectory)
    assert 0 < sum(stage["processor_seconds"] for stage in times["stages"]) < times["processor_seconds"]

    before = {file.name: file.stat().st_mtime_ns for file in results.iterdir()}
    (results / "dots.png").unlink()
    assert main(["run", str(short_recording), "-o", str(results), "-v"]) == 0
    output = capsys.readouterr().out
    # a terminal wraps at its own width, and paths may be told from where one stands
    told, kept = ([w for w in text.split() if "/" not in w] for text in (output, (results / "summary.txt").read_text()))
    assert told == kept
    assert output.count("reused") == 3  # in the verdict, and which files
    assert (results / "dots.png").exists()
    after = {file.name: file.stat().st_mtime_ns for file in results.iterdir()}
    for name in ("rig.h5", "trajectory.h5", "overlay.mp4"):
        assert after[name] == before[name]


def test_results_go_into_the_recording_by_default(recording, capsys):
    assert main(["run", str(recording), *QUICK]) == 0
    assert (recording / "results" / "trajectory.h5").exists()
    assert str(Path("results") / "trajectory.h5") in capsys.readouterr().out
    for option, told in (("--quiet", ""), ("--json", "{")):
        assert main(["run", str(recording), option, *QUICK]) == 0
        assert capsys.readouterr().out[:1] == told


def test_track_takes_a_range_of_frames_and_keeps_the_length(recording, rig_file, tmp_path):
    path = tmp_path / "part.h5"
    assert main(["track", str(recording), "--rig", str(rig_file), "-o", str(path), "--frames", "5:19", *QUICK]) == 0
    trajectory = read_trajectory(path)
    assert len(trajectory) == 24
    assert (trajectory.frame_status[5:19] == FrameStatus.MEASURED).all()
    assert (np.delete(trajectory.frame_status, range(5, 19)) == FrameStatus.NOT_PROCESSED).all()
    assert np.isnan(np.delete(trajectory.q, range(5, 19), axis=0)).all()
    assert_allclose(trajectory.time, np.arange(24) / trajectory.frame_rate, rtol=1e-12)


@pytest.fixture
def rested(recording) -> Path:
    """The recording with 100 frames of rest before and after it: its first and its last pair, over and over.

    It is said to be slow, so that it lasts longer than what is measured whole in any case; the margin is 32 frames.
    """
    toml = recording / "recording.toml"
    toml.write_text(toml.read_text().replace("frame_rate_hz = 1000", "frame_rate_hz = 100"))
    for camera in ("left", "right"):
        folder = recording / camera
        files = sorted(folder.iterdir())
        for i, file in reversed(list(enumerate(files))):
            file.rename(folder / f"{100 + i:06d}.png")
        last = 100 + len(files)
        for i in range(100):
            os.link(folder / "000100.png", folder / f"{i:06d}.png")
            os.link(folder / f"{last - 1:06d}.png", folder / f"{last + i:06d}.png")
    return recording


@pytest.mark.statistical
def test_rest_before_and_after_the_motion_is_left_out_unless_asked_for(rested, capsys):
    path = rested / "results" / "trajectory.h5"
    assert main(["run", str(rested), *QUICK]) == 0
    text = (rested / "results" / "summary.txt").read_text()
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
    assert main(["run", str(rested), *QUICK]) == 0
    assert "reused" in capsys.readouterr().out
    assert main(["run", str(rested), *QUICK, "--all"]) == 1  # another setting: kept unless told
    assert main(["run", str(rested), *QUICK, "--all", "--overwrite"]) == 0
    every = read_trajectory(path)
    assert (every.frame_status == FrameStatus.MEASURED).all()
    sigma = np.sqrt(np.diagonal(every.pose_covariance, axis1=1, axis2=2))
    change = np.abs(every.q - trajectory.q)[~still]
    assert (change[:, :3] < 0.5 * sigma[~still, :3]).all()  # noise laws measured on different frames
    with pytest.raises(SystemExit):
        main(["run", str(rested), "--all", "--frames", "0:5"])


def test_the_result_does_not_depend_on_the_number_of_reading_threads(recording, tmp_path):
    for threads in ("1", "3"):
        path = tmp_path / f"{threads}.h5"
        assert main(["track", str(recording), "-o", str(path), "--threads", threads, *QUICK]) == 0
    one, three = (read_trajectory(tmp_path / f"{threads}.h5") for threads in "13")
    np.testing.assert_array_equal(one.q, three.q)


@pytest.mark.statistical
def test_calibrate_without_a_recording(shared_data, tmp_path, capsys):
    folder = shared_data / "opencv_stereo_chessboard"
    path = tmp_path / "rig.h5"
    words = ["calibrate", "--left", str(folder / "left*.jpg"), "--right", str(folder / "right*.jpg")]
    model = ["--distortion", "k1 k2", "--board", "flat", "--no-figures", "-v"]  # choosing takes longer
    assert main([*words, "--corners", "9x6", "--square-mm", "25", "-o", str(path), *model]) == 0
    output = capsys.readouterr().out
    baseline = float(output.split("baseline")[1].split("mm")[0])
    assert 83.1 < baseline < 83.4  # reference.json beside the photographs: 83.2-83.3
    assert path.exists()


def test_an_unreadable_image_is_one_lost_camera_and_the_exit_code_says_so(recording, capsys):
    (recording / "right" / "000007.png").unlink()
    (recording / "right" / "000007.png").write_bytes(b"\x89PNG\r\n\x1a\nhalf")
    for camera in ("left", "right"):
        (recording / camera / "000011.png").unlink()
        (recording / camera / "000011.png").write_bytes(b"")
    assert main(["run", str(recording), *QUICK]) == 3
    assert "could not be read" in capsys.readouterr().err
    assert "000007.png" in (recording / "results" / "summary.txt").read_text()
    trajectory = read_trajectory(recording / "results" / "trajectory.h5")
    assert trajectory.frame_status[11] == FrameStatus.UNREADABLE
    assert trajectory.frame_status[7] == FrameStatus.ONE_CAMERA
    others = np.delete(trajectory.frame_status, [7, 11])
    assert (others == FrameStatus.MEASURED).all()
    assert len(read_details(recording / "results" / "trajectory.h5")["unreadable"]) == 3
    assert main(["run", str(recording), *QUICK]) == 3  # reused, and still incomplete


def test_help_is_there_for_every_command_and_comes_at_once():
    heavy = {"numpy", "cv2", "scipy", "h5py", "matplotlib", "numba", "skimage"}  # each takes longer than all else here
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


def test_open_shows_the_page_written_last(tmp_path, monkeypatch, capsys):
    opened = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    assert main(["open", str(tmp_path)]) == 1
    assert "no page of results" in capsys.readouterr().err
    for age, name in ((20, "trajectory_diagnosis/diagnosis.html"), (10, "trajectory_analysis/report.html")):
        page = tmp_path / "results" / name
        page.parent.mkdir(parents=True)
        page.touch()
        os.utime(page, (1e9 - age, 1e9 - age))
    assert main(["open", str(tmp_path)]) == 0
    assert opened == [page.as_uri()]


def test_a_range_that_is_cut_says_so(recording):
    (cut,) = open_pairs(recording, (5, 99)).findings
    assert cut.text == "--frames 5:99 is cut: the recording has the frames 0 to 23"
    assert not open_pairs(recording, (5, 24)).findings


def test_print_says_what_to_declare_of_its_sheets(tmp_path, capsys):
    assert main(["print", "-o", str(tmp_path)]) == 0
    (centres,) = re.findall(r"centres_mm = (\[\[.*\]\])", capsys.readouterr().out)
    assert_allclose(json.loads(centres), 1e3 * MA_2014.marker_centres_body[:, :2], atol=1e-4)  # digits that it prints


def test_printed_defaults_are_the_default_scene(tmp_path, capsys):
    assert main(["render", "--defaults"]) == 0
    (tmp_path / "scene.toml").write_text(capsys.readouterr().out)
    read = replace(load_scene(tmp_path / "scene.toml"), folder=Path())
    assert repr(read) == repr(Scene())  # to the last bit, and nan is nan
