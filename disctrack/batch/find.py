"""Which folders are recordings."""

import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from disctrack.errors import RecordingError
from disctrack.files.text import printable
from disctrack.recording.declaration import FILE_NAME
from disctrack.recording.readers.files import FORMATS, IMAGES, SUFFIXES, folders_below, natural_key

RESULTS = "results"  # beside a recording's images
FOLDER = "batch_results"  # of a batch, for what belongs to no single recording
_FILMS = SUFFIXES - IMAGES - FORMATS["hdf5"]  # of which two in a folder may be the cameras


@dataclass(frozen=True)
class FoundRecordings:
    """Recordings below some folders."""

    base: Path  # the deepest folder that holds all folders searched
    recordings: tuple[Path, ...]  # folders with a recording.toml, each once, in natural order of their names
    problems: tuple[str, ...]  # folders that could not be looked into
    undeclared: tuple[Path, ...] = ()  # that hold two folders of images or two films, and no recording.toml
    output: Path | None = None  # folder for all results; None: beside each recording

    def name(self, recording: Path) -> str:
        """The recording's place below `base`, with slashes: unique, printable, and the same on every machine."""
        relative = Path(os.path.relpath(recording, self.base)).as_posix()
        return printable(recording.name if relative == "." and len(self.recordings) == 1 else relative)

    @property
    def common(self) -> Path:
        """Folder of the summary, the index and the rigs."""
        return self.base / FOLDER if self.output is None else self.output

    def results(self, recording: Path) -> Path:
        """Folder of one recording's results."""
        return recording / RESULTS if self.output is None else self.output / self.name(recording)


def find_recordings(folders: Sequence[str | Path], output: str | Path | None = None) -> FoundRecordings:
    """Folders at and below `folders` that hold a recording.toml; links are followed, each folder is looked at once.

    output : folder for the results, which is not searched, as `results` of a recording and `batch_results` never are
    Raises RecordingError if a folder does not exist or if there is no recording at all.
    """
    roots = [Path(folder).resolve() for folder in folders]
    for folder, root in zip(folders, roots, strict=True):
        if not root.is_dir():
            raise RecordingError(f"{folder}: no such folder. Give folders that hold recordings, at any depth.")
    unread: list[OSError] = []
    apart = None if output is None else Path(output).resolve()
    seen = set() if apart is None else {apart} - set(roots)
    found: list[Path] = []
    undeclared: set[Path] = set()
    of_images = Counter[Path]()  # folders with images in each folder
    for place, inside, names in (folder for root in roots for folder in folders_below(root, seen, unread.append)):
        suffixes = [Path(name).suffix.lower() for name in names]
        is_recording = FILE_NAME in names
        inside[:] = [name for name in inside if name != FOLDER and not (is_recording and name == RESULTS)]
        if is_recording:
            found.append(place)
        elif not set(place.parents) & set(found):
            of_images[place.parent] += not IMAGES.isdisjoint(suffixes)
            undeclared |= {place} if sum(suffix in _FILMS for suffix in suffixes) > 1 else set()
    undeclared |= {place for place, n in of_images.items() if n > 1} - set(found)
    problems = [f"{error.filename} ({error.strerror})" for error in unread]
    left_out = sorted(place for place in undeclared if not set(place.parents) & undeclared)
    if not found:
        shown = ", ".join(str(folder) for folder in folders)
        raise RecordingError(
            f"{shown}: no recording found. A recording is a folder with a {FILE_NAME} beside its images."
            + (f" {left_out[0]} has images: `disctrack init {left_out[0]}` writes one." if left_out else "")
            + (f" Not searched: {'; '.join(problems)}." if problems else "")
        )
    base = Path(os.path.commonpath(roots))
    order = sorted(found, key=lambda place: [natural_key(part) for part in place.parts])
    return FoundRecordings(base, tuple(order), tuple(problems), tuple(left_out), apart)
