"""The recordings' data where the work is done: in this process, or dealt out to several.

Each recording stays with one process from beginning to end, and no recording sees another: answers do not depend on
the number of processes. They end when they are closed, and with the process that started them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from disctrack.errors import AnalysisError, DiscTrackError
from disctrack.processes import Spawn, end_with_parent, quietly

Build = Callable[[Any], Any]
ENDED_EARLY = (
    "a process that diagnosed some of the recordings has ended early, as when memory runs out: try again with fewer "
    "processes (-j 1)."
)


class Crew:
    """Objects made by `build` from items, one for each, that answer calls of their methods."""

    def __init__(self, build: Build, items: Sequence[Any], processes: int = 1) -> None:
        """What `build` raises is kept in place of its object, as a DiscTrackError.

        build : a module's function or class, as it has to be found by other processes
        """
        self._kept = list(range(len(items)))  # numbers of the objects that are asked, in their order
        self._here: dict[int, Any] = {}
        self._context, self._pools = Spawn(), list[ProcessPoolExecutor]()
        n = min(processes, len(items))
        if n <= 1:
            _begin(build, dict(enumerate(items)), self._here)
            return
        with quietly():
            self._pools = [ProcessPoolExecutor(1, self._context, end_with_parent) for _ in range(n)]
        try:
            for k, pool in enumerate(self._pools):
                pool.submit(_begin, build, {i: items[i] for i in range(k, len(items), n)})
        except OSError as error:
            self.close()
            raise AnalysisError(ENDED_EARLY) from error

    def __enter__(self) -> Crew:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the processes, whatever they do."""
        for pool in self._pools:
            pool.shutdown(wait=False, cancel_futures=True)
        for process in self._context.started:
            process.terminate()
            process.join()

    def keep(self, numbers: Sequence[int]) -> None:
        """From now on, number objects as these are counted: the others are asked nothing any more."""
        self._kept = list(numbers)

    def call(
        self, method: str, arguments: Sequence[tuple[Any, ...]], numbers: Sequence[int] | None = None
    ) -> list[Any]:
        """Results of a method of every object; a DiscTrackError takes the place of the result that it prevents.

        numbers : of the objects that are asked, as they are counted now; all of them, if not given
        """
        asked = self._kept if numbers is None else [self._kept[i] for i in numbers]
        each = list(zip(asked, arguments, strict=True))
        if not self._pools:
            return [_answer(i, method, given, self._here) for i, given in each]
        try:
            begun = [self._pools[i % len(self._pools)].submit(_answer, i, method, given) for i, given in each]
            return [future.result() for future in begun]
        except BrokenProcessPool as error:
            raise AnalysisError(ENDED_EARLY) from error


_objects: dict[int, Any] = {}  # of a process of its own


def _begin(build: Build, items: dict[int, Any], objects: dict[int, Any] = _objects) -> None:
    objects.update({i: _tried(build, item) for i, item in items.items()})


def _answer(number: int, method: str, arguments: tuple[Any, ...], objects: dict[int, Any] = _objects) -> Any:
    thing = objects[number]
    return thing if isinstance(thing, DiscTrackError) else _tried(getattr(thing, method), *arguments)


def _tried(function: Callable[..., Any], *arguments: Any) -> Any:
    try:
        return function(*arguments)
    except DiscTrackError as error:
        return error
    except Exception as error:  # whatever is wrong with one recording, the others are diagnosed
        return AnalysisError(f"{type(error).__name__}: {error}")
