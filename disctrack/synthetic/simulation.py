"""disctrack simulate: the motion of a scene into an HDF5 file that explains itself."""

import hashlib
import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from calibration.kit.arguments import checked
from calibration.kit.arrays import Array
from calibration.kit.brief import Outline
from disctrack.errors import SceneError
from disctrack.files.inputs import keep, refuse_input
from disctrack.files.labelled_arrays import Variable, flags, write_variables
from disctrack.files.software import __version__
from disctrack.files.toml_tree import MOST
from disctrack.files.whole import refuse_existing, write_whole
from disctrack.frames import continuous_quaternions, quaternion_from_rotation, rotation_from_euler
from disctrack.rolling.motion import Motion, Regime
from disctrack.rolling.simulate import simulate
from disctrack.synthetic.description import load_scene
from disctrack.synthetic.motion import effects_in_words, rolling_model, rolling_start

SCHEMA, SCHEMA_VERSION = "disctrack motion", 1
_CONVENTIONS = {
    "frame_convention": "world: k up, table z = 0; contact frame: n0 = (cos psi, sin psi, 0), m0 = k x n0, k",
    "euler_convention": "R_world_body = Rz(psi) Rx(theta) Rz(phi); psi precession, theta nutation, phi spin; rad",
    "force_convention": "forces and moments of the table on the disc, in (n0, m0, k)",
    "energy_convention": "potential energy is zero where the disc lies flat at the origin",
}


@dataclass(frozen=True, repr=False)
class SimulationRun(Outline):
    """What `run_simulate` did."""

    path: Path
    motion: Motion
    summary: str  # some lines for people


@checked
def run_simulate(
    scene_path: str | Path,
    output: str | Path,
    *,
    duration: float | None = None,
    rate: float | None = None,
    overwrite: bool = False,
) -> SimulationRun:
    """Simulate the rolling motion of a scene and write it, whole or not at all.

    duration [s], rate [Hz] : those of the scene's cameras (n_frames, frame_rate_hz) if not given. The file ends earlier
    where the motion does. Raises SceneError, ModelError, OutputError.

        >>> run_simulate("scene.toml", "motion.h5", duration=0.01).path.name
        'motion.h5'
    """
    scene_path, output = Path(scene_path), Path(output)
    keep(scene_path)
    refuse_input(output)
    scene = load_scene(scene_path)
    if scene.motion.kind != "rolling":
        raise SceneError(
            f'{scene_path}: motion.kind is "{scene.motion.kind}"; simulate needs kind = "rolling" and, if wanted, '
            "[motion.rolling] with its start and effects"
        )
    refuse_existing(output, overwrite)
    rate = scene.cameras.frame_rate_hz if rate is None else rate
    duration = max(scene.cameras.n_frames - 1, 1) / scene.cameras.frame_rate_hz if duration is None else duration
    if duration * rate > MOST:
        instants = f"{duration:g} s at {rate:g} Hz are {duration * rate:.3g} instants"
        raise SceneError(f"{scene_path}: {instants}; expected at most {MOST:g}")
    motion = simulate(rolling_model(scene), rolling_start(scene), duration, rate=rate)
    text = scene_path.read_text(encoding="utf-8")
    settings = {"duration_s": duration, "rate_hz": rate}
    attributes = {
        "name": scene.name,
        "scene": text,
        "scene_sha256": hashlib.sha256(text.encode()).hexdigest(),
        "settings": json.dumps(settings, sort_keys=True),
    }
    write_motion(output, motion, attributes)
    return SimulationRun(output, motion, f"{output}\n{summary(motion)}\neffects: {effects_in_words(scene)}")


def summary(motion: Motion) -> str:
    """The motion in some lines, for people."""
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


def write_motion(path: Path, motion: Motion, attributes: dict[str, Any] | None = None) -> None:
    """Write a motion as HDF5 that xarray and netCDF readers open: root, groups motion, energy, contact, effects."""
    buffer = io.BytesIO()
    with h5py.File(buffer, "w", track_order=True) as file:
        axes = {
            "time": Variable(motion.time, ("time",), "s", "time"),
            "quaternion_component": Variable(np.array(list("wxyz")), ("quaternion_component",), "1", "component"),
        }
        write_variables(file, _root(motion), axes)
        for name, variables in (("motion", _rates(motion)), ("energy", _energy(motion)), ("contact", _contact(motion))):
            write_variables(file.create_group(name, track_order=True), variables)
        _write_model(file, motion)
        file.attrs.update(
            {
                "schema": SCHEMA,
                "schema_version": SCHEMA_VERSION,
                "software": "disctrack",
                "software_version": __version__,
                "end": motion.end.name,
                "end_reason": motion.end.value,
                "end_time_s": motion.end_time,
                **_CONVENTIONS,
                **(attributes or {}),
            }
        )
        file.attrs["complete"] = 1
    write_whole(path, buffer.getbuffer())


_WORLD = {axis: axis for axis in "xyz"}
_ANGLES = {angle: angle for angle in ("psi", "theta", "phi")}
_CONTACT_FRAME = {"n": "n0", "m": "m0", "z": "k"}


def _columns(name: str, values: Array, axes: dict[str, str], unit: str, text: str) -> dict[str, Variable]:
    """A variable for each component of values (n, k), its axis in place of {} in the name, its words in the text."""
    named = zip(axes.items(), values.T, strict=False)  # along n0 and m0 only, a slip has no third
    return {name.format(axis): _series(column, unit, text.format(words)) for (axis, words), column in named}


def _series(values: Array, unit: str, text: str) -> Variable:
    return Variable(values, ("time",), unit, text)


def _root(motion: Motion) -> dict[str, Variable]:
    quaternion = continuous_quaternions(quaternion_from_rotation(rotation_from_euler(*motion.q[:, 3:].T)))
    dims = ("time", "quaternion_component")
    return _columns("{}", motion.q[:, :3], _WORLD, "m", "{} of the geometric centre, world frame") | {
        "psi": _series(motion.q[:, 3], "rad", "precession angle, not wrapped"),
        "theta": _series(motion.q[:, 4], "rad", "nutation angle"),
        "phi": _series(motion.q[:, 5], "rad", "spin angle, not wrapped"),
        "quaternion": Variable(quaternion, dims, "1", "orientation, body to world, continuous"),
    }


def _rates(motion: Motion) -> dict[str, Variable]:
    turn = "rate of the angular velocity along world {}"
    return {
        **_columns("{}dot", motion.qdot[:, :3], _WORLD, "m/s", "rate of {}"),
        **_columns("{}dot", motion.qdot[:, 3:], _ANGLES, "rad/s", "rate of {}"),
        **_columns("omega_{}", motion.omega_world, _WORLD, "rad/s", "angular velocity along world {}"),
        **_columns("acceleration_{}", motion.acceleration_world, _WORLD, "m/s^2", "of the centre along world {}"),
        **_columns("angular_acceleration_{}", motion.angular_acceleration_world, _WORLD, "rad/s^2", turn),
        "omega2": _series(motion.state[:, 6], "rad/s", "angular velocity along e2, psidot sin(theta)"),
        "omega3": _series(motion.state[:, 7], "rad/s", "angular velocity along e3, psidot cos(theta) + phidot"),
    }


def _energy(motion: Motion) -> dict[str, Variable]:
    at_zero = "potential energy, zero where the disc lies flat at the origin"
    return {
        "translation": _series(motion.energy_translation, "J", "kinetic energy of the centre of mass"),
        "rotation": _series(motion.energy_rotation, "J", "kinetic energy about the centre of mass"),
        "potential": _series(motion.energy_potential, "J", at_zero),
        "total": _series(motion.energy, "J", "mechanical energy"),
        "power": _series(motion.power, "W", "power of the contact and of external forces: rate of the total"),
    }


def _contact(motion: Motion) -> dict[str, Variable]:
    return {
        **_columns("F_{}", motion.contact_force, _CONTACT_FRAME, "N", "contact force on the disc along {}"),
        **_columns("M_{}", motion.contact_moment, _CONTACT_FRAME, "N m", "contact moment on the disc along {}"),
        **_columns("X_{}", motion.external_force, _CONTACT_FRAME, "N", "external force at the centre along {}"),
        **_columns("slip_{}", motion.slip_velocity, _CONTACT_FRAME, "m/s", "slip of the disc's contact point along {}"),
        "regime": Variable(motion.regime, ("time",), "1", "state of the contact", flags(Regime)),
    }


def _write_model(file: Any, motion: Motion) -> None:
    group = file.create_group("model", track_order=True)
    disc, model = motion.model.disc, motion.model
    group.attrs.update(
        {
            "radius_m": disc.radius,
            "half_thickness_m": disc.half_thickness,
            "mass_kg": disc.mass,
            "moment_diametral_kg_m2": disc.moment_diametral,
            "moment_axial_kg_m2": disc.moment_axial,
            "gravity_m_s2": model.gravity,
        }
    )
    for effect in model.effects:
        child = group.create_group(effect.name)
        child.attrs.update({"title": effect.title, "source": effect.source})
        for parameter in effect.parameters:
            child.attrs[parameter.name] = effect.values[parameter.name]
            child.attrs[f"{parameter.name}_unit"] = parameter.unit
    group.attrs["switches_time_s"] = np.array([s.time for s in motion.switches])
    group.attrs["switches_to"] = [s.after.name.lower() for s in motion.switches] or [""]
