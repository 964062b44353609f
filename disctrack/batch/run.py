"""A batch from end to end: find, plan, do, sum up."""

import contextlib
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from tqdm import tqdm

from calibration.kit.arguments import checked
from disctrack.batch.columns import Row
from disctrack.batch.find import FoundRecordings, find_recordings
from disctrack.batch.plan import BatchOptions, Job, make_plan
from disctrack.batch.pool import Cluster, Processes, do_all
from disctrack.batch.records import FAILED, NOT_MEASURED, Record
from disctrack.batch.repeats import repeats_of
from disctrack.batch.report import report_of
from disctrack.batch.summary import TOGETHER, rows_of, write_summary
from disctrack.errors import AnalysisError, ArgumentError, ClusterError, OutputError, reason_of
from disctrack.files.whole import check_writable
from disctrack.findings import Kind, Severity, of_kind
from disctrack.progress import progress_bar
from disctrack.recording.declaration import FILE_NAME
from disctrack.recording.readers.blocks import default_threads
from disctrack.report.blocks import Report

INTERRUPTED = "interrupted before it was done"


@dataclass(frozen=True)
class BatchOutcome:
    """What a batch did."""

    rows: tuple[Row, ...]  # of the recordings that were this batch's to do
    files: tuple[Path, ...]  # summary.json, summary.csv, repeats.csv, index.html; none where they could not be written
    problems: tuple[str, ...]  # besides those of single recordings
    interrupted: bool = False
    together: str = ""  # verdict of the diagnosis of all recordings together
    undeclared: tuple[str, ...] = ()  # folders of images that no recording.toml speaks of

    @property
    def failed(self) -> bool:
        """Some recording has no result, or the summary none."""
        return bool(self.problems) or any(row["status"] in (FAILED, NOT_MEASURED) for row in self.rows)

    @property
    def incomplete(self) -> bool:
        """Some recording was measured, but not all of it could be used."""
        return any(row["reason"] for row in self.rows)

    def report(self) -> Report:
        """What became of the recordings."""
        others = [*of_kind(Kind.OTHER, Severity.WARNING, self.problems)]
        others += of_kind(
            Kind.OTHER, Severity.NOTE, [f"{name}: left out, images and no {FILE_NAME}" for name in self.undeclared]
        )
        found = report_of(self.rows, repeats_of(self.rows), others, TOGETHER if self.together else "", self.files)
        together = f" All together: {self.together}" if self.together else ""
        return replace(found, verdict=found.verdict + together)


@checked
def run_batch(
    folders: Sequence[str | Path],
    options: BatchOptions | None = None,
    output: str | Path | None = None,
    side_by_side: int | None = None,
    shard: tuple[int, int] | None = None,
    cluster: str | None = None,
) -> BatchOutcome:
    """Measure all recordings at and below `folders`.

    output : folder for all results, in the order of the recordings' own folders; without it, each recording's own
    `results`, and `batch_results` in the deepest folder common to all
    side_by_side : processes; without it, one per core
    shard : (i, n), for every n-th recording from the i-th (1 to n) on
    cluster : address of a dask.distributed scheduler
    Raises RecordingError if there is nothing to measure, OutputError, ClusterError. What is wrong with one recording
    is in its row.

        >>> run_batch(["clip"], side_by_side=1).rows[0]["pairs_measured"]
        300
    """
    options = options or BatchOptions()
    cores = default_threads()
    n = side_by_side or cores
    # before the work: a wrong address must be told at once
    pool = Processes(n) if cluster is None else Cluster(cluster)
    with contextlib.closing(pool):
        found = find_recordings(folders, output)
        check_writable(found.common)
        first, step = shard or (1, 1)
        if not 1 <= first <= step:
            raise ArgumentError(f"run_batch: shard is {shard}; expected (i, n) with i from 1 to n")
        mine = found.recordings[first - 1 :: step]
        rigs, jobs, records, undeclared = make_plan(found, mine, options)
        if cluster is None:
            # cores that no other recording uses read images ahead
            threads = max(1, cores // max(1, min(n, len(jobs))))
            jobs = [replace(job, threads=threads) for job in jobs]
        stopped = _do(rigs, jobs, records, pool)
    for job in jobs:
        records.setdefault(job.name, Record(NOT_MEASURED, stopped))
    whole = shard is None  # or else whoever sums up the shards
    outcome = _summed_up(found, mine, records, options, stopped == INTERRUPTED, n if whole else 0)
    return replace(outcome, undeclared=tuple(os.path.relpath(place, found.base) for place in undeclared))


def summarise_batch(
    folders: Sequence[Path], options: BatchOptions | None = None, output: str | Path | None = None
) -> BatchOutcome:
    """The summary of what lies on the disk; nothing is measured. Raises RecordingError."""
    found = find_recordings(folders, output)
    return _summed_up(found, found.recordings, {}, options or BatchOptions(), False, default_threads())


def _do(rigs: list[Job], jobs: list[Job], records: dict[str, Record], pool: Processes | Cluster) -> str:
    """Fill `records` with what becomes of the recordings; returns why some have none."""
    n = len(jobs) + len(records)

    def done(job: Job, record: Record) -> None:
        records[job.name] = record
        advance(1)
        tqdm.write(f"{len(records):4d} of {n}  {job.name}: {record.status}", file=sys.stderr)

    try:
        with progress_bar("batch", len(jobs), "recording") as advance:
            do_all(rigs, jobs, pool, done)
    except KeyboardInterrupt:
        return INTERRUPTED
    except ClusterError as error:
        return str(error)
    return ""


def _summed_up(
    found: FoundRecordings,
    mine: Sequence[Path],
    records: dict[str, Record],
    options: BatchOptions,
    interrupted: bool,
    processes: int,
) -> BatchOutcome:
    """Processes : for the diagnosis of all together; 0: not now."""
    problems = [f"not searched: {problem}" for problem in found.problems]
    said = ""
    if options.together and processes and not interrupted:
        measured = rows_of(found, records)
        try:
            said = diagnose_all(found.common, measured, processes)
        except AnalysisError as error:
            problems.append(f"together: {error}")
        except KeyboardInterrupt:  # what was measured is summed up all the same
            interrupted = True
    files: tuple[Path, ...] = ()
    try:
        rows, files = write_summary(found, records, options)
    except OutputError as error:  # the results themselves may be safe all the same
        problems.append(str(error))
        rows = rows_of(found, records)
    files += (found.common / TOGETHER,) if said else ()
    names = {found.name(folder) for folder in mine}
    own = tuple(row for row in rows if row["recording"] in names)
    return BatchOutcome(own, files, tuple(problems), interrupted, said)


def diagnose_all(folder: Path, rows: Sequence[Row], processes: int) -> str:
    """Verdict of one diagnosis of all measured trajectories, made in a folder beside the summary unless it is there.

    Raises AnalysisError where there is none.
    """
    from disctrack.diagnosis.together.stage import run_together  # draws figures: only where they are wanted

    trajectories = [folder / row["trajectory"] for row in rows if row["trajectory"]]
    if len(trajectories) < 2:
        raise AnalysisError(f"{len(trajectories)} of the recordings measured; it takes two or more")
    try:
        whole = (folder / TOGETHER).parent
        return run_together(trajectories, whole, overwrite=True, reuse=True, processes=processes).verdict
    except Exception as error:  # the single results are worth more than their combination
        raise AnalysisError(f"the recordings could not be diagnosed: {reason_of(error)}") from error
