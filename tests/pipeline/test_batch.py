"""Many recordings: each is measured once, none takes another down, and the summary tells of all."""

import contextlib
import csv
import errno
import json
import os
import re
import resource
import shutil
from concurrent.futures import Future
from pathlib import Path
from urllib.parse import unquote

import cv2
import numpy as np
import pytest

from disctrack.batch import BatchOptions, find_recordings, run, run_batch
from disctrack.batch import measure as stage
from disctrack.batch.columns import FITTED
from disctrack.batch.plan import make_plan
from disctrack.batch.records import read_record
from disctrack.cli import main
from disctrack.track.follow.tracking import prepare
from disctrack.trajectory.file import read_trajectory
from tests.pipeline.conftest import linked, naming_rig

FAST = ["--no-report"]
MODEL = ["--distortion", "k1 k2 p1 p2", "--board", "flat"]  # choosing by held-out error is tested elsewhere


def replace(file: Path, content: bytes) -> None:
    file.unlink()
    file.write_bytes(content)


def rows_in(path: Path) -> dict[str, dict]:
    return {row["recording"]: row for row in json.loads(path.read_text())["recordings"]}


def statuses(path: Path) -> dict[str, str]:
    return {name: row["status"] for name, row in rows_in(path).items()}


def jobs_of(folder: Path, **options):
    found = find_recordings([folder])
    return make_plan(found, found.recordings, BatchOptions(report=False, **options))[1]


@pytest.fixture
def in_this_process(monkeypatch):
    """No processes of its own, where a test is about something else: starting them takes longer than measuring."""

    class Here:
        def __init__(self, size):
            self.size = size

        def submit(self, job):
            future = Future()
            future.set_result(stage.do(job))
            return future

        def close(self):
            pass

    monkeypatch.setattr("disctrack.batch.run.Processes", Here)


@pytest.mark.statistical
def test_a_batch_calibrates_a_shared_rig_once_and_tells_of_every_recording(short_recording, tmp_path, capsys):
    root = tmp_path / "day"
    for name in ("r2", "r10"):
        linked(short_recording, root / name)
    linked(short_recording, root / "bad toml")
    replace(root / "bad toml" / "recording.toml", b"x = = 3")
    replace(root / "r10" / "left" / "000005.png", b"junk")
    assert main(["batch", str(root), "-j", "2", *FAST, *MODEL]) == 1
    said, errors = capsys.readouterr()
    assert re.search(r"refusal +bad toml \(failed\).*not valid TOML", said, re.DOTALL)
    assert re.search(r"r10 \(measured\).*000005.png", said, re.DOTALL)
    assert "2 measured, 1 failed" in said
    assert "\r" not in errors  # no bar where stderr is no terminal, but a line for each recording that ends
    assert errors.count("measured\n") == 2
    assert len(list((root / "batch_results" / "rigs").rglob("rig.h5"))) == 1

    rows = rows_in(root / "batch_results" / "summary.json")
    with (root / "batch_results" / "summary.csv").open() as stream:
        table = {row["recording"]: row for row in csv.DictReader(stream)}
    assert list(table) == list(rows) == ["bad toml", "r2", "r10"]
    for name, row in rows.items():
        for column, value in row.items():
            cell = table[name][column]
            assert (cell == "") if value is None else (str(value) == cell), column
    trajectory = read_trajectory(root / "r2" / "results" / "trajectory.h5")
    assert rows["r2"]["pairs_measured"] == len(trajectory)
    parts = [rows["r2"][f"processor_seconds_{stage}"] for stage in ("track", "analyse")]
    assert 0 < sum(parts) <= rows["r2"]["processor_seconds"] + 1e-3
    assert rows["r2"]["z_sigma_m"] == np.median(trajectory.coordinate_sigma[:, 2])
    assert (root / "batch_results" / rows["r2"]["trajectory"]).samefile(root / "r2" / "results" / "trajectory.h5")
    page = (root / "batch_results" / "index.html").read_text()
    assert all(name in page for name in rows)


@pytest.mark.statistical
def test_the_same_command_goes_on_where_something_was_wrong_and_nowhere_else(
    recording, tmp_path, capsys, in_this_process
):
    root = tmp_path / "day"
    linked(recording, root / "r1")
    linked(recording, root / "bad toml")
    replace(root / "bad toml" / "recording.toml", b"x = = 3")
    assert main(["batch", str(root), *FAST]) == 1
    kept = (root / "r1" / "results" / "trajectory.h5").stat().st_mtime_ns
    replace(root / "bad toml" / "recording.toml", (root / "r1" / "recording.toml").read_bytes())
    capsys.readouterr()
    assert main(["batch", str(root), *FAST, "--json"]) == 0
    assert "1 measured, 1 measured before" in json.loads(capsys.readouterr().out)["verdict"]
    assert (root / "r1" / "results" / "trajectory.h5").stat().st_mtime_ns == kept
    again = statuses(root / "batch_results" / "summary.json")
    assert again.pop("bad toml") == "measured"
    assert set(again.values()) == {"skipped"}


@pytest.fixture
def one(recording):
    """Job of the short recording with the given rig."""
    (job,) = jobs_of(recording)
    return job


@pytest.mark.statistical
def test_what_counts_is_content_not_existence(one, recording):
    assert stage.do(one).status == "measured"
    results = recording / "results"
    assert stage.do(one).status == "skipped"
    (recording / "recording.toml").touch()
    assert stage.do(one).status == "skipped"

    image = cv2.imread(str(recording / "left" / "000003.png"), cv2.IMREAD_UNCHANGED)
    before = read_record(results)
    replace(recording / "left" / "000003.png", cv2.imencode(".png", image ^ 1)[1].tobytes())
    assert stage.do(one).status == "measured"
    assert read_record(results).numbers["input_sha256"] != before.numbers["input_sha256"]

    (wider,) = jobs_of(recording, window=0.4)
    assert stage.do(wider).status == "measured"
    assert stage.do(wider).status == "skipped"
    toml = (recording / "recording.toml").read_text()
    replace(recording / "recording.toml", toml.replace("mass_g = 209.69", "mass_g = 209.7").encode())
    (heavier,) = jobs_of(recording, window=0.4)
    assert stage.do(heavier).status == "measured"
    (again,) = jobs_of(recording, window=0.4, overwrite=True)
    assert stage.do(again).status == "measured"


def test_a_file_of_unknown_origin_is_kept(one, recording):
    foreign = recording / "results" / "trajectory.h5"
    foreign.parent.mkdir()
    foreign.write_bytes(b"years of work")
    result = stage.do(one)
    assert result.status == "failed"
    assert "--overwrite" in result.reason
    assert foreign.read_bytes() == b"years of work"


@pytest.mark.statistical
def test_files_that_vanish_in_mid_run_cost_their_frames_or_their_recording(one, recording, monkeypatch):
    real = stage.measure

    def after_the_last_images_went(*given, **options):
        for camera in ("left", "right"):
            for file in sorted((recording / camera).iterdir())[-4:]:
                file.unlink()
        return real(*given, **options)

    monkeypatch.setattr(stage, "measure", after_the_last_images_went)
    spoilt = stage.do(one)
    assert spoilt.status == "measured"
    assert spoilt.numbers["pairs_measured"] == 20
    assert "8 images could not be read" in spoilt.reason
    monkeypatch.undo()

    for file in sorted((recording / "right").iterdir())[-2:]:
        file.unlink()
    failed = stage.do(one)
    assert failed.status == "failed"
    assert "left has 20 frames" in failed.reason
    shutil.rmtree(recording)
    assert "recording.toml" in stage.do(one).reason


@pytest.mark.statistical
def test_the_summary_is_that_of_all_shards(recording, tmp_path, in_this_process):
    root = tmp_path / "day"
    for name in ("a", "b", "c"):
        linked(recording, root / name)
    options = ["batch", str(root), "-j", "1", *FAST]
    summary = root / "batch_results" / "summary.json"
    assert main([*options, "--shard", "2/2"]) == 0
    assert statuses(summary) == {"a": "not measured", "b": "measured", "c": "not measured"}
    assert main([*options, "--summary-only"]) == 1
    assert main([*options, "--shard", "1/2"]) == 0
    assert statuses(summary) == {"a": "measured", "b": "skipped", "c": "measured"}
    assert main([*options, "--summary-only"]) == 0
    (root / "c" / "results" / "trajectory.h5").unlink()
    assert main([*options, "--summary-only"]) == 1
    assert statuses(summary)["c"] == "not measured"


@pytest.mark.statistical
def test_ctrl_c_in_the_diagnosis_of_all_keeps_the_summary_and_its_page_is_named(
    recording, tmp_path, capsys, monkeypatch, in_this_process
):
    def interrupted(*_):
        raise KeyboardInterrupt

    linked(recording, tmp_path / "day" / "a")
    command = ["batch", str(tmp_path / "day"), "-j", "1", *FAST, "--together"]
    monkeypatch.setattr(run, "diagnose_all", interrupted)
    assert main(command) == 130
    assert statuses(tmp_path / "day" / "batch_results" / "summary.json") == {"a": "measured"}
    monkeypatch.setattr(run, "diagnose_all", lambda *_: "what it says")
    assert main([*command, "-v"]) == 0
    said = capsys.readouterr().out
    assert "what it says" in said
    assert "batch_results/together/diagnosis.html" in said


@pytest.mark.statistical
def test_a_summary_tells_of_declarations_that_changed_since(recording, tmp_path, capsys, in_this_process):
    file = linked(recording, tmp_path / "day" / "a") / "recording.toml"
    command = ["batch", str(tmp_path / "day"), *FAST]
    assert main(command) == 0
    text = file.read_text()
    replace(file, re.sub("mass_g = .*", "mass_g = 200.5", text).encode())
    capsys.readouterr()
    assert main([*command, "--summary-only"]) == 3
    assert "[disc] mass_g 200.5 (" in " ".join(capsys.readouterr().out.split())
    assert main(command) == 0  # measures it anew
    assert main([*command, "--summary-only"]) == 0


@contextlib.contextmanager
def largest_file(n: int):
    """Files of this process may not grow beyond n bytes, as on a disk that has no more room."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (n, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("room", [300, 20_000])  # not even a record, no trajectory
def test_without_room_there_is_a_reason_and_nothing_half_written(room, one, recording):
    results = recording / "results"
    prepare()  # what is compiled is kept in files, too
    with largest_file(room):
        result = stage.do(one)
    assert result.status == "failed"
    assert "would exceed the size limit" in result.reason
    assert [file.name for file in results.iterdir()] == (["batch.json"] if room > 1000 else [])


@pytest.mark.statistical
def test_without_room_for_the_summary_the_results_stay_and_the_line_says_so(recording, capsys, in_this_process):
    assert main(["batch", str(recording), *FAST]) == 0
    summary = recording / "batch_results" / "summary.json"
    before = summary.read_bytes()
    capsys.readouterr()
    with largest_file(1000):
        assert main(["batch", str(recording), *FAST]) == 1
    said, errors = capsys.readouterr()
    assert "1 measured before" in said
    assert "summary.json: cannot be written" in errors
    assert summary.read_bytes() == before


@pytest.mark.statistical
def test_a_read_only_folder_is_told_at_once_and_results_may_go_elsewhere(
    recording, tmp_path, monkeypatch, capsys, in_this_process
):
    make = Path.mkdir

    def unless_there(self, *arguments, **named):  # the superuser may write everywhere
        if self.is_relative_to(recording):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
        make(self, *arguments, **named)

    monkeypatch.setattr(Path, "mkdir", unless_there)
    assert main(["batch", str(recording), *FAST]) == 1
    said, errors = capsys.readouterr()
    assert said == ""
    assert "batch_results: cannot be written: no permission" in errors
    assert "-o" in errors
    assert "another place with -o" in stage.do(jobs_of(recording)[0]).reason
    assert main(["batch", str(recording), "-o", str(tmp_path / "out"), *FAST]) == 0
    assert not (recording / "results").exists()
    assert (tmp_path / "out" / "recording" / "trajectory.h5").is_file()


@pytest.mark.slow
def test_the_index_links_the_reports_and_compares_repeats(sample_clip, rig_file, tmp_path):
    """Two parts of one motion: what is fitted to them is the same, and the comparison must say so."""
    declared = naming_rig((sample_clip / "recording.toml").read_text(), rig_file)
    for name, frames in (("run 1", slice(0, 300)), ("run 2", slice(15, 300))):
        for camera in ("left", "right"):
            (tmp_path / name / camera).mkdir(parents=True)
            for file in sorted((sample_clip / camera).iterdir())[frames]:
                (tmp_path / name / camera / file.name).symlink_to(file)
        (tmp_path / name / "recording.toml").write_text(declared.replace("sample clip", name))
    outcome = run_batch([tmp_path])
    assert not outcome.problems
    page = tmp_path / "batch_results" / "index.html"
    links = [unquote(link) for link in re.findall(r'href="([^"]+\.html)"', page.read_text())]
    assert len(links) == 2
    assert all((page.parent / link).is_file() for link in links)
    found = json.loads((page.parent / "summary.json").read_text())["repeats"]
    assert {row["quantity"]: row["n"] for row in found} == {fitted.column: 2 for fitted in FITTED if fitted.repeated}
    assert all(row["p_value"] > 1e-3 for row in found)  # one motion: within the sigmas
    assert "Repeats" in page.read_text()
    one, two = outcome.rows
    later = one["t_f_s"] - two["t_f_s"]  # the second begins 15 ms later
    assert later == pytest.approx(0.015, abs=4 * np.hypot(one["t_f_sigma_s"], two["t_f_sigma_s"]))
    sigma = np.hypot(one["k_m_sigma_m_s2"], two["k_m_sigma_m_s2"])
    assert one["k_m_m_s2"] == pytest.approx(two["k_m_m_s2"], abs=4 * sigma)
