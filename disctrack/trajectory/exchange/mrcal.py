"""Rigs from and to mrcal's .cameramodel, a file for each camera, where the lens model is Brown's."""

import ast
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from calibration.cameras.camera import StereoRig
from disctrack.errors import RigFileError
from disctrack.files.whole import write_whole
from disctrack.trajectory.exchange.rig_parts import (
    array_of,
    camera_of,
    content_of,
    listed,
    rig_of,
    rotation_of,
    rotation_vector,
)

TERMS = {"LENSMODEL_PINHOLE": 0, "LENSMODEL_OPENCV4": 4, "LENSMODEL_OPENCV5": 5}


def sides_of(path: Path) -> tuple[Path, Path]:
    """The two files of a rig: NAME-left and NAME-right."""
    return path.with_name(f"{path.stem}-left{path.suffix}"), path.with_name(f"{path.stem}-right{path.suffix}")


def write_mrcal(path: Path, rig: StereoRig) -> None:
    """Write `sides_of` the path; the reference is the rig's world, lengths in metres. Raises OutputError."""
    for side, camera, (R, t) in zip(sides_of(path), rig.cameras, rig.camera_poses(), strict=True):
        text = (
            "{\n"
            "    'lensmodel':  'LENSMODEL_OPENCV5',\n"
            "    # fx, fy, cx, cy, k1, k2, p1, p2, k3\n"
            f"    'intrinsics': {listed(camera.parameters)},\n"
            "    # rotation vector and translation [m]: reference to camera\n"
            f"    'extrinsics': {listed(np.concatenate([rotation_vector(R), t]))},\n"
            f"    'imagersize': {listed(camera.image_size)}\n"
            "}\n"
        )
        write_whole(side, text.encode())


def read_mrcal(paths: Sequence[Path], *, world_is_table: bool = False) -> StereoRig:
    """A rig from two .cameramodel files with one reference, left first. Raises RigFileError, also for other lenses.

    world_is_table : True if their reference is the table, k up
    """
    if len(paths) != 2:
        raise RigFileError(f"{paths[0]}: mrcal keeps one camera per file; give two, left first")
    parts = []
    for path in paths:
        try:
            model = ast.literal_eval(content_of(path).strip())
        except (ValueError, SyntaxError, MemoryError, RecursionError) as error:
            raise RigFileError(f"{path}: not a .cameramodel of mrcal ({type(error).__name__})") from error
        if not isinstance(model, dict):
            raise RigFileError(f"{path}: not a .cameramodel of mrcal: no dictionary")
        name = str(model.get("lensmodel", model.get("lens_model", "none")))
        if name not in TERMS:
            raise RigFileError(
                f"{path}: lens model {name}; {', '.join(TERMS)} can be read. mrcal-convert-lensmodel fits one"
            )
        fx, fy, cx, cy, *D = array_of(model, "intrinsics", (4 + TERMS[name],), str(path)).tolist()
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        size = array_of(model, "imagersize", (2,), str(path))
        rt = array_of(model, "extrinsics" if "extrinsics" in model else "rt_cam_ref", (6,), str(path))
        parts.append((camera_of(K, np.array(D), size, str(path)), rotation_of(rt[:3], str(path)), rt[3:]))
    return rig_of(parts, world_is_table)
