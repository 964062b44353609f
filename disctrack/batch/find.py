"""Which folders are recordings."""

import os
from collections.abc import Generator, Sequence
from dataclasses import dataclass
from pathlib import Path

from disctrack.errors import RecordingError
from disctrack.files.text import printable
from disctrack.recording.declaration import FILE_NAME
from disctrack.recording.readers.files import FORMATS, IMAGES, SUFFIXES, natural_key

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
    problems: list[str] = []
    undeclared: list[Path] = []
    apart = None if output is None else Path(output).resolve()
    seen = set() if apart is None else {apart} - set(roots)
    found = [place for root in roots for place in _search(root, seen, problems, undeclared)]
    undeclared = [place for place in undeclared if not set(place.parents) & set(undeclared)]
    if not found:
        shown = ", ".join(str(folder) for folder in folders)
        raise RecordingError(
            f"{shown}: no recording found. A recording is a folder with a {FILE_NAME} beside its images."
            + (f" {undeclared[0]} has images: `disctrack init {undeclared[0]}` writes one." if undeclared else "")
            + (f" Not searched: {'; '.join(problems)}." if problems else "")
        )
    base = Path(os.path.commonpath(roots))
    order = sorted(found, key=lambda place: [natural_key(part) for part in place.parts])
    return FoundRecordings(base, tuple(order), tuple(problems), tuple(undeclared), apart)


def _search(folder: Path, seen: set[Path], problems: list[str], undeclared: list[Path]) -> Generator[Path, None, bool]:
    """The recordings at and below the folder; whether images lie in it. Notes in the lists what a user must be told."""
    place = folder.resolve()
    if place in seen:
        return False
    seen.add(place)
    try:
        with os.scandir(folder) as entries:
            visible = [(entry.name, entry.is_dir()) for entry in entries if not entry.name.startswith(".")]
            is_recording = (folder / FILE_NAME).exists()
    except OSError as error:
        problems.append(f"{folder} ({error.strerror})")
        return False
    below = sorted(name for name, is_folder in visible if is_folder)
    suffixes = [Path(name).suffix.lower() for name, is_folder in visible if not is_folder]
    if is_recording:
        yield folder
    of_images = 0
    for name in below:
        if name != FOLDER and not (is_recording and name == RESULTS):
            of_images += yield from _search(folder / name, seen, problems, [] if is_recording else undeclared)
    if not is_recording and max(of_images, sum(suffix in _FILMS for suffix in suffixes)) > 1:
        undeclared.append(folder)
    return not is_recording and not IMAGES.isdisjoint(suffixes)
