"""What a batch does with jobs, locks and folders, without measuring anything."""

import csv
import errno
import fcntl
import io
import json
import os
import re
import subprocess
import sys
import time
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from urllib.parse import unquote

import numpy as np
import pytest
from filelock import Timeout
from numpy.testing import assert_allclose
from scipy import optimize, stats

from disctrack.batch import locks
from disctrack.batch.columns import COLUMNS, FITTED, copies, repeats_of
from disctrack.batch.locks import locked
from disctrack.batch.plan import BatchOptions, Job, find_recordings
from disctrack.batch.pool import Cluster, do_all
from disctrack.batch.records import BUSY, DIED, FAILED, MEASURED, failed, outcome
from disctrack.batch.report import report_of
from disctrack.batch.run import as_csv, with_false_discovery, write_summary
from disctrack.errors import ClusterError, RecordingError, reason_of
from disctrack.report.html import page
from disctrack.report.terminal import full, short

GOOD, KILLED = outcome(MEASURED), outcome(DIED, "killed")


def touched(root, *files):
    for file in files:
        (root / file).parent.mkdir(parents=True, exist_ok=True)
        (root / file).touch()
    return root


def recordings_at(root, *names):
    return touched(root, *(f"{name}/recording.toml" for name in names))


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
    assert "out/copy" not in names_of(find_recordings([root], out))
    assert names_of(find_recordings([root / "r3"])) == ["r3"]
    recordings_at(root / "r3", "r3")
    assert names_of(find_recordings([root / "r3"])) == [".", "r3"]


def test_images_without_a_declaration_are_told(tmp_path):
    """The uppermost folder of a recording that was forgotten; not its views, results, or a single film of something."""
    root = recordings_at(tmp_path, "day 1/r1", "day 1/r2")
    images = "r1/left", "r1/right", "r2/calibration/left", "r2/calibration/right"
    touched(root, *(f"day 1/{name}/0.png" for name in images))
    assert find_recordings([root]).undeclared == ()
    # pictures of two rigs that a batch calibrated are no images of two cameras
    touched(root, *(f"batch_results/rigs/{rig}/calibration_residuals.png" for rig in ("one", "other")))
    assert find_recordings([root]).undeclared == ()
    touched(root, *(f"day 1/r3/{name}/0.TIF" for name in ("left", "right", "calibration/left", "calibration/right")))
    touched(root, "films/left.cine", "pictures/some/a.png")
    assert find_recordings([root]).undeclared == (root / "day 1" / "r3",)
    touched(root, "films/right.cine")
    assert set(find_recordings([root]).undeclared) == {root / "day 1" / "r3", root / "films"}
    with pytest.raises(RecordingError, match=r"r3 has images: `disctrack init .*r3` writes one"):
        find_recordings([root / "day 1" / "r3"])


def test_no_folder_and_no_recording_are_told_apart(tmp_path):
    with pytest.raises(RecordingError, match="no such folder"):
        find_recordings([tmp_path / "nothing"])
    with pytest.raises(RecordingError, match="no recording found"):
        find_recordings([tmp_path])


def job(name, rig="given.h5", kind="recording"):
    return Job(kind, name, Path("/", name), Path("/", name, "results"), Path(rig), BatchOptions())


RIG = job("a", "shared.h5", "rig")
WITH_RIG = [job("a", "shared.h5"), job("b"), job("c", "shared.h5")]


class Pool:
    """Gives the answers to each job one after the other (GOOD, unless others are listed), a moment later."""

    def __init__(self, size=2, **answers):
        self.answers, self._threads = answers, ThreadPoolExecutor(size)
        self.begun, self.running, self.at_once = [], [], []  # .at_once : how many ran when each began, itself included

    def submit(self, job):
        self.begun.append((job.kind, job.name))
        return self._threads.submit(self._do, job)

    def _do(self, job):
        self.running.append(job.name)
        self.at_once.append(len(self.running))
        time.sleep(0.05)
        self.running.remove(job.name)
        return (self.answers.get(f"{job.kind}_{job.name}") or [GOOD]).pop(0)


def done_by(pool, recordings, rigs=()):
    return {job.name: result for job, result in do_all(rigs, recordings, pool)}


def test_recordings_wait_for_their_rigs():
    pool = Pool(size=3)
    results = done_by(pool, WITH_RIG, [RIG])
    assert pool.begun == [("rig", "a"), ("recording", "a"), ("recording", "b"), ("recording", "c")]
    assert pool.at_once[0] == 1
    assert [results[name]["status"] for name in "abc"] == [MEASURED] * 3


def test_without_its_rig_a_recording_fails_with_the_rigs_reason_and_others_go_on():
    results = done_by(Pool(rig_a=[failed("no corners found")]), WITH_RIG, [RIG])
    assert "no corners found" in results["a"]["reason"]
    assert [results[name]["status"] for name in "abc"] == [FAILED, MEASURED, FAILED]


def test_a_recording_at_which_another_batch_works_is_asked_for_again_after_the_others():
    pool = Pool(size=1, recording_a=[outcome(BUSY), GOOD])
    assert done_by(pool, [job("a"), job("b")])["a"]["status"] == MEASURED
    assert [name for _, name in pool.begun] == ["a", "b", "a"]


def test_a_job_whose_process_died_is_tried_once_more_at_the_end_and_alone():
    pool = Pool(recording_a=[KILLED, KILLED], recording_b=[KILLED, GOOD])
    results = done_by(pool, [job(name) for name in "abcd"])
    assert results["a"]["reason"] == "twice, killed"
    assert [results[name]["status"] for name in "abcd"] == [FAILED, MEASURED, MEASURED, MEASURED]
    assert sorted(name for _, name in pool.begun[4:]) == ["a", "b"]  # in the order in which their processes died
    assert pool.at_once[4:] == [1, 1]


@pytest.fixture
def cluster(monkeypatch):
    """A cluster whose futures have an answer, an error, or were cancelled."""

    def submit(do, job):
        future, answer = Future(), client.answers.pop(0)
        (future.set_exception if isinstance(answer, Exception) else future.set_result)(answer)
        return future

    client = SimpleNamespace(submit=submit, get_executor=lambda pure: client, scheduler_info=lambda: {"workers": "a"})
    monkeypatch.setitem(sys.modules, "distributed", SimpleNamespace(Client=lambda address, **more: client))
    return client


def test_answers_of_a_cluster_are_results_deaths_and_failures(cluster):
    cluster.answers = [GOOD, KILLED, RuntimeError("worker lost too often"), GOOD]
    results = done_by(Cluster("tcp://there"), [job("a"), job("b"), job("c")])
    assert {name: result["status"] for name, result in results.items()} == {"a": MEASURED, "b": MEASURED, "c": FAILED}
    assert "worker lost too often" in results["c"]["reason"]


def test_a_lost_scheduler_is_told_and_no_recording_is_blamed(cluster):
    cluster.answers = [CancelledError(), CancelledError()]
    with pytest.raises(ClusterError, match="scheduler was lost"):
        done_by(Cluster("tcp://there"), [job("a"), job("b")])


def test_reasons_are_one_line_and_say_what_to_do():
    assert reason_of(RecordingError("a\n  b")) == "a b"
    assert "-j" in reason_of(MemoryError())
    assert reason_of(OSError(errno.EIO, "Input/output error", "x.png")) == "x.png: Input/output error."
    assert "ZeroDivisionError" in reason_of(ZeroDivisionError("division by zero"))


def test_a_lock_keeps_others_out_and_leaves_nothing(tmp_path):
    with locked(tmp_path / "lock"), pytest.raises(Timeout), locked(tmp_path / "lock"):
        pass
    assert not (tmp_path / "lock").exists()


def test_a_disk_without_locks_is_locked_by_a_file_and_a_dead_holders_file_is_cleared(tmp_path, monkeypatch):
    def no_locks(*_):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", no_locks)
    path, holder = tmp_path / "lock", tmp_path / "lock.holder"
    with locked(path), pytest.raises(Timeout), locked(path):
        pass
    assert not holder.exists()
    host = os.uname().nodename
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    holder.write_text(f"{dead.pid}\n{host}\n")
    with locked(path, wait=5.0):
        assert holder.read_text().startswith(f"{os.getpid()}\n{host}\n")
    holder.write_text("1\nanother-host\n")  # who knows whether it lives
    with pytest.raises(Timeout), locked(path):
        pass
    old = time.time() - locks.SILENT_FOR - 1
    os.utime(holder, (old, old))
    with locked(path, wait=5.0):
        pass


def row(**known):
    return dict.fromkeys(COLUMNS) | {"recording": "r", "status": MEASURED, "reason": ""} | known


def page_of(*given):
    return page(report_of(*given))


def test_the_page_links_reports_by_paths_that_work_and_shows_what_was_written_as_text():
    report = "../day <1>/r #2/results/report.html"
    k_m = {"k_m_m_s2": 3.81e-8, "k_m_sigma_m_s2": 1e-11, "k_m_reduced_chi_square": 23.9}
    there = row(recording="day <1>/r #2", pairs=10, pairs_measured=9, report=report, **k_m)
    lost = row(recording="x", status=FAILED, reason="<b>no</b> rig")
    text = page_of([there, lost])
    (link,) = [a for a in re.findall(r'href="([^"]+)"', text) if "report" in a]
    assert unquote(link) == report
    assert "#" not in link
    assert "day &lt;1&gt;/r #2" in text
    assert "&lt;b&gt;no&lt;/b&gt; rig" in text
    assert "3.8100 ± 0.0010 (model: χ² 23.9)" in text
    assert "model: χ²" not in page_of([there | {"k_m_reduced_chi_square": None}])
    assert "9 / 10" in text


def test_recordings_of_the_same_images_are_told():
    digests = {"a": "1", "b": "2", "c": "1", "d": None}
    rows = [row(recording=name, input_sha256=digest) for name, digest in digests.items()]
    assert copies(rows) == ["a, c"]
    assert "a, c: the same images" in "\n".join(short(report_of(rows)))
    assert "the same images" not in page_of(rows[1:])


def repeats_with(values, sigmas, **known):
    """Rows of one group whose n_theta is as given."""
    return [
        row(recording=str(i), input_sha256=str(i), repeats="glass", n_theta=v, n_theta_sigma=s, **known)
        for i, (v, s) in enumerate(zip(values, sigmas, strict=True))
    ]


def test_means_and_spread_of_repeats_agree_with_least_squares(rng):
    """Runs that scatter as their sigmas say, and the same with a scatter of their own."""
    sigma = rng.uniform(0.5, 2.0, 7) * 1e-3
    value = 0.667 + sigma * rng.standard_normal(7)
    for added in (0.0, 0.01):
        there = value + added * rng.standard_normal(7)
        (found,) = repeats_of(repeats_with(there, sigma))
        how = {"sigma": sigma, "absolute_sigma": True}
        fit, covariance = optimize.curve_fit(lambda x, a: a + 0 * x, np.zeros(7), there, **how)
        assert_allclose([found["weighted_mean"], found["weighted_mean_sigma"] ** 2], [fit[0], covariance[0, 0]])
        chi_square = np.sum(((there - fit[0]) / sigma) ** 2)
        assert_allclose(found["reduced_chi_square"], chi_square / 6, rtol=1e-6)
        assert_allclose(found["p_value"], stats.chi2.sf(chi_square, 6), rtol=1e-5)
        assert_allclose([found["mean"], found["standard_deviation"]], [there.mean(), there.std(ddof=1)])
        assert (found["p_value"] > 1e-3) == (added == 0.0)


def test_repeats_are_of_one_group_determined_and_no_copies():
    rows = repeats_with([0.66, 0.67, 0.68, 0.9, 0.9, 0.7], [0.01] * 6)
    rows[3] |= {"repeats": "steel"}  # alone of its kind
    rows[4] |= {"input_sha256": "0"}  # a copy of the first
    rows[5] |= {"n_theta": None, "n_theta_sigma": None}
    rows.append(row(recording="failed", status=FAILED))
    (found,) = repeats_of(rows)
    assert (found["repeats"], found["quantity"], found["n"]) == ("glass", "n_theta", 3)
    assert found["mean"] == pytest.approx(0.67)
    assert {name for fitted in FITTED for name in (fitted.column, fitted.sigma)} <= set(COLUMNS)
    assert "0.670 ± 0.010" in page_of(rows)
    assert "Repeats" not in page_of(rows[1:2])


def test_a_summary_lists_repeats_beside_the_recordings(tmp_path):
    found = find_recordings([recordings_at(tmp_path, "a", "b")])
    alike = {"repeats": "glass", "n_theta": 0.66, "n_theta_sigma": 0.01}
    records = {name: outcome(MEASURED) | alike | {"input_sha256": name} for name in "ab"}
    write_summary(found, records, BatchOptions())
    (repeat,) = json.loads((found.common / "summary.json").read_text())["repeats"]
    assert (repeat["quantity"], repeat["n"]) == ("n_theta", 2)
    assert "Repeats" in (found.common / "index.html").read_text()


def test_false_discoveries_are_counted_among_the_recordings_that_were_diagnosed():
    """Benjamini and Hochberg's own example of fifteen p values, of which four stand at 5 %."""
    known = [0.0001, 0.0004, 0.0019, 0.0095, 0.0201, 0.0278, 0.0298, 0.0344, 0.0459, 0.324, 0.4262, 0.5719, 0.6528,
             0.759, 1.0, None]  # fmt: skip
    rows = with_false_discovery([{"recording": f"r{i}", "diagnosis_p_value": p} for i, p in enumerate(known)])
    *shares, undiagnosed = (row["diagnosis_false_discovery"] for row in rows)
    assert sum(share <= 0.05 for share in shares) == 4
    assert undiagnosed is None
    assert with_false_discovery([]) == []


def test_names_are_text_in_a_spreadsheet_and_steer_no_terminal():
    names = ["=1+1", "+1", "-1", "@SUM(A1)", "\x1b[2J", "plain é"]
    rows = [row(recording=name, reason="\x1b]0;title\x07", pairs=-1) for name in names]
    cells = list(csv.DictReader(io.StringIO(as_csv(COLUMNS, rows).decode())))
    assert [cell["recording"] for cell in cells] == ["'=1+1", "'+1", "'-1", "'@SUM(A1)", r"\x1b[2J", "plain é"]
    assert cells[0]["pairs"] == "-1"  # a number stays one
    assert "\x1b" not in page_of(rows)
    assert "\x1b" not in "".join(full(report_of(rows)))
