"""The summary of a batch: one row per recording, as JSON and as CSV, merged from all who took part."""

import csv
import dataclasses
import io
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

from filelock import Timeout

from disctrack.batch.columns import COLUMNS, Row
from disctrack.batch.find import FoundRecordings
from disctrack.batch.locks import locked
from disctrack.batch.plan import BatchOptions
from disctrack.batch.records import MEASURED, NOT_MEASURED, SKIPPED, Record, is_done, read_record
from disctrack.batch.repeats import REPEATS, repeats_of
from disctrack.batch.report import counts, report_of
from disctrack.errors import OutputError
from disctrack.files.json_text import json_file
from disctrack.files.software import __version__
from disctrack.files.text import csv_cell
from disctrack.files.whole import write_whole
from disctrack.recording.declaration import FILE_NAME
from disctrack.recording.declaration_text import changed_since
from disctrack.report.html import page
from disctrack.trajectory.file import read_provenance

SCHEMA, SCHEMA_VERSION = "disctrack batch summary", 1
_PATHS = ("trajectory", "report", "diagnosis_report")
TOGETHER = "together/diagnosis.html"  # of all recordings, below the folder of the summary


def rows_of(found: FoundRecordings, records: Mapping[str, Record]) -> list[Row]:
    """A row for every recording: from `records` (by name) where it took part now, else from what lies on the disk."""
    rows = []
    for folder in found.recordings:
        name = found.name(folder)
        record = records[name] if name in records else _on_the_disk(folder, found.results(folder))
        rows.append(_row(found, folder, name, record))
    return rows


def _on_the_disk(folder: Path, results: Path) -> Record:
    """With a reason where the declaration is no longer the one that was measured."""
    record = read_record(results)
    if record is None:
        return Record(NOT_MEASURED, "not measured yet, or by another shard that has not come to it")
    if record.status != MEASURED:
        return record
    if not is_done(results, record, {}):
        return Record(NOT_MEASURED, "its files are not those that were measured, or not all there")
    measured = read_provenance(results / record.files["trajectory"]).declared
    changed = changed_since(folder, measured) if measured else ""
    stale = f"{FILE_NAME} has changed: {changed}; the batch without --summary-only measures it anew" if changed else ""
    return dataclasses.replace(record, status=SKIPPED, reason="; ".join(filter(None, [stale, record.reason])))


def _row(found: FoundRecordings, folder: Path, name: str, record: Record) -> Row:
    known: Row = {"recording": name, "status": record.status, "reason": record.reason}
    known |= {column: value for column, value in record.numbers.items() if column in COLUMNS}
    paths = {what: found.results(folder) / record.files[what] for what in _PATHS if what in record.files}
    paths |= {"folder": folder} | ({"rig": Path(known["rig"])} if known.get("rig") else {})
    return dict.fromkeys(COLUMNS) | known | {what: _relative(path, found.common) for what, path in paths.items()}


def _relative(path: Path, folder: Path) -> str:
    try:
        return Path(os.path.relpath(path, folder)).as_posix()
    except ValueError:  # another drive
        return path.as_posix()


def write_summary(
    found: FoundRecordings, records: Mapping[str, Record], options: BatchOptions
) -> tuple[list[Row], tuple[Path, ...]]:
    """Write summary.json, summary.csv, repeats.csv and index.html; returns the rows and the files.

    Shards that end at the same time write one after the other, each with all that is on the disk by then: the last one
    has everything. Raises OutputError.
    """
    wait = 300.0  # [s] for another process that writes the summary
    try:
        with locked(found.common / ".summary.lock", wait):
            rows = with_false_discovery(rows_of(found, records))
            return rows, tuple(_write(found, rows, options))
    except Timeout as error:
        raise OutputError(
            f"{found.common}: another process has been writing the summary for {wait:g} s. Make it anew with "
            "--summary-only."
        ) from error


def _write(found: FoundRecordings, rows: Sequence[Row], options: BatchOptions) -> Iterator[Path]:
    folder, repeats = found.common, repeats_of(rows)
    document = {
        "schema": SCHEMA,
        "schema_version": SCHEMA_VERSION,
        "version": __version__,
        "searched": [str(found.base), *found.problems],
        "options": dataclasses.asdict(options),
        "counts": counts(rows),
        "columns": COLUMNS,
        "recordings": rows,
        "columns_of_repeats": REPEATS,
        "repeats": repeats,
    }
    together = TOGETHER if (folder / TOGETHER).is_file() else ""
    contents = {
        "summary.json": json_file(document),
        "summary.csv": as_csv(COLUMNS, rows),
        "repeats.csv": as_csv(REPEATS, repeats),
        "index.html": page(report_of(rows, repeats, together=together), {}).encode(),
    }
    for name, content in contents.items():
        write_whole(folder / name, content)
        yield folder / name


def with_false_discovery(rows: Sequence[Row]) -> list[Row]:
    """The rows with the share of false findings among all that are as improbable: the more that look, the more find.

    Who believes every finding whose share is below 0.05 has 5 % false ones among them on average, if their noise is
    independent or goes together (Benjamini and Hochberg 1995, Benjamini and Yekutieli 2001).
    """
    from scipy.stats import false_discovery_control  # only where wanted

    tested = [row for row in rows if row["diagnosis_p_value"] is not None]
    shares = false_discovery_control([row["diagnosis_p_value"] for row in tested])
    known = {row["recording"]: float(share) for row, share in zip(tested, shares, strict=True)}
    return [row | {"diagnosis_false_discovery": known.get(row["recording"])} for row in rows]


def as_csv(columns: Iterable[str], rows: Sequence[Row]) -> bytes:
    """The rows as a table that a spreadsheet shows as it is."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(columns))
    writer.writeheader()
    writer.writerows({name: csv_cell(value) for name, value in row.items()} for row in rows)
    return text.getvalue().encode(errors="backslashreplace")
