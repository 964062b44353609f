"""Files that are either complete or absent: written under a temporary name, flushed to the disk, renamed."""

import contextlib
import os
import secrets
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from disctrack.errors import OutputError, told_as
from disctrack.files.inputs import refuse_input


@contextlib.contextmanager
def whole_file(path: Path, suffix: str = "", adds_to_input: bool = False) -> Iterator[Path]:
    """Temporary path to write to; it is renamed to `path` if the block ends without an error, otherwise removed.

    A killed process leaves `<name>.<eight digits>.part`. The next process that writes into the folder more than an hour
    later removes it.
    suffix : end of the temporary name, for writers that derive the format from it
    adds_to_input : the file is an input whose content is kept and extended, e.g. by the group of a stage
    Raises OutputError if the folder is full, read-only or forbidden, or if `path` is an input (`inputs.refuse_input`).
    """
    if not adds_to_input:
        refuse_input(path)
    part = path.with_name(f"{path.name}.{secrets.token_hex(4)}.part{suffix}")
    try:
        with writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            _clear_abandoned(path.parent)
            yield part
            with part.open("rb+") as stream:
                os.fsync(stream.fileno())
            os.replace(part, path)
    finally:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)


def write_whole(path: Path, content: bytes | memoryview, adds_to_input: bool = False) -> None:
    """Write `content` to `path`, completely or not at all. Raises OutputError."""
    with whole_file(path, adds_to_input=adds_to_input) as part, part.open("wb") as stream:
        stream.write(content)


def refuse_existing(path: Path, overwrite: bool) -> None:
    """Raise OutputError if `path` exists and may not be replaced."""
    if path.exists() and not overwrite:
        raise OutputError(f"{path}: exists. Choose another name or folder, or replace it with --overwrite.")


def seen_from(folder: Path, path: Path) -> Path:
    """The path as seen from the folder; unchanged if it is on another drive."""
    try:
        return Path(os.path.relpath(path, folder))
    except ValueError:
        return path


def make_folder(folder: Path) -> None:
    """Create the folder and its parents. Raises OutputError."""
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)


def check_writable(folder: Path) -> None:
    """Create the folder and a temporary file in it, to detect errors before a long run. Raises OutputError."""
    make_folder(folder)
    with writing(folder), tempfile.TemporaryFile(dir=folder):
        pass


def writing(path: Path) -> contextlib.AbstractContextManager[None]:
    """Within the block, an OSError means that `path` cannot be written, and becomes an OutputError."""
    return told_as(OutputError, f"{path}: cannot be written", OSError, then="Choose another place with -o.")


def _clear_abandoned(folder: Path) -> None:
    """Remove half-written files that did not change for an hour: their processes were killed."""
    for part in folder.glob(f"*.{'[0-9a-f]' * 8}.part*"):
        with contextlib.suppress(OSError):
            if time.time() - part.stat().st_mtime > 3600.0:
                part.unlink()
