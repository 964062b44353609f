"""Six degrees of freedom of a spinning, rolling disc from two synchronised high-speed cameras.

The public verbs in the order of the measurement; each is imported when it is first used:

    recording = read_recording("clip")                          # what recording.toml declares
    found, problems = calibrate_recording(recording)            # -> StereoCalibration, views that could not be read
    pairs = open_pairs(recording)                               # both cameras' frames, checked to belong together
    measurement = measure(recording, found.rig, pairs)          # -> Measurement with .trajectory
    write_trajectory(path, measurement.trajectory, trajectory_provenance(recording, found.rig, pairs, None))
    trajectory = read_trajectory(path)
    outcome = run_analyse(path)                                 # -> groups in the file, .report, .analysis
    diagnosed = run_diagnose(path)                              # -> .result.sentence; `diagnose` on a Trajectory
    batch = run_batch([folder])                                 # all of this for many recordings, -> .rows, .files

Frames in memory, and frames as they come from a camera:

    measurement = measure_pairs(images, rig, disc, frame_rate)  # images (n, 2, height, width)
    tracker = Tracker(rig, disc); pose = tracker.next(left, right)

The other way round: `simulate(model, state)` gives a motion, `run_simulate` and `run_render` take a scene file.

Conventions (frames, angles, units, pixels) have one home: the docstring of disctrack.frames.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from calibration.rig_file import read_rig, write_rig
    from disctrack.analyse.analysis import Analysis
    from disctrack.analyse.derivatives import differentiate
    from disctrack.analyse.stage import run_analyse
    from disctrack.batch import run_batch
    from disctrack.calibrate.views import calibrate_recording, calibrate_views, find_views
    from disctrack.diagnosis.stage import diagnose_trajectory as diagnose
    from disctrack.diagnosis.stage import run_diagnose
    from disctrack.disc import Disc
    from disctrack.errors import DiscTrackError
    from disctrack.files.software import __version__ as __version__
    from disctrack.readers import FrameReader, open_frames
    from disctrack.readers.blocks import iter_pair_blocks
    from disctrack.recording.declaration import Recording, read_recording
    from disctrack.render import run_render
    from disctrack.rolling import Model, State, simulate, steady_precession
    from disctrack.scene.simulation import run_simulate
    from disctrack.track.arrays import measure_pairs
    from disctrack.track.live import LivePose, Tracker
    from disctrack.track.overlay import write_overlay
    from disctrack.track.stage import Measurement, measure, open_pairs, trajectory_provenance
    from disctrack.trajectory import FrameStatus, MarkerStatus, Trajectory
    from disctrack.trajectory.file import (
        Provenance,
        read_group,
        read_trajectory,
        write_csv,
        write_group,
        write_trajectory,
    )

# module -> the names it gives; "name=other" where the module calls it otherwise
_HOME = {
    "calibration.rig_file": ("read_rig", "write_rig"),
    "disctrack.recording.declaration": ("Recording", "read_recording"),
    "disctrack.readers": ("FrameReader", "open_frames"),
    "disctrack.readers.blocks": ("iter_pair_blocks",),
    "disctrack.calibrate.views": ("find_views", "calibrate_views", "calibrate_recording"),
    "disctrack.disc": ("Disc",),
    "disctrack.track.stage": ("open_pairs", "Measurement", "measure", "trajectory_provenance"),
    "disctrack.trajectory": ("Trajectory", "FrameStatus", "MarkerStatus"),
    "disctrack.trajectory.file": (
        "Provenance",
        "write_trajectory",
        "read_trajectory",
        "write_csv",
        "write_group",
        "read_group",
    ),
    "disctrack.track.overlay": ("write_overlay",),
    "disctrack.analyse.derivatives": ("differentiate",),
    "disctrack.analyse.analysis": ("Analysis",),
    "disctrack.analyse.stage": ("run_analyse",),
    "disctrack.batch": ("run_batch",),
    "disctrack.errors": ("DiscTrackError",),
    "disctrack.track.arrays": ("measure_pairs",),
    "disctrack.track.live": ("Tracker", "LivePose"),
    "disctrack.diagnosis.stage": ("run_diagnose", "diagnose=diagnose_trajectory"),
    "disctrack.files.software": ("__version__",),
    "disctrack.rolling": ("Model", "State", "steady_precession", "simulate"),
    "disctrack.scene.simulation": ("run_simulate",),
    "disctrack.render": ("run_render",),
}
_MODULE_OF = {
    name.partition("=")[0]: (module, name.partition("=")[2] or name)
    for module, names in _HOME.items()
    for name in names
}

__all__ = [  # noqa: RUF022 (in the order of the measurement, not of the alphabet)
    "read_recording",
    "Recording",
    "open_frames",
    "FrameReader",
    "iter_pair_blocks",
    "find_views",
    "calibrate_views",
    "calibrate_recording",
    "read_rig",
    "write_rig",
    "Disc",
    "open_pairs",
    "measure",
    "Measurement",
    "measure_pairs",
    "Tracker",
    "LivePose",
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
    "run_diagnose",
    "diagnose",
    "run_batch",
    "Model",
    "State",
    "steady_precession",
    "simulate",
    "run_simulate",
    "run_render",
    "DiscTrackError",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'disctrack' has no attribute {name!r}")
    module, attribute = _MODULE_OF[name]
    return getattr(import_module(module), attribute)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
