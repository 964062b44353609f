"""The enlarged model as a scene file, which `simulate`, `render` and the next `diagnose` read."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from calibration.cameras.camera import StereoRig
from disctrack.diagnosis.disc_system import DiscSystem
from disctrack.discrepancy.system import Values
from disctrack.errors import AnalysisError
from disctrack.faults.catalogue import scene_faults, values_in_scene
from disctrack.faults.dots import cameras_with
from disctrack.rolling import CATALOGUE, Model, effects_from_tables
from disctrack.synthetic.description import RigSettings, Scene, load_scene, scene_toml
from disctrack.trajectory import Trajectory

PAPER = "paper"
NONE = "none"
OF_TABLE = ("table_height.", "table_plane.")


def declared_model(trajectory: Trajectory, choice: str = PAPER) -> tuple[Model, Values]:
    """Model by name or file: "paper" (rolling with the paper's k_m), "none" (no losses), or a saved model or scene.

    Disc, gravity and air are those of the trajectory. Also the faults of the measurement that the file declares.
    Raises AnalysisError, SceneError, ModelError.
    """
    bare = Model(trajectory.disc, trajectory.gravity, air_density=trajectory.air_density)
    if choice == PAPER:
        return bare.with_effects(CATALOGUE["km"]()), {}
    if choice == NONE:
        return bare, {}
    if not Path(choice).is_file():
        raise AnalysisError(f"{choice}: no such model. Give '{PAPER}', '{NONE}', or the file of a saved model (TOML).")
    scene = load_scene(choice)
    rolling = scene.motion.rolling
    effects = effects_from_tables(rolling.effects, rolling.formulas)
    return replace(bare, effects=effects), values_in_scene(bare.disc, scene.faults, scene.cameras.frame_rate_hz)


def model_toml(system: DiscSystem, values: Values, name: str) -> str:
    """The fitted motion as a scene: disc, dots, gravity, initial state, effects with their values, faults found.

    The cameras are similar to those of the recording, so that `render` shows the same view.
    """
    rig, values = _above_the_table(system, values)
    model, trajectory = system.model_with(values), system.trajectory
    disc, rate = model.disc, float(round(trajectory.frame_rate, 9))
    state = {k.partition(".")[2]: float(v) for k, v in values.items() if k.startswith("state.")}
    sizes = {"radius_mm": disc.radius, "thickness_mm": 2 * disc.half_thickness, "mass_g": disc.mass}
    dots = tuple((_rounded(x), _rounded(y)) for x, y in disc.marker_centres_body[:, :2])
    rolling = {
        "theta_deg": float(np.degrees(state["theta"])),
        "nutation_deg": 0.0,
        "state": state,
        "effects": {e.name: dict(e.values) for e in model.effects},
        "formulas": {e.name: dict(e.formulas) for e in model.effects if e.formulas},
    }
    image_size = tuple(map(int, rig.left.image_size))
    scene = Scene().changed(
        name=name,
        gravity_m_s2=model.gravity,
        air_density_kg_m3=model.air_density,
        rig=_settings_like(rig),
        cameras={"frame_rate_hz": rate, "n_frames": len(system.time), "image_size": image_size},
        disc={key: _rounded(size) for key, size in sizes.items()},
        markers={"diameter_mm": _rounded(disc.marker_diameter), "centres_mm": dots},
        faults=scene_faults(disc, values, rate),
        motion={"kind": "rolling", "rolling": rolling},
    )
    first, last = (int(trajectory.frame[i]) for i in (system.rows.start, system.rows.stop - 1))
    header = (
        f"# Fitted to frames {first} to {last} of {' '.join(name.split())}. "
        "Read by disctrack simulate, render, and diagnose --model.\n"
        "# motion.rolling: the motion and its effects. faults: what is wrong with cameras, dots and table.\n"
    )
    return header + scene_toml(scene)


def _rounded(number: float) -> float:
    """In mm, or g, without the rounding error of the conversion."""
    return float(f"{1e3 * number:.12g}")


def _settings_like(rig: StereoRig) -> RigSettings:
    """Cameras similar to these, without seeded scatter.

    The cameras of a scene point at one target and have the same scale there. Offsets of the principal points and
    unequal focal lengths are lost; the view is the same to some pixels.
    """
    R = np.stack([R for R, _ in rig.camera_poses()])
    eyes = np.stack([-R.T @ t for R, t in rig.camera_poses()])
    across = np.eye(3) - R[:, 2, :, None] * R[:, 2, None, :]  # target: the point closest to both axes
    target = np.linalg.solve(across.sum(axis=0), np.einsum("cij,cj->i", across, eyes))
    away = eyes - target
    distance = np.linalg.norm(away, axis=1)
    x, y, z = (away / distance[:, None]).T
    # the image x axis of an upright camera is horizontal; roll is the rotation about the optical axis
    horizontal = np.stack([-y, x, 0 * x], axis=1) / np.hypot(x, y)[:, None]
    seen = np.einsum("cij,cj->ci", R, horizontal)
    focal = np.array([0.5 * (c.fx + c.fy) for c in rig.cameras])
    lenses = zip(("k1", "k2", "p1", "p2", "k3"), zip(*(c.distortion for c in rig.cameras), strict=True), strict=True)
    pairs = {
        "distance_mm": 1e3 * distance,
        "off_vertical_deg": np.degrees(np.arccos(z)),
        "azimuth_deg": np.degrees(np.arctan2(y, x)),
        "roll_deg": np.degrees(np.arctan2(seen[:, 1], seen[:, 0])),
        **dict(lenses),
    }
    return RigSettings(
        mm_per_px=float(np.mean(1e3 * distance / focal)),
        target_mm=(1e3 * float(target[0]), 1e3 * float(target[1]), 1e3 * float(target[2])),
        variation=0.0,
        **{name: (float(left), float(right)) for name, (left, right) in pairs.items()},
    )


def _above_the_table(system: DiscSystem, values: Values) -> tuple[StereoRig, Values]:
    """The rig in axes of the table as fitted, and the values without the corrections of that table.

    If the tracking determined the table from the rim of the disc, each recording has its own plane among the base
    quantities of `DiscSystem`. Its correction is no fault of the board: in a rendering it would be applied twice, as
    the table is determined again.
    """
    own = {q.name for q in system.base if q.name.startswith(OF_TABLE)}
    off = scene_faults(system.disc, {name: value for name, value in values.items() if name in own})
    return cameras_with(off, system.rig), {name: value for name, value in values.items() if name not in own}
