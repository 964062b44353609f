"""Which job is ready, which waits for its rig, which is to be tried again."""

import time
from collections import deque
from collections.abc import Callable, Iterable

from disctrack.batch.plan import Job
from disctrack.batch.records import BUSY, FAILED, Result

ASK_AGAIN = 0.3  # [s] whether another batch has finished with a recording

Done = Callable[[Job, Result], None]
Share = Callable[[Job, float], None]


class JobQueue:
    """Jobs on their way. It knows nothing of processes and machines.

    Rigs come first, and what needs one waits for it. A job at which another batch works is asked for again until that
    one is done with it. A job whose process died gets a second try at the end, alone, when there is most memory.
    """

    def __init__(self, rigs: Iterable[Job], recordings: Iterable[Job], done: Done) -> None:
        """`done` is called with every job that is finished for good, and its result."""
        self._ready = deque(rigs)
        made = {job.rig for job in self._ready}
        self._waiting: dict[str, list[Job]] = {path: [] for path in made}
        for job in recordings:
            (self._waiting[job.rig] if job.needs_rig and job.rig in made else self._ready).append(job)
        self._later: list[tuple[float, Job]] = []  # (not before [s], job)
        self._alone: deque[Job] = deque()
        self._died: set[tuple[str, str]] = set()
        self._running: list[Job] = []
        self._done = done

    @property
    def finished(self) -> bool:
        """Nothing is left and nothing runs."""
        left = (self._ready, self._later, self._alone, self._running)
        return not any(left) and not any(self._waiting.values())

    def next(self) -> Job | None:
        """A job to begin now, None if there is none at present."""
        now = time.monotonic()
        for i, (when, job) in enumerate(self._later):
            if when <= now:
                del self._later[i]
                self._ready.append(job)
                break
        if self._ready:
            job = self._ready.popleft()
        elif self._alone and not self._running:
            job = self._alone.popleft()
        else:
            return None
        self._running.append(job)
        return job

    def finish(self, job: Job, result: Result) -> None:
        """A job came to its end."""
        self._running.remove(job)
        if result.status == BUSY:
            self._later.append((time.monotonic() + ASK_AGAIN, job))
            return
        self._done(job, result)
        for waiting in self._waiting.pop(job.rig, []) if job.kind == "rig" else []:
            if result.status == FAILED:
                self._done(waiting, Result.failed(f"no rig: {result.record.reason}"))
            else:
                self._ready.append(waiting)

    def died(self, job: Job, reason: str) -> None:
        """The process that did the job ended before it."""
        if (job.kind, job.name) in self._died:
            self.finish(job, Result.failed(f"twice, {reason}"))
            return
        self._died.add((job.kind, job.name))
        self._running.remove(job)
        self._alone.append(job)
