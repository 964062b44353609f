"""numba's njit and cfunc, with a memory that knows what it was compiled from.

numba keeps compiled code on disk until the file of the function itself changes. What was compiled into it from other
files (functions that it calls, constants) could change unseen, and the old code would run on. Here it is kept for as
long as the contents of the function's file and of all modules of these packages that it imports are the same; files
that were compiled from others are overwritten. A function that is given helpers from elsewhere names them in an
attribute `compiled_with`.
"""

from __future__ import annotations

import inspect
from typing import Any

from numba import cfunc, njit
from numba.core.caching import CacheImpl

from calibration.sources import PACKAGES, sha256_with_imports

__all__ = ["cfunc", "njit"]


def _aware_of_sources(locator: Any) -> Any:
    """The locator (where compiled code is kept) for functions of these packages, by their sources."""

    class AwareOfSources(locator):
        @classmethod
        def from_function(cls, py_func: Any, py_file: str) -> Any:
            helpers = getattr(py_func, "compiled_with", None)
            if helpers is None and str(py_func.__module__).split(".")[0] not in PACKAGES:
                return None  # a stranger's
            found = super().from_function(py_func, py_file)
            if found is not None:
                try:
                    found.stamp = sha256_with_imports(py_file, *map(inspect.getfile, helpers or ()))
                except OSError:  # typed at a prompt
                    return None
            return found

        def get_source_stamp(self) -> str:
            return str(self.stamp)

        def get_disambiguator(self) -> str:
            return "kept"  # not the line: a function that moves down its file overwrites what was kept of it

    return AwareOfSources


CacheImpl._locator_classes = [*map(_aware_of_sources, CacheImpl._locator_classes), *CacheImpl._locator_classes]
