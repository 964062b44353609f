"""`disctrack analyse`: from a trajectory file to the physics."""

import argparse
from dataclasses import replace
from pathlib import Path

from numpy.typing import NDArray

from disctrack.analyse.analysis import Analysis
from disctrack.analyse.motion_page import motion_html
from disctrack.analyse.stage import run_analyse
from disctrack.commands import _outputs as outputs
from disctrack.errors import RecordingError
from disctrack.files.whole import write_whole
from disctrack.progress import steps
from disctrack.recording.declaration import read_recording
from disctrack.track.measurement import open_pairs
from disctrack.track.video_overlay import draw_pair
from disctrack.trajectory.file import read_provenance, trajectory_in
from disctrack.trajectory.reuse import origin_of, reusable


def run(arguments: argparse.Namespace) -> int:
    """Analyse, write, and say what was found; returns the exit code."""
    path = trajectory_in(arguments.trajectory)
    folder = arguments.output or path.parent / f"{path.stem}_analysis"
    outputs.tell_stale(path)
    known = reusable(folder, origin_of(path, {"window": arguments.window, "circle": arguments.circle}))
    page = folder / "motion.html"
    asked = [page, *([folder / "figures"] if arguments.figures else [])]
    if known is not None and not arguments.overwrite and all(place.exists() for place in asked):
        return outputs.tell(known, arguments, folder, reused=True)
    with steps("analyse"):
        outcome = run_analyse(
            path,
            folder,
            window=arguments.window,
            circle_duration=arguments.circle,
            overwrite=arguments.overwrite or known is not None,
            figures=arguments.figures,
        )
    with steps("motion.html"):
        _write_motion_page(page, outcome.analysis, path, arguments.recording)
    files = (*outcome.summary.files, page, *outputs.write_times(folder, "analyse"))
    outputs.link_pages_of(path)
    return outputs.tell(replace(outcome.summary, files=files), arguments, folder)


def _write_motion_page(page: Path, analysis: Analysis, trajectory: Path, recording: Path | None) -> None:
    """The interactive page, with pictures where the images of this trajectory are at hand."""
    folder = recording or outputs.recording_of(trajectory)
    pairs = None
    if folder is not None:
        try:
            pairs = open_pairs(read_recording(folder))
        except RecordingError:
            if recording is not None:
                raise
    if pairs is not None and len(pairs) != len(analysis.trajectory):
        if recording is not None:
            raise RecordingError(
                f"{recording}: {len(pairs)} pairs, but {trajectory} has {len(analysis.trajectory)} frames: it was "
                "measured from another recording."
            )
        pairs = None

    def drawn(row: int) -> NDArray:
        assert pairs is not None
        images = outputs.pair_of(pairs, row)
        return draw_pair(images, analysis.trajectory, row)[: images.shape[1]]  # without the strip of numbers

    name = read_provenance(trajectory).recording
    write_whole(page, motion_html(analysis, name, None if pairs is None else drawn).encode())
