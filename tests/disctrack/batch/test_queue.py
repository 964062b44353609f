"""What a batch does with jobs, locks and folders, without measuring anything."""

import errno
import fcntl
import os
import re
import signal
import subprocess
import sys
import time
from urllib.parse import unquote

import pytest

from disctrack.batch import locks
from disctrack.batch.cluster import run_on_cluster
from disctrack.batch.columns import COLUMNS, copies
from disctrack.batch.find import find_recordings
from disctrack.batch.index import index_page
from disctrack.batch.jobs import JobQueue
from disctrack.batch.locks import Busy, locked
from disctrack.batch.plan import BatchOptions, Job, Shard
from disctrack.batch.reasons import reason_of, reason_of_death
from disctrack.batch.records import BUSY, FAILED, MEASURED, Record, Result
from disctrack.batch.run import BatchOutcome
from disctrack.batch.summary import line_of
from disctrack.errors import ClusterError, RecordingError

GOOD = Result(MEASURED, Record(MEASURED))


def recordings_at(root, *names):
    for name in names:
        (root / name).mkdir(parents=True, exist_ok=True)
        (root / name / "recording.toml").write_text("")
    return root


def names_of(found):
    return [found.name(folder) for folder in found.recordings]


def test_recordings_are_found_at_any_depth_in_natural_order_and_results_are_not_searched(tmp_path):
    root = recordings_at(tmp_path / "all", "day 2/r10", "day 2/r9", "day 10/r1", "r3", "r3/results/rendered")
    (root / "empty").mkdir()
    (root / "day 2" / "loop").symlink_to(root / "day 2", target_is_directory=True)
    assert names_of(find_recordings([root])) == ["day 2/r9", "day 2/r10", "day 10/r1", "r3"]
    again = find_recordings([root / "day 2", root / "day 10", root / "day 2" / "r9"])
    assert names_of(again) == ["day 2/r9", "day 2/r10", "day 10/r1"]  # each once, below what both have in common
    out = recordings_at(root / "out", "copy")
    assert "out/copy" in names_of(find_recordings([root]))
    assert "out/copy" not in names_of(find_recordings([root], leave_out=[out]))
    assert names_of(find_recordings([root / "r3"])) == ["r3"]
    recordings_at(root / "r3", "r3")
    assert names_of(find_recordings([root / "r3"])) == [".", "r3"]


def test_images_without_a_declaration_are_told(tmp_path):
    """The uppermost folder of a recording that was forgotten; not its views, results, or a single film of something."""
    root = recordings_at(tmp_path, "day 1/r1", "day 1/r2")
    for name in ("day 1/r1/left", "day 1/r1/right", "day 1/r2/calibration/left", "day 1/r2/calibration/right"):
        (root / name).mkdir(parents=True)
        (root / name / "0.png").write_bytes(b"")
    assert find_recordings([root]).undeclared == ()
    for rig in ("one", "other"):  # pictures of two rigs that a batch calibrated are no images of two cameras
        (root / "batch_results" / "rigs" / rig).mkdir(parents=True)
        (root / "batch_results" / "rigs" / rig / "calibration_coverage.png").touch()
    assert find_recordings([root]).undeclared == ()
    for name in ("left", "right", "calibration/left", "calibration/right"):
        (root / "day 1" / "r3" / name).mkdir(parents=True)
        (root / "day 1" / "r3" / name / "0.TIF").write_bytes(b"")
    (root / "films").mkdir()
    (root / "films" / "left.cine").write_bytes(b"")
    (root / "pictures" / "some").mkdir(parents=True)
    (root / "pictures" / "some" / "a.png").write_bytes(b"")
    assert find_recordings([root]).undeclared == (root / "day 1" / "r3",)
    (root / "films" / "right.cine").write_bytes(b"")
    assert set(find_recordings([root]).undeclared) == {root / "day 1" / "r3", root / "films"}
    with pytest.raises(RecordingError, match=r"r3 has images: `disctrack init .*r3` writes one"):
        find_recordings([root / "day 1" / "r3"])


def test_no_folder_and_no_recording_are_told_apart(tmp_path):
    with pytest.raises(RecordingError, match="no such folder"):
        find_recordings([tmp_path / "nothing"])
    with pytest.raises(RecordingError, match="no recording found"):
        find_recordings([tmp_path])


@pytest.mark.parametrize("n", [0, 1, 7, 8])
def test_shards_give_every_recording_once(n, tmp_path):
    recordings = [tmp_path / str(i) for i in range(n)]
    parts = [Shard(i, 3).part(recordings) for i in (1, 2, 3)]
    assert sorted(folder for part in parts for folder in part) == sorted(recordings)
    assert max(map(len, parts)) - min(map(len, parts)) <= 1


def job(name, rig="given.h5", kind="recording", needs_rig=False):
    return Job(kind, name, f"/{name}", f"/{name}/results", rig, BatchOptions(), needs_rig)


@pytest.fixture
def results():
    return {}


def queue_of(rigs, recordings, results):
    return JobQueue(rigs, recordings, lambda job, result: results.__setitem__((job.kind, job.name), result))


def test_a_job_survives_its_journey_as_text():
    for options in (BatchOptions(), BatchOptions(window=0.25, diagnose=True, report=False)):
        there = Job("rig", "a b", "/é", "/r", "/x", options, True, 3, 2, ("/1", "/2"))
        assert Job.from_json(there.as_json()) == there


def test_recordings_wait_for_their_rig_and_no_others_do(results):
    jobs = queue_of(
        [job("a", "shared.h5", "rig")],
        [job("a", "shared.h5", needs_rig=True), job("b"), job("c", "shared.h5", needs_rig=True)],
        results,
    )
    rig, b = jobs.next(), jobs.next()
    assert (rig.kind, b.name, jobs.next()) == ("rig", "b", None)
    jobs.finish(rig, GOOD)
    assert [jobs.next().name, jobs.next().name] == ["a", "c"]
    assert not jobs.finished


def test_without_its_rig_a_recording_fails_with_the_rigs_reason_and_others_go_on(results):
    jobs = queue_of([job("a", "shared.h5", "rig")], [job("a", "shared.h5", needs_rig=True), job("b")], results)
    jobs.finish(jobs.next(), Result.failed("no corners found"))
    assert "no corners found" in results["recording", "a"].record.reason
    jobs.finish(jobs.next(), GOOD)
    assert jobs.finished
    assert results["recording", "b"].status == MEASURED


def test_a_recording_at_which_another_batch_works_is_asked_for_again(results, monkeypatch):
    monkeypatch.setattr("disctrack.batch.jobs.ASK_AGAIN", 0.02)
    jobs = queue_of([], [job("a")], results)
    jobs.finish(jobs.next(), Result(BUSY, Record(FAILED)))
    assert jobs.next() is None
    assert not jobs.finished
    time.sleep(0.03)
    jobs.finish(jobs.next(), GOOD)
    assert jobs.finished
    assert results["recording", "a"].status == MEASURED


def test_a_job_whose_process_died_is_tried_once_more_at_the_end_and_alone(results):
    jobs = queue_of([], [job("a"), job("b"), job("c")], results)
    a, b = jobs.next(), jobs.next()
    jobs.died(a, "killed")
    c = jobs.next()
    assert c.name == "c"
    jobs.finish(c, GOOD)
    assert jobs.next() is None  # b still runs
    jobs.finish(b, GOOD)
    assert jobs.next() == a
    jobs.died(a, "killed")
    assert jobs.finished
    assert results["recording", "a"].record.reason == "twice, killed"
    assert results["recording", "b"].status == MEASURED


class Future:
    """As dask's: done, with an answer, an error, or cancelled."""

    def __init__(self, answer):
        self.answer = answer

    def done(self):
        return True

    def cancelled(self):
        return self.answer is None

    def result(self):
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer


class Client:
    """Gives one answer after the other, whatever it is asked."""

    def __init__(self, *answers):
        self.answers = list(answers)

    def submit(self, *given, **options):
        return Future(self.answers.pop(0))

    def cancel(self, futures, force):
        assert not any(isinstance(future.answer, dict) for future in futures)


def test_answers_of_a_cluster_are_results_deaths_and_failures(results):
    jobs = queue_of([], [job("a"), job("b"), job("c")], results)
    client = Client(GOOD.as_dict(), {"died": "killed"}, RuntimeError("worker lost too often"), GOOD.as_dict())
    run_on_cluster(client, jobs, lambda job, share: None)
    assert jobs.finished
    assert {name: result.status for (_, name), result in results.items()} == {"a": MEASURED, "b": MEASURED, "c": FAILED}
    assert "worker lost too often" in results["recording", "c"].record.reason


def test_a_lost_scheduler_is_told_and_no_recording_is_blamed(results):
    jobs = queue_of([], [job("a"), job("b")], results)
    with pytest.raises(ClusterError, match="scheduler was lost"):
        run_on_cluster(Client(GOOD.as_dict(), None), jobs, lambda job, share: None)
    assert set(results) == {("recording", "a")}


def test_reasons_are_one_line_and_say_what_to_do():
    assert reason_of(RecordingError("a\n  b")) == "a b"
    assert "-j" in reason_of(MemoryError())
    assert reason_of(OSError(errno.EIO, "Input/output error", "x.png")) == "x.png: Input/output error."
    assert "ZeroDivisionError" in reason_of(ZeroDivisionError("division by zero"))
    assert "memory" in reason_of_death(-9)
    assert "SIGSEGV" in reason_of_death(-signal.SIGSEGV, "said\n at last")
    assert "exit code 3" in reason_of_death(3)


_HOLD = """
import fcntl, sys, time
file = open(sys.argv[1], "w")
fcntl.flock(file, fcntl.LOCK_EX)
print(flush=True)
time.sleep(60)
"""


@pytest.fixture
def holder(tmp_path):
    """Another process that holds a lock until it is killed; the lock's path, and the process."""
    process = subprocess.Popen([sys.executable, "-c", _HOLD, tmp_path / "lock"], stdout=subprocess.PIPE)
    assert process.stdout.readline() == b"\n"
    yield tmp_path / "lock", process
    process.kill()
    process.communicate()


def test_a_lock_keeps_another_process_out_until_its_holder_is_killed(holder):
    path, process = holder
    with pytest.raises(Busy), locked(path):
        pass
    process.kill()
    with locked(path, wait=5.0), pytest.raises(Busy), locked(path):  # what the killed one left does not count
        pass
    assert not path.exists()


def test_a_disk_without_locks_is_locked_by_a_file_and_a_dead_holders_file_is_cleared(tmp_path, monkeypatch):
    def no_locks(*_):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", no_locks)
    path, holder = tmp_path / "lock", tmp_path / "lock.holder"
    with locked(path), pytest.raises(Busy), locked(path):
        pass
    assert not holder.exists()
    host = os.uname().nodename
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    holder.write_text(f"{dead.pid}\n{host}\n")
    with locked(path, wait=5.0):
        assert holder.read_text().startswith(f"{os.getpid()}\n{host}\n")
    holder.write_text("1\nanother-host\n")  # who knows whether it lives
    with pytest.raises(Busy), locked(path):
        pass
    old = time.time() - locks.SILENT_FOR - 1
    os.utime(holder, (old, old))
    with locked(path, wait=5.0):
        pass


def row(**known):
    return dict.fromkeys(COLUMNS) | {"recording": "r", "status": MEASURED, "reason": ""} | known


def test_the_page_links_reports_by_paths_that_work_and_shows_what_was_written_as_text():
    there = row(
        recording="day <1>/r #2",
        pairs=10,
        pairs_measured=9,
        report="../day <1>/r #2/results/report.html",
        k_m_m_s2=3.81e-8,
        k_m_sigma_m_s2=1e-11,
        k_m_reduced_chi_square=23.9,
    )
    lost = row(recording="x", status=FAILED, reason="<b>no</b> rig")
    text = index_page([there, lost])
    (link,) = [a for a in re.findall(r'href="([^"]+)"', text) if "report" in a]
    assert unquote(link) == there["report"]
    assert "#" not in link
    assert "day &lt;1&gt;/r #2" in text
    assert "&lt;b&gt;no&lt;/b&gt; rig" in text
    assert "3.8100 ± 0.0010 (model: χ² 23.9)" in text
    assert "9 / 10" in text


def test_recordings_of_the_same_images_are_told():
    rows = [
        row(recording=name, input_sha256=digest) for name, digest in (("a", "1"), ("b", "2"), ("c", "1"), ("d", None))
    ]
    assert copies(rows) == ["a, c"]
    assert "a, c: the same images" in index_page(rows)
    assert "the same images" not in index_page(rows[1:])
    assert "copies        a, c: the same images" in "\n".join(BatchOutcome(tuple(rows), (), ()).lines())


def test_a_line_warns_where_the_model_lacks_something():
    measured = row(pairs=10, pairs_measured=10, k_m_m_s2=3.81e-8, k_m_sigma_m_s2=1e-11, k_m_reduced_chi_square=1.01)
    assert "lacks" not in line_of(measured, 3)
    assert "lacks something (chi-square 23.9)" in line_of(measured | {"k_m_reduced_chi_square": 23.9}, 3)
