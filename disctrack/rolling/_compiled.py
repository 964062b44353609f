"""Compiled functions that call each other by address.

The integrator, the equations of motion and the law of every effect are compiled separately and cached separately (by
their own source file), and meet only through addresses. So a new effect costs the compilation of one small function,
never that of the integrator, and a cached integrator can never hold an outdated copy of a law. The records' field names
are part of each signature: a changed layout recompiles what depends on it. A call by address costs about 3 ns.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, lru_cache
from typing import Any

import numpy as np
from llvmlite import ir
from numba import from_dtype, types
from numba.extending import intrinsic, register_jitable

from calibration.compiled import cfunc
from disctrack.rolling.records import BODY, KINEMATICS, WRENCH, record_dtype


def _call_by_address(n_pointers: int) -> Callable[..., Any]:
    """Intrinsic call(address, p1, ..., pn): calls the C function void(void*, ..., void*) at `address`."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        pointer = ir.IntType(8).as_pointer()
        function = ir.FunctionType(ir.VoidType(), [pointer] * n_pointers)
        target = builder.inttoptr(args[0], function.as_pointer())
        builder.call(target, [builder.inttoptr(a, pointer) for a in args[1:]])
        return context.get_dummy_value()

    return codegen


@intrinsic
def _call_law(typingctx, address, p, s, w):  # type: ignore[no-untyped-def]
    """Law at `address` with its parameters, the kinematics and the wrench, all as addresses."""
    return types.void(types.int64, types.int64, types.int64, types.int64), _call_by_address(3)


@intrinsic
def _call_system(typingctx, address, t, y, out, a0, a1, a2, a3):  # type: ignore[no-untyped-def]
    """System function f(t, y, out, a0, a1, a2, a3) at `address`; all arguments are addresses."""
    return types.void(*[types.int64] * 8), _call_by_address(7)


call_law: Any = _call_law  # the type checker takes an intrinsic for what numba calls while compiling
call_system: Any = _call_system


def _pointer(scalar: type) -> types.Type:
    return types.CPointer(from_dtype(np.dtype(scalar)))


def _record(names: tuple[str, ...], scalar: type) -> types.Type:
    return from_dtype(record_dtype(names, scalar))


def _compile(function: Callable[..., None], signature: Any) -> Any:
    # error_model: a division by zero gives inf or nan, as in NumPy; the integrator then refuses the step
    try:
        return cfunc(signature, cache=True, error_model="numpy")(function)
    except RuntimeError:  # numba: "no locator available": typed at a prompt, there is no file to put a cache beside
        return cfunc(signature, error_model="numpy")(function)


@cache
def compile_system(function: Callable[..., None], scalar: type) -> Any:
    """f(t, y, out, table, body, kinematics, wrench) as C function; keep the object: it owns the `address`."""
    v = _pointer(scalar)
    records = [_record(names, scalar) for names in (BODY, KINEMATICS, WRENCH)]
    return _compile(function, types.void(v, v, v, types.CPointer(types.int64), *records))


@lru_cache(maxsize=256)  # the catalogue several times over; whoever calls a law holds it himself
def compile_law(function: Callable[..., None], parameters: tuple[str, ...], helpers: tuple, scalar: type) -> Any:
    """law(p, s, w) as C function for parameters of these names; `helpers` are Python functions that it may call."""
    for helper in helpers:
        register_jitable(helper)
    function.compiled_with = helpers  # type: ignore[attr-defined]  # what is kept on disk depends on them, too
    records = [_record(names, scalar) for names in (parameters, KINEMATICS, WRENCH)]
    return _compile(function, types.void(*records))
