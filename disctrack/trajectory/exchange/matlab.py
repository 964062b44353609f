"""MAT files of version 5 for MATLAB and Octave: a trajectory as one struct, a rig as the stereo toolbox has it.

Objects cannot be written into such a file, so a rig is kept as the arguments of MATLAB's own function, under its names:

    s = load('rig.mat');
    stereoParams = stereoParametersFromOpenCV(s.intrinsicMatrix1, s.distortionCoefficients1, s.intrinsicMatrix2, ...
        s.distortionCoefficients2, s.rotationOfCamera2, s.translationOfCamera2, s.imageSize, WorldUnits=s.worldUnits);

Back again: save what stereoParametersToOpenCV returns under these names. MATLAB counts rows before columns.
"""

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import loadmat, savemat

from calibration.cameras.camera import StereoRig
from disctrack.errors import RigFileError
from disctrack.files.whole import write_whole
from disctrack.frames import COORDINATES
from disctrack.trajectory import FrameStatus, Trajectory
from disctrack.trajectory.exchange.rig_parts import array_of, opencv_numbers, stereo_rig
from disctrack.trajectory.file import labelled

_NAMES = [f"{what}{number}" for number in (1, 2) for what in ("intrinsicMatrix", "distortionCoefficients")]
_NAMES += ["rotationOfCamera2", "translationOfCamera2"]


def write_mat(path: Path, trajectory: Trajectory) -> None:
    """Every variable of the trajectory file's root and the dots, in SI and radians; NaN where there is no answer.

    disctrack.q (n, 6) with disctrack.q_names, q_sigma (this frame's noise), q_sigma_calibration (common to all frames);
    disctrack.units tells the unit of every field. Raises OutputError.
    """
    variables, _, numbers = labelled(trajectory)
    disc = {name.removeprefix("disc_"): value for name, value in numbers.items() if name.startswith("disc_")}
    content = {
        "time": trajectory.time,
        "q": trajectory.q,
        "q_sigma": trajectory.coordinate_sigma,
        "q_sigma_calibration": trajectory.calibration_sigma,
        "q_names": np.array(COORDINATES, dtype=object),
        **{name: np.asarray(item.data) for name, item in variables.items()},
        "status_names": np.array([status.name.lower() for status in FrameStatus], dtype=object),
        **{name: value for name, value in numbers.items() if not name.startswith("disc_")},
        "disc": {**disc, "marker_centres_body_m": trajectory.disc.marker_centres_body},
        "units": {"time": "s", "q": "m, m, m, rad, rad, rad"} | {name: item.units for name, item in variables.items()},
    }
    _save(path, {"disctrack": content})


def write_stereo_parameters(path: Path, rig: StereoRig) -> None:
    """Arguments of stereoParametersFromOpenCV in metres; the world frame beside them. Raises OutputError."""
    size = np.array(rig.left.image_size[::-1], float)[None]
    _save(path, {"worldUnits": "m", "imageSize": size} | opencv_numbers(rig, _NAMES))


def read_stereo_parameters(path: Path, *, unit: float | None = None, world_is_table: bool = False) -> StereoRig:
    """A rig of such a MAT file.

    unit : [m] of translationOfCamera2 where the file has no worldUnits that tell it
    world_is_table : True if the world of R_left_world is the table, k up, whether or not the file says so
    Raises RigFileError.
    """
    try:
        found = loadmat(path)
    except (OSError, ValueError, NotImplementedError, TypeError) as error:
        raise RigFileError(f"{path}: not a MAT file of version 5 ({error}); save it with -v6 or -v7") from error
    if "intrinsicMatrix1" not in found:
        there = ", ".join(name for name in found if not name.startswith("__"))
        raise RigFileError(
            f"{path}: holds {there or 'nothing'}; save what stereoParametersToOpenCV returns, by its names"
        )
    told = str(np.ravel(found.get("worldUnits", ""))[0]) if np.size(found.get("worldUnits", "")) else ""
    scale = unit if unit is not None else {"m": 1.0, "mm": 1e-3}.get(told)
    if scale is None:
        raise RigFileError(f"{path}: does not say in which unit translationOfCamera2 is; give it (0.001 for mm)")
    size = array_of(found, "imageSize", (2,), str(path))[::-1]
    return stereo_rig(found, _NAMES, (size, size), scale, world_is_table, str(path))


def _save(path: Path, content: Mapping[str, Any]) -> None:
    buffer = io.BytesIO()
    savemat(buffer, dict(content), oned_as="column", long_field_names=True)
    write_whole(path, buffer.getbuffer())
