"""numba for both packages, with its cache: functions are compiled at the first call, and loaded afterwards.

To validate its cache, numba looks only at the file of a function. Some functions call those of other files (the
renderer's raster, the fit of poses, helpers of the effects' laws), so the cache is in a folder named by a hash of all
files with compiled functions.
"""

import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from hashlib import sha256
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from filelock import FileLock
from numba.core import event

T = TypeVar("T")
njit: Any = numba.njit  # a decorated function has other types than its source
cfunc: Any = numba.cfunc
config: Any = numba.config
# These functions never test for NaN, so the fast floating-point rules change the last digits only.
RULES: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": {"contract", "arcp", "nsz", "reassoc"}}
# Called from compiled code, always inlined: otherwise two copies (its own and its caller's) may be optimised
# differently, and which of them runs would depend on whether the code was just compiled or loaded.
part: Any = njit(**RULES, no_cpython_wrapper=True, no_cfunc_wrapper=True, forceinline=True)
# Called from compiled code, without fast rules and not forced inline: for integrations over thousands of steps. If a
# function creates no array, references to its arguments are not counted: that took most of the time (numba issue 2345).
owning_part = njit(error_model="numpy", nogil=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
exact_part = njit(error_model="numpy", nogil=True, no_cpython_wrapper=True, no_cfunc_wrapper=True, _nrt=False)

WITH_COMPILED = (
    "calibration/kit/compiled.py",
    "calibration/**/_[a-z]*.py",
    "disctrack/**/_[a-z]*.py",
    "disctrack/rolling/**/*.py",
    "disctrack/synthetic/*.py",
)


def _folder() -> Path:
    """Folder in NUMBA_CACHE_DIR; otherwise next to the packages, in the user's cache, or among temporary files."""
    home, sources = Path(__file__).parents[2], sha256()
    for file in sorted({file for pattern in WITH_COMPILED for file in home.glob(pattern)}):
        sources.update(file.read_bytes())
    own = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "disctrack"
    user = getattr(os, "getuid", int)()  # Windows states 0 for the owner of a file
    places = Path(__file__).parent / "__pycache__", own, Path(tempfile.gettempdir()) / f"disctrack-{user}"
    kept = config.CACHE_DIR or next((place for place in places if _is_own(place, user)), None) or tempfile.mkdtemp()
    return Path(kept) / f"compiled-{sources.hexdigest()[:16]}"


def _is_own(place: Path, user: int) -> bool:
    """True for a folder that can be written to and belongs to this user: compiled code of other users is not run."""
    with suppress(OSError):
        place.mkdir(mode=0o700, parents=True, exist_ok=True)
        return os.access(place, os.W_OK) and place.stat().st_uid == user
    return False


FOLDER = _folder()
config.CACHE_DIR = str(FOLDER)


def compiled(
    decorator: Callable[..., Callable[..., T]], signature: object, function: Callable[..., None], **rules: bool
) -> T:
    """A function compiled for one signature; its machine code is cached if the function is in a file."""
    # error_model: a division by zero gives inf or nan, as in NumPy; the integrator then refuses the step
    try:
        return decorator(signature, cache=True, error_model="numpy", **rules)(function)
    except RuntimeError:  # numba: "no locator available": defined at a prompt, or the folder is not writable
        return decorator(signature, error_model="numpy", **rules)(function)


def function_of(text: str, name: str, names: dict[str, object]) -> Callable[..., None]:
    """The function of this name in a text that the caller has checked.   names : global names of the text

    The text is written to a file if possible, as numba caches only functions from files.
    """
    file = FOLDER / "texts" / sha256(text.encode()).hexdigest()[:16]
    with suppress(OSError):
        if not file.exists():
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(text)
    names["__name__"] = __name__  # numba loads a function together with its module
    exec(compile(text, str(file), "exec"), names)
    return cast("Callable[..., None]", names[name])


class _BeforeCompiling(event.Listener):
    def __init__(self, tell: Callable[[], None]):
        self.tell = tell

    def on_start(self, event: object) -> None:
        self.tell()

    def on_end(self, event: object) -> None:
        pass


@contextmanager
def one_at_a_time(tell: Callable[[], None] = lambda: None, what: str = "") -> Iterator[None]:
    """Hold a lock while functions are compiled or loaded: one of several processes compiles, the others load its code.

    `tell` is called before compiling, and not if everything is loaded; each `what` has its own lock.
    """
    lock = FileLock(FOLDER / f"{what}.lock", is_singleton=True)
    with suppress(OSError, NotImplementedError):  # a file system without locks: every process compiles
        FOLDER.mkdir(parents=True, exist_ok=True)
        lock.acquire()
    try:
        with event.install_listener("numba:run_pass", _BeforeCompiling(tell)):
            yield
    finally:
        lock.release()
