"""truth.h5: what a synthetic recording really shows; for validation only, no stage of the measurement reads it."""

from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np

from calibration.cameras.camera import StereoRig
from calibration.kit.arrays import Array, Mask
from calibration.rig_file import write_rig_group
from disctrack.disc import Disc
from disctrack.frames import COORDINATES, rotation_from_euler
from disctrack.synthetic.cameras import image_of, views_of
from disctrack.synthetic.description import Scene, scene_toml


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
    pose, disc = ", ".join(f"{c} {'m' if c in 'xyz' else 'rad'}" for c in COORDINATES), truth.disc
    datasets = (
        ("time", truth.time, "s", "mid exposure of the left camera"),
        ("q", truth.q, pose, "pose at time, world frame = table"),
        ("qdot", truth.qdot, "m/s, rad/s", "rates of q at time"),
        ("q_right", truth.q_right, pose, "pose at the right camera's mid exposure"),
        ("markers_px", truth.markers_px, "px", "images of the dots' own centres (frame, camera, marker, xy)"),
        ("disc/paper_centre_body", truth.paper_centre_body, "m", "centre of the paper on the upper face"),
        ("disc/markers_printed", truth.markers_printed.astype(np.uint8), "1", "0: the dot has come off"),
        ("disc/marker_centres_body", disc.marker_centres_body, "m", "true centres of the dots"),
        ("disc/declared_marker_centres_body", scene.declared_disc.marker_centres_body, "m", "as in recording.toml"),
        ("board/R_world_board", truth.R_world_board, "1", "orientation of the board in the calibration views"),
        ("board/t_world_board", truth.t_world_board, "m", "lower left inner corner in the calibration views"),
    )
    with h5py.File(path, "w") as file:
        file.attrs["schema"], file.attrs["schema_version"] = "disctrack truth", 2
        file.attrs["scene"] = scene_toml(scene)  # renders the same recording again
        file.attrs["frame_rate_hz"] = truth.frame_rate
        for place, values, units, text in datasets:
            data = file.create_dataset(place, data=values, compression="gzip" if values.size > 1000 else None)
            data.attrs["units"], data.attrs["description"] = units, text
        sizes = ("radius", "half_thickness", "mass", "marker_diameter")
        file["disc"].attrs.update({name: getattr(disc, name) for name in sizes})
        for name in ("rig", "rig_while_filming"):
            write_rig_group(file.create_group(name), getattr(truth, name))
        file.create_group("effects").attrs.update(truth.effects)
