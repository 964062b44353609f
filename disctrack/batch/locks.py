"""One process at a time works on a recording, on this machine or on another that shares the disk."""

from __future__ import annotations

import contextlib
import errno
import os
import re
import socket
import time
from collections.abc import Iterator
from pathlib import Path

from disctrack.files.whole import make_folder, output_error, process_lives

try:
    import fcntl
except ImportError:  # not a Unix
    fcntl = None  # type: ignore[assignment]

_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)
SILENT_FOR = 12 * 3600.0  # [s] after which another host's lock counts as abandoned, where the disk knows no locks


class Busy(Exception):
    """Another process holds the lock."""


@contextlib.contextmanager
def locked(path: Path, wait: float = 0.0) -> Iterator[None]:
    """Hold the lock `path`, a file that is there while it is held.

    The operating system frees the lock when its holder ends, however it ends, so a file that a killed process left
    has no effect. On a disk without locks the existence of `<path>.holder` is the lock, and the host and process named
    in it tell whether it is still valid.
    wait : [s] to wait for another holder. Raises Busy, OutputError.
    """
    make_folder(path.parent)
    until = time.monotonic() + wait
    held = None
    try:
        while (held := _try(path)) is None:
            if time.monotonic() >= until:
                raise Busy(f"{path} is held by another process")
            time.sleep(0.05)
        yield
    finally:
        if held is not None:
            descriptor, file = held
            with contextlib.suppress(OSError):
                file.unlink()  # before it is free: who locks the removed file notices that it is no longer there
            os.close(descriptor)


def _try(path: Path) -> tuple[int, Path] | None:
    """Descriptor and file that hold the lock, None if another process holds it. Raises OutputError."""
    if fcntl is None:
        return _try_by_existence(path.with_name(f"{path.name}.holder"))
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    except OSError as error:
        raise output_error(path, error) from error
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if os.fstat(descriptor).st_ino == path.stat().st_ino:
            return descriptor, path
    except (BlockingIOError, PermissionError, FileNotFoundError):
        pass
    except OSError as error:
        os.close(descriptor)
        if error.errno not in _NO_LOCKS:
            raise output_error(path, error) from error
        return _try_by_existence(path.with_name(f"{path.name}.holder"))
    os.close(descriptor)
    return None


def _try_by_existence(holder: Path) -> tuple[int, Path] | None:
    try:
        descriptor = os.open(holder, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
    except FileExistsError:
        _clear_abandoned(holder)
        return None
    except OSError as error:
        raise output_error(holder, error) from error
    os.write(descriptor, f"{socket.gethostname()} {os.getpid()}\n".encode())
    return descriptor, holder


def _clear_abandoned(holder: Path) -> None:
    """Remove the file if its process has ended; of several that try, one does, and none removes its successor."""
    with contextlib.suppress(OSError):
        text = holder.read_text()
        found = re.fullmatch(r"(\S+) (\d+)\n", text)
        if found and found[1] == socket.gethostname():
            abandoned = not process_lives(int(found[2]))
        else:  # another host's, or of one that was killed before it could write its name
            abandoned = time.time() - holder.stat().st_mtime > (SILENT_FOR if found else 60.0)
        if abandoned:
            aside = holder.with_name(f"{holder.name}.{socket.gethostname()}-{os.getpid()}")
            os.rename(holder, aside)
            if aside.read_text() != text:  # in the meantime another has taken the lock
                os.link(aside, holder)
            aside.unlink()
