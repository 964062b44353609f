"""One process at a time works on a recording, on this machine or on another that shares the disk."""

import contextlib
import errno
import time
from collections.abc import Iterator
from pathlib import Path

from filelock import BaseFileLock, FileLock, SoftFileLock, Timeout

from disctrack.files.whole import make_folder, output_error

_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)
SILENT_FOR = 12 * 3600.0  # [s] after which a lock counts as abandoned, where the disk knows no locks


@contextlib.contextmanager
def locked(path: Path, wait: float = 0.0) -> Iterator[None]:
    """Hold the lock `path`, a file that is there while it is held.

    The operating system frees the lock when its holder ends, however it ends, so a file that a killed process left
    has no effect. On a disk without locks the existence of `<path>.holder` is the lock, and the host and process named
    in it tell whether it is still valid; one of another host is, for SILENT_FOR.
    wait : [s] to wait for another holder. Raises Timeout where that holds it still, OutputError.
    """
    make_folder(path.parent)
    lock: BaseFileLock = FileLock(path, timeout=wait, fallback_to_soft=False)
    try:
        try:
            lock.acquire()
        except OSError as error:
            if error.errno not in _NO_LOCKS:
                raise
            holder = path.with_name(f"{path.name}.holder")
            with contextlib.suppress(FileNotFoundError):
                if time.time() - holder.stat().st_mtime > SILENT_FOR:
                    holder.unlink()
            lock = SoftFileLock(holder, timeout=wait)
            lock.acquire()
    except Timeout:
        raise
    except OSError as error:
        raise output_error(path, error) from error
    try:
        yield
    finally:
        if not isinstance(lock, SoftFileLock):
            with contextlib.suppress(OSError):
                path.unlink()  # before it is free: who locks the removed file notices that it is no longer there
        lock.release()
