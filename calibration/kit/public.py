"""Lazy import of the public names of a package."""

import ast
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any


def imported_when_used(file: str) -> tuple[Callable[[str], Any], list[str]]:
    """The package's `__getattr__` and its public names, from the imports `name as name` in its file.

    These are under TYPE_CHECKING, for type checkers, so that each name and its module are stated once.
    """
    imports = [node for node in ast.walk(ast.parse(Path(file).read_bytes())) if isinstance(node, ast.ImportFrom)]
    module_of = {name.asname: str(node.module) for node in imports for name in node.names if name.asname}

    def asked_for(name: str) -> Any:
        if name not in module_of:
            raise AttributeError(f"module {Path(file).parent.name!r} has no attribute {name!r}")
        return getattr(import_module(module_of[name]), name)

    return asked_for, list(module_of)
