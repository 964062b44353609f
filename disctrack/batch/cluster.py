"""Workers of a dask.distributed cluster. Every one of them must see the recordings under the same paths."""

import contextlib
import logging
import time
from typing import Any

from disctrack.batch.jobs import JobQueue, Share
from disctrack.batch.plan import Job
from disctrack.batch.processes import run_alone
from disctrack.batch.records import Result
from disctrack.errors import ClusterError

CONNECT = 10.0  # [s]
POLL = 0.1  # [s]
RETRIES = 3  # of a job whose worker was lost with it, each on another worker


def connect(address: str) -> Any:
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


def run_on_cluster(client: Any, jobs: JobQueue, share: Share) -> None:
    """Do all jobs on the cluster's workers, each in a process of its own there."""
    pending: dict[Any, Job] = {}
    try:
        while not jobs.finished:
            while (job := jobs.next()) is not None:
                key = f"{job.kind}-{job.name}-{time.monotonic_ns()}"  # a job that is tried again is another task
                pending[client.submit(run_alone, job.as_json(), key=key, pure=False, retries=RETRIES)] = job
            ready = [future for future in pending if future.done()]
            for future in ready:
                _collect(jobs, pending.pop(future), future)
            if not ready:
                time.sleep(POLL)
    finally:
        with contextlib.suppress(Exception):  # the scheduler may have gone
            client.cancel(list(pending), force=True)


def _collect(jobs: JobQueue, job: Job, future: Any) -> None:
    if future.cancelled():  # not by us
        raise ClusterError(
            "the connection to the cluster's scheduler was lost. What is finished is kept; the same command continues."
        )
    try:
        answer = future.result()
    except Exception as error:  # the worker was lost too often, or the task could not even be started there
        text = " ".join(str(error).split())[:300]
        jobs.finish(job, Result.failed(f"the cluster could not do it ({type(error).__name__}: {text})."))
        return
    if "died" in answer:
        jobs.died(job, answer["died"])
    else:
        jobs.finish(job, Result.from_dict(answer))
