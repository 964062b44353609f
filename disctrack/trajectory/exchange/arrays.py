"""Formats of named arrays: OpenCV's YAML or XML files, and MAT files of version 5 for MATLAB and Octave.

A rig is stored as the arguments of a function: in OpenCV's files under the names of its stereo sample (M1 D1 M2 D2 R
T), in a MAT file, which cannot hold objects, under those of MATLAB's function:

    s = load('rig.mat');
    stereoParams = stereoParametersFromOpenCV(s.intrinsicMatrix1, s.distortionCoefficients1, s.intrinsicMatrix2, ...
        s.distortionCoefficients2, s.rotationOfCamera2, s.translationOfCamera2, s.imageSize, WorldUnits=s.worldUnits);

For the reverse, save the values of stereoParametersToOpenCV under these names. MATLAB's image size is (rows, columns).
A trajectory is one struct.
"""

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.io import loadmat, savemat

from calibration.cameras.camera import StereoRig
from calibration.kit.arrays import Array
from disctrack.errors import OutputError, RigFileError, told_as
from disctrack.files.whole import whole_file, write_whole
from disctrack.frames import COORDINATES
from disctrack.trajectory import FrameStatus, Trajectory
from disctrack.trajectory.exchange.rigs import array_of, camera_of, content_of, rotation_of
from disctrack.trajectory.file import disc_sizes, labelled, recording_numbers

_YAML = ("M1", "D1", "M2", "D2", "R", "T")
_BESIDE = ("image_size1", "image_size2", "R_left_world", "t_left_world")
_MAT = [f"{what}{number}" for number in (1, 2) for what in ("intrinsicMatrix", "distortionCoefficients")]
_MAT += ["rotationOfCamera2", "translationOfCamera2"]


def write_opencv(path: Path, rig: StereoRig) -> None:
    """Write intrinsics and extrinsics; lengths in metres. Raises OutputError.

    M1 D1 M2 D2 R T are arguments of cv2.stereoRectify; R_left_world and t_left_world define the world frame.
    """
    with whole_file(path, suffix=path.suffix) as part:
        storage = cv2.FileStorage(str(part), cv2.FILE_STORAGE_WRITE)
        if not storage.isOpened():
            raise OutputError(f"{path}: the rig cannot be written there")
        storage.write("unit", "m")
        sizes = {f"image_size{c}": np.array([camera.image_size], np.int32) for c, camera in enumerate(rig.cameras, 1)}
        for name, number in (_numbers(rig, _YAML) | sizes).items():
            storage.write(name, number)
        storage.release()


def read_opencv(
    paths: Sequence[Path],
    *,
    image_size: tuple[int, int] | None = None,
    unit: float | None = None,
    world_is_table: bool = False,
) -> StereoRig:
    """A rig from one file, or from two (intrinsics.yml and extrinsics.yml of OpenCV's sample).

    image_size : (width, height) [px], needed if the files do not contain it
    unit : [m] length of the file's unit (0.025 if T is in squares of 25 mm); default: metres if the file says so
    world_is_table : True if R_left_world and t_left_world are those of the table, k up, whatever the file says

    The covariance is zero, as such files contain none. Raises RigFileError.
    """
    nodes: dict[str, Any] = {"unit": "", "world_is_table": False}
    for path in paths:
        nodes |= _nodes(path)
    where = ", ".join(str(p) for p in paths)
    missing = [name for name in _YAML if name not in nodes]
    if missing:
        raise RigFileError(f"{where}: {', '.join(missing)} missing; a stereo rig has M1, D1, M2, D2, R and T")
    if unit is None and nodes["unit"] != "m":
        raise RigFileError(f"{where}: does not say in which unit T is; give it (0.025 for squares of 25 mm)")
    sizes = [nodes.get(f"image_size{number}", np.array(image_size or (), float)).ravel() for number in (1, 2)]
    if any(size.size != 2 for size in sizes):
        raise RigFileError(f"{where}: does not tell the image size; give width and height")
    if not {"R_left_world", "t_left_world"} <= nodes.keys():
        if world_is_table:
            raise RigFileError(f"{where}: without R_left_world and t_left_world nothing says where the table is")
        nodes = {name: nodes[name] for name in _YAML}
    return _stereo_rig(nodes, _YAML, sizes, 1.0 if unit is None else unit, world_is_table, where)


def _nodes(path: Path) -> dict[str, Any]:
    """Entries of a file that belong to a rig. Raises RigFileError."""
    found: dict[str, Any] = {}
    with told_as(RigFileError, f"{path}: not a stereo rig in OpenCV's YAML, XML or JSON format", Exception):
        storage = cv2.FileStorage(content_of(path), cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        for name in (*_YAML, *_BESIDE):
            matrix = storage.getNode(name).mat()
            if matrix is not None:
                found[name] = np.asarray(matrix, float)
        if storage.getNode("unit").string() == "m":
            found["unit"] = "m"
        if storage.getNode("world_is_table").real() == 1.0:
            found["world_is_table"] = True
    return found


def write_mat(path: Path, trajectory: Trajectory) -> None:
    """Write all variables of the trajectory file's root and of the dots, in SI and radians; NaN for missing values.

    disctrack.q (n, 6) with disctrack.q_names, q_sigma (this frame's noise), q_sigma_calibration (common to all frames);
    disctrack.units holds the unit of every field. Raises OutputError.
    """
    variables = labelled(trajectory)
    content = {
        "time": trajectory.time,
        "q": trajectory.q,
        "q_sigma": trajectory.coordinate_sigma,
        "q_sigma_calibration": trajectory.calibration_sigma,
        "q_names": np.array(COORDINATES, dtype=object),
        **{name: np.asarray(item.data) for name, item in variables.items()},
        "status_names": np.array([status.name.lower() for status in FrameStatus], dtype=object),
        **recording_numbers(trajectory),
        "disc": {**disc_sizes(trajectory.disc), "marker_centres_body_m": trajectory.disc.marker_centres_body},
        "units": {"time": "s", "q": "m, m, m, rad, rad, rad"} | {name: item.units for name, item in variables.items()},
    }
    _save(path, {"disctrack": content})


def write_stereo_parameters(path: Path, rig: StereoRig) -> None:
    """Write arguments of stereoParametersFromOpenCV in metres, and the world frame. Raises OutputError."""
    size = np.array(rig.left.image_size[::-1], float)[None]
    _save(path, {"worldUnits": "m", "imageSize": size} | _numbers(rig, _MAT))


def read_stereo_parameters(path: Path, *, unit: float | None = None, world_is_table: bool = False) -> StereoRig:
    """A rig from a MAT file with these arguments.

    unit : [m] of translationOfCamera2 if the file has no worldUnits
    world_is_table : True if the world of R_left_world is the table, k up, whatever the file says
    Raises RigFileError.
    """
    with told_as(RigFileError, f"{path}: not a MAT file of version 5", Exception, then="Save it with -v6 or -v7."):
        found = loadmat(path)
    if "intrinsicMatrix1" not in found:
        names = ", ".join(name for name in found if not name.startswith("__"))
        raise RigFileError(f"{path}: holds {names or 'nothing'}; save by name what stereoParametersToOpenCV returns")
    stated = str(np.ravel(found.get("worldUnits", ""))[0]) if np.size(found.get("worldUnits", "")) else ""
    scale = unit if unit is not None else {"m": 1.0, "mm": 1e-3}.get(stated)
    if scale is None:
        raise RigFileError(f"{path}: does not say in which unit translationOfCamera2 is; give it (0.001 for mm)")
    size = array_of(found, "imageSize", (2,), str(path))[::-1]
    return _stereo_rig(found, _MAT, (size, size), scale, world_is_table, str(path))


def _save(path: Path, content: Mapping[str, Any]) -> None:
    buffer = io.BytesIO()
    savemat(buffer, dict(content), oned_as="column", long_field_names=True)
    write_whole(path, buffer.getbuffer())


def _stereo_rig(
    found: Mapping[str, Any],
    names: Sequence[str],
    sizes: Sequence[Array],
    unit: float,
    world_is_table: bool,
    where: str,
) -> StereoRig:
    """A rig from arguments of OpenCV's functions; names : of K and D of both cameras, of R and t from left to right.

    Also uses R_left_world, t_left_world and world_is_table if found. unit : [m]
    Raises RigFileError.
    """
    *of_cameras, R, t = names
    cameras = [
        camera_of(array_of(found, K, (3, 3), where), array_of(found, D, (-1,), where), size, f"{where}: {K}, {D}")
        for K, D, size in zip(of_cameras[::2], of_cameras[1::2], sizes, strict=True)
    ]
    world = {"R_left_world": np.eye(3), "t_left_world": np.zeros(3), "world_is_table": 0.0, **found}
    places: dict[str, Any] = {}
    for rotation, translation, between in ((R, t, "right_left"), ("R_left_world", "t_left_world", "left_world")):
        places[f"R_{between}"] = rotation_of(array_of(world, rotation, (-1,), where), f"{where}: {rotation}")
        places[f"t_{between}"] = unit * array_of(world, translation, (3,), where)
    is_table = world_is_table or bool(np.ravel(world["world_is_table"])[0])
    return StereoRig(cameras[0], cameras[1], **places, world_is_table=is_table)


def _numbers(rig: StereoRig, names: Sequence[str]) -> dict[str, Any]:
    """The inverse of `_stereo_rig`, in metres: values of `names`, and the world frame."""
    of_cameras = [number for camera in rig.cameras for number in (camera.camera_matrix, np.array([camera.distortion]))]
    numbers = dict(zip(names, (*of_cameras, rig.R_right_left, rig.t_right_left[:, None]), strict=True))
    world = {"R_left_world": rig.R_left_world, "t_left_world": rig.t_left_world[:, None]}
    return numbers | world | {"world_is_table": int(rig.world_is_table)}
