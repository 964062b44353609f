"""Reuse of results of the stages after a trajectory, if they are complete and of the same origin and version."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from disctrack.files.json_text import json_file, json_sha256, plain
from disctrack.files.software import software_version
from disctrack.files.whole import write_whole
from disctrack.report.blocks import Report, document, restored
from disctrack.report.terminal import full
from disctrack.trajectory.file import read_provenance

FILE_NAME, SUMMARY = "made_from.json", "summary.txt"


def origin_of(trajectory: Path, settings: Mapping[str, Any]) -> str:
    """SHA-256 (hex) of the trajectory's fingerprint, the settings and the version. Raises TrajectoryFileError."""
    return hash_of([read_provenance(trajectory).fingerprint, dict(settings)])


def content_of(name: str) -> str:
    """Content of the file of this name if it exists, otherwise the name itself."""
    return Path(name).read_text(encoding="utf-8") if Path(name).is_file() else name


def hash_of(content: Any) -> str:
    """SHA-256 (hex) of content in JSON types, and of the version."""
    return json_sha256([content, software_version()])


def remember(folder: Path, origin: str, report: Report, files: Sequence[Path]) -> None:
    """Store origin and report of the results in their folder, and the report as summary.txt. Raises OutputError."""
    names = [file.relative_to(folder).as_posix() for file in files if file.is_relative_to(folder)]
    content = {
        "origin": origin,
        "report": document(replace(report, data={})),
        "data": plain(report.data),
        "files": names,
    }
    write_whole(folder / FILE_NAME, json_file(content))
    write_whole(folder / SUMMARY, ("\n".join(full(report)) + "\n").encode())


def reusable(folder: Path, origin: str) -> Report | None:
    """The report of the results in the folder, if all files exist and are of this origin; otherwise None."""
    try:
        content = json.loads((folder / FILE_NAME).read_text(encoding="utf-8"))
        whole = content["origin"] == origin and all((folder / name).is_file() for name in content["files"])
        return restored(content["report"], content["data"]) if whole else None
    except (OSError, ValueError, KeyError, TypeError):
        return None
