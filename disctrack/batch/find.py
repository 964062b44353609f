"""Which folders are recordings."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from disctrack.errors import RecordingError
from disctrack.readers.files import natural_key
from disctrack.recording.declaration import FILE_NAME

RESULTS = "results"  # beside a recording's images


@dataclass(frozen=True)
class FoundRecordings:
    """Recordings below some folders."""

    base: Path  # the deepest folder that holds all folders searched
    recordings: tuple[Path, ...]  # folders with a recording.toml, each once, in natural order of their names
    problems: tuple[str, ...]  # folders that could not be looked into

    def name(self, recording: Path) -> str:
        """The recording's place below `base`, with slashes: unique, and the same on every machine."""
        relative = Path(os.path.relpath(recording, self.base)).as_posix()
        return recording.name if relative == "." and len(self.recordings) == 1 else relative


def find_recordings(folders: Sequence[Path], leave_out: Sequence[Path] = ()) -> FoundRecordings:
    """Folders at and below `folders` that hold a recording.toml; links are followed, each folder is looked at once.

    leave_out : folders that are not searched (those that results go to); a recording's own `results` never is
    Raises RecordingError if a folder does not exist or if there is no recording at all.
    """
    roots = [Path(folder).resolve() for folder in folders]
    for folder, root in zip(folders, roots, strict=True):
        if not root.is_dir():
            raise RecordingError(f"{folder}: no such folder. Give folders that hold recordings, at any depth.")
    problems: list[str] = []
    seen = {folder.resolve() for folder in leave_out} - set(roots)
    found = [place for root in roots for place in _search(root, seen, problems)]
    if not found:
        shown = ", ".join(str(folder) for folder in folders)
        raise RecordingError(
            f"{shown}: no recording found. A recording is a folder with a {FILE_NAME} beside its images."
            + (f" Not searched: {'; '.join(problems)}." if problems else "")
        )
    base = Path(os.path.commonpath(roots))
    order = sorted(found, key=lambda place: [natural_key(part) for part in place.parts])
    return FoundRecordings(base, tuple(order), tuple(problems))


def _search(folder: Path, seen: set[Path], problems: list[str]) -> Iterator[Path]:
    place = folder.resolve()
    if place in seen:
        return
    seen.add(place)
    try:
        with os.scandir(folder) as entries:
            below = sorted(entry.name for entry in entries if entry.is_dir() and not entry.name.startswith("."))
            is_recording = (folder / FILE_NAME).exists()
    except OSError as error:
        problems.append(f"{folder} ({error.strerror})")
        return
    if is_recording:
        yield folder
    for name in below:
        if not (is_recording and name == RESULTS):
            yield from _search(folder / name, seen, problems)
