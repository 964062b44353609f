"""Speed of a batch: one process against two, beside two independent ones, and beside blocks of frames in one process.

    python tests/benchmarks/bench_batch.py RECORDING [--rig RIG] [--copies N] [--report] [--repeats N]

Makes N copies of the recording (links to its files) that name one rig, and measures them
  - by `disctrack batch -j 1` and `-j 2`;
  - by two independent `disctrack batch -j 1`, half of the copies each: what this machine gives to two processes that
    know nothing of each other, so that their time is the least that -j 2 could take;
  - in one process, one recording after the other, each read and, where it is long enough, followed by two threads.
Times are the best of the repeats, taken in turn. On a busy machine trust the processor's time, and the ratio to the two
independent processes: two processes get twice the share of one there, whatever they do.
Not a test: nothing fails here.
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2

from calibration import CalibrationSettings
from calibration.rig_file import read_rig
from disctrack.analyse.analysis import analyse
from disctrack.analyse.stage import run_analyse, write_analysis
from disctrack.batch import read_summary
from disctrack.batch.processes import ONE_THREAD
from disctrack.calibrate.stage import calibrate_into, source_of
from disctrack.files.trajectory_file import Provenance, write_trajectory
from disctrack.recording.declaration import read_recording
from disctrack.track.stage import measure, open_pairs
from disctrack.track.tracking import prepare

PACKAGE = str(Path(__file__).resolve().parents[2])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--rig", type=Path, help="default: calibrated from the recording's views")
    parser.add_argument("--copies", type=int, default=8)
    parser.add_argument("--report", action="store_true", help="with report and figures of each, as a user would")
    parser.add_argument("--repeats", type=int, default=2)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        day = copies_of(arguments.recording.resolve(), arguments.rig, Path(scratch), arguments.copies)
        compare(day, arguments.report, arguments.repeats)


def copies_of(recording: Path, rig: Path | None, scratch: Path, n: int) -> list[Path]:
    """The copies, in two halves of one folder."""
    declared = read_recording(recording)
    if rig is None:
        rig = scratch / "rig.h5"
        settings = CalibrationSettings(distortion="k1 k2 p1 p2", board="flat")
        calibrate_into(rig, source_of(declared, settings), overwrite=True, figures=False)
    text = declared.file.read_text(encoding="utf-8")
    start, end = text.index("[calibration]"), text.index("[gravity]")
    text = f'{text[:start]}[calibration]\nrig = "{rig.resolve().as_posix()}"\n\n{text[end:]}'
    folders = []
    for i in range(n):
        folder = scratch / "day" / f"half {i % 2}" / f"copy {i}"
        folder.mkdir(parents=True)
        for camera in ("left", "right"):
            (folder / camera).symlink_to(recording / camera, target_is_directory=True)
        (folder / "recording.toml").write_text(text, encoding="utf-8")
        folders.append(folder)
    return folders


def compare(day: list[Path], report: bool, repeats: int) -> None:
    root = day[0].parents[1]
    halves = sorted({folder.parent for folder in day})
    ways = {
        "disctrack batch -j 1": lambda: batches([root], 1, report),
        "disctrack batch -j 2": lambda: batches([root], 2, report),
        "two independent processes": lambda: batches(halves, 1, report),
        "one process, two threads per recording": lambda: with_two_threads(day, report),
    }
    with_two_threads(day[:1], report)  # compiles
    best, busy = dict.fromkeys(ways, (float("inf"), float("inf"))), dict.fromkeys(ways, 0.0)
    for _ in range(repeats):
        for way, action in ways.items():
            for results in root.rglob("*results"):
                shutil.rmtree(results)
            used = processor()
            wall = action()
            best[way] = min(best[way][0], wall), min(best[way][1], processor() - used)
            busy[way] = max(busy[way], in_recordings(root) / wall)
    pairs = sum(len(open_pairs(read_recording(folder))) for folder in day)
    (one, one_core), (two, two_cores), (independent, _), (threads, _) = best.values()
    print(f"{len(day)} recordings, {pairs} pairs, {'with' if report else 'without'} reports")
    for way, (seconds, cores) in best.items():
        rate, gain = f"{pairs / seconds:6.0f} pairs/s", f"{one / seconds:5.2f} x -j 1"
        at_once = f"{busy[way]:4.2f} recordings at once" if busy[way] else ""
        print(f"  {way:<44} {seconds:7.1f} s  {cores:7.1f} s of a core  {rate}  {gain}  {at_once}")
    print(f"  {'-j 2 / two independent processes, time':<44} {two / independent:7.2f}")
    print(f"  {'-j 2 / -j 1, time of a core':<44} {two_cores / one_core:7.2f}")
    print(f"  {'two threads / -j 2, time':<44} {threads / two:7.2f}")


def in_recordings(root: Path) -> float:
    """Seconds that the single recordings took, summed up: over the time of the whole, how many went side by side.

    It leaves out what a batch costs besides: starting processes, planning, summing up. A busy machine slows both alike.
    """
    rows = [row for summary in root.rglob("summary.json") for row in read_summary(summary)]
    return sum(row["seconds"] for row in rows)


def processor() -> float:
    """Processor time [s] of this process and of those that have ended."""
    own, ended = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return own.ru_utime + own.ru_stime + ended.ru_utime + ended.ru_stime


def batches(roots: list[Path], side_by_side: int, report: bool) -> float:
    """Seconds that batches on these folders take, all at once."""
    began = time.perf_counter()
    words = ["-j", str(side_by_side), *([] if report else ["--no-report"])]
    running = [
        subprocess.Popen(
            [sys.executable, "-m", "disctrack", "batch", str(root), *words],
            cwd=PACKAGE,
            env=os.environ | ONE_THREAD,
            stdout=subprocess.DEVNULL,
        )
        for root in roots
    ]
    if any(process.wait() for process in running):
        raise SystemExit("a batch failed")
    return time.perf_counter() - began


def with_two_threads(day: list[Path], report: bool) -> float:
    """Seconds for the same in this process, its start not counted."""
    cv2.setNumThreads(1)
    prepare()
    began = time.perf_counter()
    for folder in day:
        recording = read_recording(folder)
        pairs, rig = open_pairs(recording), read_rig(recording.rig_file)
        trajectory = measure(recording, rig, pairs, threads=2).trajectory
        path = folder / "results" / "trajectory.h5"
        provenance = Provenance(recording.name, pairs.inputs(), {})
        write_trajectory(path, trajectory, provenance, overwrite=True)
        if report:
            run_analyse(path, overwrite=True)
        else:
            write_analysis(path, analyse(trajectory))
    return time.perf_counter() - began


if __name__ == "__main__":
    main()
