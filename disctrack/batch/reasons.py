"""Why something failed, in one line."""

import errno
import signal

from disctrack.errors import DiscTrackError

_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def reason_of(error: BaseException) -> str:
    """What to tell about an error, whatever it is."""
    if isinstance(error, DiscTrackError):
        text = str(error)
    elif isinstance(error, MemoryError):
        text = "out of memory. Run fewer side by side with -j, or give the machine more memory."
    elif isinstance(error, OSError) and error.strerror:
        where = f"{error.filename}: " if error.filename else ""
        text = f"{where}{error.strerror}."
        if error.errno in _NO_ROOM:
            text += " Free some space, or choose another place with -o."
    else:
        text = f"internal error ({type(error).__name__}: {error}); please report it."
    return " ".join(text.split())


def reason_of_death(returncode: int | None, said: str = "") -> str:
    """What to tell about a worker process that ended by itself.

    said : the last that it wrote on stderr
    """
    if returncode == -getattr(signal, "SIGKILL", 9):
        text = (
            "its process was killed (signal 9), as the system does when memory runs out. Run fewer side by side "
            "with -j, or give the machine more memory."
        )
    elif returncode is not None and returncode < 0:
        text = f"its process was ended by signal {-returncode} ({_signal_name(-returncode)})."
    else:
        text = f"its process ended by itself (exit code {returncode})."
    last = " ".join(said.split())[-300:]
    return f"{text} It said: {last}" if last else text


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return "unknown"
