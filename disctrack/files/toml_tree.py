"""TOML files: reading with errors that name the file; conversion to frozen dataclasses, and back to text.

Fields may be bool, int, float, str, tuples, dictionaries by name, and dataclasses; a Path is not part of the file.
Numbers are within the limits of a `limited` field, otherwise within +-MOST.
"""

import json
import math
import re
import tomllib
import typing
from dataclasses import Field, field, fields, is_dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np

from disctrack.errors import DiscTrackError, SceneError, told_as
from disctrack.files.whole import MOST_TEXT, read_regular

MOST = 1e7  # of a number; lengths, angles, rates, grey values and frame counts of a laboratory are smaller
NOT_NEGATIVE, POSITIVE = (0.0, MOST), (1 / MOST, MOST)  # the reciprocal of a positive number is within the limits, too


def limited(default: Any, limits: tuple[float, float]) -> Any:
    """Field of a dataclass whose numbers must be within limits."""
    return field(default=default, metadata={"limits": limits})


def read_toml(path: Path, error: type[DiscTrackError]) -> dict[str, Any]:
    """Content of the file. Raises `error` with the file, the problem, and a remedy."""
    with told_as(error, f"{path}: cannot be read", OSError, then="Give the path of a TOML file."):
        content = read_regular(path, MOST_TEXT)
    try:
        return tomllib.loads(content.decode())
    # not text, not TOML, nested too deeply, or a number of thousands of digits
    except (ValueError, RecursionError) as reason:
        place = re.search(r"at line (\d+)", str(reason))
        line = content.decode().splitlines()[int(place[1]) - 1].strip()[:80] if place else ""
        hint = " Numbers have a point: 37.5." if re.search(r"= *-?\d+,\d", line) else ""
        hint += " Folders are divided by /." if "\\" in line else ""
        raise error(
            f"{path}: not valid TOML: {reason}{f': {line}' if line else ''}. Correct that, in UTF-8; if this is not a "
            f"TOML file, give the right one.{hint}"
        ) from reason


def build(kind: Any, tree: dict[str, Any], where: str, section: str = "") -> Any:
    """Instance of the dataclass `kind` from nested dictionaries; `where` (the file) and `section` are for messages.

    Raises SceneError for an unknown key, with the nearest known one, and for a value of the wrong type.
    """
    hints = typing.get_type_hints(kind)
    known = {f.name: f for f in fields(kind) if hints[f.name] is not Path}
    values = {}
    for key, value in tree.items():
        if key not in known:
            near = get_close_matches(key, known, n=1, cutoff=0.0)
            place = f"[{section}]" if section else "the top level"
            raise SceneError(f"{where}: unknown key '{key}' in {place}; the nearest known key is '{near[0]}'")
        values[key] = _convert(hints[key], value, where, f"{section}.{key}" if section else key, known[key])
    return kind(**values)


def _convert(hint: Any, value: Any, where: str, key: str, f: Field) -> Any:
    """`value` of the field f converted to its annotation `hint`: number, string, tuple, dataclass, or mapping."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if is_dataclass(hint) and isinstance(value, dict):
        return build(hint, value, where, key)
    if origin is tuple and isinstance(value, list):
        kinds = [arguments[0]] * len(value) if arguments[-1] is Ellipsis else list(arguments)
        if len(kinds) == len(value):
            return tuple(_convert(k, v, where, key, f) for k, v in zip(kinds, value, strict=True))
        raise SceneError(f"{where}: {key} has {len(value)} values, {len(kinds)} are expected")
    if origin is dict and isinstance(value, dict):
        return {str(k): _convert(arguments[1], v, where, f"{key}.{k}", f) for k, v in value.items()}
    if type(value) in (int, hint) and hint in (int, float):
        least, most = f.metadata.get("limits", (-MOST, MOST))
        not_given = f.default is math.nan and math.isnan(value)
        if not (least <= value <= most or not_given):
            raise SceneError(f"{where}: {key} = {value}; expected a number from {least:g} to {most:g}")
        return hint(value)
    if type(value) is hint:
        return value
    wanted = getattr(hint, "__name__", str(hint)) if origin is None else f"a list ({hint})"
    raise SceneError(f"{where}: {key} = {value!r} is of the wrong kind; expected {wanted}")


def toml_lines(settings: Any, name: str = "") -> list[str]:
    """Lines of a TOML file, or of its section `name`, that `build` reads back to an equal dataclass."""
    own, below = ([f"\n[{name}]"] if name else []), []
    for key, value in vars(settings).items():
        if is_dataclass(value):
            below += toml_lines(value, f"{name}.{key}" if name else key)
        elif not isinstance(value, Path):
            own.append(f"{key} = {toml_value(value)}")
    return own + below


def toml_value(value: Any) -> str:
    """A value as TOML writes it."""
    if is_dataclass(value):
        value = vars(value)
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_text(str(k))} = {toml_value(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(toml_value(v) for v in value) + "]"
    if isinstance(value, bool):
        return str(value).lower()
    return _text(value) if isinstance(value, str) else repr(value)


def _text(value: str) -> str:
    # JSON escapes are valid TOML, except surrogate pairs, which are avoided here, and DEL, which TOML must escape
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
