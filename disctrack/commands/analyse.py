"""`disctrack analyse`: from a trajectory file to the physics."""

import argparse
from pathlib import Path

from numpy.typing import NDArray

from disctrack.analyse.analysis import Analysis
from disctrack.analyse.motion_page import write_motion_page
from disctrack.analyse.stage import run_analyse
from disctrack.commands import DONE
from disctrack.commands._outputs import pair_of, tell_stale, write_times
from disctrack.errors import RecordingError
from disctrack.progress import stage
from disctrack.recording.declaration import FILE_NAME, read_recording
from disctrack.track.measurement import open_pairs
from disctrack.track.video_overlay import draw_pair
from disctrack.trajectory.file import read_provenance, trajectory_in
from disctrack.trajectory.reuse import origin_of, remember, reusable


def run(arguments: argparse.Namespace) -> int:
    """Analyse, write, and say what was found; returns the exit code."""
    path = trajectory_in(arguments.trajectory)
    folder = arguments.output or path.parent / f"{path.stem}_analysis"
    tell_stale(path)
    origin = origin_of(path, {"window": arguments.window, "circle": arguments.circle})
    told = reusable(folder, origin)
    page = folder / "motion.html"
    asked = [page, *([folder / "figures"] if arguments.figures else [])]
    more = not all(place.exists() for place in asked)
    if told is not None and not (arguments.overwrite or more):
        print(
            "\n".join([f"reused        {folder}: complete result of the same trajectory, settings and version", *told])
        )
        return DONE
    again = arguments.overwrite or told is not None
    with stage("analyse"):
        outcome = run_analyse(
            path,
            folder,
            window=arguments.window,
            circle_duration=arguments.circle,
            overwrite=again,
            figures=arguments.figures,
        )
    lines = outcome.lines()
    with stage("motion.html"):
        _write_motion_page(page, outcome.analysis, path, arguments.recording)
    lines.append(f"              {page}")
    lines += [f"              {file}" for file in write_times(folder, "analyse")]
    remember(folder, origin, lines, (outcome.report, page, *outcome.figures))
    print("\n".join(lines))
    return DONE


def _write_motion_page(page: Path, analysis: Analysis, trajectory: Path, recording: Path | None) -> None:
    """The interactive page, with pictures where the images of this trajectory are at hand."""
    folder = recording or next(
        (place for place in (trajectory.parent, trajectory.parent.parent) if (place / FILE_NAME).is_file()), None
    )
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
        images = pair_of(pairs, row)
        return draw_pair(images, analysis.trajectory, row)[: images.shape[1]]  # without the strip of numbers

    write_motion_page(page, analysis, read_provenance(trajectory).recording, None if pairs is None else drawn)
