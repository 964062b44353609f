"""Exchange of rigs with OpenCV's YAML or XML files, in the names of its stereo sample (M1 D1 M2 D2 R T)."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from calibration.cameras.camera import Camera, StereoRig
from calibration.kit.arrays import Array
from disctrack.errors import OutputError, RigFileError
from disctrack.files.whole import whole_file
from disctrack.trajectory.exchange.rig_parts import MAX_BYTES, camera_of, rotation_of


def write_opencv(path: Path, rig: StereoRig) -> None:
    """Write intrinsics and extrinsics; lengths in metres. Raises OutputError.

    M1 D1 M2 D2 R T are what cv2.stereoRectify takes; R_left_world and t_left_world hold the world frame.
    """
    with whole_file(path, suffix=path.suffix) as part:
        storage = cv2.FileStorage(str(part), cv2.FILE_STORAGE_WRITE)
        if not storage.isOpened():
            raise OutputError(f"{path}: the rig cannot be written there")
        storage.write("unit", "m")
        for number, camera in enumerate(rig.cameras, start=1):
            storage.write(f"M{number}", camera.camera_matrix)
            storage.write(f"D{number}", np.array([camera.distortion]))
            storage.write(f"image_size{number}", np.array([camera.image_size], dtype=np.int32))
        storage.write("R", rig.R_right_left)
        storage.write("T", rig.t_right_left[:, None])
        storage.write("R_left_world", rig.R_left_world)
        storage.write("t_left_world", rig.t_left_world[:, None])
        storage.write("world_is_table", int(rig.world_is_table))
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
    nodes: dict[str, Array] = {}
    told_metres, is_table = False, world_is_table
    names = ("M1", "D1", "M2", "D2", "R", "T", "image_size1", "image_size2", "R_left_world", "t_left_world")
    for path in paths:
        storage = _opened(path)
        try:
            for name in names:
                matrix = storage.getNode(name).mat()
                if matrix is not None:
                    nodes[name] = np.asarray(matrix, float)
            told_metres |= storage.getNode("unit").string() == "m"
            is_table |= storage.getNode("world_is_table").real() == 1.0
        except (cv2.error, ValueError, TypeError, SystemError) as error:
            raise RigFileError(f"{path}: not a stereo rig in OpenCV's format ({error})") from error
        finally:
            storage.release()
    where = ", ".join(str(p) for p in paths)
    missing = [name for name in names[:6] if name not in nodes]
    if missing:
        raise RigFileError(f"{where}: {', '.join(missing)} missing; a stereo rig has M1, D1, M2, D2, R and T")
    if unit is None and not told_metres:
        raise RigFileError(f"{where}: does not say in which unit T is; give it (0.025 for squares of 25 mm)")
    scale = 1.0 if unit is None else unit
    cameras = [_camera(nodes, number, image_size, where) for number in (1, 2)]
    world = "R_left_world" in nodes and "t_left_world" in nodes
    if world_is_table and not world:
        raise RigFileError(f"{where}: without R_left_world and t_left_world nothing says where the table is")
    return StereoRig(
        left=cameras[0],
        right=cameras[1],
        R_right_left=rotation_of(nodes["R"], f"{where}: R"),
        t_right_left=_vector(nodes["T"], where) * scale,
        R_left_world=rotation_of(nodes["R_left_world"], f"{where}: R_left_world") if world else np.eye(3),
        t_left_world=_vector(nodes["t_left_world"], where) * scale if world else np.zeros(3),
        world_is_table=world and is_table,
    )


def _opened(path: Path) -> cv2.FileStorage:
    if not path.is_file():
        raise RigFileError(f"{path}: no such file")
    if path.stat().st_size > MAX_BYTES:
        raise RigFileError(f"{path}: {path.stat().st_size} bytes are too many for a rig")
    try:
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    except (cv2.error, SystemError) as error:
        raise RigFileError(f"{path}: not a file in OpenCV's YAML, XML or JSON format") from error
    if not storage.isOpened():
        raise RigFileError(f"{path}: not a file in OpenCV's YAML, XML or JSON format")
    return storage


def _camera(nodes: dict[str, Array], number: int, image_size: tuple[int, int] | None, where: str) -> Camera:
    size = nodes.get(f"image_size{number}", np.array(image_size or (), float)).ravel()
    if size.size != 2:
        raise RigFileError(f"{where}: does not tell the image size; give width and height")
    return camera_of(nodes[f"M{number}"], nodes[f"D{number}"].ravel(), size, f"{where}: M{number}, D{number}")


def _vector(t: Array, where: str) -> Array:
    if t.size != 3 or not np.isfinite(t).all():
        raise RigFileError(f"{where}: T is not a vector of three numbers")
    return t.ravel()
