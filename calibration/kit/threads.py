"""One thread for BLAS in our own hot parts, whoever calls them: a script, a notebook, a batch or the command line.

Their matrices are small. Threads that wait for each other's part of a small product cost more processor time than the
product, and many times more on a busy machine.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

from threadpoolctl import threadpool_limits

P = ParamSpec("P")
R = TypeVar("R")


def one_blas_thread(function: Callable[P, R]) -> Callable[P, R]:
    """The function, with one thread for linear algebra until it returns; the caller's own setting holds again then."""

    @wraps(function)
    def limited(*arguments: P.args, **named: P.kwargs) -> R:
        with threadpool_limits(limits=1, user_api="blas"):
            return function(*arguments, **named)

    return limited
