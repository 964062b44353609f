"""Folders below a folder, as a user sees them: links are followed, what is hidden is not."""

import os
from collections.abc import Callable, Iterator
from pathlib import Path


def folders_below(
    root: Path, seen: set[Path], failed: Callable[[OSError], object] | None = None
) -> Iterator[tuple[Path, list[str], list[str]]]:
    """The folder and all below it, each once, with the names of folders and files in it.

    The names of folders may be taken out, as of `os.walk`: those are not looked into.
    seen : folders, without links on the way to them, that are not looked into again; grows
    failed : is told of folders that cannot be read
    """
    for place, inside, names in os.walk(root, onerror=failed, followlinks=True):
        real = Path(place).resolve()
        inside[:] = sorted(name for name in inside if not name.startswith(".") and real not in seen)
        if real not in seen:
            seen.add(real)
            yield Path(place), inside, [name for name in names if not name.startswith(".")]
