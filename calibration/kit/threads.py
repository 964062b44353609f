"""One thread for BLAS in our own hot parts, whoever calls them: a script, a notebook, a batch or the command line.

Their matrices are small. Threads that wait for each other's part of a small product cost more processor time than the
product, and many times more on a busy machine.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

from threadpoolctl import threadpool_limits

Function = TypeVar("Function", bound=Callable[..., Any])


def one_blas_thread(function: Function) -> Function:
    """The function, with one thread for linear algebra until it returns; the caller's own setting holds again then."""
    return cast(Function, threadpool_limits.wrap(limits=1, user_api="blas")(function))
