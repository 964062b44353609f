"""Measured trajectories of a disc without rendering, for tests: see disctrack.validate.hidden."""

from disctrack.validate.hidden import (
    CORNER_SIGMA_PX,
    K_M,
    SIGMA_PX,
    Unseen,
    measured,
    rig_covariance,
)

__all__ = ["CORNER_SIGMA_PX", "K_M", "SIGMA_PX", "Unseen", "measured", "rig_covariance"]
