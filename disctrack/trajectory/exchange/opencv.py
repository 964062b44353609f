"""Exchange of rigs with OpenCV's YAML or XML files, in the names of its stereo sample (M1 D1 M2 D2 R T)."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from calibration.cameras.camera import StereoRig
from disctrack.errors import OutputError, RigFileError
from disctrack.files.whole import whole_file
from disctrack.trajectory.exchange.rig_parts import content_of, opencv_numbers, stereo_rig

_NAMES = ("M1", "D1", "M2", "D2", "R", "T")
_MORE = ("image_size1", "image_size2", "R_left_world", "t_left_world")


def write_opencv(path: Path, rig: StereoRig) -> None:
    """Write intrinsics and extrinsics; lengths in metres. Raises OutputError.

    M1 D1 M2 D2 R T are what cv2.stereoRectify takes; R_left_world and t_left_world hold the world frame.
    """
    with whole_file(path, suffix=path.suffix) as part:
        storage = cv2.FileStorage(str(part), cv2.FILE_STORAGE_WRITE)
        if not storage.isOpened():
            raise OutputError(f"{path}: the rig cannot be written there")
        storage.write("unit", "m")
        sizes = {f"image_size{c}": np.array([camera.image_size], np.int32) for c, camera in enumerate(rig.cameras, 1)}
        for name, number in (opencv_numbers(rig, _NAMES) | sizes).items():
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

    image_size : (width, height) [px], needed where the files do not tell it
    unit : [m] length of the file's unit (0.025 where T is in squares of 25 mm); default: metres if the file says so
    world_is_table : True if R_left_world and t_left_world are those of the table, k up, whether or not the file says so

    The covariance is zero: such files carry none. Raises RigFileError.
    """
    nodes: dict[str, Any] = {"unit": "", "world_is_table": False}
    for path in paths:
        nodes |= _nodes(path)
    where = ", ".join(str(p) for p in paths)
    missing = [name for name in _NAMES if name not in nodes]
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
        nodes = {name: nodes[name] for name in _NAMES}
    return stereo_rig(nodes, _NAMES, sizes, 1.0 if unit is None else unit, world_is_table, where)


def _nodes(path: Path) -> dict[str, Any]:
    """What a file holds of a rig. Raises RigFileError."""
    text = content_of(path)
    found: dict[str, Any] = {}
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        for name in (*_NAMES, *_MORE):
            matrix = storage.getNode(name).mat()
            if matrix is not None:
                found[name] = np.asarray(matrix, float)
        if storage.getNode("unit").string() == "m":
            found["unit"] = "m"
        if storage.getNode("world_is_table").real() == 1.0:
            found["world_is_table"] = True
    except (cv2.error, ValueError, TypeError, SystemError) as error:
        raise RigFileError(f"{path}: not a stereo rig in OpenCV's YAML, XML or JSON format ({error})") from error
    return found
