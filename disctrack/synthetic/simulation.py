"""disctrack simulate: write the motion of a scene to a self-describing HDF5 file."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np

from calibration.kit.brief import Brief
from calibration.kit.types import checked
from disctrack.errors import SceneError
from disctrack.files.labelled_arrays import Variable, flags, write_variables
from disctrack.files.software import __version__
from disctrack.files.whole import keep, refuse_existing, whole_file
from disctrack.frames import continuous_quaternions, quaternion_from_rotation, rotation_from_euler
from disctrack.rolling.motion import Motion
from disctrack.rolling.records import Regime
from disctrack.rolling.simulate import simulate
from disctrack.synthetic.description import load_scene
from disctrack.synthetic.motion import effects_in_words, rolling_model, rolling_start

_CONVENTIONS = {
    "frame_convention": "world: k up, table z = 0; contact frame: n0 = (cos psi, sin psi, 0), m0 = k x n0, k",
    "euler_convention": "R_world_body = Rz(psi) Rx(theta) Rz(phi); psi precession, theta nutation, phi spin; rad",
    "force_convention": "forces and moments of the table on the disc, in (n0, m0, k)",
    "energy_convention": "potential energy is zero where the disc lies flat at the origin",
}


@dataclass(frozen=True, repr=False)
class SimulationRun(Brief):
    """Result of `run_simulate`."""

    path: Path
    motion: Motion
    summary: str  # some lines of text


@checked
def run_simulate(
    scene_path: str | Path,
    output: str | Path,
    *,
    duration: float | None = None,
    rate: float | None = None,
    overwrite: bool = False,
) -> SimulationRun:
    """Simulate the rolling motion of a scene and write it completely or not at all.

    duration [s], rate [Hz] : by default those of the scene's cameras (n_frames, frame_rate_hz). The motion may end
    earlier. Raises SceneError, ModelError, OutputError.

        >>> run_simulate("scene.toml", "motion.h5", duration=0.01).path.name
        'motion.h5'
    """
    scene_path, output = Path(scene_path), Path(output)
    keep(scene_path)
    refuse_existing(output, overwrite)
    scene = load_scene(scene_path)
    if scene.motion.kind != "rolling":
        raise SceneError(
            f'{scene_path}: motion.kind is "{scene.motion.kind}"; simulate needs kind = "rolling" and, if wanted, '
            "[motion.rolling] with its start and effects"
        )
    rate = scene.cameras.frame_rate_hz if rate is None else rate
    duration = max(scene.cameras.n_frames - 1, 1) / scene.cameras.frame_rate_hz if duration is None else duration
    motion = simulate(rolling_model(scene), rolling_start(scene), duration, rate=rate)
    settings = json.dumps({"duration_s": duration, "rate_hz": rate})
    text = scene_path.read_text(encoding="utf-8")
    write_motion(output, motion, {"name": scene.name, "scene": text, "settings": settings})
    return SimulationRun(output, motion, f"{output}\n{summary(motion)}\neffects: {effects_in_words(scene)}")


def summary(motion: Motion) -> str:
    """The motion in some lines of text."""
    theta, psidot, energy = np.degrees(motion.q[:, 4]), motion.qdot[:, 3], motion.energy * 1e3
    needed = motion.friction_needed[(motion.regime != Regime.FLYING) & ~np.isnan(motion.friction_needed)]
    hold = f"rolling needs a friction coefficient of {needed.max():.3g}" if needed.size else "never held by the table"
    lines = [
        f"{len(motion)} instants, {motion.time[0]:.4g} to {motion.time[-1]:.4g} s",
        f"end at {motion.end_time:.6g} s: {motion.end.value}",
        f"nutation {theta[0]:.4g} -> {theta[-1]:.4g} deg, precession {psidot[0]:.5g} -> {psidot[-1]:.5g} rad/s",
        f"energy {energy[0]:.5g} -> {energy[-1]:.5g} mJ; {hold}",
    ]
    lines += [f"{s.time:.5g} s: {s.before.name.lower()} -> {s.after.name.lower()}" for s in motion.switches[:6]]
    if len(motion.switches) > 6:
        lines.append(f"... {len(motion.switches) - 6} more changes between rolling, slip and flight")
    return "\n".join(lines)


_ONE = {"": ""}
_AT_ZERO = "potential energy, zero where the disc lies flat at the origin"
_WORLD = {axis: axis for axis in "xyz"}
_ANGLES = {"psi": "precession angle, not wrapped", "theta": "nutation angle", "phi": "spin angle, not wrapped"}
_TABLE = {"n": "n0", "m": "m0", "z": "k"}
_NODAL_FRAME = {"2": "e2, psidot sin(theta)", "3": "e3, psidot cos(theta) + phidot"}


def write_motion(path: Path, motion: Motion, attributes: Mapping[str, str]) -> None:
    """Write a motion as HDF5, readable by xarray and netCDF: root, groups motion, energy, contact, effects."""
    axes = {
        "time": Variable(motion.time, ("time",), "s", "time"),
        "quaternion_component": Variable(np.array(list("wxyz")), ("quaternion_component",), "1", "component"),
    }
    with whole_file(path) as part, h5py.File(part, "w", track_order=True) as file:
        for group, variables in _variables(motion).items():
            write_variables(file.create_group(group, track_order=True) if group else file, variables, axes)
        # "effect.parameter", in the units of `disctrack simulate --list-effects`; the scene has the rest of the model
        file.create_group("effects").attrs.update(motion.model.values)
        file.attrs.update(schema="disctrack motion", schema_version=2, software="disctrack")
        file.attrs["switches_time_s"] = np.array([s.time for s in motion.switches])
        file.attrs["switches_to"] = [s.after.name.lower() for s in motion.switches] or [""]
        file.attrs.update(software_version=__version__, end=motion.end.name, end_reason=motion.end.value)
        file.attrs.update({"end_time_s": motion.end_time, **_CONVENTIONS, **attributes, "complete": 1})


def _variables(motion: Motion) -> dict[str, dict[str, Variable]]:
    """Datasets of the file by group."""
    # group, values, name, components with their words, unit, meaning; component and words replace {}
    layout = (
        ("", motion.q[:, :3], "{}", _WORLD, "m", "{} of the geometric centre, world frame"),
        ("", motion.q[:, 3:], "{}", _ANGLES, "rad", "{}"),
        ("motion", motion.qdot[:, :3], "{}dot", _WORLD, "m/s", "rate of {}"),
        ("motion", motion.qdot[:, 3:], "{}dot", {name: name for name in _ANGLES}, "rad/s", "rate of {}"),
        ("motion", motion.omega_world, "omega_{}", _WORLD, "rad/s", "angular velocity along world {}"),
        ("motion", motion.acceleration_world, "acceleration_{}", _WORLD, "m/s^2", "of the centre along world {}"),
        ("motion", motion.angular_acceleration_world, "angular_acceleration_{}", _WORLD, "rad/s^2",
         "rate of the angular velocity along world {}"),
        ("motion", motion.state[:, 6:8], "omega{}", _NODAL_FRAME, "rad/s", "angular velocity along {}"),
        ("energy", motion.energy_translation, "translation", _ONE, "J", "kinetic energy of the centre of mass"),
        ("energy", motion.energy_rotation, "rotation", _ONE, "J", "kinetic energy about the centre of mass"),
        ("energy", motion.energy_potential, "potential", _ONE, "J", _AT_ZERO),
        ("energy", motion.energy, "total", _ONE, "J", "mechanical energy"),
        ("energy", motion.power, "power", _ONE, "W", "power of the contact and of external forces: rate of the total"),
        ("contact", motion.contact_force, "F_{}", _TABLE, "N", "contact force on the disc along {}"),
        ("contact", motion.contact_moment, "M_{}", _TABLE, "N m", "contact moment on the disc along {}"),
        ("contact", motion.external_force, "X_{}", _TABLE, "N", "external force at the centre along {}"),
        ("contact", motion.slip_velocity, "slip_{}", _TABLE, "m/s", "slip of the disc's contact point along {}"),
    )  # fmt: skip
    found: dict[str, dict[str, Variable]] = {group: {} for group, *_ in layout}
    for group, values, name, components, unit, meaning in layout:
        columns = values.reshape(len(motion), -1).T
        for (component, words), column in zip(components.items(), columns, strict=False):  # slip has two components
            described = meaning.format(words)
            found[group][name.format(component)] = Variable(column, ("time",), unit, described)
    quaternion = continuous_quaternions(quaternion_from_rotation(rotation_from_euler(*motion.q[:, 3:].T)))
    dims = ("time", "quaternion_component")
    found[""]["quaternion"] = Variable(quaternion, dims, "1", "orientation, body to world, continuous")
    found["contact"]["regime"] = Variable(motion.regime, ("time",), "1", "state of the contact", flags(Regime))
    return found
