"""Every public function says at once what it got and what it wants, whichever of its arguments is wrong."""

import inspect
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

import numpy as np
import pytest

import calibration
import disctrack
from disctrack.errors import ArgumentError

MADE = {"Board", "Camera", "Observations", "StereoRig"}
MADE |= {"Disc", "Model", "Provenance", "State", "Tracker"}
OFFERED = {name: getattr(package, name) for package in (calibration, disctrack) for name in package.__all__}
PUBLIC = {name: item for name, item in OFFERED.items() if inspect.isfunction(item) or name in MADE}
PLAIN = {str: "text", float: 0.5, int: 1, bool: True, Path: Path("x"), os.PathLike[str]: Path("x"), NoneType: None}


def stand_in(kind: Any) -> Any:
    """Something of this kind, which no function would get far with."""
    origin, parts = get_origin(kind), get_args(kind)
    if kind in PLAIN:
        return PLAIN[kind]
    if origin in (Union, UnionType):
        return stand_in(parts[0])
    if origin is Annotated:
        return max(parts[1].least, 1.0) if parts[0] in (int, float) else np.zeros(1)
    if origin is np.ndarray:
        return np.zeros(1)
    if origin is tuple:
        return tuple(stand_in(part) for part in parts if part is not ...)
    if origin is not None:
        return len if origin is Callable else {} if issubclass(origin, Mapping) else ()
    return (tuple if issubclass(kind, tuple) else object).__new__(kind)


@pytest.mark.parametrize("name", PUBLIC)
def test_a_wrong_argument_is_refused_by_its_name(name):
    function = PUBLIC[name]
    hints = get_type_hints(function.__init__ if isinstance(function, type) else function, include_extras=True)
    parameters = [p for p in inspect.signature(function).parameters.values() if p.kind is not p.VAR_KEYWORD]
    right = {p.name: stand_in(hints[p.name]) for p in parameters}
    for p in parameters:
        with pytest.raises(ArgumentError, match=rf"{name}: {p.name} is .*; expected"):
            function(**right | {p.name: object()})
    with pytest.raises(ArgumentError, match=r"unexpected keyword argument|missing a required argument"):
        function(**{"not_an_argument": 1})
