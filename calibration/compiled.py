"""numba's njit and cfunc, with a memory that knows what it was compiled from, and code that ships with the packages.

numba keeps compiled code on disk until the file of the function itself changes. What was compiled into it from other
files (functions that it calls, constants) could change unseen, and the old code would run on. Here it is kept for as
long as the contents of the function's file and of all modules of these packages that it imports are the same; files
that were compiled from others are overwritten. A function that is given helpers from elsewhere names them in an
attribute `compiled_with`.

The functions that every user needs ship as machine code (folder `ahead`, written by tests/ship_compiled.py), each for
two levels of x86-64 processors. It is taken as it is, and nothing is written, where sources, types, system, Python
and numba are those that it was made with; everywhere else numba compiles as ever.
"""

from __future__ import annotations

import gzip
import hashlib
import inspect
import io
import pickle
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import llvmlite.binding as llvm
import numba
from numba.core import sigutils
from numba.core.caching import CompileResultCacheImpl, FunctionCache
from numba.core.ccallback import CFunc
from numba.core.runtime import rtsys
from numba.core.serialize import dumps

from calibration.sources import PACKAGES, sha256_with_imports

__all__ = ["cfunc", "dumps", "njit"]

AHEAD = Path(__file__).parent / "ahead"
# Levels of the x86-64 psABI, and what a processor must have for their code, in LLVM's words; the first that fits is
# taken. Code for x86-64-v4 was 6 % slower at tracking than that for v3, on a processor that has both.
_V3 = ("avx", "avx2", "bmi", "bmi2", "cx16", "f16c", "fma", "lzcnt", "movbe", "popcnt", "sahf", "sse4.2", "xsave")
LEVELS = {"x86-64-v3": frozenset(f"+{feature}" for feature in _V3), "x86-64": frozenset[str]()}
# Compiled code meets Python by named functions only, the same in these: code made by the first was tried on all.
SAME_INTERFACE = ((3, 11), (3, 12), (3, 13))


def njit(function: Any = None, *, cache: bool = False, **rules: Any) -> Any:
    """`numba.njit`; with cache=True what is compiled is kept, or taken from what ships.

    In place of the function a signature, or a list of them, may stand: it is compiled for these, now, and no others.
    """
    signatures = None if function is None or inspect.isfunction(function) else function

    def compiled(function: Callable[..., Any]) -> Any:
        dispatcher = numba.njit(**rules)(function)
        if cache:
            dispatcher._cache = _ShippedOrKept(function)
        if signatures is not None:
            for signature in signatures if isinstance(signatures, list) else [signatures]:
                dispatcher.compile(signature)
            dispatcher.disable_compile()
        return dispatcher

    return compiled(function) if inspect.isfunction(function) else compiled


def cfunc(function: Callable[..., Any], signature: Any, *, cache: bool = True, **rules: Any) -> CFunc:
    """As `numba.cfunc`: a C function of these types; with cache=True as with `njit`. Keep it: it owns its address."""
    callback: Any = CFunc(function, sigutils.normalize_signature(signature), {}, rules)
    if cache:
        callback._cache = _ShippedOrKept(function)
    callback.compile()
    return callback


_to_be_told: list[Callable[[], None]] = []


@contextmanager
def when_compiling(tell: Callable[[], None]) -> Iterator[None]:
    """Call `tell` whenever a function that is kept is about to be compiled."""
    _to_be_told.append(tell)
    try:
        yield
    finally:
        _to_be_told.remove(tell)


class _ShippedOrKept(FunctionCache):
    def load_overload(self, sig: Any, target_context: Any) -> Any:
        # Not numba's own way, which first imports all that its compiler may be asked for (0.35 s of processor time):
        # what is kept needs the runtime's memory alone, and whoever compiles imports the rest.
        rtsys.initialize(target_context)
        codegen = target_context.codegen()
        ships = _shipped(self._py_func, sig, self._impl.locator.get_source_stamp(), codegen) if self._enabled else None
        if ships is not None:
            return self._impl.rebuild(target_context, ships)
        kept = None
        try:
            with self._guard_against_spurious_io_errors():
                kept = self._load_overload(sig, target_context)
        except Exception:  # files cut off by a full disk or a lost machine break in any way: as if there were none
            with suppress(OSError):
                self.flush()
        if kept is None:
            for tell in tuple(_to_be_told):
                tell()
        return kept


def shipped_file(function: Callable[..., Any], sig: Any) -> Path:
    """Where the machine code of a function for these argument types is."""
    types = hashlib.sha256(str(sig).encode()).hexdigest()[:8]
    return AHEAD / f"{function.__module__}.{function.__qualname__}-{types}.gz"


def made_for(stamp: str, sig: Any) -> tuple[str, ...]:
    """What must be the same where machine code is made and where it is used."""
    version = tuple(sys.version_info[:2])
    versions = SAME_INTERFACE if version in SAME_INTERFACE else version
    python = f"{sys.implementation.name} {versions}{sys.abiflags}"  # t: a build without its lock, with other objects
    return stamp, str(sig), llvm.get_process_triple(), python, numba.__version__


def _shipped(function: Callable[..., Any], sig: Any, stamp: str, codegen: Any) -> Any:
    """What numba would have kept of the function; None where what ships is for others, or is damaged."""
    able = set(codegen._tm_features.split(","))
    level = next(level for level, needed in LEVELS.items() if needed <= able)
    try:
        # the whole first: only at its end stands the sum by which damage is seen, and machine code must have none
        file = io.BytesIO(gzip.decompress(shipped_file(function, sig).read_bytes()))
        return pickle.loads(pickle.load(file)[level]) if pickle.load(file) == made_for(stamp, sig) else None
    except Exception:  # no file of ours; what is no pickle breaks in any way
        return None


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


_theirs = CompileResultCacheImpl._locator_classes
CompileResultCacheImpl._locator_classes = [*map(_aware_of_sources, _theirs), *_theirs]
