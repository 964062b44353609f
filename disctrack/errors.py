"""The errors that disctrack raises on purpose; `cli` alone turns them into a line and an exit code."""

from typing import Any

from calibration.kit.errors import ArgumentError, CalibrationError, DiscTrackError, RigFileError

__all__ = [
    "AnalysisError",
    "ArgumentError",
    "CalibrationError",
    "ClusterError",
    "DiscTrackError",
    "OutputError",
    "RecordingError",
    "RigFileError",
    "SceneError",
    "TrackingError",
    "TrajectoryFileError",
]


class AnalysisError(DiscTrackError):
    """A trajectory does not hold enough for what was asked of it."""


class ClusterError(DiscTrackError):
    """The machines that were to share the work cannot be used."""


class RecordingError(DiscTrackError):
    """A recording folder, its recording.toml or its images cannot be used as they are."""


class SceneError(DiscTrackError):
    """A scene file cannot be read, or asks for something impossible."""


class TrackingError(DiscTrackError):
    """The disc cannot be found or followed in the images. findings : why, as far as that was seen"""

    def __init__(self, text: str, findings: tuple[Any, ...] = ()) -> None:
        super().__init__(text)
        self.findings = findings  # of Finding


class OutputError(DiscTrackError):
    """A result cannot be written where it was asked for."""


class TrajectoryFileError(DiscTrackError):
    """A trajectory file cannot be read, or holds something else."""


class ModelError(DiscTrackError):
    """A model of the motion cannot be built: unknown effect or parameter, a value out of bounds, no such motion."""
