"""Measured trajectories of a disc without rendering, with what is planted as keywords (disctrack.validate.points)."""

import numpy as np

from disctrack.diagnosis import DiscSystem
from disctrack.diagnosis.model_file import declared_model
from disctrack.diagnosis.motion import motion_candidates
from disctrack.discrepancy.fit import fit
from disctrack.faults.keys import Faults
from disctrack.frames import rotation_from_quaternion
from disctrack.rolling import CATALOGUE, Model
from disctrack.synthetic.description import Scene
from disctrack.track.pose import DotsInFrames
from disctrack.validate import points

K_M = CATALOGUE["km"]().values["k_m"]  # [m s^2] as published, known of to every diagnosis


def measured(
    effects=None, *, laws=(), k_m=K_M, n=500, declared_rate=1000.0, seed=1, rig_seed=None, faults=None, **other
):
    """`effects` : by "effect.parameter"; `laws` : by formula, that they may name; `other` : of the motion's start, and
    of `points.measured`.

    rig_seed : of the errors of calibration and laboratory, equal for recordings of one day
    """
    model = Model(Scene().declared_disc, laws=tuple(laws)).with_values({"km.k_m": k_m} | dict(effects or {}))
    sections = {"disc": other.pop("disc", {})} | other.pop("laboratory", {})  # what differs from the scene's usual ones
    of_points = {name: other.pop(name) for name in ("motion", "sigma_px") if name in other}
    start = {"theta_deg": 14.0, "nutation_deg": 0.5, "omega3_rad_s": other.pop("omega3", 1.0)} | other
    formulas = {law.name: law.formulas for law in laws}
    rolling = start | {"effects": {e.name: e.values for e in model.effects}, "formulas": formulas}
    motion, cameras = {"kind": "rolling", "rolling": rolling}, {"frame_rate_hz": declared_rate, "n_frames": n}
    day, noise = (seed, None) if rig_seed is None else (rig_seed, seed)
    scene = Scene(seed=day, faults=faults or Faults()).changed(cameras=cameras, motion=motion, **sections)
    return points.measured(scene, noise_seed=noise, **of_points)


def dots_of(trajectory):
    """The dots of a trajectory with its poses."""
    dots = trajectory.markers_px, trajectory.markers_covariance_px2
    poses = rotation_from_quaternion(trajectory.quaternion), trajectory.q[:, :3]
    return DotsInFrames(trajectory.rig, trajectory.disc, *dots, *poses)


def system_of(trajectory, names=None, model="paper"):
    """What a diagnosis with this model asks.   names : of the only effects that may be missing, if not all"""
    declared, _ = declared_model(trajectory, model)
    return DiscSystem(trajectory, declared, None if names is None else motion_candidates(declared, names))


def with_base_fit(trajectory):
    """The same, and its base fit."""
    system = system_of(trajectory)
    return system, fit(system, system.base, system.start())


def assert_found(result, truth, sigmas, most=np.inf):
    """A diagnosis found the effects of these numbers and no others, each number as below."""
    found = {f.candidate.name for f in result.diagnosis.found}
    assert found == {name.partition(".")[0] for name in truth}, result.sentence
    assert_sized(result.diagnosis.after, truth, sigmas, most)


def assert_sized(fit, truth, sigmas, most=np.inf):
    """Each of these numbers was found within so many of its sigmas, and these are below `most`."""
    for name, true in truth.items():
        assert abs(fit.values[name] - true) < sigmas * fit.sigma(name) < most, name
