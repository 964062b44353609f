"""What the commands share: options, checks before the work, files after it."""

import argparse
import json
import os
import sys
import time
from collections.abc import Iterable, Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration import CalibrationSettings, StereoRig
from disctrack.calibrate.stage import boards_in
from disctrack.commands import DONE, INCOMPLETE
from disctrack.errors import OutputError, RecordingError, TrajectoryFileError
from disctrack.files.json_text import json_file, json_text
from disctrack.files.software import software_version
from disctrack.files.whole import check_writable as check_writable
from disctrack.files.whole import write_whole
from disctrack.findings import Finding, Kind, Severity, in_doubt, leading, of_kind
from disctrack.progress import progress_bar, times_so_far
from disctrack.recording.changed import changed_since, told_differences
from disctrack.recording.declaration import FILE_NAME, Recording
from disctrack.report.blocks import Facts, Report, document
from disctrack.report.html import link_pages
from disctrack.report.terminal import show
from disctrack.track import run_summary as summary
from disctrack.track.follow.tracking import TrackingSettings
from disctrack.track.measurement import ImagePairs, measure, trajectory_provenance
from disctrack.track.video_overlay import shown_rows, write_overlay
from disctrack.trajectory import Trajectory
from disctrack.trajectory import file as storage
from disctrack.trajectory.exchange.csv_table import write_csv
from disctrack.trajectory.reuse import SUMMARY

RESULTS = "results"


def calibration_settings(arguments: argparse.Namespace) -> CalibrationSettings:
    """The options of a calibration as they were given."""
    return CalibrationSettings(distortion=arguments.distortion, board=arguments.board)


def track_into(
    path: Path, recording: Recording, rig: StereoRig, rig_file: Path, pairs: ImagePairs, arguments: argparse.Namespace
) -> tuple[Report, tuple[Finding, ...]]:
    """Track, or reuse what is there; write trajectory, table, pictures, video. returns : also what was noticed

    Raises OutputError if `path` holds something else and may not be replaced.
    """
    rows = [("recording", f"{recording.name}: {len(pairs)} pairs at {recording.frame_rate:g} Hz")]
    trajectory, details = None, {}
    fresh, settings = False, TrackingSettings(first_pass=not (arguments.all or arguments.frames))
    if path.exists() and not arguments.overwrite:
        if not storage.is_result_of(path, trajectory_provenance(recording, rig, pairs, settings)):
            raise OutputError(
                f"{path}: exists, and is not the complete result of these images, settings and version"
                f"{_why(path, recording)}. Keep it and choose another place with -o, or replace it with --overwrite."
            )
        trajectory, details = storage.read_trajectory(path), storage.read_details(path)
        rows.append(("reused", f"{path}: complete result of the same images, settings and version"))
    if trajectory is None:
        with progress_bar("track", len(pairs), "pair") as advance:
            boards = boards_in(rig_file, recording)
            measurement = measure(recording, rig, pairs, settings, arguments.threads, advance, boards)
        trajectory, details = measurement.trajectory, measurement.details
        provenance = trajectory_provenance(recording, rig, pairs, settings)
        storage.write_trajectory(path, trajectory, provenance, overwrite=arguments.overwrite, details=details)
        speed = len(pairs) / max(measurement.seconds, 1e-9)
        fresh = True
        rows.append(("speed", f"{speed:.0f} pairs/s ({measurement.seconds:.2f} s with reading the images)"))
    report = Report(
        recording.name,
        f"Frames: {summary.frames_text(trajectory)}{'' if fresh else ' (reused)'}.",
        f"sigma {summary.sigma_text(trajectory)}",
        leading(trajectory.findings),
        blocks=[Facts([*rows, *summary.trajectory_rows(trajectory, details)])],
        files=[path, *_companions(path, trajectory, pairs, arguments, fresh)],
        then=f"disctrack analyse {relative(path)}",
    )
    return report, trajectory.findings


def _why(path: Path, recording: Recording) -> str:
    """What was declared otherwise, or which version made it, where that explains why a result is not reused."""
    try:
        made = storage.read_provenance(path)
    except TrajectoryFileError:
        return ""
    changed = told_differences(json.loads(json.dumps(recording.declared, default=str)), _declared(made))
    return f" ({FILE_NAME}: {changed})" if changed else f" (made by {made.version})"


def _declared(made: storage.Provenance) -> dict[str, Any]:
    """The declaration that a trajectory was measured with."""
    kept = made.settings.get("recording")
    return dict(kept) if isinstance(kept, dict) else {}


def recording_of(trajectory: Path) -> Path | None:
    """The folder of the recording in whose folder or results a trajectory lies."""
    return next((place for place in trajectory.absolute().parents[:2] if (place / FILE_NAME).is_file()), None)


def tell_stale(trajectory: Path) -> None:
    """Say on stderr where the recording.toml beside a trajectory is no longer the one that it was measured with."""
    folder = recording_of(trajectory)
    kept = _declared(storage.read_provenance(trajectory))
    changed = changed_since(folder, kept) if folder is not None and kept else ""
    if folder is not None and changed:
        place = relative(folder)
        print(
            f"disctrack: {place / FILE_NAME} has changed: {changed}. What follows is of {relative(trajectory)} as it "
            f"was measured; `disctrack run {place} --overwrite` measures anew.",
            file=sys.stderr,
        )


def exit_code(findings: Iterable[Finding]) -> int:
    """INCOMPLETE where images could not be read, or the result is in doubt; said on stderr."""
    spoilt = [finding for finding in findings if finding.doubtful or finding.kind == Kind.UNREADABLE]
    if not spoilt:
        return DONE
    said = "the result is in doubt" if in_doubt(spoilt) else "some images could not be read"
    print(f"disctrack: {said} (see above).", file=sys.stderr)
    return INCOMPLETE


def tell(
    report: Report,
    arguments: argparse.Namespace,
    folder: Path,
    findings: Iterable[Finding] = (),
    *,
    reused: bool = False,
) -> int:
    """Show a report as the options ask for it; returns the exit code.

    folder : where all of the report lies as summary.txt, if it does;  findings : of the measurement
    """
    if arguments.json:
        print(json_text(document(report), indent=1))
    elif not arguments.quiet:
        again = "reused: the complete result of the same input, settings and version"
        said = of_kind(Kind.OTHER, Severity.NOTE, [again] if reused else [])
        page = None if report.page is None else relative(report.page)
        files = [relative(file) for file in report.files]
        text = folder / SUMMARY
        if reused and arguments.verbose and text.is_file():
            print(again, text.read_text(encoding="utf-8"), sep="\n\n", end="")
        else:
            shown = replace(report, findings=[*report.findings, *said], files=files, page=page)
            show(shown, verbose=arguments.verbose)
    return exit_code(findings)


def link_pages_of(trajectory: Path) -> None:
    """Let the pages that were made of a recording name each other."""
    folder, stem = trajectory.parent, trajectory.stem
    link_pages({
        "analysis": folder / f"{stem}_analysis" / "report.html",
        "motion": folder / f"{stem}_analysis" / "motion.html",
        "diagnosis": folder / f"{stem}_diagnosis" / "diagnosis.html",
        "video": folder / "overlay.mp4",
    })  # fmt: skip


def _companions(
    path: Path, trajectory: Trajectory, pairs: ImagePairs, arguments: argparse.Namespace, fresh: bool
) -> Iterator[Path]:
    """Table, pictures and video beside the trajectory; those that a reused result already has are kept."""
    prefix = "" if path.stem == "trajectory" else f"{path.stem}_"
    if arguments.csv:
        write_csv(path.with_suffix(".csv"), trajectory, overwrite=True)
        yield path.with_suffix(".csv")
    if not arguments.no_figures:
        from disctrack.report.figures import save_figure
        from disctrack.track.pictures import FIGURES

        pictures = {path.with_name(f"{prefix}{name}.png"): make for name, make in FIGURES.items()}
        missing = [picture for picture in pictures if fresh or not picture.exists()]
        if missing:
            with progress_bar("figures", len(missing), "figure") as advance:
                for picture in missing:
                    save_figure(pictures[picture](trajectory), picture)
                    advance(1)
        yield from pictures
    if not arguments.no_video:
        video = path.with_name(f"{prefix}overlay.mp4")
        if fresh or not video.exists():
            _write_video(video, trajectory, pairs)
        yield video


def _write_video(path: Path, trajectory: Trajectory, pairs: ImagePairs) -> None:

    rows = shown_rows(pairs.start, pairs.stop)
    with progress_bar("video", len(rows), "frame") as advance:
        write_overlay(path, ((row, pair_of(pairs, row)) for row in rows), trajectory, advance)


def pair_of(pairs: ImagePairs, row: int) -> NDArray:
    """Both images of a frame; one that cannot be read is black."""
    width, height = pairs.left.image_size
    images = np.zeros((2, height, width), np.uint8 if pairs.left.bit_depth == 8 else np.uint16)
    for image, reader in zip(images, (pairs.left, pairs.right), strict=True):
        try:
            reader.read(row, image)
        except RecordingError:
            image[...] = 0
    return images


def write_times(folder: Path, command: str) -> list[Path]:
    """Keep in times.json what the stages of this command took; returns it, or nothing where all was reused.

    The processor's seconds are those of the whole process: with its imports, and with what is in no stage. Raises
    OutputError.
    """
    stages = times_so_far()
    if not stages:
        return []
    path = folder / "times.json"
    try:
        document = dict(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):  # not there, or not ours to mend
        document = {}
    document[command] = {
        "version": software_version(),
        "seconds": round(sum(stage.seconds for stage in stages), 3),
        "processor_seconds": round(time.process_time(), 3),
        "stages": [asdict(stage) for stage in stages],
    }
    write_whole(path, json_file(document))
    return [path]


def relative(path: Path) -> Path:
    """The shorter of the path and its form relative to the working folder."""
    try:
        short = Path(os.path.relpath(path))
    except ValueError:  # another drive
        return path
    return min(short, path, key=lambda p: len(str(p)))
