"""Which effect is missing from the model of the motion, or of the measurement?

`disctrack.discrepancy` works on any system. `DiscSystem` makes one of a trajectory of the disc and the rolling model;
`run_diagnose` is the stage from file to file.
"""

from disctrack.diagnosis.answer import DiscDiagnosis
from disctrack.diagnosis.disc_system import DiscSystem
from disctrack.diagnosis.stage import DiagnoseOutcome, diagnose, run_diagnose
from disctrack.discrepancy.search import Diagnosis, Settings
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
    "run_diagnose",
]
