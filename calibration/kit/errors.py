"""What can go wrong, as classes a caller can tell apart.

Every message says which file, frame or camera, what was found, what was expected and what to do.
"""


class DiscTrackError(Exception):
    """Base of every error this distribution raises on purpose.

    It lives here, not in `disctrack`, because imports point from `disctrack` to `calibration` only.

        >>> try:
        ...     read_recording("nowhere")
        ... except DiscTrackError as error:
        ...     print(str(error).partition(":")[0])
        nowhere
    """


class ArgumentError(DiscTrackError, TypeError, ValueError):
    """A function was given something else than it takes."""


class CalibrationError(DiscTrackError):
    """The cameras cannot be calibrated from what was given."""


class RigFileError(DiscTrackError):
    """A rig file cannot be read, or does not hold a stereo rig."""
