"""A process that does jobs: reads one per line from stdin, writes progress and results as lines to stdout.

It ends when its stdin does: with the batch that started it, however that ended, even in the middle of a job.
"""

import json
import os
import queue
import signal
import sys
import threading
import time
from types import FrameType
from typing import Any, TextIO

PROGRESS_EVERY = 0.1  # [s]
GRACE = 3.0  # [s] to clear up after its batch has gone


def main() -> None:
    """Serve until stdin ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # of the terminal; the batch decides what becomes of its workers
    signal.signal(signal.SIGTERM, _stop)
    lines: queue.Queue[str | None] = queue.Queue()
    busy = threading.Event()
    threading.Thread(target=_listen, args=(lines, busy), daemon=True).start()
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # whatever a library prints must not mix with the answers

    import cv2

    cv2.setNumThreads(1)  # the others have the cores
    from disctrack.batch.measure import do
    from disctrack.batch.plan import Job

    while (line := lines.get()) is not None:
        busy.set()
        result = do(Job.from_json(line), _Teller(answers))
        busy.clear()
        _tell(answers, result.as_dict())


def _stop(number: int, frame: FrameType | None) -> None:
    """Leave by way of the blocks that remove half-written files."""
    sys.exit(128 + number)


def _listen(lines: queue.Queue[str | None], busy: threading.Event) -> None:
    for line in sys.stdin:
        lines.put(line)
    lines.put(None)
    if busy.is_set():
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(GRACE)
        os._exit(1)


class _Teller:
    """Tells the share done, from any thread, and not more often than anyone can read."""

    def __init__(self, answers: TextIO) -> None:
        self.answers = answers
        self.last = 0.0
        self.lock = threading.Lock()

    def __call__(self, share: float) -> None:
        with self.lock:
            now = time.monotonic()
            if now - self.last > PROGRESS_EVERY:
                self.last = now
                _tell(self.answers, {"share": share})


def _tell(answers: TextIO, message: dict[str, Any]) -> None:
    try:
        answers.write(json.dumps(message) + "\n")
        answers.flush()
    except OSError:  # nobody listens any more; not an error of the recording
        sys.exit(1)


if __name__ == "__main__":
    main()
