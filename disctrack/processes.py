"""How child processes are started."""

import contextlib
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from multiprocessing.context import SpawnContext, SpawnProcess
from types import ModuleType

# For parallel processes: one thread each, more would compete for the cores.
ONE_THREAD = {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL", "BLIS", "NUMEXPR", "NUMBA")}
ONE_THREAD |= {"VECLIB_MAXIMUM_THREADS": "1", "OPENCV_FOR_THREADS_NUM": "1"}
_STARTING = threading.Lock()
_GRACE = 3.0  # [s] to clean up after SIGTERM, before the process exits


@contextlib.contextmanager
def quietly() -> Iterator[None]:
    """Processes started within have one thread each, no signals of the terminal, and do not run the caller's script."""
    with _STARTING:
        script = sys.modules["__main__"]
        before = {name: os.environ.get(name) for name in ONE_THREAD}
        kinds = {signal.SIGINT, signal.SIGHUP} if hasattr(signal, "pthread_sigmask") else set()
        sys.modules["__main__"] = ModuleType("__main__")
        os.environ.update(ONE_THREAD)
        blocked = signal.pthread_sigmask(signal.SIG_BLOCK, kinds) if kinds else set()
        try:
            if kinds:
                from multiprocessing.resource_tracker import ensure_running  # not on Windows

                ensure_running()  # it starts with the first process, and unblocks Ctrl-C
                signal.pthread_sigmask(signal.SIG_BLOCK, kinds)
            yield
        finally:
            sys.modules["__main__"] = script
            for name, value in before.items():
                os.environ.pop(name)
                os.environ.update({} if value is None else {name: value})
            if kinds:
                signal.pthread_sigmask(signal.SIG_SETMASK, blocked)


def end_with_parent() -> None:
    """Called in a new process: sends it SIGTERM when its parent ends."""
    threading.Thread(target=_wait_and_end, daemon=True).start()


def _wait_and_end() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(_GRACE)
    os._exit(1)


class _Process(SpawnProcess):
    def start(self) -> None:
        with quietly():
            super().start()


class Spawn(SpawnContext):
    """Context that keeps a list of its processes, for their exit codes."""

    def __init__(self) -> None:
        self.started: list[SpawnProcess] = []

    def Process(self, *given: object, **named: object) -> SpawnProcess:  # type: ignore[override]
        """A process of the context, started `quietly`."""
        self.started.append(_Process(*given, **named))  # type: ignore[arg-type]
        return self.started[-1]
