"""Many recordings: each is measured once, none takes another down, whatever befalls processes, disks and machines."""

import contextlib
import csv
import errno
import json
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from multiprocessing.context import SpawnProcess
from pathlib import Path
from types import SimpleNamespace

import cv2
import h5py
import numpy as np
import pytest

from disctrack.batch import BatchOptions, find_recordings, pool, run, run_batch
from disctrack.batch import measure as stage
from disctrack.batch.locks import locked
from disctrack.batch.measure import LOCK, do
from disctrack.batch.plan import make_plan
from disctrack.batch.records import MEASURED, is_done, read_row
from disctrack.processes import Spawn
from disctrack.track.follow.tracking import prepare
from disctrack.trajectory.file import read_trajectory
from tests.pipeline.conftest import edit, linked

FAST = ["--no-report"]


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

    with ThreadPoolExecutor(1) as pool:
        here = partial(SimpleNamespace, submit=partial(pool.submit, stage.do), close=lambda: None)
        monkeypatch.setattr("disctrack.batch.run.Processes", lambda size: here())
        yield


@pytest.mark.statistical
def test_a_batch_calibrates_a_rig_once_tells_of_every_recording_and_goes_on_where_it_failed(
    short_recording, tmp_path, cli
):
    root = a_day(short_recording, tmp_path / "day", ("r2", "r10", "bad toml"))
    replace(root / "bad toml" / "recording.toml", b"x = = 3")
    replace(root / "r10" / "left" / "000005.png", b"junk")
    said, errors = cli("batch", root, "-j", "2", *FAST, code=1)
    assert re.search(r"refusal +bad toml \(failed\).*not valid TOML", said, re.DOTALL)
    assert re.search(r"r10 \(measured\).*000005.png", said, re.DOTALL)
    assert "2 measured, 1 failed" in said
    assert "\r" not in errors  # no bar where stderr is no terminal, but a line for each recording that ends
    assert errors.count("measured\n") == 2
    assert len(list((root / "batch_results" / "rigs").rglob("rig.h5"))) == 1

    rows = rows_in(root / "batch_results" / "summary.json")
    lines = (root / "batch_results" / "summary.csv").read_text().splitlines()
    table = {row["recording"]: row for row in csv.DictReader(lines)}
    assert list(table) == list(rows) == ["bad toml", "r2", "r10"]
    for name, row in rows.items():
        for column, value in row.items():
            cell = table[name][column]
            assert (cell == "") if value is None else (str(value) == cell), column
    trajectory = read_trajectory(root / "r2" / "results" / "trajectory.h5")
    assert rows["r2"]["pairs_measured"] == len(trajectory)
    assert rows["r2"]["z_sigma_m"] == np.median(trajectory.coordinate_sigma[:, 2])
    assert (root / "batch_results" / rows["r2"]["trajectory"]).samefile(root / "r2" / "results" / "trajectory.h5")
    page = (root / "batch_results" / "index.html").read_text()
    assert all(name in page for name in rows)
    replace(root / "bad toml" / "recording.toml", (root / "r2" / "recording.toml").read_bytes())
    assert "1 measured, 2 measured before" in cli("batch", root, *FAST, code=3).out  # r10 lacks an image


@pytest.fixture
def one(recording):
    """Job of the short recording with the given rig."""
    (job,) = jobs_of(recording)
    return job


@pytest.mark.statistical
def test_what_counts_is_content_not_existence(one, recording):
    assert stage.do(one)["status"] == "measured"
    results = recording / "results"
    assert stage.do(one)["status"] == "skipped"
    (recording / "recording.toml").touch()
    assert stage.do(one)["status"] == "skipped"

    image = cv2.imread(str(recording / "left" / "000003.png"), cv2.IMREAD_UNCHANGED)
    before = read_row(results)
    replace(recording / "left" / "000003.png", cv2.imencode(".png", image ^ 1)[1].tobytes())
    assert stage.do(one)["status"] == "measured"
    assert read_row(results)["input_sha256"] != before["input_sha256"]

    (wider,) = jobs_of(recording, window=0.4)
    assert stage.do(wider)["status"] == "measured"
    assert stage.do(wider)["status"] == "skipped"
    edit(recording, "mass_g = 209.69", "mass_g = 209.7")
    (heavier,) = jobs_of(recording, window=0.4)
    assert stage.do(heavier)["status"] == "measured"
    (again,) = jobs_of(recording, window=0.4, overwrite=True)
    assert stage.do(again)["status"] == "measured"


def test_a_file_of_unknown_origin_is_kept(one, recording):
    foreign = recording / "results" / "trajectory.h5"
    foreign.parent.mkdir()
    foreign.write_bytes(b"years of work")
    result = stage.do(one)
    assert result["status"] == "failed"
    assert "--overwrite" in result["reason"]
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
    assert spoilt["status"] == "measured"
    assert spoilt["pairs_measured"] == 20
    assert "8 images could not be read" in spoilt["reason"]
    monkeypatch.undo()

    for file in sorted((recording / "right").iterdir())[-2:]:
        file.unlink()
    failed = stage.do(one)
    assert failed["status"] == "failed"
    assert "left has 20 frames" in failed["reason"]
    shutil.rmtree(recording)
    assert "recording.toml" in stage.do(one)["reason"]


@pytest.mark.statistical
def test_the_summary_is_that_of_all_shards(recording, tmp_path, cli, in_this_process):
    root = a_day(recording, tmp_path / "day", tuple("abc"))
    command = "batch", root, "-j", "1", *FAST
    summary = root / "batch_results" / "summary.json"
    cli(*command, "--shard", "2/2")
    assert statuses(summary) == {"a": "not measured", "b": "measured", "c": "not measured"}
    cli(*command, "--summary-only", code=1)
    cli(*command, "--shard", "1/2")
    assert statuses(summary) == {"a": "measured", "b": "skipped", "c": "measured"}
    cli(*command, "--summary-only")
    (root / "c" / "results" / "trajectory.h5").unlink()
    cli(*command, "--summary-only", code=1)
    assert statuses(summary)["c"] == "not measured"


@pytest.mark.statistical
def test_ctrl_c_in_the_diagnosis_of_all_keeps_the_summary_and_its_page_is_named(
    recording, tmp_path, cli, monkeypatch, in_this_process
):
    def interrupted(*_):
        raise KeyboardInterrupt

    linked(recording, tmp_path / "day" / "a")
    command = "batch", tmp_path / "day", "-j", "1", *FAST, "--together"
    monkeypatch.setattr(run, "diagnose_all", interrupted)
    cli(*command, code=130)
    assert statuses(tmp_path / "day" / "batch_results" / "summary.json") == {"a": "measured"}
    monkeypatch.setattr(run, "diagnose_all", lambda *_: "what it says")
    said = cli(*command, "-v").out
    assert "what it says" in said
    assert "batch_results/together/diagnosis.html" in said


@pytest.mark.statistical
def test_a_summary_tells_of_declarations_that_changed_since(recording, tmp_path, cli, in_this_process):
    folder = linked(recording, tmp_path / "day" / "a")
    command = "batch", tmp_path / "day", *FAST
    cli(*command)
    edit(folder, "mass_g = 209.69", "mass_g = 200.5")
    assert "[disc] mass_g 200.5 (" in " ".join(cli(*command, "--summary-only", code=3).out.split())
    cli(*command)  # measures it anew
    cli(*command, "--summary-only")


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
    assert result["status"] == "failed"
    assert "File too large" in result["reason"]
    assert [file.name for file in results.iterdir()] == (["batch.json"] if room > 1000 else [])


@pytest.mark.statistical
def test_without_room_for_the_summary_the_results_stay_and_the_line_says_so(recording, cli, in_this_process):
    cli("batch", recording, *FAST)
    summary = recording / "batch_results" / "summary.json"
    before = summary.read_bytes()
    with largest_file(1000):
        said, errors = cli("batch", recording, *FAST, code=1)
    assert "1 measured before" in said
    assert "summary.json: cannot be written" in errors
    assert summary.read_bytes() == before


@pytest.mark.statistical
def test_a_read_only_folder_is_told_at_once_and_results_may_go_elsewhere(
    recording, tmp_path, monkeypatch, cli, in_this_process
):
    make = Path.mkdir

    def unless_there(self, *arguments, **named):  # the superuser may write everywhere
        if self.is_relative_to(recording):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
        make(self, *arguments, **named)

    monkeypatch.setattr(Path, "mkdir", unless_there)
    said, errors = cli("batch", recording, *FAST, code=1)
    assert said == ""
    assert "batch_results: cannot be written: Permission denied" in errors
    assert "-o" in errors
    assert "another place with -o" in stage.do(jobs_of(recording)[0])["reason"]
    cli("batch", recording, "-o", tmp_path / "out", *FAST)
    assert not (recording / "results").exists()
    assert (tmp_path / "out" / "recording" / "trajectory.h5").is_file()


REPOSITORY = Path(__file__).resolve().parents[2]
NAMES = ("a", "b")
PATIENCE = 120.0  # [s] on a busy machine
# What dask's own code is warned of in versions to come is no fault of this one.
_OF_ANOTHER_PROJECT = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")


@pytest.fixture
def day(recording, tmp_path) -> Path:
    """A folder with two recordings of one rig."""
    return a_day(recording, tmp_path / "day")


def a_day(recording: Path, root: Path, names: tuple[str, ...] = NAMES) -> Path:
    for name in names:
        linked(recording, root / name)
    return root


def start(root: Path) -> subprocess.Popen:
    """`disctrack batch` in a process group of its own, when it has begun with a recording."""
    command = [sys.executable, "-m", "disctrack", "batch", str(root), "--no-report", "-j", "2"]
    pipe = subprocess.PIPE
    process = subprocess.Popen(
        command, cwd=REPOSITORY, stdout=pipe, stderr=pipe, text=True, start_new_session=True, preexec_fn=heed_interrupts
    )
    wait_until(lambda: any((root / name / "results" / LOCK).exists() for name in NAMES), process)
    return process


def heed_interrupts() -> None:
    """As a terminal's processes do: a shell's background jobs, and so tests that are one, ignore them."""
    for kind in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(kind, signal.SIG_DFL)


def wait_until(condition, process=None):
    """What the condition is, once it is true or the process has ended."""
    until = time.monotonic() + PATIENCE
    while not (found := condition()) and (process is None or process.poll() is None):
        assert time.monotonic() < until
        time.sleep(0.01)
    return found


def numbers(path: Path) -> dict[str, np.ndarray]:
    found = {}
    with h5py.File(path) as file:
        assert file.attrs["complete"] == 1
        file.visititems(lambda name, item: found.update({name: item[()]}) if isinstance(item, h5py.Dataset) else None)
    return found


def assert_whole(root: Path, reference: Path) -> int:
    """Whatever has the name of a result is one, equal to that of an undisturbed run; returns how many are finished."""
    expected = numbers(reference / "a" / "results" / "trajectory.h5")
    finished = 0
    for folder in root.glob("*/left"):
        results = folder.parent / "results"
        with locked(results / LOCK, wait=PATIENCE):  # its process has ended, too
            there = [file for file in results.rglob("*") if file.is_file() and ".part" not in file.name]
        for file in there:
            if file.suffix == ".h5":
                for key, values in numbers(file).items():  # groups of later stages may not be there yet
                    np.testing.assert_array_equal(values, expected[key], err_msg=key)
            elif file.suffix == ".json":
                json.loads(file.read_text())
            else:
                assert file.name == LOCK
        row = read_row(results)
        if row is not None:
            assert row["status"] == MEASURED
            assert is_done(results, row, {"report": False})
            assert numbers(results / "trajectory.h5").keys() == expected.keys()
            finished += 1
    return finished


@pytest.mark.statistical
@pytest.mark.parametrize("kills", [1, pytest.param(50, marks=pytest.mark.slow)])
def test_a_batch_killed_at_random_instants_leaves_only_whole_results_and_can_go_on(recording, tmp_path, kills):
    root, undisturbed = (a_day(recording, tmp_path / name, ("a",)) for name in ("day", "undisturbed"))
    (job,) = jobs_of(undisturbed)
    assert do(job)["status"] == MEASURED  # in this process
    results = root / "a" / "results"
    process = start(root)
    began = time.monotonic()
    assert "leaked" not in process.communicate(timeout=PATIENCE)[1]  # of what processes that end owe to the system
    duration, chance = time.monotonic() - began, random.Random(17)
    for _ in range(kills):
        if assert_whole(root, undisturbed):
            shutil.rmtree(results)
        (results / LOCK).unlink(missing_ok=True)  # a dead process's: it would seem to have begun
        process = start(root)
        time.sleep(chance.uniform(0, duration))
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate(timeout=PATIENCE)
    for part in root.rglob("*.part*"):
        os.utime(part, (0, 0))  # as a day later
    process = start(root)
    process.communicate(timeout=PATIENCE)
    assert process.returncode == 0
    assert assert_whole(root, undisturbed) == 1
    assert not list(root.rglob("*.part*"))  # those that killed processes left are cleared away


def test_what_a_terminal_sends_spares_even_the_first_process():
    """It is begun together with one that keeps count of what the system lends, which unblocks Ctrl-C."""
    blocked = "len({signal.SIGINT, signal.SIGHUP} & signal.pthread_sigmask(signal.SIG_BLOCK, ()))"
    process = f"Spawn().Process(target=exec, args=('import signal, sys; sys.exit({blocked})',))"
    code = f"from disctrack.processes import Spawn; process = {process}; process.start(); process.join()"
    ended = subprocess.run([sys.executable, "-c", f"{code}; raise SystemExit(process.exitcode)"], cwd=REPOSITORY)
    assert ended.returncode == 2


def test_where_no_process_can_be_started_all_is_as_before(monkeypatch):
    def refused():
        raise OSError(errno.EAGAIN, "no more processes")

    def found():
        return sys.modules["__main__"], dict(os.environ), signal.pthread_sigmask(signal.SIG_BLOCK, ())

    monkeypatch.setattr("multiprocessing.resource_tracker.ensure_running", refused)
    before = found()
    with pytest.raises(OSError, match="no more processes"):
        Spawn().Process(target=print).start()
    assert found() == before


@pytest.mark.statistical
@pytest.mark.parametrize("kind", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_an_interrupted_batch_says_so_clears_up_and_can_go_on(recording, tmp_path, kind):
    day = a_day(recording, tmp_path / "day", tuple("abcdefgh"))  # more than are done while this process looks
    process = start(day)
    os.killpg(process.pid, kind)  # as a terminal does: to all processes
    said, errors = process.communicate(timeout=PATIENCE)
    assert process.returncode == 128 + kind
    assert "interrupted before it was done" in " ".join(said.split())
    word = "interrupted" if kind == signal.SIGINT else f"ended by {kind.name}"
    assert any(line.startswith(f"disctrack: {word}") for line in errors.splitlines())
    assert "Traceback" not in errors
    assert not list(day.rglob("*.part*"))  # a lock's file may stay: it has no effect without its holder
    assert "not measured" in statuses(day / "batch_results" / "summary.json").values()


@pytest.mark.statistical
def test_processes_end_with_a_batch_that_is_killed(recording, tmp_path):
    """Only the batch itself, as when memory runs out: the recording at work must not stay locked."""
    day = a_day(recording, tmp_path / "day", tuple("abcdefgh"))
    process = start(day)
    process.kill()
    process.communicate(timeout=PATIENCE)
    for name in NAMES:
        (day / name / "results").mkdir(exist_ok=True)
        with locked(day / name / "results" / LOCK, wait=30.0):
            pass


@pytest.mark.statistical
def test_a_killed_worker_is_tried_again_and_a_deadly_recording_fails_alone(day, monkeypatch):
    done, deaths = pool.Processes.done, {"a": 2, "b": 1}  # how often the process is killed

    def deadly(self, job):
        if deaths[job.name]:
            deaths[job.name] -= 1
            self._own.kept = self._begun()
            self._own.kept[0].kill()
        return done(self, job)

    monkeypatch.setattr(pool.Processes, "done", deadly)
    outcome = run_batch([day], BatchOptions(report=False), side_by_side=2)
    a, b = outcome.rows
    assert (a["status"], b["status"]) == ("failed", "measured")
    assert "twice" in a["reason"]
    assert "killed (signal 9)" in a["reason"]


def test_recordings_for_which_no_process_can_be_started_fail_with_that_reason(day, monkeypatch):
    def refused(*_, **__):
        raise OSError(errno.EAGAIN, "Resource temporarily unavailable")

    monkeypatch.setattr(SpawnProcess, "start", refused)
    outcome = run_batch([day], BatchOptions(report=False))
    assert [row["status"] for row in outcome.rows] == ["failed", "failed"]
    assert "no process could be started for it: Resource temporarily unavailable" in outcome.rows[0]["reason"]


@pytest.mark.statistical
@_OF_ANOTHER_PROJECT
def test_a_cluster_that_loses_a_worker_in_mid_run_completes_everything(day):
    distributed, psutil = map(pytest.importorskip, ("distributed", "psutil"))

    def measuring():
        """Workers of whose processes one holds a lock."""
        workers = [psutil.Process(worker.pid) for worker in cluster.workers.values()]
        with contextlib.suppress(psutil.NoSuchProcess):  # one that ends now
            return [w for w in workers for p in w.children() for f in p.open_files() if Path(f.path).name == LOCK]

    def kill_one():
        wait_until(measuring)[0].kill()

    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        killer = threading.Thread(target=kill_one, daemon=True)
        killer.start()
        outcome = run_batch([day], BatchOptions(report=False), cluster=cluster.scheduler_address)
        killer.join(timeout=1.0)
        assert not killer.is_alive()
    # One that was whole when its worker died, before it could say so, is found done by the worker that takes it over.
    assert {row["status"] for row in outcome.rows} <= {"measured", "skipped"}
    ours = [numbers(day / name / "results" / "trajectory.h5") for name in NAMES]
    for key, values in ours[0].items():
        np.testing.assert_array_equal(values, ours[1][key], err_msg=key)


@pytest.mark.statistical
@_OF_ANOTHER_PROJECT
def test_a_dead_address_and_a_missing_extra_are_told_before_anything_is_done(day, monkeypatch, cli):
    pytest.importorskip("distributed")
    monkeypatch.setattr(pool, "CONNECT", 0.5)
    command = "batch", day, "--cluster", "tcp://127.0.0.1:9"
    assert "no scheduler answers" in cli(*command, code=1).err
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert "disctrack[cluster]" in cli(*command, code=1).err
    assert not list(day.rglob("*results"))
