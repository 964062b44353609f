"""Recordings that are worked on side by side.

They are independent: answers do not depend on the number of threads. Integration and linear algebra, which take most of
the time, do not hold the lock of the interpreter.
"""

from collections.abc import Callable, Iterable
from multiprocessing.pool import ThreadPool
from typing import Any

from disctrack.errors import AnalysisError, DiscTrackError


def side_by_side(function: Callable[..., Any], each: Iterable[tuple[Any, ...]], threads: int = 1) -> list[Any]:
    """Results of a function for these arguments; an exception takes the place of its result, as a DiscTrackError."""

    def tried(arguments: tuple[Any, ...]) -> Any:
        try:
            return function(*arguments)
        except DiscTrackError as error:
            return error
        except Exception as error:  # an error of one recording does not stop the others
            return AnalysisError(f"{type(error).__name__}: {error}")

    with ThreadPool(threads) as pool:
        return pool.map(tried, each, chunksize=1)
