"""`disctrack track`: a recording and a rig become a trajectory."""

import argparse

from disctrack.calibrate.stage import given_rig
from disctrack.commands import _outputs as outputs
from disctrack.errors import RecordingError
from disctrack.recording.declaration import read_recording
from disctrack.track import measurement as pipeline


def run(arguments: argparse.Namespace) -> int:
    """Track; returns the exit code."""
    recording = read_recording(arguments.recording)
    path = arguments.output or recording.folder / outputs.RESULTS / "trajectory.h5"
    rig_file = arguments.rig or recording.rig_file or recording.folder / outputs.RESULTS / "rig.h5"
    if not rig_file.is_file():
        raise RecordingError(
            f"{rig_file}: no such rig file. Calibrate first (disctrack calibrate {arguments.recording} -o rig.h5), "
            "or name the rig with --rig."
        )
    rig, _ = given_rig(rig_file)
    pairs = pipeline.open_pairs(recording, arguments.frames or (None, None))
    outputs.check_writable(path.parent, path)
    return outputs.finish(outputs.track_into(path, recording, rig, rig_file, pairs, arguments), arguments, path.parent)
