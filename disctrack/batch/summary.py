"""The summary of a batch: one row per recording, as JSON and as CSV, merged from all who took part."""

import contextlib
import csv
import dataclasses
import io
import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

from disctrack.batch.columns import COLUMNS, FALSE_DISCOVERY, LACKS_SOMETHING, Row
from disctrack.batch.index import index_page
from disctrack.batch.locks import Busy, locked
from disctrack.batch.plan import BatchOptions, Places
from disctrack.batch.records import FAILED, MEASURED, NOT_MEASURED, SKIPPED, Record, Result, is_done, read_record
from disctrack.batch.repeats import REPEATS, repeats_of
from disctrack.batch.together import FOLDER
from disctrack.errors import OutputError
from disctrack.files.json_text import json_file
from disctrack.files.software import __version__
from disctrack.files.text import csv_cell, printable
from disctrack.files.whole import write_whole
from disctrack.recording.changed import changed_since
from disctrack.recording.declaration import FILE_NAME
from disctrack.report.numbers import measured, rounded
from disctrack.trajectory.file import read_provenance

SCHEMA, SCHEMA_VERSION = "disctrack batch summary", 1
_PATHS = ("trajectory", "report", "diagnosis_report")
_WAIT = 300.0  # [s] for another process that writes the summary


def rows_of(places: Places, recordings: Sequence[Path], results: Mapping[str, Result]) -> list[Row]:
    """A row for every recording: from `results` (by name) where it took part now, else from what lies on the disk."""
    rows = []
    for folder in recordings:
        name = places.found.name(folder)
        record, status = _outcome(places.results(folder), results.get(name))
        if name not in results and status == SKIPPED:
            record = _if_stale(folder, places.results(folder), record)
        rows.append(_row(places, folder, name, record, status))
    return rows


def _outcome(folder: Path, result: Result | None) -> tuple[Record, str]:
    if result is not None:
        return result.record, result.status
    record = read_record(folder)
    if record is None:
        return Record(NOT_MEASURED, "not measured yet, or by another shard that has not come to it"), NOT_MEASURED
    if record.status == MEASURED and not is_done(folder, record, {}):
        return Record(NOT_MEASURED, "its files are not those that were measured, or not all there"), NOT_MEASURED
    return record, SKIPPED if record.status == MEASURED else FAILED


def _if_stale(folder: Path, results: Path, record: Record) -> Record:
    """The record, with a reason where the declaration is no longer the one that was measured."""
    measured = read_provenance(results / record.files["trajectory"]).settings.get("recording")
    changed = changed_since(folder, measured) if isinstance(measured, dict) else ""
    stale = f"{FILE_NAME} has changed: {changed}; the batch without --summary-only measures it anew" if changed else ""
    return dataclasses.replace(record, reason="; ".join(filter(None, [stale, record.reason])))


def _row(places: Places, folder: Path, name: str, record: Record, status: str) -> Row:
    row: Row = dict.fromkeys(COLUMNS)
    row |= {k: v for k, v in record.numbers.items() if k in COLUMNS}
    row |= {"recording": name, "status": status, "reason": record.reason, "folder": _relative(folder, places.common)}
    for what in _PATHS:
        if what in record.files:
            row[what] = _relative(places.results(folder) / record.files[what], places.common)
    if row["rig"]:
        row["rig"] = _relative(Path(row["rig"]), places.common)
    return row


def _relative(path: Path, folder: Path) -> str:
    try:
        return Path(os.path.relpath(path, folder)).as_posix()
    except ValueError:  # another drive
        return path.as_posix()


def write_summary(
    places: Places, recordings: Sequence[Path], results: Mapping[str, Result], options: BatchOptions
) -> tuple[list[Row], tuple[Path, ...]]:
    """Write summary.json, summary.csv, repeats.csv and index.html; returns the rows and the files.

    Shards that end at the same time write one after the other, each with all that is on the disk by then: the last one
    has everything. Raises OutputError.
    """
    folder = places.common
    with _for_writing(folder):
        rows = with_false_discovery(rows_of(places, recordings, results))
        repeats = repeats_of(rows)
        document = {
            "schema": SCHEMA,
            "schema_version": SCHEMA_VERSION,
            "version": __version__,
            "searched": [str(places.found.base), *places.found.problems],
            "options": dataclasses.asdict(options),
            "counts": counts(rows),
            "columns": COLUMNS,
            "recordings": rows,
            "columns_of_repeats": REPEATS,
            "repeats": repeats,
        }
        together = f"{FOLDER}/diagnosis.html"
        contents = {
            "summary.json": json_file(document),
            "summary.csv": _as_csv(COLUMNS, rows),
            "repeats.csv": _as_csv(REPEATS, repeats),
            "index.html": index_page(rows, repeats, together if (folder / together).is_file() else "").encode(),
        }
        for name, content in contents.items():
            write_whole(folder / name, content)
    return rows, tuple(folder / name for name in contents)


def with_false_discovery(rows: Sequence[Row]) -> list[Row]:
    """The rows with the share of false findings among all that are as improbable: the more that look, the more find."""
    from disctrack.discrepancy.significance import false_discovery  # SciPy's statistics: only where wanted

    tested = [row for row in rows if row["diagnosis_p_value"] is not None]
    shares = false_discovery([row["diagnosis_p_value"] for row in tested])
    known = {row["recording"]: float(share) for row, share in zip(tested, shares, strict=True)}
    return [row | {"diagnosis_false_discovery": known.get(row["recording"])} for row in rows]


@contextlib.contextmanager
def _for_writing(folder: Path) -> Iterator[None]:
    try:
        with locked(folder / ".summary.lock", wait=_WAIT):
            yield
    except Busy as error:
        raise OutputError(
            f"{folder}: another process has been writing the summary for {_WAIT:g} s. Make it anew with --summary-only."
        ) from error


def read_summary(path: Path) -> list[Row]:
    """Rows of a summary.json. Raises OutputError if it is none."""
    try:
        document = json.loads(Path(path).read_text(encoding="utf-8"))
        if document["schema"] == SCHEMA:
            return list(document["recordings"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise OutputError(f"{path}: cannot be read as the summary of a batch ({error}).") from error
    raise OutputError(f"{path}: not the summary of a batch. Give the summary.json that disctrack batch wrote.")


def counts(rows: Sequence[Row]) -> dict[str, int]:
    """How many recordings have which status."""
    statuses = [row["status"] for row in rows]
    return {status: statuses.count(status) for status in (MEASURED, SKIPPED, FAILED, NOT_MEASURED)}


def _as_csv(columns: Iterable[str], rows: Sequence[Row]) -> bytes:
    text = io.StringIO()
    writer = csv.DictWriter(text, list(columns))
    writer.writeheader()
    writer.writerows({name: csv_cell(value) for name, value in row.items()} for row in rows)
    return text.getvalue().encode(errors="backslashreplace")


def line_of(row: Row, width: int) -> str:
    """One line for people: what became of a recording. width : of the longest name"""
    head = f"{row['status']:<13} {row['recording']:<{width}}"
    if row["status"] in (FAILED, NOT_MEASURED):
        return printable(f"{head}  {row['reason']}")
    parts = [f"{row['pairs_measured']} of {row['pairs']} pairs"]
    if row["k_m_m_s2"] is not None:
        parts.append(f"k_m {measured(row['k_m_m_s2'], row['k_m_sigma_m_s2'], 'm s^2')}")
        if row["k_m_reduced_chi_square"] > LACKS_SOMETHING:
            parts.append(f"but the model with it lacks something (chi-square {rounded(row['k_m_reduced_chi_square'])})")
    if row["n_theta"] is not None:
        parts.append(f"n_theta {measured(row['n_theta'], row['n_theta_sigma'])}")
    if row["t_f_s"] is not None:
        parts.append(f"t_f {measured(row['t_f_s'], row['t_f_sigma_s'])} s")
    rms = [row[f"reprojection_rms_{camera}_px"] for camera in ("left", "right")]
    if None not in rms:
        parts.append(f"rms {rounded(max(rms))} px")
    if row["diagnosis"]:
        share = row["diagnosis_false_discovery"]
        doubt = "" if share is None or share < FALSE_DISCOVERY else f" (of as improbable ones {share:.0%} are chance)"
        parts.append(f"{row['diagnosis']}{doubt if row['diagnosis'] != 'nothing missing' else ''}")
    if row["reason"]:
        parts.append(f"but {row['reason']}")
    return printable(f"{head}  {', '.join(parts)}")
