"""Files that are either complete or absent: written under a temporary name, flushed to the disk, renamed."""

import contextlib
import errno
import os
import secrets
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from disctrack.errors import OutputError
from disctrack.files.inputs import refuse_input

_REMEDIES = {
    errno.ENOSPC: "the disk is full. Free some space, or choose another place with -o",
    errno.EDQUOT: "your quota is used up. Free some space, or choose another place with -o",
    errno.EFBIG: "the file would exceed the size limit of this account or disk. Choose another place with -o",
    errno.EROFS: "the disk is read-only. Choose another place with -o",
    errno.EACCES: "no permission to write there. Choose another place with -o",
    errno.EPERM: "no permission to write there. Choose another place with -o",
}


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
        make_folder(path.parent)
        _clear_abandoned(path.parent)
        yield part
        with part.open("rb+") as stream:
            os.fsync(stream.fileno())
        os.replace(part, path)
        _sync_folder(path.parent)
    except OSError as error:
        raise output_error(path, error) from error
    finally:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)


def write_whole(path: Path, content: bytes | memoryview, adds_to_input: bool = False) -> None:
    """Write `content` to `path`, completely or not at all. Raises OutputError."""
    with whole_file(path, adds_to_input=adds_to_input) as part, part.open("wb") as stream:
        stream.write(content)


def refuse_existing(path: Path, overwrite: bool, what: str = "") -> None:
    """Raise OutputError if `path` exists and may not be replaced; `what` describes it in the message."""
    if path.exists() and not overwrite:
        raise OutputError(f"{path}: exists{what}. Choose another name or folder, or replace it with --overwrite.")


def make_folder(folder: Path) -> None:
    """Create the folder and its parents. Raises OutputError."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise output_error(folder, error) from error


def check_writable(folder: Path) -> None:
    """Create the folder and a temporary file in it, to detect errors before a long run. Raises OutputError."""
    make_folder(folder)
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise output_error(folder, error) from error


def output_error(path: Path, error: OSError) -> OutputError:
    """Error with a remedy, if `path` cannot be written."""
    remedy = _REMEDIES.get(error.errno or 0, f"{error.strerror or error}. Choose another place with -o")
    return OutputError(f"{path}: cannot be written: {remedy}.")


def _clear_abandoned(folder: Path) -> None:
    """Remove half-written files that did not change for an hour: their processes were killed."""
    for part in folder.glob(f"*.{'[0-9a-f]' * 8}.part*"):
        with contextlib.suppress(OSError):
            if time.time() - part.stat().st_mtime > 3600.0:
                part.unlink()


def _sync_folder(folder: Path) -> None:
    """Flush the new name to the disk, if the file system can do this for a folder."""
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
