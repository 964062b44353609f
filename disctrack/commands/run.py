"""`disctrack run`: the whole measurement of one recording."""

import argparse
import sys
from dataclasses import replace

from disctrack.calibrate.stage import calibrate_into, given_rig, source_of
from disctrack.commands import _outputs as outputs
from disctrack.files.whole import write_whole
from disctrack.recording.declaration import read_recording
from disctrack.report.blocks import Facts, Section
from disctrack.report.terminal import full
from disctrack.track import measurement as pipeline


def run(arguments: argparse.Namespace) -> int:
    """Calibrate unless the recording names a rig, track, draw; returns the exit code."""
    recording = read_recording(arguments.recording)
    folder = arguments.output or recording.folder / outputs.RESULTS
    pairs = pipeline.open_pairs(recording, arguments.frames or (None, None))
    summary = folder / outputs.SUMMARY
    outputs.check_writable(folder, folder / "trajectory.h5", summary)
    rig_file = recording.rig_file or folder / "rig.h5"
    if recording.rig_file is not None:
        rig, known = given_rig(rig_file)
    else:
        rig, known = calibrate_into(rig_file, source_of(recording), arguments.overwrite, not arguments.no_figures)
    verdict = f"Calibration: {known.verdict}"
    if recording.rig_file is None and not arguments.quiet:  # before the frames, which take longer
        print(verdict, file=sys.stderr, flush=True)
    tracked = outputs.track_into(folder / "trajectory.h5", recording, rig, rig_file, pairs, arguments)
    whole = [("verdict", known.verdict), ("accuracy", known.accuracy)]
    report = replace(
        tracked,
        verdict=f"{tracked.verdict} {verdict}",
        blocks=[Section("Calibration", [Facts(whole), *known.blocks]), Section("Tracking", tracked.blocks)],
        files=[*known.files, *tracked.files, summary],
    )
    write_whole(summary, ("\n".join(full(report)) + "\n").encode())
    return outputs.finish(report, arguments, folder)
