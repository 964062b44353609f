"""Types of both packages: arrays, and arguments of public functions, converted to their annotations and checked.

An object of the packages may be given as the file that contains it, or as a result that contains it: its class states
the reader in `read_by`, and the attribute of other results in `held_as`. A number has the unit and the bounds of its
`Range`. Other conditions are checked by the functions.
"""

import functools
import inspect
import math
import os
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from numbers import Integral, Real
from pathlib import Path
from pkgutil import resolve_name
from types import NoneType, UnionType
from typing import Annotated, Any, TypeVar, Union, cast, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibration.kit.errors import ArgumentError

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
AnyArray = NDArray  # of another type: grey values, records, variables of a file
Indices = NDArray[np.intp]
Codes = NDArray[np.uint8]  # members of an IntEnum
Numbers = NDArray[np.inexact[Any]]  # real, or complex if imaginary parts carry derivatives
Array32 = NDArray[np.float32]
Image = NDArray[np.uint8] | NDArray[np.uint16]  # one image or a stack, as a camera records it


def robust_sigma(values: NDArray[np.floating]) -> float:
    """Standard deviation from the median absolute deviation, robust against outliers."""
    return 1.4826 * float(np.median(np.abs(values - np.median(values))))


def evenly(n: int, most: int) -> list[int]:
    """Indices of at most `most` of n items, evenly spaced."""
    return sorted({round(i) for i in np.linspace(0, n - 1, min(n, most))})


T = TypeVar("T", bound=Callable[..., Any])
Sizes = TypeVar("Sizes", float, NDArray[np.float64])


@dataclass(frozen=True)
class Range:
    """A number from `least` to `most`, in `unit`; or an array of them."""

    unit: str
    least: float = -math.inf
    most: float = math.inf

    def __str__(self) -> str:
        most = f" to {self.most:g}" if math.isfinite(self.most) else " on"
        return f"a number from {self.least:g}{most}, in {self.unit}"

    def take(self, number: Sizes) -> Sizes:
        """The number, unchanged. Raises ValueError."""
        if not np.all(np.isfinite(number) & (self.least <= number) & (number <= self.most)):
            raise ValueError
        return number


FrameRate = Annotated[float, Range("Hz", 1e-3, 1e8)]  # more than any camera has
Seconds = Annotated[float, Range("s", 1e-6)]
Gravity = Annotated[float, Range("m/s^2", 1e-3, 100.0)]
Thickness = Annotated[float, Range("m", 0.0, 1.0)]
Length = Annotated[float, Range("m", 1e-12, 10.0)]  # a disc may be as thin as in theory
Mass = Annotated[float, Range("kg", 1e-6, 1e4)]
Density = Annotated[float, Range("kg/m^3", 0.0, 1e3)]
Threads = Annotated[int, Range("threads", 1, 10_000)]
Times = Annotated[ArrayLike, Range("s")]


def checked(target: T) -> T:
    """A function or class whose arguments are converted to their annotations. Raises ArgumentError."""
    if isinstance(target, type):
        target.__init__ = checked(target.__init__)  # type: ignore[misc]
        return cast("T", target)
    signature = inspect.signature(target)
    what = target.__qualname__.removesuffix(".__init__")

    @functools.wraps(target)
    def with_checked(*given: Any, **named: Any) -> Any:
        try:
            bound = signature.bind(*given, **named)
        except TypeError as error:
            raise ArgumentError(f"{what}: {error}; it takes {signature}") from error
        hints = _hints(target, include_extras=True)
        for name, value in bound.arguments.items():
            if name in hints:
                bound.arguments[name] = _as(value, hints[name], f"{what}: {name}")
        return target(*bound.args, **bound.kwargs)

    return cast("T", with_checked)


_hints = functools.cache(get_type_hints)  # not before a call: annotations may name what is defined later


def _as(value: Any, kind: Any, name: str) -> Any:
    try:
        return _fit(value, kind)
    except (TypeError, ValueError):
        raise ArgumentError(f"{name} is {_short(value)}; expected {_rule(kind)[1]}") from None


def _fit(value: Any, kind: Any) -> Any:
    """The value converted to the kind. Raises TypeError, ValueError."""
    return value if isinstance(kind, type) and type(value) is kind else _rule(kind)[0](value)


Rule = tuple[Callable[[Any], Any], str]  # converter (raises TypeError, ValueError), and what is expected, in words


@functools.cache
def _rule(kind: Any) -> Rule:
    origin, parts = get_origin(kind), get_args(kind)
    if kind in _PLAIN:
        return _PLAIN[kind]
    if origin is Annotated:
        kind, limits = parts
        if kind == ArrayLike:
            return lambda value: limits.take(_array(value).astype(float)), f"numbers in {limits.unit}"
        return lambda value: limits.take(_fit(value, kind)), str(limits)
    if origin in (Union, UnionType):
        options = dict.fromkeys(_rule(option)[1] for option in parts if option is not NoneType)
        return lambda value: _first_that_fits(value, parts), " or ".join(options)
    if origin is np.ndarray:
        return _array, "an array of numbers"
    if isinstance(origin, type):
        if "__call__" in vars(origin):  # of a function
            return lambda value: _collection(value, origin, parts), "a function"
        inner = ", ".join(_rule(part)[1] for part in parts if part is not ...)
        words = f"a {origin.__name__.lower()} of ({inner})"
        return lambda value: _collection(value, origin, parts), words
    path = " or the path of its file or folder" if getattr(kind, "read_by", "") else ""
    name = getattr(kind, "__name__", str(kind))
    expected = f"{'an' if name[0] in 'AEIO' else 'a'} {name}{path}"
    return lambda value: _object(value, kind) if isinstance(kind, type) else value, expected


def _first_that_fits(value: Any, options: tuple[Any, ...]) -> Any:
    """The value converted to the first of several kinds that is possible."""
    for option in sorted(options, key=lambda option: type(value) is not option):  # its own type first
        with suppress(TypeError, ValueError):
            return _fit(value, option)
    raise TypeError


def _collection(value: Any, kind: type, parts: tuple[Any, ...]) -> Any:
    """A collection with converted members; an array is a collection, text is not."""
    if kind is tuple and parts[-1] is not ...:
        if not isinstance(value, tuple | list):
            raise TypeError
        return tuple(_fit(v, part) for v, part in zip(value, parts, strict=True))
    listed = isinstance(value, list | tuple | np.ndarray) and issubclass(tuple, kind)
    fits = listed or (isinstance(value, kind) and not isinstance(value, str | bytes))
    if not fits or isinstance(value, Mapping) != issubclass(kind, Mapping):
        raise TypeError
    if listed and parts:
        members = [_fit(member, parts[0]) for member in value]
        return value if isinstance(value, np.ndarray) else type(value)(members)
    return value


def _object(value: Any, kind: type) -> Any:
    """An object of a class, also from its file or from a result that contains it."""
    if isinstance(value, kind):
        return value
    if (reader := getattr(kind, "read_by", "")) and isinstance(value, str | os.PathLike):
        return resolve_name(reader)(value)
    held = getattr(value, getattr(kind, "held_as", ""), None)
    if not isinstance(held, kind):
        raise TypeError
    return held


def _of(*kinds: type, into: Callable[[Any], Any] = lambda value: value) -> Callable[[Any], Any]:
    """Converter for a value of one of these types; True is no number."""

    def taken(value: Any) -> Any:
        if not isinstance(value, kinds) or (isinstance(value, bool | np.bool_) and bool not in kinds):
            raise TypeError
        return into(value)

    return taken


def _array(value: Any) -> NDArray[Any]:
    array = np.asarray(value)
    if array.dtype.kind not in "biufc":
        raise TypeError
    return array


_PLAIN: dict[Any, Rule] = {
    NoneType: (_of(NoneType), "None"),
    bool: (_of(bool, np.bool_), "True or False"),
    int: (_of(Integral, into=int), "a whole number"),
    float: (_of(Real, into=lambda value: Range("").take(float(value))), "a finite number"),
    str: (_of(str), "text"),
    Path: (_of(str, os.PathLike), "a path"),
    os.PathLike[str]: (_of(os.PathLike), "a path"),
    Any: (lambda value: value, "anything"),
}


def _short(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"an array of shape {value.shape}, {value.dtype}"
    text = repr(value)
    return text if len(text) <= 60 else f"a {type(value).__name__}"


def grey_values(image: Any, name: str) -> NDArray[Any]:
    """One or more images of any real type as uint8 or uint16: fractions of 1 are scaled by 65535, others rounded.

    Raises ArgumentError if a value is NaN, negative, or above 65535.
    """
    pixels = np.asarray(image)
    if pixels.dtype in (np.uint8, np.uint16):
        return pixels
    if pixels.dtype.kind not in "biuf":
        raise ArgumentError(f"{name}: images of type {pixels.dtype}; expected grey values, e.g. uint8 or uint16")
    if not np.isfinite(pixels).all():
        raise ArgumentError(f"{name}: not every grey value is a number; expected values from 0 on")
    if pixels.size and not 0 <= pixels.min() <= pixels.max() <= 65535:
        raise ArgumentError(f"{name}: grey values {pixels.min():g} to {pixels.max():g}; expected 0 to 1, or 0 to 65535")
    scale = 65535.0 if pixels.dtype.kind == "f" and pixels.size and pixels.max() <= 1 else 1.0
    return np.asarray(np.rint(scale * pixels.astype(float)), np.uint16)
