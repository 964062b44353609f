"""The row that is stored with each recording's results: their status, numbers and provenance."""

import contextlib
import json
from pathlib import Path

from disctrack.batch.columns import PATHS, Row
from disctrack.errors import DiscTrackError
from disctrack.files.json_text import json_file
from disctrack.files.whole import write_whole
from disctrack.findings import Kind, Severity
from disctrack.trajectory.file import read_provenance

RECORD = "batch.json"
SCHEMA, SCHEMA_VERSION = "disctrack batch record", 2
MEASURED, SKIPPED, FAILED, NOT_MEASURED = "measured", "skipped", "failed", "not measured"
BUSY, DIED = "busy", "died"  # another batch is working on it; its process ended before the job was done

Stages = dict[str, float | bool]  # stages after the trajectory, and their settings


def outcome(status: str, reason: str = "") -> Row:
    """A row with nothing but status and reason."""
    return {"status": status, "reason": reason}


def failed(reason: str, kind: Kind = Kind.OTHER) -> Row:
    """Row of a failure, with its reason and the kind of finding."""
    return outcome(FAILED, reason) | {"severity": Severity.REFUSAL.name.lower(), "finding": kind.value}


def write_row(folder: Path, row: Row) -> None:
    """Store the row with the results, last, so that all its files exist. Raises OutputError.

    row : with the requested `stages`, and PATHS relative to the folder
    """
    write_whole(folder / RECORD, json_file({"schema": SCHEMA, "schema_version": SCHEMA_VERSION, **row}))


def read_row(folder: Path) -> Row | None:
    """The row that is stored in the folder; None if it is missing or cannot be read."""
    try:
        row: Row = json.loads((folder / RECORD).read_text(encoding="utf-8"))
        same = row.pop("schema") == SCHEMA and row.pop("schema_version") == SCHEMA_VERSION
        return row | outcome(row["status"], row["reason"]) if same else None
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        return None


def is_done(folder: Path, row: Row, requested: Stages) -> bool:
    """True if the row is of a measured recording with all requested stages, and all its files exist.

    The trajectory must have the row's fingerprint; `disctrack.trajectory.file.kept_or_made` decides whether it is the
    result of the present inputs.
    """
    if row["status"] != MEASURED or not row.get("trajectory"):
        return False
    made = [(row["stages"].get(stage), value) for stage, value in requested.items()]
    suffices = all(there == value or (value is False and there is True) for there, value in made)
    with contextlib.suppress(DiscTrackError):
        whole = suffices and all((folder / row[file]).is_file() for file in PATHS if row.get(file))
        return whole and read_provenance(folder / row["trajectory"]).fingerprint == row["fingerprint"]
    return False
