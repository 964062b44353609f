"""What may go wrong with the processes of a batch: killed, interrupted, doubled, lost with their machine."""

import contextlib
import errno
import json
import os
import random
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import h5py
import numpy as np
import pytest

from disctrack.batch import BatchOptions, find_recordings, pool, run_batch
from disctrack.batch.locks import locked
from disctrack.batch.measure import LOCK, do
from disctrack.batch.plan import make_plan
from disctrack.batch.pool import connect
from disctrack.batch.records import MEASURED, is_done, read_record
from disctrack.cli import main
from disctrack.errors import ClusterError
from tests.pipeline.conftest import linked

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


def start(root: Path, *words: str) -> subprocess.Popen:
    """`disctrack batch` in a process group of its own."""
    command = [sys.executable, "-m", "disctrack", "batch", str(root), "--no-report", "-j", "2", *words]
    pipe = subprocess.PIPE
    return subprocess.Popen(
        command, cwd=REPOSITORY, stdout=pipe, stderr=pipe, text=True, start_new_session=True, preexec_fn=heed_interrupts
    )


def heed_interrupts() -> None:
    """As a terminal's processes do: a shell's background jobs, and so tests that are one, ignore them."""
    for kind in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(kind, signal.SIG_DFL)


def wait_until(condition, process=None) -> None:
    until = time.monotonic() + PATIENCE
    while not condition() and (process is None or process.poll() is None):
        assert time.monotonic() < until
        time.sleep(0.01)


def begun(root: Path) -> bool:
    return any((root / name / "results" / LOCK).exists() for name in NAMES)


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
        record = read_record(results)
        if record is not None:
            assert record.status == MEASURED
            assert is_done(results, record, {"report": False})
            assert numbers(results / "trajectory.h5").keys() == expected.keys()
            finished += 1
    return finished


@pytest.fixture
def undisturbed(recording, tmp_path) -> Path:
    """The same day, measured without a fault, in this process."""
    root = a_day(recording, tmp_path / "undisturbed", ("a",))
    found = find_recordings([root])
    _, (job,), *_ = make_plan(found, found.recordings, BatchOptions(report=False))
    assert do(job).status == MEASURED
    return root


@pytest.mark.statistical
@pytest.mark.parametrize(("names", "kills"), [(("a",), 1), pytest.param(NAMES, 50, marks=pytest.mark.slow)])
def test_a_batch_killed_at_random_instants_leaves_only_whole_results_and_can_go_on(
    recording, tmp_path, undisturbed, names, kills
):
    """Batches are killed until so many have died in mid-run, some several times; the last one is completed."""
    process = start(a_day(recording, tmp_path / "timed", names))
    wait_until(lambda: begun(tmp_path / "timed"), process)
    began = time.monotonic()
    process.communicate(timeout=PATIENCE)
    duration, chance = time.monotonic() - began, random.Random(17)
    died: list[int] = []  # how many recordings were finished at each kill
    finished, root, tree = len(names), tmp_path, 0
    while len(died) < kills or finished < len(names):
        if finished == len(names):
            tree += 1
            root = a_day(recording, tmp_path / f"tree {tree}", names)
        process = start(root)
        if len(died) < kills:
            wait_until(lambda root=root: begun(root), process)
            time.sleep(chance.uniform(0, duration))
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
        process.communicate(timeout=PATIENCE)
        finished = assert_whole(root, undisturbed)
        if process.returncode == -signal.SIGKILL:
            died.append(finished)
        else:
            assert process.returncode == 0
            assert finished == len(names)
            assert not list(root.rglob("*.part*"))  # those that killed processes left are cleared away
    assert kills < 50 or len(set(died)) > 1  # kills fell into different stages of a batch


@pytest.mark.statistical
@pytest.mark.parametrize("kind", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_an_interrupted_batch_says_so_clears_up_and_can_go_on(recording, tmp_path, kind):
    day = a_day(recording, tmp_path / "day", tuple("abcdefgh"))  # more than are done while this process looks
    process = start(day)
    wait_until(lambda: begun(day), process)
    os.killpg(process.pid, kind)  # as a terminal does: to all processes
    said, errors = process.communicate(timeout=PATIENCE)
    assert process.returncode == 128 + kind
    assert "interrupted before it was done" in " ".join(said.split())
    word = "interrupted" if kind == signal.SIGINT else f"ended by {kind.name}"
    assert any(line.startswith(f"disctrack: {word}") for line in errors.splitlines())
    assert "Traceback" not in errors
    assert not list(day.rglob("*.part*"))  # a lock's file may stay: it has no effect without its holder
    statuses = json.loads((day / "batch_results" / "summary.json").read_text())["counts"]
    assert statuses["not measured"] > 0


@pytest.mark.statistical
def test_processes_end_with_a_batch_that_is_killed(recording, tmp_path):
    """Only the batch itself, as when memory runs out: the recording at work must not stay locked."""
    day = a_day(recording, tmp_path / "day", tuple("abcdefgh"))
    process = start(day)
    wait_until(lambda: begun(day), process)
    process.kill()
    process.communicate(timeout=PATIENCE)
    for name in NAMES:
        (day / name / "results").mkdir(exist_ok=True)
        with locked(day / name / "results" / LOCK, wait=30.0):
            pass


@pytest.mark.statistical
def test_a_killed_worker_is_tried_again_and_a_deadly_recording_fails_alone(day, monkeypatch):
    begin, deaths = pool._Worker.begin, {"a": 2, "b": 1}  # how often the process is killed

    def deadly(self, job):
        future = begin(self, job)
        if deaths[job.name]:
            deaths[job.name] -= 1
            self.process.kill()
        return future

    monkeypatch.setattr(pool._Worker, "begin", deadly)
    outcome = run_batch([day], BatchOptions(report=False), side_by_side=2)
    a, b = outcome.rows
    assert (a["status"], b["status"]) == ("failed", "measured")
    assert "twice" in a["reason"]
    assert "killed (signal 9)" in a["reason"]


def test_recordings_for_which_no_process_can_be_started_fail_with_that_reason(day, monkeypatch):
    def refused(*_, **__):
        raise OSError(errno.EAGAIN, "Resource temporarily unavailable")

    monkeypatch.setattr(pool.SpawnProcess, "start", refused)
    outcome = run_batch([day], BatchOptions(report=False))
    assert [row["status"] for row in outcome.rows] == ["failed", "failed"]
    assert "no process could be started for it: Resource temporarily unavailable" in outcome.rows[0]["reason"]


@pytest.mark.slow
def test_two_batches_on_one_folder_measure_each_recording_once(day):
    both = [start(day, "--json"), start(day, "--json")]
    said = [process.communicate(timeout=PATIENCE) for process in both]
    assert [process.returncode for process in both] == [0, 0], said
    found = [row for output, _ in said for row in json.loads(output)["blocks"][0]["blocks"][1]["rows"]]
    assert sorted((row[0], row[2]) for row in found) == [
        (name, was) for name in NAMES for was in ("measured", "measured before")
    ]
    assert json.loads((day / "batch_results" / "summary.json").read_text())["counts"]["failed"] == 0


@pytest.fixture
def dask_cluster(tmp_path):
    """A scheduler and two workers, each a process of this machine; its address, and the workers' processes."""
    pytest.importorskip("distributed")
    file, search = tmp_path / "scheduler.json", os.pathsep.join([str(REPOSITORY), os.environ.get("PYTHONPATH", "")])
    words = {
        "dask_scheduler": ["--port", "0", "--no-dashboard", "--scheduler-file", str(file)],
        "dask_worker": ["--nthreads", "1", "--no-nanny", "--no-dashboard", "--scheduler-file", str(file)],
    }
    processes = [
        subprocess.Popen(
            [sys.executable, "-m", f"distributed.cli.{program}", *words[program]],
            cwd=tmp_path,
            env=os.environ | {"PYTHONPATH": search},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        for program in ("dask_scheduler", "dask_worker", "dask_worker")
    ]
    wait_until(lambda: file.exists() and file.read_text().endswith("}"))
    yield json.loads(file.read_text())["address"], processes[1:]
    for process in reversed(processes):
        process.kill()
        process.wait()


@pytest.mark.statistical
@_OF_ANOTHER_PROJECT
def test_a_cluster_that_loses_a_worker_in_mid_run_completes_everything(dask_cluster, day, monkeypatch):
    address, workers = dask_cluster
    submitted = []

    def connect_to_both(address):
        wait_until(lambda: has_workers(address, len(workers)))
        return connect(address)

    def kill_one():
        wait_until(lambda: all((day / name / "results" / LOCK).exists() for name in NAMES))
        workers[0].kill()  # both recordings are being measured, so one of them is lost with it
        submitted.append(time.monotonic())

    monkeypatch.setattr(pool, "connect", connect_to_both)
    killer = threading.Thread(target=kill_one, daemon=True)
    killer.start()
    outcome = run_batch([day], BatchOptions(report=False), cluster=address)
    killer.join()
    assert submitted
    # One that was whole when its worker died, before it could say so, is found done by the worker that takes it over.
    assert {row["status"] for row in outcome.rows} <= {"measured", "skipped"}
    ours = [numbers(day / name / "results" / "trajectory.h5") for name in NAMES]
    for key, values in ours[0].items():
        np.testing.assert_array_equal(values, ours[1][key], err_msg=key)


def has_workers(address: str, n: int) -> bool:
    with contextlib.suppress(ClusterError), contextlib.closing(connect(address)) as client:
        return len(client.scheduler_info()["workers"]) == n
    return False


@pytest.mark.statistical
@_OF_ANOTHER_PROJECT
def test_a_dead_address_and_a_missing_extra_are_told_before_anything_is_done(day, monkeypatch, capsys):
    pytest.importorskip("distributed")
    monkeypatch.setattr(pool, "CONNECT", 0.5)
    assert main(["batch", str(day), "--cluster", "tcp://127.0.0.1:9"]) == 1
    assert "no scheduler answers" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert main(["batch", str(day), "--cluster", "tcp://127.0.0.1:9"]) == 1
    assert "disctrack[cluster]" in capsys.readouterr().err
    assert not list(day.rglob("*results"))
