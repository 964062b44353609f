"""Linear algebra has one thread in our own hot parts, and the caller's own before and after."""

import numpy as np
from threadpoolctl import threadpool_info, threadpool_limits

from calibration.kit.threads import one_blas_thread


def threads() -> set[int]:
    np.ones((2, 2)) @ np.ones((2, 2))
    return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}


def test_inside_there_is_one_thread_and_afterwards_as_many_as_before():
    with threadpool_limits(limits=2, user_api="blas"):
        before = threads()
        inside = one_blas_thread(threads)()
        assert threads() == before
    assert inside == {1}
    assert before == {2}  # otherwise nothing was limited
