"""Which effect is missing from the model of the motion, or of the measurement?

`disctrack.discrepancy` works on any system. `DiscSystem` makes one of a trajectory of the disc and the rolling model;
`run_diagnose` is the stage from file to file.
"""

from disctrack.diagnosis.answer import DiscDiagnosis
from disctrack.diagnosis.disc_system import DiscSystem
from disctrack.diagnosis.stage import diagnose, run_diagnose
from disctrack.discrepancy.search import Settings

__all__ = ["DiscDiagnosis", "DiscSystem", "Settings", "diagnose", "run_diagnose"]
