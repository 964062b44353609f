"""The stage: trajectory file in; diagnosis.json, enlarged model and the group `diagnosis` out."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from disctrack.diagnosis.disc_errors import Errors, energy_balance, errors
from disctrack.diagnosis.disc_system import DiscSystem
from disctrack.diagnosis.enlarged import PAPER, declared_model, model_toml
from disctrack.diagnosis.output import as_json, lines, write_diagnosis
from disctrack.diagnosis.search import Diagnosis, Settings, diagnose
from disctrack.diagnosis.words import sentence
from disctrack.errors import AnalysisError, OutputError
from disctrack.storage import read_provenance, read_trajectory
from disctrack.trajectory import Trajectory
from disctrack.whole_files import write_whole


@dataclass(frozen=True)
class DiscDiagnosis:
    """Diagnosis of one trajectory of the disc."""

    system: DiscSystem
    diagnosis: Diagnosis
    model: str
    sentence: str
    before: Errors | None  # None where the base fit did not converge
    after: Errors | None
    energy: dict[str, float]  # [J]

    @property
    def document(self) -> dict[str, Any]:
        """What diagnosis.json says."""
        return as_json(self.diagnosis, self.sentence, self.model, self.before, self.after, self.energy)


@dataclass(frozen=True)
class DiagnoseOutcome:
    """What `run_diagnose` did."""

    result: DiscDiagnosis
    files: tuple[Path, ...]
    summary: tuple[str, ...]


def diagnose_trajectory(trajectory: Trajectory, model: str = PAPER, settings: Settings | None = None) -> DiscDiagnosis:
    """What does the model lack? Fit, trace, refit, judge.

    model : "paper", "none", or a TOML file (`enlarged.declared_model`)
    Raises AnalysisError, SceneError, ModelError.
    """
    declared = declared_model(trajectory, model)
    system = DiscSystem(trajectory, declared.model)
    diagnosis = diagnose(system, system.start(declared.faults), settings)
    before = after = None
    energy: dict[str, float] = {}
    if diagnosis.held_out_before is not None and diagnosis.held_out_after is not None:
        before = errors(system, diagnosis.before, diagnosis.held_out_before)
        after = errors(system, diagnosis.after, diagnosis.held_out_after)
        energy = energy_balance(system, diagnosis.after.values)
    return DiscDiagnosis(system, diagnosis, declared.name, sentence(diagnosis, after), before, after, energy)


def run_diagnose(
    path: Path, output: Path | None = None, *, model: str = PAPER, overwrite: bool = False
) -> DiagnoseOutcome:
    """Diagnose a trajectory file; write diagnosis.json, diagnosis.html with figures, model.toml, and the file's group.

    output : folder; without it `<name>_diagnosis` beside the file
    Raises TrajectoryFileError, AnalysisError, SceneError, ModelError, OutputError.
    """
    from disctrack.diagnosis.report import write_report  # matplotlib is wanted here only

    path = Path(path)
    folder = Path(output) if output is not None else path.with_name(f"{path.stem}_diagnosis")
    report = folder / "diagnosis.json"
    if report.exists() and not overwrite:
        raise OutputError(f"{report}: exists. Choose another folder with -o, or replace with --overwrite.")
    trajectory, provenance = read_trajectory(path), read_provenance(path)
    try:
        result = diagnose_trajectory(trajectory, model)
    except AnalysisError as error:
        raise AnalysisError(f"{path}: {error}") from error
    document = {"recording": provenance.recording, **result.document}
    write_diagnosis(path, result.system, result.diagnosis, document)
    write_whole(report, (json.dumps(document, indent=1) + "\n").encode())
    toml = folder / "model.toml"
    text = model_toml(result.system, result.diagnosis.after.values, provenance.recording)
    write_whole(toml, text.encode())
    pages = write_report(folder, result, provenance.recording)
    said = lines(result.diagnosis, result.sentence, result.before, result.after)
    return DiagnoseOutcome(result, (report, toml, *pages), tuple(said))
