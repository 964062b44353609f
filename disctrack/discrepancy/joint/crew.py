"""Objects that hold the recordings' data, in this process or distributed over several.

Each recording stays in one process, and recordings are independent: answers do not depend on the number of processes.
These end when the crew is closed, and with the process that started them.
"""

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
    """Objects made by `build`, one for each item, whose methods are called remotely."""

    def __init__(self, build: Build, items: Sequence[Any], processes: int = 1) -> None:
        """An exception of `build` takes the place of its object, as a DiscTrackError.

        build : a function or class of a module, which other processes can import
        """
        self._kept = list(range(len(items)))  # indices of the objects that are called, in order
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

    def __enter__(self) -> "Crew":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Terminate the processes."""
        for pool in self._pools:
            pool.shutdown(wait=False, cancel_futures=True)
        for process in self._context.started:
            process.terminate()
            process.join()

    def keep(self, numbers: Sequence[int]) -> None:
        """Call only these objects from now on; they are renumbered in this order."""
        self._kept = list(numbers)

    def call(
        self, method: str, arguments: Sequence[tuple[Any, ...]], numbers: Sequence[int] | None = None
    ) -> list[Any]:
        """Results of a method of every object; an exception takes the place of its result, as a DiscTrackError.

        numbers : indices of the objects that are called; by default all
        """
        called = self._kept if numbers is None else [self._kept[i] for i in numbers]
        each = list(zip(called, arguments, strict=True))
        if not self._pools:
            return [_answer(i, method, given, self._here) for i, given in each]
        try:
            begun = [self._pools[i % len(self._pools)].submit(_answer, i, method, given) for i, given in each]
            return [future.result() for future in begun]
        except BrokenProcessPool as error:
            raise AnalysisError(ENDED_EARLY) from error


_objects: dict[int, Any] = {}  # of a worker process


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
    except Exception as error:  # an error of one recording does not stop the others
        return AnalysisError(f"{type(error).__name__}: {error}")
