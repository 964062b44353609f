"""The enlarged model as a scene file: what `simulate`, `render` and the next `diagnose` read."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calibration.cameras.camera import StereoRig, placed_at, rotation_from_vector
from disctrack.diagnosis.disc_system import DiscSystem
from disctrack.diagnosis.scene_rig import scene_with_rig
from disctrack.discrepancy.system import Values
from disctrack.errors import AnalysisError
from disctrack.faults.catalogue import scene_faults, setup_of, values_in_scene
from disctrack.rolling import CATALOGUE, Model, effects_from_tables
from disctrack.synthetic.description import Scene, load_scene, scene_toml
from disctrack.trajectory import Trajectory

PAPER = "paper"
NONE = "none"
OF_TABLE = ("table_height.", "table_plane.")


@dataclass(frozen=True)
class Declared:
    """A model to start from: effects of the motion, and faults of the measurement that are known already."""

    model: Model
    faults: Mapping[str, float]
    name: str


def declared_model(trajectory: Trajectory, choice: str = PAPER) -> Declared:
    """Model by name or file: "paper" (rolling with the paper's k_m), "none" (no losses), or a saved model or scene.

    Disc, gravity and air are those of the trajectory. Raises AnalysisError, SceneError, ModelError.
    """
    bare = Model(trajectory.disc, trajectory.gravity, air_density=trajectory.air_density)
    if choice == PAPER:
        return Declared(bare.with_effects(CATALOGUE["km"]()), {}, choice)
    if choice == NONE:
        return Declared(bare, {}, choice)
    if not Path(choice).is_file():
        raise AnalysisError(f"{choice}: no such model. Give '{PAPER}', '{NONE}', or the file of a saved model (TOML).")
    scene = load_scene(choice)
    rolling = scene.motion.rolling
    effects = effects_from_tables(rolling.effects, rolling.formulas)
    return Declared(
        replace(bare, effects=effects),
        values_in_scene(trajectory.disc, scene.faults, scene.cameras.frame_rate_hz),
        str(choice),
    )


def model_toml(system: DiscSystem, values: Values, name: str) -> str:
    """The fitted motion as a scene: disc, dots, gravity, first state, effects with their values, faults found.

    The cameras are like those of the recording, so that `render` shows it from where it was filmed.
    """
    rig, values = _above_the_table(system, values)
    model = system.model_with(values)
    state = {k.partition(".")[2]: float(v) for k, v in values.items() if k.startswith("state.")}
    scene = Scene(name=name, gravity_m_s2=model.gravity, air_density_kg_m3=model.air_density)
    scene = scene_with_rig(scene, rig)
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
    )
    scene = replace(scene, faults=scene_faults(disc, values, scene.cameras.frame_rate_hz))
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


def _above_the_table(system: DiscSystem, values: Values) -> tuple[StereoRig, Values]:
    """The rig in axes of the table that the motion found, and the values without what that table is off by.

    Where tracking levelled the table by the disc's rim, each recording has a plane of its own (`DiscSystem.base`): by
    paper on the face it seems too high. That is no fault of the board, and would be made twice where the file is
    rendered and levelled again.
    """
    own = {q.name for q in system.base if q.name.startswith(OF_TABLE)}
    setup = setup_of(system.disc, {name: value for name, value in values.items() if name in own})
    turn, shift = rotation_from_vector(setup.table_turn), np.array([0.0, 0.0, setup.table_height])
    poses = [(R @ turn, t + R @ shift) for R, t in system.rig.camera_poses()]
    return replace(system.rig, **placed_at(poses)), {n: v for n, v in values.items() if n not in own}


def _rounded(number: float) -> float:
    return float(f"{number:.12g}")


def _header(name: str, system: DiscSystem) -> list[str]:
    first, last = (int(system.trajectory.frame[i]) for i in (system.rows.start, system.rows.stop - 1))
    return [
        f"# Fitted to frames {first} to {last} of {' '.join(name.split())}. "
        "Read by disctrack simulate, render, and diagnose --model.",
        "# motion.rolling: the motion and its effects. faults: what is wrong with cameras, dots and table.",
    ]
