"""The enlarged model as a scene file: what `simulate`, `render` and the next `diagnose` read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from disctrack.diagnosis.disc.scene_rig import scene_with_rig
from disctrack.diagnosis.disc.system import DiscSystem
from disctrack.diagnosis.engine.system import Values
from disctrack.errors import AnalysisError
from disctrack.frames import CAMERAS
from disctrack.rolling import CATALOGUE, Model, effects_from_tables
from disctrack.scene.description import CameraFault, Faults, Scene, load_scene, scene_toml
from disctrack.trajectory import Trajectory

PAPER = "paper"
NONE = "none"


@dataclass(frozen=True)
class Declared:
    """A model to start from: effects of the motion, and faults of the measurement that are known already."""

    model: Model
    faults: Mapping[str, float]
    name: str


def declared_model(trajectory: Trajectory, choice: str = PAPER) -> Declared:
    """Model by name or file: "paper" (rolling with the paper's k_m), "none" (no losses), or a saved model or scene.

    The disc and gravity are those of the trajectory. Raises AnalysisError, SceneError, ModelError.
    """
    bare = Model(trajectory.disc, trajectory.gravity)
    if choice == PAPER:
        return Declared(bare.with_effects(CATALOGUE["km"]()), {}, choice)
    if choice == NONE:
        return Declared(bare, {}, choice)
    if not Path(choice).is_file():
        raise AnalysisError(f"{choice}: no such model. Give '{PAPER}', '{NONE}', or the file of a saved model (TOML).")
    scene = load_scene(choice)
    rolling = scene.motion.rolling
    effects = effects_from_tables(rolling.effects, rolling.formulas)
    return Declared(replace(bare, effects=effects), _values_of_faults(scene), str(choice))


def model_toml(system: DiscSystem, values: Values, name: str) -> str:
    """The fitted motion as a scene: disc, dots, gravity, first state, effects with their values, faults found.

    The cameras are like those of the recording, so that `render` shows it from where it was filmed.
    """
    model = system.model_with(values)
    state = {k.partition(".")[2]: float(v) for k, v in values.items() if k.startswith("state.")}
    scene = scene_with_rig(Scene(name=name, gravity_m_s2=model.gravity), system.rig)
    disc = model.disc
    scene = replace(
        scene,
        cameras=replace(
            scene.cameras, frame_rate_hz=float(round(system.trajectory.frame_rate, 9)), n_frames=len(system.time)
        ),
        disc=replace(
            scene.disc,
            radius_mm=_rounded(1e3 * disc.radius),
            thickness_mm=_rounded(2e3 * disc.half_thickness),
            mass_g=_rounded(1e3 * disc.mass),
        ),
        markers=replace(
            scene.markers,
            diameter_mm=_rounded(1e3 * disc.marker_diameter),
            centres_mm=tuple((_rounded(1e3 * x), _rounded(1e3 * y)) for x, y in disc.marker_centres_body[:, :2]),
        ),
        faults=_faults(system, values),
    )
    rolling = replace(
        scene.motion.rolling,
        theta_deg=float(np.degrees(state["theta"])),
        nutation_deg=0.0,
        state=state,
        effects={e.name: dict(e.values) for e in model.effects},
        formulas={e.name: dict(e.formulas) for e in model.effects if e.formulas},
    )
    scene = replace(scene, motion=replace(scene.motion, kind="rolling", rolling=rolling))
    return "\n".join([*_header(name, system), scene_toml(scene)])


def _rounded(number: float) -> float:
    return float(f"{number:.12g}")


def _header(name: str, system: DiscSystem) -> list[str]:
    first, last = (int(system.trajectory.frame[i]) for i in (system.rows.start, system.rows.stop - 1))
    return [
        f"# Fitted to frames {first} to {last} of {name}. Read by disctrack simulate, render, and diagnose --model.",
        "# motion.rolling: the motion and its effects. faults: what is wrong with cameras, dots and table.",
    ]


def _faults(system: DiscSystem, values: Values) -> Faults:
    get = lambda key: float(values.get(key, 0.0))  # noqa: E731
    rate = get("frame_rate.change")
    m = system.disc.n_markers
    misprint = tuple((1e3 * get(f"misprint_{i}.x"), 1e3 * get(f"misprint_{i}.y")) for i in range(m))
    return Faults(
        right_delay_s=get("time_offset.delay"),
        frame_rate_hz=system.trajectory.frame_rate * (1 + rate) if rate else 0.0,
        misprint_mm=misprint if np.any(misprint) else (),
        pattern_offset_mm=(1e3 * get("pattern_offset.x"), 1e3 * get("pattern_offset.y")),
        pattern_turn_deg=float(np.degrees(get("pattern_rotation.angle"))),
        pattern_scale=1.0 + get("pattern_scale.change"),
        pattern_height_mm=1e3 * get("pattern_height.offset"),
        table_turn_deg=(float(np.degrees(get("table_plane.tilt_x"))), float(np.degrees(get("table_plane.tilt_y")))),
        table_height_mm=1e3 * get("table_height.offset"),
        exposure_s=float(np.sqrt(max(get("exposure_blur.T2"), 0.0))),
        ellipse_centre_share=get("ellipse_centre.share"),
        left=_camera_fault("left", values),
        right=_camera_fault("right", values),
    )


def _camera_fault(camera: str, values: Values) -> CameraFault:
    get = lambda key: float(values.get(f"{camera}_{key}", 0.0))  # noqa: E731
    turn, shift = ([get(f"{kind}_{axis}") for axis in "xyz"] for kind in ("turned.rotation", "shifted.translation"))
    return CameraFault(
        rotation_deg=tuple(float(np.degrees(v)) for v in turn),  # type: ignore[arg-type]
        translation_mm=tuple(1e3 * v for v in shift),  # type: ignore[arg-type]
        focal_scale=1.0 + get("focal.change"),
        k1_change=get("distortion.k1"),
        principal_point_change_px=(get("principal_point.x"), get("principal_point.y")),
    )


def _values_of_faults(scene: Scene) -> dict[str, float]:
    """Inverse of `_faults`."""
    faults = scene.faults
    values = {
        "time_offset.delay": faults.right_delay_s,
        "frame_rate.change": faults.frame_rate_hz / scene.cameras.frame_rate_hz - 1 if faults.frame_rate_hz else 0.0,
        "pattern_offset.x": 1e-3 * faults.pattern_offset_mm[0],
        "pattern_offset.y": 1e-3 * faults.pattern_offset_mm[1],
        "pattern_rotation.angle": float(np.radians(faults.pattern_turn_deg)),
        "pattern_scale.change": faults.pattern_scale - 1.0,
        "pattern_height.offset": 1e-3 * faults.pattern_height_mm,
        "table_plane.tilt_x": float(np.radians(faults.table_turn_deg[0])),
        "table_plane.tilt_y": float(np.radians(faults.table_turn_deg[1])),
        "table_height.offset": 1e-3 * faults.table_height_mm,
        "exposure_blur.T2": faults.exposure_s**2,
        "ellipse_centre.share": faults.ellipse_centre_share,
    }
    for i, (x, y) in enumerate(faults.misprint_mm):
        values |= {f"misprint_{i}.x": 1e-3 * x, f"misprint_{i}.y": 1e-3 * y}
    for name, fault in zip(CAMERAS, (faults.left, faults.right), strict=True):
        for i, axis in enumerate("xyz"):
            values[f"{name}_turned.rotation_{axis}"] = float(np.radians(fault.rotation_deg[i]))
            values[f"{name}_shifted.translation_{axis}"] = 1e-3 * fault.translation_mm[i]
        values[f"{name}_focal.change"] = fault.focal_scale - 1.0
        values[f"{name}_distortion.k1"] = fault.k1_change
        values[f"{name}_principal_point.x"], values[f"{name}_principal_point.y"] = fault.principal_point_change_px
    return {k: v for k, v in values.items() if v}
