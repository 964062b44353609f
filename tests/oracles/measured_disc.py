"""Measured trajectories of a disc without rendering, for tests: see disctrack.diagnosis.trials.recordings."""

from disctrack.diagnosis.trials.recordings import (
    CORNER_SIGMA_PX,
    K_M,
    SIGMA_PX,
    Unseen,
    measured,
    rig_covariance,
)

__all__ = ["CORNER_SIGMA_PX", "K_M", "SIGMA_PX", "Unseen", "measured", "rig_covariance"]
