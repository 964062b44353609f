"""All jobs, one way or another: what is ready, what waits for its rig, what is tried again."""

from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait

from disctrack.batch.plan import Job
from disctrack.batch.pool import Died, Pool
from disctrack.batch.reasons import reason_of
from disctrack.batch.records import BUSY, FAILED, Result

LOOK = 0.1  # [s] after which Ctrl-C is heard at the latest

Done = Callable[[Job, Result], None]


def do_all(rigs: Sequence[Job], recordings: Sequence[Job], pool: Pool, done: Done) -> None:
    """Do every job; `done` is called with each that is finished for good. Raises ClusterError.

    Rigs come first, and what needs one waits for it. A job at which another batch works is asked for again until that
    one is done with it. A job whose process died gets a second try at the end, alone, when there is most memory.
    """
    made = {rig.rig for rig in rigs}
    ready = deque([*rigs, *(job for job in recordings if job.rig not in made)])
    waiting = {path: [job for job in recordings if job.rig == path] for path in made}
    alone: deque[Job] = deque()
    died: set[Job] = set()
    running: dict[Future[Result], Job] = {}

    def begin(job: Job) -> None:
        try:
            running[pool.submit(job)] = job
        except OSError as error:  # no memory, or no more processes allowed
            finish(job, Result.failed(f"no process could be started for it: {reason_of(error)}"))

    def finish(job: Job, result: Result) -> None:
        if result.status == BUSY:
            ready.append(job)
            return
        done(job, result)
        for after in waiting.pop(job.rig, []) if job.kind == "rig" else []:
            if result.status == FAILED:
                done(after, Result.failed(f"no rig: {result.record.reason}"))
            else:
                ready.append(after)

    def settle(job: Job, future: Future[Result]) -> None:
        try:
            finish(job, pool.result(future))
        except Died as death:
            if job in died:
                finish(job, Result.failed(f"twice, {death}"))
            else:
                died.add(job)
                alone.append(job)

    while ready or alone or running:
        while ready and len(running) < pool.size:
            begin(ready.popleft())
        if alone and not running:
            begin(alone.popleft())
        for future in wait(running, LOOK, FIRST_COMPLETED).done:
            settle(running.pop(future), future)
