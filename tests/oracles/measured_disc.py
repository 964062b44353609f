"""Measured trajectories of a disc without rendering, with what is planted as keywords (disctrack.validate.points)."""

from disctrack.faults.keys import Faults
from disctrack.validate import points
from disctrack.validate.points import K_M, SIGMA_PX, Filmed, Laboratory, Planted

__all__ = ["K_M", "SIGMA_PX", "Laboratory", "measured"]


def measured(effects=None, *, faults=None, laboratory=None, motion=None, laws=(), disc=None, **filmed):
    """`filmed` : fields of `Filmed`; the others as in `Planted` and `points.measured`."""
    planted = Planted(effects=effects or {}, faults=faults or Faults(), laboratory=laboratory or Laboratory())
    return points.measured(planted, Filmed(**filmed), motion=motion, laws=laws, disc=disc)
