"""The errors that disctrack raises; only `cli` turns them into a line and an exit code."""

from typing import Any

from calibration.kit.errors import ArgumentError as ArgumentError
from calibration.kit.errors import CalibrationError as CalibrationError
from calibration.kit.errors import DiscTrackError
from calibration.kit.errors import RigFileError as RigFileError
from calibration.kit.errors import told_as as told_as


class AnalysisError(DiscTrackError):
    """A trajectory does not contain enough data for an analysis."""


class ClusterError(DiscTrackError):
    """The machines of a cluster cannot be used."""


class RecordingError(DiscTrackError):
    """A recording folder, its recording.toml or its images cannot be used."""


class SceneError(DiscTrackError):
    """A scene file cannot be read, or describes an impossible scene."""


class TrackingError(DiscTrackError):
    """The disc cannot be found or followed in the images.

    told : advice if the cause is unknown;  findings : the likely cause
    """

    def __init__(self, text: str, told: str = "", findings: tuple[Any, ...] = ()) -> None:
        super().__init__(text)
        self.told, self.findings = told, findings  # of Finding

    def __str__(self) -> str:
        why = f"Most likely {self.findings[0].sentence}" if self.findings else self.told
        return f"{self.args[0]}. {why}" if why else str(self.args[0])


class OutputError(DiscTrackError):
    """A result cannot be written to its destination."""


class TrajectoryFileError(DiscTrackError):
    """A trajectory file cannot be read, or holds something else."""


class ModelError(DiscTrackError):
    """A model of the motion cannot be built: unknown effect or parameter, a value out of bounds, no such motion."""


def reason_of(error: BaseException) -> str:
    """Message for any error, in one line."""
    if isinstance(error, DiscTrackError):
        text = str(error)
    elif isinstance(error, MemoryError):
        text = "out of memory. Close other programs, run fewer in parallel (-j), or measure fewer --frames at once."
    elif isinstance(error, OSError):
        text = f"{f'{error.filename}: ' if error.filename else ''}{error.strerror or error}."
    else:
        text = f"internal error ({type(error).__name__}: {error}); DISCTRACK_TRACEBACK=1 shows where. Please report it."
    return " ".join(text.split())
