"""Short representation of results: a few facts on one line, or a small table in a notebook."""

from collections.abc import Mapping
from enum import Enum
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

SHOWN_RANGES = 6


def ranges(numbers: ArrayLike) -> str:
    """Ascending numbers (n,) as ranges: 3, 7-9, 12."""
    counted = np.asarray(numbers)
    parts = np.split(counted, np.flatnonzero(np.diff(counted) != 1) + 1)
    shown = [f"{part[0]}" if len(part) == 1 else f"{part[0]}-{part[-1]}" for part in parts[:SHOWN_RANGES]]
    return ", ".join(shown) + (f", ... {len(parts) - SHOWN_RANGES} more" if len(parts) > SHOWN_RANGES else "")


class Brief:
    """A result with a short representation. Dataclasses that inherit it need `repr=False`."""

    def facts(self) -> Mapping[str, str]:
        """Main results, heading -> value with its unit; by default all fields.

        Numbers and words unchanged, arrays by their shape, parts by their name; empty fields are left out.
        """
        shown = {name: _outlined(value) for name, value in vars(self).items()}
        return {name: text for name, text in shown.items() if text}

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(f'{name} {value}' for name, value in self.facts().items())})"

    def _repr_html_(self) -> str:
        rows = "".join(f"<tr><th>{escape(k)}</th><td>{escape(v)}</td></tr>" for k, v in self.facts().items())
        return f"<table><caption>{type(self).__name__}</caption>{rows}</table>"


LONGEST = 60  # characters of a text that is shown whole


def _outlined(value: Any) -> str:
    if isinstance(value, np.ndarray) and value.ndim:
        return " x ".join(map(str, value.shape))
    if isinstance(value, (float, np.ndarray)):
        return f"{value:.6g}"
    if isinstance(value, (tuple, list, Mapping)):
        return str(len(value) or "")
    if isinstance(value, (str, Path, Enum, bool, int)):
        text = value.name if isinstance(value, Enum) else str(value)
        return text if len(text) <= LONGEST else f"{text[: LONGEST - 3]}..."
    return "" if value is None else type(value).__name__
