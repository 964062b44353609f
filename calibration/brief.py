"""How results show themselves: a few facts on one line, or as a small table in a notebook."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape


class Brief:
    """A result that holds large arrays and is shown by a few facts. Dataclasses that inherit it take `repr=False`."""

    def facts(self) -> Mapping[str, str]:
        """What a glance should tell: heading -> value with its unit."""
        raise NotImplementedError

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(f'{name} {value}' for name, value in self.facts().items())})"

    def _repr_html_(self) -> str:
        rows = "".join(f"<tr><th>{escape(k)}</th><td>{escape(v)}</td></tr>" for k, v in self.facts().items())
        return f"<table><caption>{type(self).__name__}</caption>{rows}</table>"
