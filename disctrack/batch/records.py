"""The row that is kept beside each recording's results: how far they are complete, of what they were made."""

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
BUSY, DIED = "busy", "died"  # another batch is at it; the process that did it ended before it was done

Stages = dict[str, float | bool]  # what is made of a trajectory, with which settings


def outcome(status: str, reason: str = "") -> Row:
    """A row of which no more is known; a job's is MEASURED, or of one that was not done SKIPPED, BUSY, DIED."""
    return {"status": status, "reason": reason}


def failed(reason: str, kind: Kind = Kind.OTHER) -> Row:
    """A failure with its reason, and what kind of finding that is."""
    return outcome(FAILED, reason) | {"severity": Severity.REFUSAL.name.lower(), "finding": kind.value}


def write_row(folder: Path, row: Row) -> None:
    """Keep it beside the results, last, so that all it speaks of is there. Raises OutputError.

    row : with the `stages` that were asked for, and PATHS relative to the folder
    """
    document = {"schema": SCHEMA, "schema_version": SCHEMA_VERSION, **row}
    write_whole(folder / RECORD, json_file(document))


def read_row(folder: Path) -> Row | None:
    """The row that is kept in the folder; None if there is none that can be read."""
    try:
        row: Row = json.loads((folder / RECORD).read_text(encoding="utf-8"))
        if row.pop("schema") != SCHEMA or row.pop("schema_version") > SCHEMA_VERSION:
            return None
        # the first version kept numbers and files apart
        return {**row.pop("numbers", {}), **row.pop("files", {}), **outcome(row["status"], row["reason"]), **row}
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        return None


def is_done(folder: Path, row: Row | None, asked: Stages) -> bool:
    """True if the row is of a measured recording with all stages asked for, and all its files are there.

    The trajectory must be the row's; whether that is the result of the present inputs is another question
    (`disctrack.trajectory.file.kept_or_made`).
    """
    if row is None or row["status"] != MEASURED or not row.get("trajectory"):
        return False
    made = [(row["stages"].get(stage), value) for stage, value in asked.items()]
    whole = all((folder / row[file]).is_file() for file in PATHS if row.get(file))
    with contextlib.suppress(DiscTrackError):
        same = read_provenance(folder / row["trajectory"]).fingerprint == row["fingerprint"]
        return same and whole and all(there == value or (value is False and there is True) for there, value in made)
    return False
