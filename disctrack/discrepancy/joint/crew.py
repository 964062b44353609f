"""The recordings' data where the work is done: in this process, or dealt out to several.

Each recording stays with one process from beginning to end, and no recording sees another: answers do not depend on
the number of processes. They end when they are closed, and with the process that started them.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from typing import Any

from disctrack.discrepancy.joint.joint_system import Request
from disctrack.discrepancy.joint.reduction import Reduced
from disctrack.errors import AnalysisError, DiscTrackError
from disctrack.recording.readers.blocks import ONE_THREAD

Build = Callable[[Any], Any]
ENDED_EARLY = (
    "a process that diagnosed some of the recordings has ended early, as when memory runs out: try again with fewer "
    'processes (-j 1). In a script of your own the call has to stand under `if __name__ == "__main__":`, as each '
    "process reads the script"
)


class Crew:
    """Objects made by `build` from items, one for each, that answer calls of their methods."""

    def __init__(self, build: Build, items: Sequence[Any], processes: int = 1) -> None:
        """What `build` raises is kept in place of its object, as a DiscTrackError.

        build : a module's function, as it has to be found by other processes
        """
        self.n = len(items)
        self._kept = list(range(self.n))  # numbers of the objects that are asked, in their order
        self._here: dict[int, Any] = {}
        self._workers: list[tuple[Any, Connection]] = []
        n = min(processes, self.n)
        if n <= 1:
            self._here = {i: _built(build, item) for i, item in enumerate(items)}
            return
        context = multiprocessing.get_context("spawn")
        before = {name: os.environ.get(name) for name in ONE_THREAD}
        os.environ.update(ONE_THREAD)
        try:
            with _without_interruptions():
                for _ in range(n):
                    ours, theirs = context.Pipe()
                    process = context.Process(target=_work, args=(theirs, build), daemon=True)
                    process.start()
                    theirs.close()
                    self._workers.append((process, ours))
            # not with the arguments above: starting a process that ends before it has read them never returns
            for k, (_, connection) in enumerate(self._workers):
                connection.send({i: items[i] for i in range(k, self.n, n)})
        except OSError as error:
            self.close()
            raise AnalysisError(ENDED_EARLY) from error
        finally:
            for name, value in before.items():
                if value is None:
                    os.environ.pop(name, None)
                else:
                    os.environ[name] = value

    def __enter__(self) -> Crew:
        return self

    def __exit__(self, error: object, *_: object) -> None:
        self.close(at_once=error is not None)

    def close(self, at_once: bool = False) -> None:
        """End the processes.   at_once : whatever they do, as after Ctrl-C"""
        for process, connection in self._workers:
            connection.close()
            process.join(timeout=0 if at_once else 5)
            if process.is_alive():
                process.terminate()
        self._workers = []

    def keep(self, numbers: Sequence[int]) -> None:
        """From now on, number objects as these are counted: the others are asked nothing any more."""
        self._kept = list(numbers)

    def call(self, method: str, arguments: Sequence[tuple[Any, ...]]) -> list[Any]:
        """Results of a method of every object; a DiscTrackError takes the place of the result that it prevents."""
        numbers = self._kept
        if not self._workers:
            return [_answer(self._here[i], method, a) for i, a in zip(numbers, arguments, strict=True)]
        n = len(self._workers)
        asked: list[list[int]] = [[] for _ in range(n)]
        for i in numbers:
            asked[i % n].append(i)
        by_number = dict(zip(numbers, arguments, strict=True))
        try:
            for mine, (_, connection) in zip(asked, self._workers, strict=True):
                connection.send((method, [(i, by_number[i]) for i in mine]))
            found: dict[int, Any] = {}
            for mine, (_, connection) in zip(asked, self._workers, strict=True):
                found.update(zip(mine, connection.recv(), strict=True))
        except (EOFError, OSError) as error:
            raise AnalysisError(ENDED_EARLY) from error
        return [found[i] for i in numbers]

    def ask(self, number: int, method: str, *arguments: Any) -> Any:
        """Result of a method of one object, as they are counted now."""
        everyone = self._kept
        self._kept = [everyone[number]]
        try:
            return self.call(method, [arguments])[0]
        finally:
            self._kept = everyone

    def reduce(self, requests: Sequence[Request]) -> list[Reduced | None]:
        """What each recording says of its shared quantities."""
        found = self.call("reduce", [(values, names) for _, values, names in requests])
        return [None if isinstance(answer, DiscTrackError) else answer for answer in found]


@contextlib.contextmanager
def _without_interruptions() -> Iterator[None]:
    """Processes that are started within know nothing of Ctrl-C: this one hears it, once it is over, and ends them."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    resource_tracker.ensure_running()  # which, where it is started with the first process, lets them through again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _built(build: Build, item: Any) -> Any:
    try:
        return build(item)
    except DiscTrackError as error:
        return error
    except Exception as error:  # whatever is wrong with one recording, the others are diagnosed
        return AnalysisError(f"{type(error).__name__}: {error}")


def _answer(thing: Any, method: str, arguments: tuple[Any, ...]) -> Any:
    if isinstance(thing, DiscTrackError):
        return thing
    try:
        return getattr(thing, method)(*arguments)
    except DiscTrackError as error:
        return error
    except Exception as error:
        return AnalysisError(f"{type(error).__name__}: {error}")


def _work(connection: Connection, build: Build) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        objects = {i: _built(build, item) for i, item in connection.recv().items()}
    except (EOFError, OSError):
        return
    while True:
        try:
            method, requests = connection.recv()
        except (EOFError, OSError):
            return
        connection.send([_answer(objects[i], method, arguments) for i, arguments in requests])
