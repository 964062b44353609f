"""Inputs are ordinary files of bounded size; and no output replaces one, or lies where the next run takes it for one.

What a command has read, or what a recording names, is kept whatever the user allows.
"""

import contextlib
import errno
import glob
import os
import stat
import tomllib
from collections.abc import Iterator
from pathlib import Path

from disctrack.errors import OutputError

RECORDING_FILE = "recording.toml"
MOST_TEXT = 16 << 20  # [bytes] of a file that people write, or a camera beside its frames; real ones have 100 kB
MOST_IMAGE = 1 << 30  # [bytes] of a file with one image
_KINDS = {
    stat.S_IFIFO: "a named pipe", stat.S_IFCHR: "a device", stat.S_IFBLK: "a device", stat.S_IFSOCK: "a socket",
    stat.S_IFDIR: "a folder",
}  # fmt: skip


def open_regular(path: Path) -> int:
    """Descriptor of a file to be read. Raises OSError, at once also before what would make a reader wait for ever.

    A pipe waits for somebody to write, a device may have no end; a link may lead to either.
    """
    descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_BINARY", 0) | getattr(os, "O_NONBLOCK", 0))
    if fault := _not_regular(os.fstat(descriptor)):
        os.close(descriptor)
        raise OSError(errno.EINVAL, fault)
    return descriptor


def read_regular(path: Path, most: int) -> bytes:
    """Content of a file of at most so many bytes. Raises OSError, also where it is no regular file or a larger one."""
    with open(open_regular(path), "rb") as stream:
        content = stream.read(min(os.fstat(stream.fileno()).st_size, most) + 1)
    if len(content) > most:
        raise OSError(errno.EFBIG, f"it has more than the {most >> 20} MB that a file of this kind may have")
    return content


def why_not_regular(path: Path) -> str:
    """What a path leads to instead of a regular file; "" where it leads to one, or to nothing."""
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
    # an input that the command has written anew is another file: the inode of the old one may be anybody's since then
    if _read and file in _read and _file(_read[file]) == file:
        also = f" (as {_read[file]})" if _read[file] != path else ""
        raise OutputError(f"{path}: is read by this command{also}, and no output replaces an input. {_ELSEWHERE}")
    if told := _claimed(path):
        raise OutputError(f"{path}: {told}. {_ELSEWHERE}")


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


def _claimed(path: Path) -> str:
    """Why a recording in the folders above wants no output there: it names the path, or is it, or has its frames there.

    "" where there is none.
    """
    place = Path(_name(path))
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
    """A recording.toml and what it names, as absolute patterns; itself alone where it cannot be read."""
    found = [glob.escape(str(file))]
    with contextlib.suppress(OSError, ValueError, RecursionError, AttributeError):  # AttributeError: no text there
        declared = tomllib.loads(read_regular(file, MOST_TEXT).decode())
        for section, keys in (("cameras", ("left", "right")), ("calibration", ("left", "right", "rig"))):
            for name in filter(None, map(declared.get(section, {}).get, keys)):
                below = os.path.join(glob.escape(str(file.parent)), name.replace("{number}", "*"))
                found.append(os.path.normpath(below))
    return [os.path.normcase(pattern) for pattern in found]
