"""Six degrees of freedom of a spinning, rolling disc from two synchronised high-speed cameras.

The public verbs in the order of the measurement; each is imported when it is first used:

    recording = read_recording("clip")                          # what recording.toml declares
    found, problems = calibrate_recording(recording)            # -> StereoCalibration, views that could not be read
    pairs = open_pairs(recording)                               # both cameras' frames, checked to belong together
    measurement = measure(recording, found.rig, pairs)          # -> Measurement with .trajectory
    write_trajectory(path, measurement.trajectory, trajectory_provenance(recording, found.rig, pairs, None))
    trajectory = read_trajectory(path)
    outcome = run_analyse(path)                                 # -> groups in the file, .report, .analysis
    batch = run_batch([folder])                                 # all of this for many recordings, -> .rows, .files

Conventions (frames, angles, units, pixels) have one home: the docstring of disctrack.frames.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.2.0"

if TYPE_CHECKING:
    from disctrack.analyse.analysis import Analysis
    from disctrack.analyse.derivatives import differentiate
    from disctrack.analyse.stage import run_analyse
    from disctrack.batch import run_batch
    from disctrack.calibrate.views import calibrate_recording, calibrate_views, find_views
    from disctrack.disc import Disc
    from disctrack.errors import DiscTrackError
    from disctrack.files.trajectory_file import (
        Provenance,
        read_group,
        read_trajectory,
        write_csv,
        write_group,
        write_trajectory,
    )
    from disctrack.readers import FrameReader, open_frames
    from disctrack.readers.blocks import iter_pair_blocks
    from disctrack.recording.declaration import Recording, read_recording
    from disctrack.track.overlay import write_overlay
    from disctrack.track.stage import Measurement, measure, open_pairs, trajectory_provenance
    from disctrack.trajectory import FrameStatus, MarkerStatus, Trajectory

_HOME = {
    "recording.declaration": ("Recording", "read_recording"),
    "readers": ("FrameReader", "open_frames"),
    "readers.blocks": ("iter_pair_blocks",),
    "calibrate.views": ("find_views", "calibrate_views", "calibrate_recording"),
    "disc": ("Disc",),
    "track.stage": ("open_pairs", "Measurement", "measure", "trajectory_provenance"),
    "trajectory": ("Trajectory", "FrameStatus", "MarkerStatus"),
    "files.trajectory_file": (
        "Provenance",
        "write_trajectory",
        "read_trajectory",
        "write_csv",
        "write_group",
        "read_group",
    ),
    "track.overlay": ("write_overlay",),
    "analyse.derivatives": ("differentiate",),
    "analyse.analysis": ("Analysis",),
    "analyse.stage": ("run_analyse",),
    "batch": ("run_batch",),
    "errors": ("DiscTrackError",),
}
_MODULE_OF = {name: module for module, names in _HOME.items() for name in names}

__all__ = [  # noqa: RUF022 (in the order of the measurement, not of the alphabet)
    "read_recording",
    "Recording",
    "open_frames",
    "FrameReader",
    "iter_pair_blocks",
    "find_views",
    "calibrate_views",
    "calibrate_recording",
    "Disc",
    "open_pairs",
    "measure",
    "Measurement",
    "Trajectory",
    "FrameStatus",
    "MarkerStatus",
    "trajectory_provenance",
    "Provenance",
    "write_trajectory",
    "read_trajectory",
    "write_csv",
    "write_group",
    "read_group",
    "write_overlay",
    "differentiate",
    "run_analyse",
    "Analysis",
    "run_batch",
    "DiscTrackError",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'disctrack' has no attribute {name!r}")
    return getattr(import_module(f"disctrack.{_MODULE_OF[name]}"), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
