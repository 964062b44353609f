"""Objects that hold the recordings' data, whose methods are called side by side.

Recordings are independent: answers do not depend on the number of threads. Integration and linear algebra, which take
most of the time, do not hold the lock of the interpreter.
"""

from collections.abc import Callable, Sequence
from multiprocessing.pool import ThreadPool
from typing import Any

from disctrack.errors import AnalysisError, DiscTrackError


class Crew:
    """Objects made by `build`, one for each item, whose methods are called side by side."""

    def __init__(self, build: Callable[[Any], Any], items: Sequence[Any], threads: int = 1) -> None:
        """An exception of `build` takes the place of its object, as a DiscTrackError."""
        self._threads = max(1, min(threads, len(items)))
        self._objects = self._side_by_side([(build, item) for item in items])
        self.keep(range(len(items)))

    def keep(self, numbers: Sequence[int]) -> None:
        """Call only these objects from now on; they are renumbered in this order."""
        self._kept = [self._objects[i] for i in numbers]

    def call(
        self, method: str, arguments: Sequence[tuple[Any, ...]], numbers: Sequence[int] | None = None
    ) -> list[Any]:
        """Results of a method of every object; an exception takes the place of its result, as a DiscTrackError.

        numbers : indices of the objects that are called; by default all
        """
        called = self._kept if numbers is None else [self._kept[i] for i in numbers]
        return self._side_by_side(
            [(_method, one, method, *given) for one, given in zip(called, arguments, strict=True)]
        )

    def _side_by_side(self, calls: Sequence[tuple[Any, ...]]) -> list[Any]:
        with ThreadPool(self._threads) as pool:
            return pool.starmap(_tried, calls, chunksize=1)


def _method(thing: Any, name: str, *arguments: Any) -> Any:
    return thing if isinstance(thing, DiscTrackError) else getattr(thing, name)(*arguments)


def _tried(function: Callable[..., Any], *arguments: Any) -> Any:
    try:
        return function(*arguments)
    except DiscTrackError as error:
        return error
    except Exception as error:  # an error of one recording does not stop the others
        return AnalysisError(f"{type(error).__name__}: {error}")
