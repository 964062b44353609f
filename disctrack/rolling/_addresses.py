"""Calls of compiled functions by their address, from compiled code; apart from all that those functions are made of."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

Addresses: TypeAlias = NDArray[np.int64]


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
