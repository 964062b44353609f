"""Files: inputs are regular, of bounded size, and never replaced by an output; outputs are either complete or absent.

Files that a command has read, or that a recording declares, are protected even with --overwrite, and no output matches
the patterns of a recording. Outputs are written under a temporary name, flushed to the disk, renamed.
"""

import contextlib
import errno
import glob
import os
import re
import secrets
import stat
import tempfile
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path

from disctrack.errors import OutputError, told_as

RECORDING_FILE = "recording.toml"
MOST_TEXT = 16 << 20  # [bytes] of a text file, written by people or by a camera with its frames; real ones have 100 kB
MOST_IMAGE = 1 << 30  # [bytes] of a file with one image
_KINDS = {
    stat.S_IFIFO: "a named pipe", stat.S_IFCHR: "a device", stat.S_IFBLK: "a device", stat.S_IFSOCK: "a socket",
    stat.S_IFDIR: "a folder",
}  # fmt: skip


def open_regular(path: Path) -> int:
    """Descriptor of a file to be read. Raises OSError, also for files on which reading might never end.

    A pipe waits for a writer, a device may have no end; a link may lead to either.
    """
    descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_BINARY", 0) | getattr(os, "O_NONBLOCK", 0))
    if fault := _not_regular(os.fstat(descriptor)):
        os.close(descriptor)
        raise OSError(errno.EINVAL, fault)
    return descriptor


def read_regular(path: Path, most: int) -> bytes:
    """Content of a file of at most `most` bytes. Raises OSError, also if it is not a regular file, or is larger."""
    with open(open_regular(path), "rb") as stream:
        content = stream.read(min(os.fstat(stream.fileno()).st_size, most) + 1)
    if len(content) > most:
        raise OSError(errno.EFBIG, f"it has more than the {most >> 20} MB that a file of this kind may have")
    return content


def why_not_regular(path: Path) -> str:
    """Why a path is not a regular file; "" if it is one, or does not exist."""
    try:
        return _not_regular(path.stat())
    except (OSError, ValueError):
        return ""


def _not_regular(status: os.stat_result) -> str:
    kind = stat.S_IFMT(status.st_mode)
    return "" if kind == stat.S_IFREG else f"it is {_KINDS.get(kind, 'something else')}, not a regular file"


_read: dict[tuple[int, int], Path] | None = None  # by device and inode; None outside a command


@contextlib.contextmanager
def inputs_kept() -> Iterator[None]:
    """Within the block, files passed to `keep` cannot be replaced. Outside of commands there is no protection."""
    global _read
    before, _read = _read, {}
    try:
        yield
    finally:
        _read = before


def keep(path: Path) -> None:
    """Register a file that the command reads and does not write itself."""
    if _read is not None and (file := _file(path)) is not None:
        _read[file] = path


def refuse_input(path: Path) -> None:
    """Raise OutputError if an output of this name would replace an input, also through links or another spelling."""
    file = _file(path)
    # an input that the command has rewritten is another file: the old inode may have been reused
    if _read and file in _read and _file(_read[file]) == file:
        also = f" (as {_read[file]})" if _read[file] != path else ""
        raise OutputError(f"{path}: is read by this command{also}, and no output replaces an input. {_ELSEWHERE}")
    if reason := _claimed(path):
        raise OutputError(f"{path}: {reason}. {_ELSEWHERE}")


_ELSEWHERE = "Choose another place with -o."


def _file(path: Path) -> tuple[int, int] | None:
    """Device and inode, equal for all names of a file; None if it does not exist."""
    try:
        status = path.stat()
    except (OSError, ValueError):
        return None
    return status.st_dev, status.st_ino


def _claimed(path: Path) -> str:
    """Why a recording in a parent folder forbids this output; "" if none does.

    The path is its recording.toml, matches a pattern in it, or is in the folder of its frames.
    """
    place = Path(os.path.abspath(path))
    # with links in its folders resolved; the last component may be a link
    place = Path(os.path.normcase(os.path.join(os.path.realpath(place.parent), place.name)))
    for folder in place.parents:
        file = folder / RECORDING_FILE
        for pattern in _patterns(file) if file.is_file() else ():
            if place.exists() and (place.match(pattern)):
                return f"belongs to the recording {file}, and no output replaces an input"
            among, name = os.path.split(pattern)
            if glob.has_magic(name) and among != os.path.normcase(folder) and place.parent.match(among):
                return f"lies among the frames of {file}; the next run would take pictures there for frames"
    return ""


def _patterns(file: Path) -> list[str]:
    """A recording.toml and the files that it declares, as absolute patterns; only itself if it cannot be read."""
    found = [glob.escape(str(file))]
    with contextlib.suppress(OSError, ValueError, RecursionError, AttributeError):  # AttributeError: no text there
        declared = tomllib.loads(read_regular(file, MOST_TEXT).decode())
        for value in (*declared.get("cameras", {}).values(), *declared.get("calibration", {}).values()):
            if isinstance(value, str):
                name = re.sub(r"(?<=..):/.*", "", value.replace("{number}", "*"))  # without the data set in a file
                found.append(os.path.normpath(os.path.join(glob.escape(str(file.parent)), name)))
    return [os.path.normcase(pattern) for pattern in found]


@contextlib.contextmanager
def whole_file(path: Path, suffix: str = "", adds_to_input: bool = False) -> Iterator[Path]:
    """Temporary path to write to; it is renamed to `path` if the block ends without an error, otherwise removed.

    A killed process leaves `<name>.<eight digits>.part`. The next process that writes into the folder more than an hour
    later removes it.
    suffix : end of the temporary name, for writers that derive the format from it
    adds_to_input : the file is an input whose content is kept and extended, e.g. by the group of a stage
    Raises OutputError if the folder is full, read-only or forbidden, or if `path` is an input (`refuse_input`).
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
    """Raise OutputError if `path` is an input (`refuse_input`), or exists and may not be replaced."""
    refuse_input(path)
    if path.exists() and not overwrite:
        raise OutputError(f"{path}: exists. Choose another name or replace it: --overwrite (Python: overwrite=True).")


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


def check_writable(folder: Path, *outputs: Path) -> None:
    """Create the folder and a temporary file in it, to detect errors before a long run. Raises OutputError.

    outputs : files that will be written there, of which none may be an input (`refuse_input`)
    """
    for path in outputs:
        refuse_input(path)
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
