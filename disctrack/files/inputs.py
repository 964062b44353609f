"""No output replaces an input: what a command has read, or what a recording names, is kept whatever the user allows."""

import contextlib
import glob
import os
import tomllib
from collections.abc import Iterator
from pathlib import Path

from disctrack.errors import OutputError

RECORDING_FILE = "recording.toml"
_LEVELS = 4  # folders above an output in which a recording may lie that names it

_read: dict[tuple[int, int], Path] | None = None  # by device and inode; None outside a command


@contextlib.contextmanager
def inputs_kept() -> Iterator[None]:
    """Within the block nothing that `keep` is told of can be replaced. A library's user may do as he likes."""
    global _read
    before, _read = _read, {}
    try:
        yield
    finally:
        _read = before


def keep(path: Path) -> None:
    """Tell of a file that the command reads and does not itself make."""
    if _read is not None and (file := _file(path)) is not None:
        _read[file] = path


def refuse_input(path: Path) -> None:
    """Raise OutputError if an output of this name would replace an input, also through links or another spelling."""
    file = _file(path)
    if file is None:
        return
    if _read and file in _read:
        also = f" (as {_read[file]})" if _read[file] != path else ""
        raise OutputError(f"{path}: is read by this command{also}, and no output replaces an input. {_ELSEWHERE}")
    if (recording := _named_by(path)) is not None:
        raise OutputError(
            f"{path}: belongs to the recording {recording}, and no output replaces an input. {_ELSEWHERE}"
        )


_ELSEWHERE = "Choose another place with -o."


def _name(path: Path) -> str:
    """The place that a path means, without links on the way to it; the last step may be a link itself."""
    path = Path(os.path.abspath(path))
    return os.path.normcase(os.path.join(os.path.realpath(path.parent), path.name))


def _file(path: Path) -> tuple[int, int] | None:
    """The file itself, whatever its names; None where there is none."""
    try:
        status = path.stat()
    except (OSError, ValueError):
        return None
    return status.st_dev, status.st_ino


def _named_by(path: Path) -> Path | None:
    """A recording.toml in the folders above that names the path as its images, its views or its rig, or is it."""
    place = Path(_name(path))
    if place.name == os.path.normcase(RECORDING_FILE):
        return path
    for folder in list(place.parents)[:_LEVELS]:
        file = folder / RECORDING_FILE
        if file.is_file() and any(place.match(pattern) for pattern in _patterns(file)):
            return file
    return None


def _patterns(file: Path) -> list[str]:
    """What a recording.toml names, as absolute patterns; nothing where it cannot be read, which is told elsewhere."""
    try:
        declared = tomllib.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return []
    found = []
    for section, keys in (("cameras", ("left", "right")), ("calibration", ("left", "right", "rig"))):
        part = declared.get(section)
        names = [part.get(key) for key in keys] if isinstance(part, dict) else []
        for name in names:
            if isinstance(name, str) and name:
                below = os.path.normpath(os.path.join(glob.escape(str(file.parent)), name.replace("{number}", "*")))
                found.append(os.path.normcase(below))
    return found
