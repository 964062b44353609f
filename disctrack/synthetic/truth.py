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


_POSE = ", ".join(f"{c} {'m' if c in 'xyz' else 'rad'}" for c in COORDINATES)
# Of every array of a Truth: where it lies in the file, unit and meaning
_DATASETS = {
    "time": ("s", "mid exposure of the left camera"),
    "q": (_POSE, "pose at time, world frame = table"),
    "qdot": ("m/s, rad/s", "rates of q at time"),
    "q_right": (_POSE, "pose at the right camera's mid exposure"),
    "disc/paper_centre_body": ("m", "centre of the paper on the upper face"),
    "disc/markers_printed": ("1", "0: the dot has come off"),
    "board/R_world_board": ("1", "orientation of the board in the calibration views"),
    "board/t_world_board": ("m", "lower left inner corner in the calibration views"),
}
_CENTRES = "disc/marker_centres_body"
_SIZES = ("radius", "half_thickness", "mass", "marker_diameter")  # of the disc
_RIGS = ("rig", "rig_while_filming")


def write_truth(path: Path, truth: Truth, scene: Scene) -> None:
    """Write `truth` and the scene it was rendered from."""
    with h5py.File(path, "w") as file:
        file.attrs["schema"], file.attrs["schema_version"] = SCHEMA, SCHEMA_VERSION
        file.attrs["scene"] = scene_toml(scene)  # renders the same recording again
        file.attrs["frame_rate_hz"] = truth.frame_rate
        for place, described in _DATASETS.items():
            values = np.asarray(getattr(truth, Path(place).name))
            _put(file, place, values.astype(np.uint8) if values.dtype == bool else values, *described)
        _put(file, "markers_px", truth.markers_px, "px", "images of the dots' own centres (frame, camera, marker, xy)")
        _put(file, _CENTRES, truth.disc.marker_centres_body, "m", "true centres of the dots")
        declared = scene.declared_disc.marker_centres_body
        _put(file, "disc/declared_marker_centres_body", declared, "m", "as in recording.toml")
        file["disc"].attrs.update({name: getattr(truth.disc, name) for name in _SIZES})
        for name in _RIGS:
            write_rig_group(file.create_group(name), getattr(truth, name))
        file.create_group("effects").attrs.update(truth.effects)


def _put(file: h5py.File, name: str, values: NDArray[Any], units: str, text: str) -> None:
    data = file.create_dataset(name, data=values, compression="gzip" if values.size > 1000 else None)
    data.attrs["units"], data.attrs["description"] = units, text


def read_truth(path: str | Path) -> Truth:
    """Truth of a file that `write_truth` wrote; raises OutputError for anything else."""
    try:
        with h5py.File(path, "r") as file:
            if file.attrs.get("schema") != SCHEMA:
                raise OutputError(
                    f"{path}: schema {file.attrs.get('schema')!r}; expected {SCHEMA!r}, as `render` writes"
                )
            found: dict[str, Any] = {Path(place).name: file[place][:] for place in _DATASETS}
            found["markers_printed"] = found["markers_printed"].astype(bool)
            found |= {name: read_rig_group(file[name]) for name in _RIGS}
            sizes = {name: float(file["disc"].attrs[name]) for name in _SIZES}
            return Truth(
                **found,
                frame_rate=float(file.attrs["frame_rate_hz"]),
                disc=Disc(marker_centres_body=file[_CENTRES][:], **sizes),
                effects={name: float(value) for name, value in file["effects"].attrs.items()},
            )
    except (OSError, KeyError, RigFileError) as error:
        raise OutputError(f"{path}: not a truth file ({error}); render the recording again") from error
