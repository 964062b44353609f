"""Six degrees of freedom of a spinning, rolling disc from two synchronised high-speed cameras.

The public verbs in the order of the measurement; each is imported when it is first used:

    recording = read_recording("clip")                          # what recording.toml declares
    found, problems = calibrate_recording(recording)            # -> StereoCalibration, views that could not be read
    pairs = open_pairs(recording)                               # frames of both cameras, checked for consistency
    measurement = measure(recording, found.rig, pairs)          # -> Measurement with .trajectory
    write_trajectory(path, measurement.trajectory, trajectory_provenance(recording, found.rig, pairs, None))
    trajectory = read_trajectory(path)
    outcome = run_analyse(path)                                 # -> groups in the file, .report, .analysis
    diagnosed = run_diagnose(path)                              # -> .result.sentence; `diagnose` on a Trajectory
    batch = run_batch([folder])                                 # all of this for many recordings, -> .rows, .files

Frames in memory, and live frames from a camera:

    measurement = measure_pairs(images, rig, disc, frame_rate)  # images (n, 2, height, width)
    tracker = Tracker(rig, disc); pose = tracker.next(left, right)

Forward models: `simulate(model, state)` returns a motion, `run_simulate` and `run_render` take a scene file.

Conventions (frames, angles, units, pixels) are in the docstring of disctrack.frames.
"""

from typing import TYPE_CHECKING

from calibration.kit.public import imported_when_used

if TYPE_CHECKING:
    from calibration.rig_file import read_rig as read_rig
    from calibration.rig_file import write_rig as write_rig
    from disctrack.analyse.analysis import Analysis as Analysis
    from disctrack.analyse.derivatives import differentiate as differentiate
    from disctrack.analyse.stage import run_analyse as run_analyse
    from disctrack.batch import run_batch as run_batch
    from disctrack.calibrate.stage import calibrate_recording as calibrate_recording
    from disctrack.calibrate.stage import calibrate_views as calibrate_views
    from disctrack.calibrate.stage import find_views as find_views
    from disctrack.diagnosis.stage import diagnose as diagnose
    from disctrack.diagnosis.stage import run_diagnose as run_diagnose
    from disctrack.disc import Disc as Disc
    from disctrack.errors import DiscTrackError as DiscTrackError
    from disctrack.files.software import __version__ as __version__
    from disctrack.recording.declaration import Recording as Recording
    from disctrack.recording.declaration import read_recording as read_recording
    from disctrack.recording.readers import FrameReader as FrameReader
    from disctrack.recording.readers import open_frames as open_frames
    from disctrack.recording.readers.blocks import iter_pair_blocks as iter_pair_blocks
    from disctrack.rolling import Model as Model
    from disctrack.rolling import State as State
    from disctrack.rolling import simulate as simulate
    from disctrack.rolling import steady_precession as steady_precession
    from disctrack.synthetic.recording import run_render as run_render
    from disctrack.synthetic.simulation import run_simulate as run_simulate
    from disctrack.track.follow.live import LivePose as LivePose
    from disctrack.track.follow.live import Tracker as Tracker
    from disctrack.track.measurement import measure as measure
    from disctrack.track.measurement import measure_pairs as measure_pairs
    from disctrack.track.measurement import open_pairs as open_pairs
    from disctrack.track.measurement import trajectory_provenance as trajectory_provenance
    from disctrack.track.refine.assembly import Measurement as Measurement
    from disctrack.track.video_overlay import write_overlay as write_overlay
    from disctrack.trajectory import FrameStatus as FrameStatus
    from disctrack.trajectory import MarkerStatus as MarkerStatus
    from disctrack.trajectory import Trajectory as Trajectory
    from disctrack.trajectory.exchange.formats import convert as convert
    from disctrack.trajectory.exchange.motion import write_csv as write_csv
    from disctrack.trajectory.file import Provenance as Provenance
    from disctrack.trajectory.file import read_group as read_group
    from disctrack.trajectory.file import read_trajectory as read_trajectory
    from disctrack.trajectory.file import write_group as write_group
    from disctrack.trajectory.file import write_trajectory as write_trajectory

__getattr__, _names = imported_when_used(__file__)
__all__ = [name for name in _names if name != "__version__"]


def __dir__() -> list[str]:
    return _names
