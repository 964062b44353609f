"""What the packages' sources are: so that nothing made by other sources is taken for theirs."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Collection, Iterator
from functools import cache
from pathlib import Path

PACKAGES = ("calibration", "disctrack")  # side by side
_HOME = Path(__file__).parents[1]
_IMPORTS = re.compile(r"^\s*from ((?:calibration|disctrack)(?:\.\w+)*) import (\([^)]*\)|[^\n]*)", re.MULTILINE)


def sources_sha256(folder: Path, without: Collection[str] = ()) -> str:
    """SHA-256 (hex) of all Python sources in the folder and below, but for some folders directly in it."""
    digest = hashlib.sha256()
    for name, file in sorted(_sources(str(folder), without)):
        with open(file, "rb", buffering=0) as source:
            content = source.read()
        digest.update(f"{name} {len(content)}\n".encode() + content)
    return digest.hexdigest()


def _sources(folder: str, without: Collection[str], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Name relative to the first folder, and path."""
    with os.scandir(folder) as entries:
        for entry in entries:
            if entry.name.endswith(".py"):
                yield prefix + entry.name, entry.path
            elif entry.name not in without and entry.name.isidentifier() and entry.is_dir():
                yield from _sources(entry.path, (), f"{prefix}{entry.name}/")


def sha256_with_imports(*files: str) -> str:
    """SHA-256 (hex) of the files and of every module of these packages that they import, directly or not."""
    digest = hashlib.sha256()
    for file in sorted(_with_imports(files)):
        digest.update(_read(file)[0])
    return digest.hexdigest()


def _with_imports(files: Collection[str]) -> set[str]:
    found: set[str] = set()
    new = set(files)
    while new:
        found |= new
        new = {module for file in new for module in _read(file)[1]} - found
    return found


@cache
def _read(file: str) -> tuple[bytes, frozenset[str]]:
    """SHA-256 of a file, and the files of these packages that it imports."""
    content = Path(file).read_bytes()
    imported: set[str] = set()
    for module, names in _IMPORTS.findall(content.decode("utf-8", "replace")):
        imported.update(_files_of(module))
        for name in re.findall(r"\w+", names):
            imported.update(_files_of(f"{module}.{name}"))  # where it is a module
    return hashlib.sha256(content).digest(), frozenset(imported)


@cache
def _files_of(module: str) -> tuple[str, ...]:
    """The module's file, and that of its package; () where it is none."""
    path = _HOME.joinpath(*module.split("."))
    return tuple(str(file) for file in (path.with_suffix(".py"), path / "__init__.py") if file.is_file())
