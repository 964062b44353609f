"""Search for recordings, and the jobs: one for each rig, then one for each recording."""

import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from disctrack.analyse.analysis import WINDOW
from disctrack.batch.columns import Row
from disctrack.batch.records import Stages, failed
from disctrack.calibrate.stage import source_of
from disctrack.errors import RecordingError, reason_of
from disctrack.files.text import printable
from disctrack.findings import Kind
from disctrack.recording.declaration import FILE_NAME, Recording, read_recording
from disctrack.recording.readers.files import FORMATS, IMAGES, SUFFIXES, folders_below, natural_key
from disctrack.track.measurement import open_pairs

RESULTS = "results"  # in the folder of a recording
FOLDER = "batch_results"  # of a batch, for files that are common to all recordings
_FILMS = SUFFIXES - IMAGES - FORMATS["hdf5"]  # of films; two in one folder may be those of the cameras


@dataclass(frozen=True)
class FoundRecordings:
    """Recordings at and below the searched folders."""

    base: Path  # the deepest folder that contains all searched folders
    recordings: tuple[Path, ...]  # folders with a recording.toml, each once, in natural order of their names
    problems: tuple[str, ...]  # folders that could not be read
    undeclared: tuple[Path, ...] = ()  # folders with two folders of images or two films, and without recording.toml
    output: Path | None = None  # folder for all results; None: in the folder of each recording

    def name(self, recording: Path) -> str:
        """The recording's path relative to `base`, with slashes: unique, printable, and equal on every machine."""
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
    """Folders at and below `folders` that contain a recording.toml; links are followed, each folder is read once.

    output : folder for the results, which is not searched; nor are `results` of a recording and `batch_results`
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
    of_images = Counter[Path]()  # number of folders with images in each folder
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


@dataclass(frozen=True)
class BatchOptions:
    """Settings of the user for all recordings."""

    window: float = WINDOW  # [s] before t_f, for the exponents
    report: bool = True  # report.html and figures of each recording
    diagnose: bool = False
    together: bool = False  # in addition, one diagnosis of all recordings
    overwrite: bool = False  # replace existing results

    @property
    def stages(self) -> Stages:
        """Requested stages after the trajectory, with their settings."""
        return {"window_s": self.window, "report": self.report, "diagnose": self.diagnose}


@dataclass(frozen=True)
class Job:
    """One piece of work for one process."""

    kind: str  # "rig" or "recording"
    name: str  # of the recording; for a rig, the first recording that needs it
    folder: Path  # of that recording
    results: Path  # folder of the results
    rig: Path  # rig file: output of a "rig", input of a "recording"
    options: BatchOptions
    threads: int = 1  # for reading images


def make_plan(
    found: FoundRecordings, recordings: Sequence[Path], options: BatchOptions
) -> tuple[list[Job], list[Job], dict[str, Row], tuple[Path, ...]]:
    """Read every recording.toml, count the images, and group recordings with equal calibration views by rig.

    returns : jobs of rigs and of recordings, rows of recordings that fail before they begin, by name, and folders of
        images that no recording.toml declares
    """
    rigs: dict[Path, Job] = {}
    jobs: list[Job] = []
    failures: dict[str, Row] = {}
    undeclared = found.undeclared
    for folder in recordings:
        name, about = found.name(folder), Kind.DECLARATION
        try:
            recording = read_recording(folder)
            about = Kind.READING
            undeclared = tuple(place for place in undeclared if not _has_views_of(place, recording))
            open_pairs(recording)  # raises if there is nothing to measure
            rig = recording.rig_file
            if rig is None:
                # the folder's name is the hash of all inputs of the calibration
                rig = found.common / "rigs" / source_of(recording).provenance.fingerprint[:16] / "rig.h5"
                rigs.setdefault(rig, Job("rig", name, folder, rig.parent, rig, options))
            jobs.append(Job("recording", name, folder, found.results(folder), rig, options))
        except Exception as error:  # an error of one recording must not stop the others
            failures[name] = failed(reason_of(error), about)
    return [*rigs.values()], jobs, failures, undeclared


def _has_views_of(place: Path, recording: Recording) -> bool:
    """Are the calibration views, which recordings may share, in this folder?"""
    return recording.views is not None and (recording.folder / recording.views.left).resolve().is_relative_to(place)
