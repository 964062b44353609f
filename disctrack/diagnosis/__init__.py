"""Which effect is missing from the model of the motion, or of the measurement?

`diagnose` (engine) works on any `System`. `DiscSystem` makes one of a trajectory of the disc
and the rolling model; `run_diagnose` is the stage from file to file. Systems that are no disc: `disctrack.examples`;
for their noise there is `engine.noise_with_memory`, for their diagnosis.json `pages.general`.
"""

from disctrack.diagnosis.disc.diagnosis import DiscDiagnosis
from disctrack.diagnosis.disc.system import DiscSystem
from disctrack.diagnosis.stage import DiagnoseOutcome, diagnose_trajectory, run_diagnose
from disctrack.discrepancy.search import Diagnosis, Settings, diagnose
from disctrack.discrepancy.system import Candidate, Quantity, System

__all__ = [
    "Candidate",
    "DiagnoseOutcome",
    "Diagnosis",
    "DiscDiagnosis",
    "DiscSystem",
    "Quantity",
    "Settings",
    "System",
    "diagnose",
    "diagnose_trajectory",
    "run_diagnose",
]
