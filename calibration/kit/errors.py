"""Classes of errors.

Every message states the file, frame or camera, what was found, what was expected and what to do.
"""

from collections.abc import Iterator
from contextlib import contextmanager


class DiscTrackError(Exception):
    """Base of every error this distribution raises on purpose.

    It is defined here, not in `disctrack`, because `calibration` never imports `disctrack`.

        >>> try:
        ...     read_recording("nowhere")
        ... except DiscTrackError as error:
        ...     print(str(error).partition(":")[0])
        nowhere/recording.toml
    """


class ArgumentError(DiscTrackError, TypeError, ValueError):
    """An argument of a function is not valid."""


class CalibrationError(DiscTrackError):
    """The cameras cannot be calibrated from the given data."""


class RigFileError(DiscTrackError):
    """A rig file cannot be read, or does not contain a stereo rig."""


@contextmanager
def told_as(error: type[DiscTrackError], said: str, *kinds: type[Exception], then: str = "") -> Iterator[None]:
    """Convert exceptions of these kinds, mostly of libraries, into an error of ours: `said`, reason, `then`.

    Errors of ours are converted only if their own class is given.
    """
    try:
        yield
    except kinds as reason:
        if isinstance(reason, DiscTrackError) and type(reason) not in kinds:
            raise
        why = getattr(reason, "strerror", "") or " ".join(str(reason).split()) or type(reason).__name__
        raise error(f"{said}: {why.removesuffix('.')}.{f' {then}' if then else ''}") from reason
