"""Locks: one process at a time works on a recording, on this machine or on another that shares the disk."""

import contextlib
import errno
import time
from collections.abc import Iterator
from pathlib import Path

from filelock import BaseFileLock, FileLock, SoftFileLock, Timeout

from disctrack.files.whole import make_folder, writing

_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)
SILENT_FOR = 12 * 3600.0  # [s] after which a lock counts as abandoned, on a disk without locks


@contextlib.contextmanager
def locked(path: Path, wait: float = 0.0) -> Iterator[None]:
    """Hold the lock `path`, a file that exists while the lock is held.

    The operating system releases the lock when its holder ends in any way, so a file left by a killed process has no
    effect. On a disk without locks the file `<path>.holder` is the lock: it names host and process, and is valid while
    that process runs, or for SILENT_FOR if the host is another one.
    wait : [s] to wait for another holder. Raises Timeout if that still holds the lock, OutputError.
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
    except OSError:
        with writing(path):
            raise
    try:
        yield
    finally:
        if not isinstance(lock, SoftFileLock):
            with contextlib.suppress(OSError):
                path.unlink()  # before the release: a process that locks the removed file notices the removal
        lock.release()
