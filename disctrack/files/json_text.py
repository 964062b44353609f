"""Strict JSON for all our files: without NaN, infinity and NumPy types."""

import json
from dataclasses import is_dataclass
from hashlib import sha256
from typing import Any

import numpy as np


def plain(item: Any) -> Any:
    """The item in JSON types: None for numbers that are not finite, lists for tuples and arrays, text for keys.

    A dataclass becomes a dictionary of its fields.
    """
    if isinstance(item, dict) or is_dataclass(item):
        return {str(key): plain(value) for key, value in (item if isinstance(item, dict) else vars(item)).items()}
    if isinstance(item, list | tuple):
        return [plain(value) for value in item]
    if isinstance(item, np.ndarray | np.generic):
        return plain(item.tolist())
    if isinstance(item, float):
        return item if np.isfinite(item) else None
    return item


def json_text(document: Any, indent: int | None = None) -> str:
    """The document as strict JSON."""
    return json.dumps(plain(document), indent=indent, allow_nan=False)


def json_sha256(document: object) -> str:
    """SHA-256 (hex) of the document as strict JSON; the order of keys does not matter."""
    return sha256(json.dumps(plain(document), sort_keys=True).encode()).hexdigest()


def json_file(document: Any) -> bytes:
    """The document as content of an indented file."""
    return (json_text(document, indent=1) + "\n").encode()
