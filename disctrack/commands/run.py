"""`disctrack run`: the whole measurement of one recording."""

import argparse

from disctrack.calibrate.stage import calibrate_into, given_rig, source_of
from disctrack.commands import _outputs as outputs
from disctrack.files.inputs import refuse_input
from disctrack.files.whole import write_whole
from disctrack.recording.declaration import read_recording
from disctrack.track import measurement as pipeline
from disctrack.track import run_summary as summary


def run(arguments: argparse.Namespace) -> int:
    """Calibrate unless the recording names a rig, track, draw; returns the exit code."""
    recording = read_recording(arguments.recording)
    folder = arguments.output or recording.folder / outputs.RESULTS
    options = outputs.track_options(arguments)
    pairs = pipeline.open_pairs(recording, options.frames)
    for name in ("trajectory.h5", "summary.txt"):
        refuse_input(folder / name)
    outputs.check_writable(folder)
    if recording.rig_file is not None:
        rig_file = recording.rig_file
        calibrated = given_rig(rig_file)
    else:
        rig_file = folder / "rig.h5"
        source = source_of(recording, outputs.calibration_settings(arguments))
        calibrated = calibrate_into(rig_file, source, options.overwrite, options.figures)
    lines, files, findings = outputs.track_into(
        folder / "trajectory.h5", recording, calibrated.rig, rig_file, pairs, options
    )
    text = [*calibrated.lines, *lines]
    write_whole(folder / "summary.txt", ("\n".join(text) + "\n").encode())
    files = [*calibrated.files, *files, folder / "summary.txt", *outputs.write_times(folder, "run")]
    print("\n".join([*text, *summary.file_lines([outputs.relative(file) for file in files])]))
    return outputs.exit_code(findings)
