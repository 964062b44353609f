"""Settings as frozen dataclasses, and the TOML text of the same shape: one way and back, for any tree of them.

Fields may be bool, int, float, str, tuples, dictionaries by name, and dataclasses; a Path is not part of the file.
"""

from __future__ import annotations

import json
import types
import typing
from dataclasses import fields, is_dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from disctrack.errors import SceneError


def build(kind: Any, tree: dict[str, Any], where: str, section: str = "") -> Any:
    """Instance of the dataclass `kind` from nested dictionaries; `where` (the file) and `section` are for messages.

    Raises SceneError for an unknown key, naming the nearest known one, and for a value of the wrong kind.
    """
    hints = typing.get_type_hints(kind)
    known = [f.name for f in fields(kind) if hints[f.name] is not Path]
    values = {}
    for key, value in tree.items():
        if key not in known:
            near = get_close_matches(key, known, n=1, cutoff=0.0)
            place = f"[{section}]" if section else "the top level"
            raise SceneError(f"{where}: unknown key '{key}' in {place}; the nearest known key is '{near[0]}'")
        values[key] = _convert(hints[key], value, where, f"{section}.{key}" if section else key)
    return kind(**values)


def _convert(hint: Any, value: Any, where: str, key: str) -> Any:
    """`value` as the annotation `hint` wants it: number, string, tuple of them, dataclass, or mapping."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if is_dataclass(hint) and isinstance(value, dict):
        return build(hint, value, where, key)
    if origin is tuple and isinstance(value, list):
        kinds = [arguments[0]] * len(value) if arguments[-1] is Ellipsis else list(arguments)
        if len(kinds) == len(value):
            return tuple(_convert(k, v, where, key) for k, v in zip(kinds, value, strict=True))
        raise SceneError(f"{where}: {key} has {len(value)} values, {len(kinds)} are expected")
    if origin is dict and isinstance(value, dict):
        return {str(k): _convert(arguments[1], v, where, f"{key}.{k}") for k, v in value.items()}
    if hint is float and isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    if isinstance(hint, type) and not isinstance(hint, types.GenericAlias) and type(value) is hint:
        return value
    wanted = getattr(hint, "__name__", str(hint)) if origin is None else f"a list ({hint})"
    raise SceneError(f"{where}: {key} = {value!r} is of the wrong kind; expected {wanted}")


def toml_lines(settings: Any, name: str = "") -> list[str]:
    """Lines of a TOML file, or of its section `name`, that `build` reads back to an equal dataclass."""
    own, below = ([f"\n[{name}]"] if name else []), []
    for f in fields(settings):
        value = getattr(settings, f.name)
        if isinstance(value, Path):
            continue
        if is_dataclass(value):
            below += toml_lines(value, f"{name}.{f.name}" if name else f.name)
        else:
            own.append(f"{f.name} = {_toml_value(value)}")
    return own + below


def _toml_value(value: Any) -> str:
    if is_dataclass(value):
        value = {f.name: getattr(value, f.name) for f in fields(value)}
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(k)} = {_toml_value(v)}" for k, v in value.items()) + "}"
    if isinstance(value, tuple):
        return "[" + ", ".join(_toml_value(v) for v in value) + "]"
    return json.dumps(value) if isinstance(value, str) else repr(value)
