"""What is to be done: each rig once, then one job per recording."""

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

    kind: str  # "rig" or "recording"
    name: str  # of the recording; for a rig, the first recording that needs it
    folder: str  # of that recording
    results: str  # folder for what comes out
    rig: str  # rig file: what a "rig" makes and a "recording" uses
    options: BatchOptions
    threads: int = 1  # that read images


def make_plan(
    found: FoundRecordings, recordings: Sequence[Path], options: BatchOptions
) -> tuple[list[Job], list[Job], dict[str, Record], tuple[Path, ...]]:
    """Read every recording.toml, count the images, and find who shares a rig by the content of the views.

    returns : jobs of rigs and of recordings, what fails before it begins by the recording's name, and folders of images
        that no recording.toml speaks of
    """
    rigs: dict[str, Job] = {}
    jobs: list[Job] = []
    failures: dict[str, Record] = {}
    undeclared = found.undeclared
    for folder in recordings:
        name, about = found.name(folder), Kind.DECLARATION
        try:
            recording = read_recording(folder)
            about = Kind.READING
            undeclared = tuple(place for place in undeclared if not _has_views_of(place, recording))
            jobs.append(_job(found, recording, name, options, rigs))
        except Exception as error:  # whatever is wrong with one recording, the others are measured
            failures[name] = failed(reason_of(error), about)
    needed = {job.rig for job in jobs}
    return [job for path, job in rigs.items() if path in needed], jobs, failures, undeclared


def _has_views_of(place: Path, recording: Recording) -> bool:
    """Do the views that many recordings may share lie in this folder?"""
    return recording.views is not None and (recording.folder / recording.views.left).resolve().is_relative_to(place)


def _job(found: FoundRecordings, recording: Recording, name: str, options: BatchOptions, rigs: dict[str, Job]) -> Job:
    folder = recording.folder
    open_pairs(recording)  # raises where there is nothing to measure
    results = found.results(folder)
    if recording.rig_file is not None:
        return Job("recording", name, str(folder), str(results), str(recording.rig_file), options)
    # named by the content of all that it depends on
    made_from = source_of(recording, options.calibration).provenance.fingerprint[:16]
    rig = found.common / "rigs" / made_from / "rig.h5"
    rigs.setdefault(str(rig), Job("rig", name, str(folder), str(rig.parent), str(rig), options))
    return Job("recording", name, str(folder), str(results), str(rig), options)
