"""One BLAS thread in the time-critical functions of both packages, for all callers.

Their matrices are small: synchronising threads costs more processor time than the product, and many times more on a
busy machine.
"""

from collections.abc import Callable
from typing import Any, TypeVar, cast

from threadpoolctl import threadpool_limits

Function = TypeVar("Function", bound=Callable[..., Any])


def one_blas_thread(function: Function) -> Function:
    """The function, with one thread for linear algebra until it returns; then the caller's setting is restored."""
    return cast(Function, threadpool_limits.wrap(limits=1, user_api="blas")(function))
