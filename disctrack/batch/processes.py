"""Processes on this machine: as many jobs side by side, and none that takes another down."""

from __future__ import annotations

import contextlib
import json
import os
import queue
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import IO, Any

from disctrack.batch.jobs import JobQueue, Share
from disctrack.batch.plan import Job
from disctrack.batch.reasons import reason_of, reason_of_death
from disctrack.batch.records import Result
from disctrack.recording.readers.blocks import ONE_THREAD

_STOPPING, _ASK_AGAIN = 9.0, 2.0  # [s] that a worker has to clear up, and after which it is asked once more


class Worker:
    """One process that does jobs one after the other; what it says goes into `events`."""

    def __init__(self, events: queue.Queue[tuple[Worker, dict[str, Any] | None]]) -> None:
        """`events` gets (worker, message), and (worker, None) when the process has ended. Raises OSError."""
        self.job: Job | None = None
        self._events = events
        self._said: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115 (as long as the process)
        try:
            self._process = self._started()
        except OSError:
            self._said.close()
            raise
        self._listener = threading.Thread(target=self._listen, daemon=True)
        self._listener.start()

    def _started(self) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, "-m", "disctrack.batch.worker"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._said,
            env=os.environ | ONE_THREAD | {"PYTHONPATH": _search_path()},
            text=True,
            encoding="utf-8",
        )

    def _listen(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            with contextlib.suppress(ValueError):  # the line at which it was killed
                self._events.put((self, json.loads(line)))
        self._process.wait()
        self._events.put((self, None))

    def begin(self, job: Job) -> None:
        """Give it a job. If it has died, that will be among the events."""
        assert self._process.stdin is not None
        self.job = job
        with contextlib.suppress(OSError):
            self._process.stdin.write(job.as_json() + "\n")
            self._process.stdin.flush()

    def why_it_ended(self) -> str:
        """Signal or exit code, and the last that it said."""
        self._said.seek(0)
        said = self._said.read()[-2000:].decode("utf-8", "replace").strip()
        return reason_of_death(self._process.wait(), said.splitlines()[-1] if said else "")

    def ask_to_stop(self) -> None:
        """At once if it does a job; in any case when it is done with it."""
        with contextlib.suppress(OSError):
            if self.job is not None:
                self._process.terminate()
            elif self._process.stdin is not None:
                self._process.stdin.close()

    def stop(self, until: float) -> None:
        """Wait for its end until that instant, asking again now and then, and then end it."""
        while self._process.poll() is None:
            left = until - time.monotonic()
            if left <= 0:
                self._process.kill()
            try:
                self._process.wait(min(left, _ASK_AGAIN) if left > 0 else None)
            except subprocess.TimeoutExpired:  # where it was, the request may have been swallowed
                self.ask_to_stop()
        self._listener.join(1.0)  # it reads to the end of what a dead process has said
        for stream in (self._process.stdin, self._process.stdout, self._said):
            if stream is not None:
                with contextlib.suppress(OSError):
                    stream.close()


def run_here(jobs: JobQueue, side_by_side: int, share: Share) -> None:
    """Do all jobs in processes of this machine. Whatever ends this function ends the processes."""
    events: queue.Queue[tuple[Worker, dict[str, Any] | None]] = queue.Queue()
    workers: list[Worker] = []
    try:
        while not jobs.finished:
            while (idle := [w for w in workers if w.job is None]) or len(workers) < side_by_side:
                job = jobs.next()
                if job is None:
                    break
                try:
                    worker = idle[0] if idle else Worker(events)
                except OSError as error:  # no memory, or no more processes allowed
                    jobs.finish(job, Result.failed(f"no process could be started for it: {reason_of(error)}"))
                    continue
                workers += [] if idle else [worker]
                worker.begin(job)
            try:
                worker, message = events.get(timeout=0.1)
            except queue.Empty:
                continue
            _hear(jobs, workers, worker, message, share)
    finally:
        for worker in workers:
            worker.ask_to_stop()
        until = time.monotonic() + _STOPPING
        for worker in workers:
            worker.stop(until)


def _hear(jobs: JobQueue, workers: list[Worker], worker: Worker, message: dict[str, Any] | None, share: Share) -> None:
    job = worker.job
    if message is None:
        workers.remove(worker)
        if job is not None:
            share(job, 0.0)
            jobs.died(job, worker.why_it_ended())
        worker.stop(time.monotonic())
    elif job is not None and "share" in message:
        share(job, float(message["share"]))
    elif job is not None:
        worker.job = None
        jobs.finish(job, Result.from_dict(message))


def run_alone(job_line: str) -> dict[str, Any]:
    """Do one job in a process of its own and wait for it; for the machines of a cluster.

    job_line : Job.as_json()
    returns : Result.as_dict(), or {"died": why}
    """
    events: queue.Queue[tuple[Worker, dict[str, Any] | None]] = queue.Queue()
    worker = Worker(events)
    worker.begin(Job.from_json(job_line))
    try:
        while (message := events.get()[1]) is not None:
            if "share" not in message:
                worker.job = None
                return message
        return {"died": worker.why_it_ended()}
    finally:
        worker.ask_to_stop()
        worker.stop(time.monotonic() + _STOPPING)


def _search_path() -> str:
    """Where the workers find this package, also when it is not installed."""
    here = str(Path(__file__).resolve().parents[2])
    return os.pathsep.join([here, *filter(None, [os.environ.get("PYTHONPATH")])])
