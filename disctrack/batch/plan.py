"""What is to be done: one job per recording; recordings of the same views share a rig."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from calibration import CalibrationSettings
from disctrack.analyse.analysis import WINDOW
from disctrack.batch.find import FoundRecordings
from disctrack.batch.records import Record, Stages, failed
from disctrack.calibrate.stage import source_of
from disctrack.errors import reason_of
from disctrack.findings import Kind
from disctrack.recording.declaration import Recording, read_recording
from disctrack.track.measurement import open_pairs


@dataclass(frozen=True)
class BatchOptions:
    """What a user chose about every recording."""

    distortion: str = "auto"  # see CalibrationSettings
    board: str = "auto"
    window: float = WINDOW  # [s] before t_f, for the exponents
    report: bool = True  # report.html and figures of each recording
    diagnose: bool = False
    together: bool = False  # one diagnosis of all recordings, besides
    overwrite: bool = False  # measure anew what is done already

    @property
    def calibration(self) -> CalibrationSettings:
        """Settings of every calibration."""
        return CalibrationSettings(distortion=self.distortion, board=self.board)

    @property
    def stages(self) -> Stages:
        """What is asked for beyond the trajectory."""
        return {"window_s": self.window, "report": self.report, "diagnose": self.diagnose}


@dataclass(frozen=True)
class Job:
    """One piece of work for one process."""

    name: str  # of the recording
    folder: str
    results: str  # folder for what comes out
    rig: str  # rig file: given, or to be made by whoever comes first
    options: BatchOptions
    threads: int = 1  # that read images


def make_plan(
    found: FoundRecordings, recordings: Sequence[Path], options: BatchOptions
) -> tuple[list[Job], dict[str, Record], tuple[Path, ...]]:
    """Read every recording.toml, count the images, and find who shares a rig by the content of the views.

    returns : jobs, what fails before it begins by the recording's name, and folders of images that no recording.toml
        speaks of
    """
    jobs: list[Job] = []
    failures: dict[str, Record] = {}
    undeclared = found.undeclared
    for folder in recordings:
        name, about = found.name(folder), Kind.DECLARATION
        try:
            recording = read_recording(folder)
            about = Kind.READING
            undeclared = tuple(place for place in undeclared if not _has_views_of(place, recording))
            jobs.append(_job(found, recording, name, options))
        except Exception as error:  # whatever is wrong with one recording, the others are measured
            failures[name] = failed(reason_of(error), about)
    return jobs, failures, undeclared


def _has_views_of(place: Path, recording: Recording) -> bool:
    """Do the views that many recordings may share lie in this folder?"""
    return recording.views is not None and (recording.folder / recording.views.left).resolve().is_relative_to(place)


def _job(found: FoundRecordings, recording: Recording, name: str, options: BatchOptions) -> Job:
    open_pairs(recording)  # raises where there is nothing to measure
    rig = recording.rig_file
    if rig is None:  # named by the content of all that it depends on
        made_from = source_of(recording, options.calibration).provenance.fingerprint[:16]
        rig = found.common / "rigs" / made_from / "rig.h5"
    return Job(name, str(recording.folder), str(found.results(recording.folder)), str(rig), options)
