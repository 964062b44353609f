"""Which effect is missing from the model of the motion, or of the measurement?

`diagnose` (search) is the engine: it works on any `System` (system). `DiscSystem` makes one of a trajectory of the disc
and the rolling model; `run_diagnose` is the stage from file to file. Systems that are no disc: `disctrack.examples`;
for their noise there is `coloured`, for their diagnosis.json `general`.
"""

from disctrack.diagnosis.diagnose import DiagnoseOutcome, diagnose_trajectory, run_diagnose
from disctrack.diagnosis.disc_diagnosis import DiscDiagnosis
from disctrack.diagnosis.disc_system import DiscSystem
from disctrack.diagnosis.search import Diagnosis, Settings, diagnose
from disctrack.diagnosis.system import Candidate, Quantity, System

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
