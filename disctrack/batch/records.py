"""What is kept beside each recording's results: how far they are complete, of what they were made, and their row."""

import json
from dataclasses import dataclass, field
from pathlib import Path

from disctrack.batch.columns import Row
from disctrack.errors import DiscTrackError
from disctrack.files.json_text import json_file
from disctrack.files.whole import write_whole
from disctrack.findings import Kind, Severity
from disctrack.trajectory.file import read_provenance

RECORD = "batch.json"
SCHEMA, SCHEMA_VERSION = "disctrack batch record", 1
MEASURED, SKIPPED, FAILED, NOT_MEASURED = "measured", "skipped", "failed", "not measured"
BUSY, DIED = "busy", "died"  # another batch is at it; the process that did it ended before it was done

Stages = dict[str, float | bool]  # what is made of a trajectory, with which settings


@dataclass(frozen=True)
class Record:
    """Outcome of one job; a recording's is written last, so that all it speaks of is there."""

    status: str  # MEASURED, FAILED, or of a job that was not done now SKIPPED, BUSY, DIED, NOT_MEASURED
    reason: str = ""
    fingerprint: str = ""  # of the trajectory's inputs, settings and version
    stages: Stages = field(default_factory=dict)
    files: dict[str, str] = field(default_factory=dict)  # what -> path relative to the record's folder
    numbers: Row = field(default_factory=dict)  # columns of the summary


def failed(reason: str, kind: Kind = Kind.OTHER) -> Record:
    """A failure with its reason, and what kind of finding that is."""
    return Record(FAILED, reason, numbers={"severity": Severity.REFUSAL.name.lower(), "finding": kind.value})


def write_record(folder: Path, record: Record) -> None:
    """Write it whole. Raises OutputError."""
    document = {"schema": SCHEMA, "schema_version": SCHEMA_VERSION, **record.__dict__}
    write_whole(folder / RECORD, json_file(document))


def read_record(folder: Path) -> Record | None:
    """The record in the folder; None if there is none that can be read."""
    try:
        document = json.loads((folder / RECORD).read_text(encoding="utf-8"))
        if document.pop("schema") != SCHEMA or document.pop("schema_version") != SCHEMA_VERSION:
            return None
        return Record(**document)
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        return None


def is_done(folder: Path, record: Record | None, asked: Stages) -> bool:
    """True if the record tells of a measured recording with all stages asked for, and all its files are there.

    The trajectory must be the record's; whether that is the result of the present inputs is another question
    (`disctrack.trajectory.file.kept_or_made`).
    """
    if record is None or record.status != MEASURED or "trajectory" not in record.files:
        return False
    made = [(record.stages.get(stage), value) for stage, value in asked.items()]
    if not all(there == value or (value is False and there is True) for there, value in made):
        return False
    if not all((folder / file).is_file() for file in record.files.values()):
        return False
    try:
        return read_provenance(folder / record.files["trajectory"]).fingerprint == record.fingerprint
    except DiscTrackError:
        return False
