"""Distribution of jobs to processes of this machine or of a cluster, with repetition of failed ones.

Each process does one job at a time: if it crashes or is killed, only that job is lost.
"""

import contextlib
import itertools
import logging
import multiprocessing
import os
import signal
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, ThreadPoolExecutor, wait
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path

import cv2

from disctrack.batch.columns import Row
from disctrack.batch.measure import do
from disctrack.batch.plan import Job
from disctrack.batch.records import BUSY, DIED, FAILED, failed, outcome
from disctrack.errors import ClusterError, reason_of, told_as
from disctrack.findings import Kind
from disctrack.processes import Spawn, end_with_parent

CONNECT = 10.0  # [s] for a scheduler to answer
LOOK = 0.1  # [s] between checks for Ctrl-C
_CLEARING = 2.0  # [s] that processes have to clean up before the next request to end


def do_all(rigs: Sequence[Job], recordings: Sequence[Job], pool: "Processes | Cluster") -> Iterator[tuple[Job, Row]]:
    """Do every job; yields each recording with its final row. Raises ClusterError.

    Rigs come first; a recording whose rig failed fails for the same reason. A job that another batch is working on is
    submitted again until that batch is done. A job whose process died is repeated once at the end, alone, with the most
    memory available.
    """
    no_rig = {rig.rig: row["reason"] for rig, row in _finished(rigs, pool) if row["status"] == FAILED}
    for job in recordings:
        if job.rig in no_rig:
            yield job, failed(f"no rig: {no_rig[job.rig]}", Kind.CALIBRATION)
    yield from _finished([job for job in recordings if job.rig not in no_rig], pool)


def _finished(jobs: Sequence[Job], pool: "Processes | Cluster") -> Iterator[tuple[Job, Row]]:
    """Do the jobs in parallel; yields each with its final row when it ends."""
    running, died, again = {pool.submit(job): job for job in jobs}, list[Job](), list[Job]()
    while running:
        for future in wait(running, LOOK, FIRST_COMPLETED).done:
            job, row = running.pop(future), _result(future)
            if row["status"] == BUSY:
                running[pool.submit(job)] = job  # behind all others
            elif row["status"] == DIED and job not in again:
                died.append(job)
            else:
                yield job, failed(f"twice, {row['reason']}") if row["status"] == DIED else row
        if died and not running:
            again.append(died.pop(0))
            running[pool.submit(again[-1])] = again[-1]


def _result(future: Future[Row]) -> Row:
    """Row of a job that has ended. Raises ClusterError if the batch cannot continue."""
    try:
        return future.result()
    except CancelledError as error:  # by the scheduler
        said = "the connection to the cluster's scheduler was lost. What is finished is kept"
        raise ClusterError(f"{said}; the same command continues.") from error
    except OSError as error:  # no memory, or no more processes allowed
        return failed(f"no process could be started for it: {reason_of(error)}")
    except Exception as error:  # the machines of a cluster were lost too often, or could not start the job
        return failed(f"it could not be done ({type(error).__name__}: {' '.join(str(error).split())[:300]}).")


class Processes:
    """Processes of this machine, each with a thread that sends it one job after the other."""

    def __init__(self, size: int) -> None:
        self._threads = ThreadPoolExecutor(size, thread_name_prefix="batch")
        self._own = threading.local()  # the process of a thread
        self._context = Spawn()
        self._ends = False
        self._folder = tempfile.TemporaryDirectory(prefix="disctrack-")
        self._numbers = itertools.count()  # of files for what processes print

    def submit(self, job: Job) -> Future[Row]:
        """Submit a job; its future raises OSError if no process can be started."""
        return self._threads.submit(self.done, job)

    def done(self, job: Job) -> Row:
        """Do a job in this thread's process; if the process dies, the row is DIED with the reason."""
        if self._ends:
            return outcome(DIED, "the batch ended")
        process, jobs, said = getattr(self._own, "kept", None) or self._begun()
        self._own.kept = None
        try:
            jobs.send(job)
            row: Row = jobs.recv()
        except (EOFError, ConnectionError):
            return outcome(DIED, _why_it_ended(process, said))
        self._own.kept = process, jobs, said
        return row

    def _begun(self) -> tuple[SpawnProcess, Connection, Path]:
        """A new process, the connection for jobs, and the file for its printed output. Raises OSError."""
        (jobs, its_end), said = self._context.Pipe(), Path(self._folder.name, str(next(self._numbers)))
        process = self._context.Process(target=_work, args=(its_end, said))
        process.start()
        its_end.close()  # so that the connection closes when the process ends, which ends `recv`
        return process, jobs, said

    def close(self) -> None:
        """End running processes after they have cleaned up."""
        self._ends = True
        self._threads.shutdown(wait=False, cancel_futures=True)
        # repeatedly: code that a process was running may have suppressed the request
        for ask in (*[SpawnProcess.terminate] * 4, SpawnProcess.kill):
            living = [process for process in self._context.started if process.is_alive()]
            for process in living:
                ask(process)
            for process in living:
                process.join(_CLEARING)
        self._threads.shutdown()
        self._folder.cleanup()


class Cluster:
    """Workers of a dask.distributed scheduler. Each of them must see the recordings under the same paths."""

    def __init__(self, address: str) -> None:
        """Connect. Raises ClusterError if dask.distributed is not installed, or without a scheduler or workers."""
        remedy = "Install disctrack[cluster], here and on the cluster's machines, or leave --cluster out."
        with told_as(ClusterError, "--cluster needs dask.distributed", ImportError, then=remedy):
            import distributed
        logging.getLogger("distributed").setLevel(logging.CRITICAL)  # relevant errors are reported by ClusterError
        remedy = "Give the address that dask-scheduler printed, e.g. tcp://host:8786."
        said = f"--cluster {address}: no scheduler answers"
        with told_as(ClusterError, said, OSError, ValueError, TypeError, then=remedy):
            self._client = distributed.Client(address, timeout=CONNECT, set_as_default=False)
        self._executor = self._client.get_executor(pure=False)  # a repeated job is a new task
        if not self._client.scheduler_info()["workers"]:
            self.close()
            raise ClusterError(
                f"--cluster {address}: the scheduler has no workers. Start dask-worker on some machines."
            )

    def submit(self, job: Job) -> Future[Row]:
        """Submit a job; its future raises errors of the cluster."""
        future: Future[Row] = self._executor.submit(do_alone, job)
        return future

    def close(self) -> None:
        """Cancel running jobs and disconnect."""
        with contextlib.suppress(Exception):  # the scheduler may have gone
            self._executor.shutdown(wait=False)
            self._client.close()


def do_alone(job: Job) -> Row:
    """Do a job on a machine of the cluster, in a separate process."""
    multiprocessing.current_process().daemon = False  # dask's workers are daemons, which may not start processes
    with contextlib.closing(Processes(1)) as here:
        return here.done(job)


def _why_it_ended(process: SpawnProcess, said: Path) -> str:
    """Signal or exit code, and the end of its printed output."""
    process.join()
    words = said.read_text("utf-8", "replace").split() if said.exists() else []
    code = process.exitcode
    if code == -getattr(signal, "SIGKILL", 9):
        text = "its process was killed (signal 9), as the system does when memory runs out. Run fewer side by side: -j."
    elif code is not None and code < 0:
        text = f"its process was ended by signal {-code} ({signal.strsignal(-code)})."
    else:
        text = f"its process ended by itself (exit code {code})."
    return f"{text} It said: {' '.join(words)[-300:]}" if words else text


def _work(jobs: Connection, said: Path) -> None:
    """Main loop of a new process: redirect printed output to a file, end with the parent, do jobs."""
    # an exit, so that `finally` blocks remove half-written files
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    output = os.open(said, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    for stream in (1, 2):
        os.dup2(output, stream)
    cv2.setNumThreads(1)  # the other cores are used by other processes
    end_with_parent()
    while True:
        job = jobs.recv()  # if ended here by SIGTERM, the process exits normally and releases its resources
        try:
            row = do(job)
        except SystemExit:  # after half-written files were removed
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
            signal.raise_signal(signal.SIGTERM)
        jobs.send(row)
