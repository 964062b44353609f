"""Common parts of the commands: options, checks, reports and output files."""

import argparse
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from calibration import StereoRig
from calibration.kit.types import AnyArray
from disctrack.calibrate.stage import boards_in
from disctrack.commands import DONE, INCOMPLETE
from disctrack.files.json_text import json_text
from disctrack.files.whole import check_writable as check_writable
from disctrack.files.whole import seen_from
from disctrack.findings import Kind, Severity, in_doubt, leading, of_kind
from disctrack.progress import progress_bar
from disctrack.recording.declaration import FILE_NAME, Recording, changed_since
from disctrack.report.blocks import Facts, Report, document
from disctrack.report.html import link_pages
from disctrack.report.terminal import show
from disctrack.track import run_summary as summary
from disctrack.track.measurement import ImagePairs, TrackingSettings, measure, trajectory_provenance
from disctrack.track.video_overlay import shown_rows, write_overlay
from disctrack.trajectory import Trajectory
from disctrack.trajectory.exchange.motion import write_csv
from disctrack.trajectory.file import Details, Provenance, kept_or_made, read_provenance
from disctrack.trajectory.reuse import SUMMARY

RESULTS = "results"


def track_into(
    path: Path, recording: Recording, rig: StereoRig, rig_file: Path, pairs: ImagePairs, arguments: argparse.Namespace
) -> Report:
    """Track, or reuse an existing result; write trajectory, table, pictures, video.

    Raises OutputError if `path` contains something else and may not be replaced.
    """
    settings = TrackingSettings(first_pass=not (arguments.all or arguments.frames))
    rows = [("recording", f"{recording.name}: {len(pairs)} pairs at {recording.frame_rate:g} Hz")]

    def measured() -> tuple[Trajectory, Details]:
        with progress_bar("track", len(pairs), "pair") as advance:
            found = measure(recording, rig, pairs, settings, arguments.threads, advance, boards_in(rig_file, recording))
        speed = len(pairs) / max(found.seconds, 1e-9)
        rows.append(("speed", f"{speed:.0f} pairs/s ({found.seconds:.2f} s with reading the images)"))
        return found.trajectory, found.details

    def changed(made: Provenance) -> str:
        found = changed_since(recording.folder, made.declared)
        return f"{FILE_NAME}: {found}" if found else ""

    provenance = trajectory_provenance(recording, rig, pairs, settings)
    trajectory, details, fresh = kept_or_made(path, provenance, measured, arguments.overwrite, changed)
    if not fresh:
        rows.append(("reused", f"{path}: complete result of the same images, settings and version"))
    return Report(
        recording.name,
        f"Frames: {summary.frames_text(trajectory)}{'' if fresh else ' (reused)'}.",
        f"sigma {summary.sigma_text(trajectory)}",
        leading(trajectory.findings),
        blocks=[Facts([*rows, *summary.trajectory_rows(trajectory, details)])],
        files=[path, *_companions(path, trajectory, pairs, arguments, fresh)],
        then=f"disctrack analyse {relative(path)}",
    )


def recording_of(trajectory: Path) -> Path | None:
    """The folder of the recording whose folder or results contain a trajectory; None if there is none."""
    return next((place for place in trajectory.absolute().parents[:2] if (place / FILE_NAME).is_file()), None)


def warn_if_stale(trajectory: Path) -> None:
    """Print on stderr if the recording.toml of a trajectory has changed since the measurement."""
    folder, kept = recording_of(trajectory), read_provenance(trajectory).declared
    if folder is not None and (changed := changed_since(folder, kept)):
        place = relative(folder)
        print(
            f"disctrack: {place / FILE_NAME} has changed: {changed}. What follows is of {relative(trajectory)} as it "
            f"was measured; `disctrack run {place} --overwrite` measures anew.",
            file=sys.stderr,
        )


def finish(report: Report, arguments: argparse.Namespace, folder: Path, *, reused: bool = False) -> int:
    """Print a report according to the options. folder : that may contain the complete report as summary.txt

    returns : INCOMPLETE if images could not be read, or the result is in doubt, which is printed on stderr
    """
    show_report(report, arguments, folder, reused=reused)
    spoilt = [finding for finding in report.findings if finding.doubtful or finding.kind == Kind.UNREADABLE]
    if not spoilt:
        return DONE
    said = "the result is in doubt" if in_doubt(spoilt) else "some images could not be read"
    print(f"disctrack: {said} (see above).", file=sys.stderr)
    return INCOMPLETE


def show_report(report: Report, arguments: argparse.Namespace, folder: Path, *, reused: bool = False) -> None:
    """Print a report according to the options."""
    if arguments.json:
        print(json_text(document(report), indent=1))
    elif not arguments.quiet:
        again = "reused: the complete result of the same input, settings and version"
        said = of_kind(Kind.OTHER, Severity.NOTE, [again] if reused else [])
        files = [relative(file) for file in report.files]
        text = folder / SUMMARY
        if reused and arguments.verbose and text.is_file():
            print(again, text.read_text(encoding="utf-8"), sep="\n\n", end="")
        else:
            shown = replace(report, findings=[*report.findings, *said], files=files)
            show(shown, verbose=arguments.verbose)


def link_pages_of(trajectory: Path) -> None:
    """Link the pages of a recording with each other."""
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
    """Table, pictures and video next to the trajectory; those of a reused result are kept."""
    prefix = "" if path.stem == "trajectory" else f"{path.stem}_"
    if arguments.csv:
        write_csv(path.with_suffix(".csv"), trajectory, overwrite=True)
        yield path.with_suffix(".csv")
    if not arguments.no_figures:
        from disctrack.report.figures import save_figure
        from disctrack.track.pictures import FIGURES

        for name, make in FIGURES.items():
            picture = path.with_name(f"{prefix}{name}.png")
            if fresh or not picture.exists():
                save_figure(make(trajectory), picture)
            yield picture
    if not arguments.no_video:
        video = path.with_name(f"{prefix}overlay.mp4")
        if fresh or not video.exists():
            rows = shown_rows(pairs.start, pairs.stop)
            with progress_bar("video", len(rows), "frame") as advance:
                write_overlay(video, ((row, pair_of(pairs, row)) for row in rows), trajectory, advance)
        yield video


def pair_of(pairs: ImagePairs, row: int) -> AnyArray:
    """Both images of a frame (2, height, width); one that cannot be read is black."""
    (block,) = pairs.reading({})(row, row + 1)
    return block.images[0]


def relative(path: Path) -> Path:
    """The shorter of the path and its form relative to the working folder."""
    return min(seen_from(Path(), path), path, key=lambda p: len(str(p)))
