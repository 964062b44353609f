"""Measured trajectories of a disc without rendering, with what is planted as keywords (disctrack.validate.points)."""

import numpy as np

from disctrack.diagnosis import DiscSystem
from disctrack.diagnosis.model_file import declared_model
from disctrack.diagnosis.motion import motion_candidates
from disctrack.discrepancy.fit import fit
from disctrack.faults.keys import Faults
from disctrack.frames import rotation_from_quaternion
from disctrack.track.refine.self_calibration import DotsInFrames
from disctrack.validate import points
from disctrack.validate.points import K_M, SIGMA_PX, Filmed, Laboratory, Planted

__all__ = ["K_M", "SIGMA_PX", "Laboratory", "assert_sized", "dots_of", "measured", "system_of", "with_base_fit"]


def measured(effects=None, *, faults=None, laboratory=None, motion=None, laws=(), disc=None, **filmed):
    """`filmed` : fields of `Filmed`; the others as in `Planted` and `points.measured`."""
    planted = Planted(effects=effects or {}, faults=faults or Faults(), laboratory=laboratory or Laboratory())
    return points.measured(planted, Filmed(**filmed), motion=motion, laws=laws, disc=disc)


def dots_of(trajectory):
    """The dots of a trajectory with its poses."""
    return DotsInFrames(
        trajectory.rig,
        trajectory.disc,
        trajectory.markers_px,
        trajectory.markers_covariance_px2,
        rotation_from_quaternion(trajectory.quaternion),
        trajectory.q[:, :3],
    )


def system_of(trajectory, names=None, model="paper"):
    """What a diagnosis with this model asks.   names : of the only effects that may be missing, if not all"""
    declared = declared_model(trajectory, model).model
    return DiscSystem(trajectory, declared, None if names is None else motion_candidates(declared, names))


def with_base_fit(trajectory, names=None, model="paper"):
    """The same, and its base fit."""
    system = system_of(trajectory, names, model)
    return system, fit(system, system.base, system.start())


def assert_sized(fit, truth, sigmas, most=np.inf):
    """Each of these numbers was found within so many of its sigmas, and these are below `most`."""
    for name, true in truth.items():
        assert abs(fit.values[name] - true) < sigmas * fit.sigma(name) < most, name
