"""truth.h5: what a synthetic recording really shows; for validation only, no stage of the measurement reads it."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from calibration.cameras.camera import StereoRig
from calibration.kit.arrays import Array, Mask
from calibration.rig_file import read_rig_group, write_rig_group
from disctrack.disc import Disc
from disctrack.errors import OutputError, RigFileError
from disctrack.frames import COORDINATES, rotation_from_euler
from disctrack.synthetic.cameras import image_of, views_of
from disctrack.synthetic.description import Scene, scene_toml

SCHEMA = "disctrack truth"
SCHEMA_VERSION = 2


@dataclass(frozen=True)
class Truth:
    """What is true of a recording, SI and radians."""

    time: Array  # (n,) mid exposure of the left camera's frames [s]
    q: Array  # (n, 6) at `time`, angles not wrapped
    qdot: Array  # (n, 6) rates at `time`
    q_right: Array  # (n, 6) at the right camera's mid exposure; equals q unless that camera is delayed
    frame_rate: float  # true one [Hz]
    rig: StereoRig  # while the chessboard was shown
    rig_while_filming: StereoRig  # while the disc was filmed
    disc: Disc  # with the true centres of the dots
    paper_centre_body: Array  # (2,) [m]
    markers_printed: Mask  # (m,) False for dots that have come off
    R_world_board: Array  # (v, 3, 3) of the calibration views
    t_world_board: Array  # (v, 3) [m]
    effects: dict[str, float]  # "effect.parameter" of the rolling model, SI

    @property
    def markers_px(self) -> Array:
        """(n, 2, m, 2) images of the dots' own centres at mid exposure, whether visible or not."""
        pixels = []
        for q, view in zip((self.q, self.q_right), views_of(self.rig_while_filming), strict=True):
            R = rotation_from_euler(*q[:, 3:].T)
            pixels.append(image_of(self.disc.marker_centres_body @ np.swapaxes(R, -1, -2) + q[:, None, :3], view))
        return np.stack(pixels, axis=1)


def write_truth(path: Path, truth: Truth, scene: Scene) -> None:
    """Write `truth` and the scene it was rendered from."""
    with h5py.File(path, "w") as file:
        file.attrs["schema"], file.attrs["schema_version"] = SCHEMA, SCHEMA_VERSION
        file.attrs["scene"] = scene_toml(scene)  # renders the same recording again
        file.attrs["frame_rate_hz"] = truth.frame_rate
        _put(file, "time", truth.time, "s", "mid exposure of the left camera")
        units = ", ".join(f"{c} {'m' if c in 'xyz' else 'rad'}" for c in COORDINATES)
        _put(file, "q", truth.q, units, "pose at time, world frame = table")
        _put(file, "qdot", truth.qdot, "m/s, rad/s", "rates of q at time")
        _put(file, "q_right", truth.q_right, units, "pose at the right camera's mid exposure")
        _put(file, "markers_px", truth.markers_px, "px", "images of the dots' own centres (frame, camera, marker, xy)")
        disc = file.create_group("disc")
        for name in ("radius", "half_thickness", "mass", "marker_diameter"):
            disc.attrs[name] = getattr(truth.disc, name)
        _put(disc, "marker_centres_body", truth.disc.marker_centres_body, "m", "true centres of the dots")
        _put(disc, "declared_marker_centres_body", scene.declared_disc.marker_centres_body, "m", "as in recording.toml")
        _put(disc, "paper_centre_body", truth.paper_centre_body, "m", "centre of the paper on the upper face")
        _put(disc, "markers_printed", truth.markers_printed.astype(np.uint8), "1", "0: the dot has come off")
        for name, rig in (("rig", truth.rig), ("rig_while_filming", truth.rig_while_filming)):
            write_rig_group(file.create_group(name), rig)
        board = file.create_group("board")
        _put(board, "R_world_board", truth.R_world_board, "1", "orientation of the board in the calibration views")
        _put(board, "t_world_board", truth.t_world_board, "m", "lower left inner corner in the calibration views")
        effects = file.create_group("effects")
        for name, value in truth.effects.items():
            effects.attrs[name] = value


def _put(group: Any, name: str, values: NDArray[Any], units: str, text: str) -> None:
    data = group.create_dataset(name, data=values, compression="gzip" if values.size > 1000 else None)
    data.attrs["units"], data.attrs["description"] = units, text


def read_truth(path: str | Path) -> Truth:
    """Truth of a file that `write_truth` wrote; raises OutputError for anything else."""
    try:
        with h5py.File(path, "r") as file:
            if file.attrs.get("schema") != SCHEMA:
                raise OutputError(
                    f"{path}: schema {file.attrs.get('schema')!r}; expected {SCHEMA!r}, as `render` writes"
                )
            disc = file["disc"]
            return Truth(
                time=file["time"][:],
                q=file["q"][:],
                qdot=file["qdot"][:],
                q_right=file["q_right"][:],
                frame_rate=float(file.attrs["frame_rate_hz"]),
                rig=read_rig_group(file["rig"]),
                rig_while_filming=read_rig_group(file["rig_while_filming"]),
                disc=Disc(
                    radius=float(disc.attrs["radius"]),
                    half_thickness=float(disc.attrs["half_thickness"]),
                    mass=float(disc.attrs["mass"]),
                    marker_centres_body=disc["marker_centres_body"][:],
                    marker_diameter=float(disc.attrs["marker_diameter"]),
                ),
                paper_centre_body=disc["paper_centre_body"][:],
                markers_printed=disc["markers_printed"][:].astype(bool),
                R_world_board=file["board/R_world_board"][:],
                t_world_board=file["board/t_world_board"][:],
                effects={name: float(value) for name, value in file["effects"].attrs.items()},
            )
    except (OSError, KeyError, RigFileError) as error:
        raise OutputError(f"{path}: not a truth file ({error}); render the recording again") from error
