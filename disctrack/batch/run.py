"""A complete batch: find recordings, plan jobs, do them, write the summary.

The summary has one row per recording, as JSON and as CSV, merged from all processes and shards.
"""

import contextlib
import csv
import io
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from filelock import Timeout
from tqdm import tqdm

from calibration.kit.types import checked
from disctrack.batch.columns import COLUMNS, PATHS, REPEATS, Row, repeats_of
from disctrack.batch.locks import locked
from disctrack.batch.plan import BatchOptions, FoundRecordings, Job, find_recordings, make_plan
from disctrack.batch.pool import Cluster, Processes, do_all
from disctrack.batch.records import FAILED, MEASURED, NOT_MEASURED, SKIPPED, is_done, outcome, read_row
from disctrack.batch.report import counts, report_of
from disctrack.errors import AnalysisError, ArgumentError, ClusterError, OutputError, reason_of, told_as
from disctrack.files.json_text import json_file
from disctrack.files.software import __version__
from disctrack.files.text import csv_cell
from disctrack.files.whole import check_writable, seen_from, write_whole
from disctrack.findings import Kind, Severity, of_kind
from disctrack.progress import progress_bar
from disctrack.recording.declaration import FILE_NAME, changed_since
from disctrack.recording.readers.blocks import default_threads
from disctrack.report.blocks import Report
from disctrack.report.html import page
from disctrack.trajectory.file import read_provenance

INTERRUPTED = "interrupted before it was done"
SCHEMA, SCHEMA_VERSION = "disctrack batch summary", 1
TOGETHER = "together/diagnosis.html"  # diagnosis of all recordings, relative to the folder of the summary


@dataclass(frozen=True)
class BatchOutcome:
    """Result of a batch."""

    rows: tuple[Row, ...]  # of the recordings of this batch or shard
    files: tuple[Path, ...]  # summary.json, summary.csv, repeats.csv, index.html; none if they could not be written
    problems: tuple[str, ...]  # other than those of single recordings
    interrupted: bool = False
    together: str = ""  # verdict of the diagnosis of all recordings together
    undeclared: tuple[str, ...] = ()  # folders of images that no recording.toml declares

    @property
    def failed(self) -> bool:
        """True if a recording has no result, or the batch has a problem."""
        return bool(self.problems) or any(row["status"] in (FAILED, NOT_MEASURED) for row in self.rows)

    @property
    def incomplete(self) -> bool:
        """True if some results of a recording are missing or doubtful."""
        return any(row["reason"] for row in self.rows)

    def report(self) -> Report:
        """Report of the recordings and the problems."""
        left_out = [f"{name}: left out, images and no {FILE_NAME}" for name in self.undeclared]
        others = of_kind(Kind.OTHER, Severity.WARNING, self.problems) + of_kind(Kind.OTHER, Severity.NOTE, left_out)
        found = report_of(self.rows, others, TOGETHER if self.together else "", self.files)
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

    output : folder for all results, with subfolders as the recordings have; by default, `results` in each recording,
    and `batch_results` in the deepest folder common to all
    side_by_side : number of processes; by default one per core
    shard : (i, n), for every n-th recording from the i-th (1 to n) on
    cluster : address of a dask.distributed scheduler
    Raises RecordingError if there is nothing to measure, OutputError, ClusterError. Errors of single recordings are
    reported in their rows.

        >>> run_batch(["clip"], side_by_side=1).rows[0]["pairs_measured"]
        300
    """
    options = options or BatchOptions()
    cores = default_threads()
    n = side_by_side or cores
    # before the work, so that a wrong address is reported at once
    pool = Processes(n) if cluster is None else Cluster(cluster)
    with contextlib.closing(pool):
        found = find_recordings(folders, output)
        check_writable(found.common)
        first, step = shard or (1, 1)
        if not 1 <= first <= step:
            raise ArgumentError(f"run_batch: shard is {shard}; expected (i, n) with i from 1 to n")
        mine = slice(first - 1, None, step)
        rigs, jobs, records, undeclared = make_plan(found, found.recordings[mine], options)
        if cluster is None:
            # cores that are not used by other recordings read images ahead
            threads = max(1, cores // max(1, min(n, len(jobs))))
            jobs = [replace(job, threads=threads) for job in jobs]
        stopped = _do(rigs, jobs, records, pool)
    for job in jobs:
        records.setdefault(job.name, outcome(NOT_MEASURED, stopped))
    whole = shard is None  # only then the diagnosis of all together is made here
    done = _summed_up(found, mine, records, options, stopped == INTERRUPTED, n if whole else 0)
    return replace(done, undeclared=tuple(str(seen_from(found.base, place)) for place in undeclared))


def summarise_batch(folders: Sequence[Path], options: BatchOptions, output: Path | None) -> BatchOutcome:
    """Write the summary of the results on the disk, without measuring. Raises RecordingError."""
    found = find_recordings(folders, output)
    return _summed_up(found, slice(None), {}, options, False, default_threads())


def _do(rigs: list[Job], jobs: list[Job], records: dict[str, Row], pool: Processes | Cluster) -> str:
    """Do the jobs and put their rows into `records`; returns why the batch stopped early, otherwise ""."""
    n = len(jobs) + len(records)
    try:
        with progress_bar("batch", len(jobs), "recording") as advance:
            for job, row in do_all(rigs, jobs, pool):
                records[job.name] = row
                advance(1)
                tqdm.write(f"{len(records):4d} of {n}  {job.name}: {row['status']}", file=sys.stderr)
    except KeyboardInterrupt:
        return INTERRUPTED
    except ClusterError as error:
        return str(error)
    return ""


def _summed_up(
    found: FoundRecordings,
    mine: slice,
    records: dict[str, Row],
    options: BatchOptions,
    interrupted: bool,
    processes: int,
) -> BatchOutcome:
    """Diagnosis of all together and summary.

    mine : recordings of this batch or shard
    processes : for that diagnosis, 0 to omit it
    """
    problems = [f"not searched: {problem}" for problem in found.problems]
    said = ""
    if options.together and processes and not interrupted:
        try:
            said = diagnose_all(found.common, rows_of(found, records), processes)
        except AnalysisError as error:
            problems.append(f"together: {error}")
        except KeyboardInterrupt:  # the summary is written nevertheless
            interrupted = True
    files: tuple[Path, ...] = ()
    try:
        rows, files = write_summary(found, records, options)
    except OutputError as error:  # the results of the recordings may be complete nevertheless
        problems.append(str(error))
        rows = rows_of(found, records)
    files += (found.common / TOGETHER,) if said else ()
    return BatchOutcome(tuple(rows[mine]), files, tuple(problems), interrupted, said)


def diagnose_all(folder: Path, rows: Sequence[Row], processes: int) -> str:
    """Verdict of one diagnosis of all measured trajectories, reused if it exists in its folder below the summary.

    Raises AnalysisError if it is not possible.
    """
    from disctrack.diagnosis.together.stage import run_together  # imports the figures, which few batches need

    trajectories = [folder / row["trajectory"] for row in rows if row["trajectory"]]
    if len(trajectories) < 2:
        raise AnalysisError(f"{len(trajectories)} of the recordings measured; it takes two or more")
    try:
        whole = (folder / TOGETHER).parent
        return run_together(trajectories, whole, overwrite=True, reuse=True, processes=processes).verdict
    except Exception as error:  # must not prevent the summary of the single results
        raise AnalysisError(f"the recordings could not be diagnosed: {reason_of(error)}") from error


def rows_of(found: FoundRecordings, records: Mapping[str, Row]) -> list[Row]:
    """A row with all columns for every recording: from `records` (by name) if it is there, otherwise from the disk.

    Paths are relative to the summary's folder.
    """
    rows = []
    for folder in found.recordings:
        name, results = found.name(folder), found.results(folder)
        known = records[name] if name in records else _on_the_disk(folder, results)
        row: Row = {column: known.get(column) for column in COLUMNS} | {"recording": name}
        # the rig's path is absolute
        paths = {what: results / row[what] for what in (*PATHS, "rig") if row[what]} | {"folder": folder}
        rows.append(row | {what: seen_from(found.common, path).as_posix() for what, path in paths.items()})
    return rows


def _on_the_disk(folder: Path, results: Path) -> Row:
    """The stored row of a recording, with a reason if its declaration has changed since the measurement."""
    row = read_row(results)
    if row is None:
        return outcome(NOT_MEASURED, "not measured yet, or by another shard that has not come to it")
    if row["status"] != MEASURED:
        return row
    if not is_done(results, row, {}):
        return outcome(NOT_MEASURED, "its files are not those that were measured, or not all there")
    changed = changed_since(folder, read_provenance(results / row["trajectory"]).declared)
    stale = f"{FILE_NAME} has changed: {changed}; the batch without --summary-only measures it anew" if changed else ""
    return row | outcome(SKIPPED, "; ".join(filter(None, [stale, row["reason"]])))


def write_summary(
    found: FoundRecordings, records: Mapping[str, Row], options: BatchOptions
) -> tuple[list[Row], tuple[Path, ...]]:
    """Write summary.json, summary.csv, repeats.csv and index.html; returns the rows and the files.

    Shards that end at the same time write one after the other, each with all results on the disk: the last summary is
    complete. Raises OutputError.
    """
    wait = 300.0  # [s] for another process that writes the summary
    said = f"{found.common}: another process has been writing the summary for {wait:g} s"
    remedy = "Make it anew with --summary-only."
    with told_as(OutputError, said, Timeout, then=remedy), locked(found.common / ".summary.lock", wait):
        rows = with_false_discovery(rows_of(found, records))
        repeats = repeats_of(rows)
        document = {
            "schema": SCHEMA,
            "schema_version": SCHEMA_VERSION,
            "version": __version__,
            "searched": [str(found.base), *found.problems],
            "options": asdict(options),
            "counts": counts(rows),
            "columns": COLUMNS,
            "recordings": rows,
            "columns_of_repeats": REPEATS,
            "repeats": repeats,
        }
        together = TOGETHER if (found.common / TOGETHER).is_file() else ""
        files = {
            found.common / "summary.json": json_file(document),
            found.common / "summary.csv": as_csv(COLUMNS, rows),
            found.common / "repeats.csv": as_csv(REPEATS, repeats),
            found.common / "index.html": page(report_of(rows, together=together)).encode(),
        }
        for file, content in files.items():
            write_whole(file, content)
        return rows, tuple(files)


def with_false_discovery(rows: Sequence[Row]) -> list[Row]:
    """The rows with the false discovery rate of their p values: with many recordings, chance produces small ones.

    If all findings with a rate below 0.05 are accepted, 5 % of them are false on average, for noise that is independent
    or positively correlated (Benjamini and Hochberg 1995, Benjamini and Yekutieli 2001).
    """
    from scipy.stats import false_discovery_control  # slow to import, and seldom needed

    tested = [row for row in rows if row["diagnosis_p_value"] is not None]
    shares = false_discovery_control([row["diagnosis_p_value"] for row in tested])
    known = {row["recording"]: float(share) for row, share in zip(tested, shares, strict=True)}
    return [row | {"diagnosis_false_discovery": known.get(row["recording"])} for row in rows]


def as_csv(columns: Iterable[str], rows: Sequence[Row]) -> bytes:
    """The rows as a table; text cells are protected from evaluation as formulas."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(columns))
    writer.writeheader()
    writer.writerows({name: csv_cell(value) for name, value in row.items()} for row in rows)
    return text.getvalue().encode(errors="backslashreplace")
