"""Rigs from and to Kalibr's camchain YAML: cam0 (left), cam1 (right), pinholes with radtan or no distortion.

cam1 holds T_cn_cnm1 (4, 4), from cam0's axes to its own, in metres. Kalibr knows no world.
"""

from pathlib import Path

import numpy as np

from calibration.cameras.camera import StereoRig
from disctrack.errors import OutputError, RigFileError
from disctrack.files.whole import write_whole
from disctrack.trajectory.exchange.rig_parts import (
    array_of,
    camera_of,
    content_of,
    listed,
    rig_of,
    rotation_of,
)


def write_kalibr(path: Path, rig: StereoRig) -> None:
    """k3 and the world have no place there. Raises OutputError."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rig.R_right_left, rig.t_right_left
    text = ""
    for number, camera in enumerate(rig.cameras):
        text += (
            f"cam{number}:\n"
            f"  cam_overlaps: [{1 - number}]\n"
            "  camera_model: pinhole\n"
            f"  distortion_coeffs: {listed(camera.distortion[:4])}\n"
            "  distortion_model: radtan\n"
            f"  intrinsics: {listed(camera.parameters[:4])}\n"
            f"  resolution: {listed(camera.image_size)}\n"
            f"  rostopic: /cam{number}/image_raw\n"
        )
    text += "  T_cn_cnm1:\n" + "".join(f"  - {listed(row)}\n" for row in T)
    write_whole(path, text.encode())


def read_kalibr(path: Path) -> StereoRig:
    """cam0 and cam1 of a camchain. Raises RigFileError; OutputError where PyYAML is not installed."""
    try:
        import yaml
    except ImportError as error:
        raise OutputError(f"{path}: Kalibr's YAML needs PyYAML: pip install pyyaml") from error
    try:
        chain = yaml.safe_load(content_of(path))
    except yaml.YAMLError as error:
        raise RigFileError(f"{path}: not YAML: {error}") from error
    parts = []
    for name in ("cam0", "cam1"):
        where, table = f"{path}, {name}", chain.get(name) if isinstance(chain, dict) else None
        if not isinstance(table, dict):
            raise RigFileError(f"{path}: holds no {name}; a camchain of two cameras has cam0 and cam1")
        lens, model = table.get("distortion_model"), table.get("camera_model")
        if model != "pinhole" or lens not in ("radtan", "none"):
            raise RigFileError(f"{where}: {model} with {lens}; pinhole with radtan (Brown's k1 k2 p1 p2) can be read")
        fx, fy, cx, cy = array_of(table, "intrinsics", (4,), where)
        D = array_of(table, "distortion_coeffs", (-1,), where) if lens == "radtan" else np.zeros(0)
        K, size = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), array_of(table, "resolution", (2,), where)
        T = np.eye(4) if name == "cam0" else array_of(table, "T_cn_cnm1", (4, 4), where)
        parts.append((camera_of(K, D, size, where), rotation_of(T[:3, :3], where), T[:3, 3]))
    return rig_of(parts, world_is_table=False)
