"""What the public functions are given: taken where it makes sense, refused at once where it does not.

`checked` reads a function's annotations. An object of the package may be given as the file that holds it, or as a
result that carries it; a number has the unit and the range of its `Range`.
"""

import functools
import inspect
import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from numbers import Real
from typing import Annotated, Any, ParamSpec, TypeVar, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from disctrack.errors import ArgumentError

P = ParamSpec("P")
R = TypeVar("R")

# What a file, a folder or another object stands for: class -> the public function that reads it, ...
READ_BY = {"Recording": "read_recording", "StereoRig": "read_rig", "Trajectory": "read_trajectory"}
# ... and the attribute of other objects that holds it.
HELD_AS = {"StereoRig": "rig", "Disc": "disc", "Trajectory": "trajectory"}


@dataclass(frozen=True)
class Range:
    """A number above `above`, at most `most`, in `unit`."""

    unit: str
    above: float = 0.0
    most: float = math.inf

    def of(self, value: Any, name: str) -> float:
        """The value as a float. Raises ArgumentError."""
        number = isinstance(value, Real) and not isinstance(value, bool | np.bool_)
        if number and math.isfinite(value) and self.above < value <= self.most:
            return float(value)
        most = f" and at most {self.most:g}" if math.isfinite(self.most) else ""
        raise ArgumentError(f"{name} is {_short(value)}; expected a number above {self.above:g}{most}, in {self.unit}")


FrameRate = Annotated[float, Range("Hz", most=1e8)]  # beyond what any camera does
Seconds = Annotated[float, Range("s")]
Gravity = Annotated[float, Range("m/s^2", most=100.0)]


def checked(function: Callable[P, R]) -> Callable[P, R]:
    """The function, with arguments as its annotations want them. Raises ArgumentError."""
    signature = inspect.signature(function)
    what = function.__qualname__.removesuffix(".__init__")

    @functools.wraps(function)
    def with_checked(*given: P.args, **named: P.kwargs) -> R:
        try:
            bound = signature.bind(*given, **named)
        except TypeError as error:
            raise ArgumentError(f"{what}{signature}: {error}") from error
        for name, kind in _wanted(function).items():
            if name in bound.arguments:
                bound.arguments[name] = _as(bound.arguments[name], kind, f"{what}: {name}")
        return function(*bound.args, **bound.kwargs)

    return with_checked


@functools.cache
def _wanted(function: Callable[..., Any]) -> dict[str, Any]:
    hints = get_type_hints(function, include_extras=True)
    return {name: kind for name, kind in hints.items() if name != "return" and _is_checked(kind)}


def _is_checked(kind: Any) -> bool:
    if get_origin(kind) is Annotated:
        return any(isinstance(part, Range) for part in get_args(kind))
    return isinstance(kind, type) and (kind.__name__ in READ_BY or kind.__name__ in HELD_AS)


def _as(value: Any, kind: Any, name: str) -> Any:
    if get_origin(kind) is Annotated:
        return next(part for part in get_args(kind) if isinstance(part, Range)).of(value, name)
    if isinstance(value, kind):
        return value
    reader = READ_BY.get(kind.__name__)
    if reader and isinstance(value, str | os.PathLike):
        return getattr(import_module("disctrack"), reader)(value)
    held = getattr(value, HELD_AS.get(kind.__name__, ""), None)
    if isinstance(held, kind):
        return held
    of_file = " or the path of its file or folder" if reader else ""
    raise ArgumentError(f"{name} is {_short(value)}; expected a {kind.__name__}{of_file}")


def _short(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"an array of shape {value.shape}, {value.dtype}"
    text = repr(value)
    return text if len(text) <= 60 else f"a {type(value).__name__}"


def grey_values(image: Any, name: str) -> NDArray[Any]:
    """An image or many, of any real type, as uint8 or uint16: fractions of 1 as 65535ths, other numbers rounded.

    Raises ArgumentError where a value is none, negative, or above 65535.
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
