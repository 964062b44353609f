"""`disctrack analyse`: from a trajectory file to the physics."""

import argparse
from dataclasses import replace
from functools import partial
from pathlib import Path

from calibration.kit.types import AnyArray
from disctrack.analyse.analysis import Analysis
from disctrack.analyse.motion_page import motion_html
from disctrack.analyse.stage import run_analyse
from disctrack.commands import _outputs as outputs
from disctrack.errors import RecordingError
from disctrack.files.whole import write_whole
from disctrack.progress import steps
from disctrack.recording.declaration import read_recording
from disctrack.track.measurement import ImagePairs, open_pairs
from disctrack.track.video_overlay import draw_pair
from disctrack.trajectory import Trajectory
from disctrack.trajectory.file import read_provenance, trajectory_in
from disctrack.trajectory.reuse import origin_of, reusable


def run(arguments: argparse.Namespace) -> int:
    """Analyse, write files and print the report; returns the exit code."""
    path = trajectory_in(arguments.trajectory)
    folder = arguments.output or path.parent / f"{path.stem}_analysis"
    outputs.warn_if_stale(path)
    known = reusable(folder, origin_of(path, {"window": arguments.window, "circle": arguments.circle}))
    page = folder / "motion.html"
    requested = [page, *([folder / "figures"] if arguments.figures else [])]
    if known is not None and not arguments.overwrite and all(place.exists() for place in requested):
        return outputs.finish(known, arguments, folder, reused=True)
    again = arguments.overwrite or known is not None
    with steps("analyse"):
        outcome = run_analyse(
            path, folder, arguments.window, arguments.circle, overwrite=again, figures=arguments.figures
        )
    with steps("motion.html"):
        _write_motion_page(page, outcome.analysis, path, arguments.recording)
    outputs.link_pages_of(path)
    return outputs.finish(replace(outcome.summary, files=(*outcome.summary.files, page)), arguments, folder)


def _write_motion_page(page: Path, analysis: Analysis, trajectory: Path, recording: Path | None) -> None:
    """The interactive page, with pictures if the images of this trajectory are available."""
    drawn, n = None, len(analysis.trajectory)
    if folder := recording or outputs.recording_of(trajectory):
        try:
            pairs = open_pairs(read_recording(folder))
            if len(pairs) != n:
                said = f"{len(pairs)} pairs, but {trajectory} has {n} frames: it was measured from another recording"
                raise RecordingError(f"{folder}: {said}.")
            drawn = partial(_drawn, analysis.trajectory, pairs)
        except RecordingError:
            if recording is not None:
                raise
    write_whole(page, motion_html(analysis, read_provenance(trajectory).recording, drawn).encode())


def _drawn(trajectory: Trajectory, pairs: ImagePairs, row: int) -> AnyArray:
    images = outputs.pair_of(pairs, row)
    return draw_pair(images, trajectory, row)[: images.shape[1]]  # without the strip of numbers
