"""Where jobs are done: processes of this machine, or of a cluster's machines, behind one interface.

Every job is done in a process of its own kind: one that crashes or is killed takes its own job with it and no other.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import math
import multiprocessing
import os
import signal
import sys
import tempfile
import time
from concurrent.futures import CancelledError, Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.context import SpawnProcess
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Protocol

import cv2

from disctrack.batch.measure import do
from disctrack.batch.plan import Job
from disctrack.batch.reasons import reason_of, reason_of_death
from disctrack.batch.records import Result
from disctrack.errors import ClusterError
from disctrack.processes import Spawn, end_with_parent, quietly

if TYPE_CHECKING:
    from distributed import Client

CONNECT = 10.0  # [s] for a scheduler to answer
# [s] that processes have to clear up, and after which they are asked once more
_STOPPING, _ASK_AGAIN = 9.0, 2.0


class Died(Exception):
    """The process that did a job ended before the job did; its text says why."""


class Pool(Protocol):
    """Does jobs, `size` at once."""

    size: float

    def submit(self, job: Job) -> Future[Result]:
        """Begin a job. Raises OSError where no process can be started for it."""

    def result(self, future: Future[Result]) -> Result:
        """Result of a job that was begun. Raises Died, and ClusterError where nothing further can be done."""

    def close(self) -> None:
        """End in order what still runs."""


class Processes:
    """Processes of this machine, each with an executor of its own: when it breaks, it is clear whose job broke it."""

    def __init__(self, size: int) -> None:
        self.size: float = size
        self._workers: list[_Worker] = []
        self._idle: list[_Worker] = []
        self._busy: dict[Future[Result], _Worker] = {}
        self._folder = tempfile.TemporaryDirectory(prefix="disctrack-")
        self._said = (Path(self._folder.name) / str(i) for i in itertools.count())

    def submit(self, job: Job) -> Future[Result]:
        """See Pool."""
        if not self._idle:
            self._idle.append(_Worker(next(self._said)))
            self._workers.append(self._idle[-1])
        worker = self._idle.pop()
        future = worker.begin(job)
        self._busy[future] = worker
        return future

    def result(self, future: Future[Result]) -> Result:
        """See Pool."""
        try:
            result = future.result()
        except BrokenProcessPool as error:
            raise Died(self._busy.pop(future).why_it_ended()) from error
        except Exception as error:
            result = Result.failed(reason_of(error))
        self._idle.append(self._busy.pop(future))
        return result

    def close(self) -> None:
        """See Pool."""
        until = time.monotonic() + _STOPPING
        living = [worker.process for worker in self._workers if worker.process is not None]
        for worker in self._workers:
            worker.executor.shutdown(wait=False, cancel_futures=True)
        for process in living:
            process.terminate()
        for process in living:
            process.join(_ASK_AGAIN)
            while process.is_alive():  # where it was, the request may have been swallowed
                process.terminate() if time.monotonic() < until else process.kill()
                process.join(_ASK_AGAIN)
        self._folder.cleanup()


class Cluster:
    """Workers of a dask.distributed scheduler. Each of them must see the recordings under the same paths."""

    def __init__(self, address: str) -> None:
        """Raises ClusterError if dask.distributed is not installed or nobody answers."""
        self.size: float = math.inf  # the scheduler deals them out
        self._client = connect(address)
        self._executor: Executor = self._client.get_executor(pure=False)  # a job that is tried again is another task

    def submit(self, job: Job) -> Future[Result]:
        """See Pool."""
        return self._executor.submit(do_alone, job)

    def result(self, future: Future[Result]) -> Result:
        """See Pool."""
        try:
            return future.result()
        except Died:
            raise
        except CancelledError as error:  # not by us
            raise ClusterError(
                "the connection to the cluster's scheduler was lost. What is finished is kept; "
                "the same command continues."
            ) from error
        except Exception as error:  # its machines were lost too often, or could not even begin
            text = " ".join(str(error).split())[:300]
            return Result.failed(f"the cluster could not do it ({type(error).__name__}: {text}).")

    def close(self) -> None:
        """See Pool."""
        with contextlib.suppress(Exception):  # the scheduler may have gone
            self._executor.shutdown(wait=False)
            self._client.close()


def connect(address: str) -> Client:
    """Client of the scheduler. Raises ClusterError if dask.distributed is not installed or nobody answers."""
    try:
        import distributed
    except ImportError as error:
        raise ClusterError(
            "--cluster needs dask.distributed: install disctrack[cluster], here and on the cluster's machines, or "
            "leave --cluster out."
        ) from error
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # what matters of it is told here
    try:
        client = distributed.Client(address, timeout=CONNECT, set_as_default=False)
    except (OSError, TimeoutError, ValueError, TypeError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ClusterError(
            f"--cluster {address}: no scheduler answers ({reason}). Give the address that dask-scheduler printed, e.g. "
            "tcp://host:8786."
        ) from error
    if not client.scheduler_info()["workers"]:
        client.close()
        raise ClusterError(f"--cluster {address}: the scheduler has no workers. Start dask-worker on some machines.")
    return client


def do_alone(job: Job) -> Result:
    """Do a job on one of a cluster's machines, in a process of its own. Raises Died."""
    multiprocessing.current_process().daemon = False  # dask's workers are, and Python allows daemons no processes
    here = Processes(1)
    try:
        return here.result(here.submit(job))
    finally:
        here.close()


class _Worker:
    """One process that does jobs one after the other."""

    def __init__(self, said: Path) -> None:
        """Said : file for whatever its libraries print"""
        context = Spawn()
        with quietly():  # with the first one Python starts its process that clears up semaphores
            self.executor = ProcessPoolExecutor(1, context, _prepare, (said,))
        self._context, self._said = context, said

    @property
    def process(self) -> SpawnProcess | None:
        """Of the executor, where it lives."""
        return next((process for process in self._context.started if process.is_alive()), None)

    def begin(self, job: Job) -> Future[Result]:
        """Give it a job. Raises OSError where the process cannot be started."""
        try:
            return self.executor.submit(_do, job)
        except BrokenProcessPool as error:  # it died while it had nothing to do
            future: Future[Result] = Future()
            future.set_exception(error)
            return future

    def why_it_ended(self) -> str:
        """Signal or exit code, and the last that it said."""
        self.executor.shutdown()
        said = self._said.read_text("utf-8", "replace").strip() if self._said.exists() else ""
        return reason_of_death(self._context.started[0].exitcode, said.splitlines()[-1] if said else "")


def _prepare(said: Path) -> None:
    """In a new process: what its libraries print goes into a file, and it ends with the batch that started it."""
    signal.signal(signal.SIGTERM, _stop)
    output = os.open(said, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    for stream in (1, 2):
        os.dup2(output, stream)
    cv2.setNumThreads(1)  # the others have the cores
    end_with_parent()


def _stop(number: int, frame: FrameType | None) -> None:
    """Leave by way of the blocks that remove half-written files."""
    sys.exit(128 + number)


def _do(job: Job) -> Result:
    try:
        return do(job)
    except SystemExit:  # half-written files are gone; the executor would keep the process
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        signal.raise_signal(signal.SIGTERM)
        raise
