"""Compiled functions that call each other by address.

The integrator, the equations of motion and the law of every effect are compiled separately, and call each other only by
address. A new effect requires the compilation of one small function, not of the integrator. The field names of the
records are part of each signature. A call by address takes about 3 ns.
"""

import operator
from collections.abc import Callable
from functools import cache, lru_cache
from typing import Any, TypeAlias

import numpy as np
from llvmlite import ir
from numba import from_dtype, types
from numba.core import cgutils
from numba.extending import intrinsic, lower_builtin, register_jitable
from numpy.typing import NDArray

from calibration.kit.compiled import cfunc, compiled, one_at_a_time
from disctrack.rolling.records import BODY, INSTANT, record_dtype

Addresses: TypeAlias = NDArray[np.int64]


@intrinsic
def _call(typingctx, address, pointers):  # type: ignore[no-untyped-def]
    """Call the C function void(void*, ..., void*) at an address; `pointers` is a tuple of addresses."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        pointer = ir.IntType(8).as_pointer()
        given = [builder.inttoptr(a, pointer) for a in cgutils.unpack_tuple(builder, args[1])]
        function = ir.FunctionType(ir.VoidType(), [pointer] * len(given))
        builder.call(builder.inttoptr(args[0], function.as_pointer()), given)
        return context.get_dummy_value()

    return types.void(types.int64, pointers), codegen


call: Any = _call  # the type checker sees the signature that numba uses while compiling


@lower_builtin(operator.truediv, types.complex128, types.complex128)
def _divided(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """Complex division, NaN if the divisor is zero: numba's own raises an error, which a C function cannot pass on."""

    def ratio(a: complex, b: complex) -> complex:  # Smith 1962
        if b.real == 0.0 and b.imag == 0.0:
            return complex(np.nan, np.nan)
        if abs(b.real) >= abs(b.imag):
            r = b.imag / b.real
            d = b.real + b.imag * r
            return complex((a.real + a.imag * r) / d, (a.imag - a.real * r) / d)
        r = b.real / b.imag
        d = b.real * r + b.imag
        return complex((a.real * r + a.imag) / d, (a.imag * r - a.real) / d)

    return context.compile_internal(builder, ratio, signature, arguments)


def _compile(function: Callable[..., None], signature: Any) -> Any:
    with one_at_a_time():
        return compiled(cfunc, signature, function)


def _record(names: tuple[str, ...], scalar: type) -> types.Type:
    return from_dtype(record_dtype(names, scalar))


@cache
def compile_system(function: Callable[..., None], scalar: type) -> Any:
    """f(t, y, out, table, body, instant) as C function; keep the object: it owns the `address`."""
    v = types.CPointer(from_dtype(np.dtype(scalar)))
    records = [_record(names, scalar) for names in (BODY, INSTANT)]
    return _compile(function, types.void(v, v, v, types.CPointer(types.int64), *records))


@lru_cache(maxsize=256)  # several times the size of the catalogue; callers keep their own reference to a law
def compile_law(function: Callable[..., None], parameters: tuple[str, ...], helpers: tuple, scalar: type) -> Any:
    """law(p, s, w) as C function for parameters of these names; `helpers` are Python functions that it may call.

    s and w are the same record: a law reads its kinematics and adds to its wrench.
    """
    for helper in helpers:
        register_jitable(helper)
    return _compile(function, types.void(*(_record(names, scalar) for names in (parameters, INSTANT, INSTANT))))
