"""All jobs, done by processes of this machine or of a cluster: what is ready, what waits, what is tried again.

Every job is done in a process of its own kind: one that crashes or is killed takes its own job with it and no other.
"""

from __future__ import annotations

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
from types import FrameType
from typing import TYPE_CHECKING

import cv2

from disctrack.batch.columns import Row
from disctrack.batch.measure import do
from disctrack.batch.plan import Job
from disctrack.batch.records import BUSY, DIED, FAILED, failed, outcome
from disctrack.errors import ClusterError, reason_of, told_as
from disctrack.findings import Kind
from disctrack.processes import Spawn, end_with_parent

if TYPE_CHECKING:
    from distributed import Client

CONNECT = 10.0  # [s] for a scheduler to answer
LOOK = 0.1  # [s] after which Ctrl-C is heard at the latest
_CLEARING = 2.0  # [s] that processes have to clear up before they are asked once more


def do_all(rigs: Sequence[Job], recordings: Sequence[Job], pool: Processes | Cluster) -> Iterator[tuple[Job, Row]]:
    """Do every job; yields each recording that is finished for good. Raises ClusterError.

    Rigs come first; a recording without its rig fails for the rig's reason. A job at which another batch works is asked
    for again until that one is done with it. A job whose process died gets a second try at the end, alone, when there
    is most memory.
    """
    no_rig = {rig.rig: row["reason"] for rig, row in _finished(rigs, pool) if row["status"] == FAILED}
    for job in recordings:
        if job.rig in no_rig:
            yield job, failed(f"no rig: {no_rig[job.rig]}", Kind.CALIBRATION)
    yield from _finished([job for job in recordings if job.rig not in no_rig], pool)


def _finished(jobs: Sequence[Job], pool: Processes | Cluster) -> Iterator[tuple[Job, Row]]:
    """Do the jobs, as many side by side as the pool can; yields each as it ends for good."""
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
    """Row of a job that has ended. Raises ClusterError where nothing further can be done."""
    try:
        return future.result()
    except CancelledError as error:  # not by us
        said = "the connection to the cluster's scheduler was lost. What is finished is kept"
        raise ClusterError(f"{said}; the same command continues.") from error
    except OSError as error:  # no memory, or no more processes allowed
        return failed(f"no process could be started for it: {reason_of(error)}")
    except Exception as error:  # a cluster's machines were lost too often, or could not even begin
        return failed(f"it could not be done ({type(error).__name__}: {' '.join(str(error).split())[:300]}).")


class Processes:
    """Processes of this machine, a thread for each, which gives it one job after the other."""

    def __init__(self, size: int) -> None:
        self._threads = ThreadPoolExecutor(size, thread_name_prefix="batch")
        self._own = threading.local()  # the process that a thread keeps
        self._context = Spawn()
        self._ends = False
        self._folder = tempfile.TemporaryDirectory(prefix="disctrack-")
        self._said = (Path(self._folder.name) / str(i) for i in itertools.count())

    def submit(self, job: Job) -> Future[Row]:
        """Begin a job; its future raises OSError where no process can be started for it."""
        return self._threads.submit(self.done, job)

    def done(self, job: Job) -> Row:
        """Do a job in this thread's process; its row says where that ended before the job did, and why."""
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
        """A new process, what it is told jobs by, and the file for whatever its libraries print. Raises OSError."""
        (jobs, its_end), said = self._context.Pipe(), next(self._said)
        process = self._context.Process(target=_work, args=(its_end, said))
        process.start()
        its_end.close()  # with the process its own goes, too: that ends what waits for an answer
        return process, jobs, said

    def close(self) -> None:
        """End in order what still runs."""
        self._ends = True
        self._threads.shutdown(wait=False, cancel_futures=True)
        # more than once: where a process was, the request may have been swallowed
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
        """Raises ClusterError if dask.distributed is not installed or nobody answers."""
        self._client = connect(address)
        self._executor = self._client.get_executor(pure=False)  # a job that is tried again is another task

    def submit(self, job: Job) -> Future[Row]:
        """Begin a job; its future raises what is wrong with the cluster."""
        future: Future[Row] = self._executor.submit(do_alone, job)
        return future

    def close(self) -> None:
        """End in order what still runs."""
        with contextlib.suppress(Exception):  # the scheduler may have gone
            self._executor.shutdown(wait=False)
            self._client.close()


def connect(address: str) -> Client:
    """Client of the scheduler. Raises ClusterError if dask.distributed is not installed or nobody answers."""
    remedy = "Install disctrack[cluster], here and on the cluster's machines, or leave --cluster out."
    with told_as(ClusterError, "--cluster needs dask.distributed", ImportError, then=remedy):
        import distributed
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # what matters of it is told here
    remedy = "Give the address that dask-scheduler printed, e.g. tcp://host:8786."
    said = f"--cluster {address}: no scheduler answers"
    with told_as(ClusterError, said, OSError, ValueError, TypeError, then=remedy):
        client = distributed.Client(address, timeout=CONNECT, set_as_default=False)
    if not client.scheduler_info()["workers"]:
        client.close()
        raise ClusterError(f"--cluster {address}: the scheduler has no workers. Start dask-worker on some machines.")
    return client


def do_alone(job: Job) -> Row:
    """Do a job on one of a cluster's machines, in a process of its own."""
    multiprocessing.current_process().daemon = False  # dask's workers are, and Python allows daemons no processes
    with contextlib.closing(Processes(1)) as here:
        return here.done(job)


def _why_it_ended(process: SpawnProcess, said: Path) -> str:
    """Signal or exit code, and the last that it said."""
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
    """In a new process: what its libraries print goes into a file, and it ends with the batch that started it."""
    signal.signal(signal.SIGTERM, _stop)
    output = os.open(said, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    for stream in (1, 2):
        os.dup2(output, stream)
    cv2.setNumThreads(1)  # the others have the cores
    end_with_parent()
    while True:
        job = jobs.recv()  # struck here, it ends in order, and gives back what it has of the system
        try:
            row = do(job)
        except SystemExit:  # half-written files are gone
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
            signal.raise_signal(signal.SIGTERM)
        jobs.send(row)


def _stop(number: int, frame: FrameType | None) -> None:
    """Leave by way of the blocks that remove half-written files."""
    sys.exit(128 + number)
