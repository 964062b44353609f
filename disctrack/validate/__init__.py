"""The accuracy claim of 0.005 mm and 0.05 deg put to the test: render -> measure -> compare with the truth.

poses (what is asked) -> trial (one recording: render, calibrate, measure) -> comparison (errors and their statistics);
bound, efficiency (how well any method could do), stress (how much it bears), controls (planted faults) -> summary,
tables, plots -> run. Only the truth and the reported numbers enter a judgement, never how the measurement is done.
"""

from disctrack.validate.run import QUICK, ValidationPlan, run_validate, scene_of, validate, write_validation
from disctrack.validate.summary import Summary, complaints, summarise, verdict

__all__ = [
    "QUICK",
    "Summary",
    "ValidationPlan",
    "complaints",
    "run_validate",
    "scene_of",
    "summarise",
    "validate",
    "verdict",
    "write_validation",
]
