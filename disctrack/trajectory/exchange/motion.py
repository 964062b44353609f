"""A trajectory in formats of other programs: tables, points in space and in images, rotations."""

import csv
import io
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from calibration.cameras.camera import normalise
from calibration.kit.types import Array, checked
from disctrack.errors import OutputError, RigFileError, told_as
from disctrack.files.whole import refuse_existing, whole_file, write_whole
from disctrack.frames import CAMERAS, COORDINATES, rotation_from_quaternion
from disctrack.trajectory import FrameStatus, Trajectory
from disctrack.trajectory.exchange.rigs import content_of, save_mat
from disctrack.trajectory.file import disc_sizes, labelled, recording_numbers


def body_points(trajectory: Trajectory) -> tuple[Array, list[str]]:
    """World positions (n, k, 3) [m] of centre, tips of body axes of length radius, and dots; their names."""
    disc = trajectory.disc
    body = np.concatenate([np.zeros((1, 3)), disc.radius * np.eye(3), disc.marker_centres_body])
    labels = ["CENTRE", "AXIS_1", "AXIS_2", "AXIS_3", *(f"DOT_{i}" for i in range(disc.n_markers))]
    return body @ np.swapaxes(rotations(trajectory), 1, 2) + trajectory.q[:, None, :3], labels


def rotations(trajectory: Trajectory) -> Array:
    """R_world_body (n, 3, 3); NaN in frames without a pose."""
    return np.where(trajectory.measured[:, None, None], rotation_from_quaternion(trajectory.quaternion), np.nan)


def place_sigma_mm(trajectory: Trajectory) -> Array:
    """(n,) one sigma of the position [mm]; -1, the usual mark of missing points, in frames without a pose."""
    sigma = np.sqrt(np.einsum("nii->n", trajectory.pose_covariance[:, :3, :3]))
    return np.where(trajectory.measured, 1e3 * sigma, -1.0)


@checked
def write_csv(path: str | Path, trajectory: Trajectory, overwrite: bool = False) -> None:
    """Write the trajectory as a table in millimetres and degrees, one row per frame, empty if unknown.

    Columns of every coordinate: value, sigma from the noise of the frame, and sigma from the calibration, common to all
    frames. Coordinates have seven decimals, whatever the number of turns of an angle; sigmas have seven digits.

        >>> write_csv("table.csv", read_trajectory("clip"))
    """
    path = Path(path)
    refuse_existing(path, overwrite)
    scale = np.repeat([1e3, np.degrees(1.0)], 3)
    parts = ("", "sigma_", "sigma_calibration_")
    names = [f"{name}_{part}{unit}" for part in parts for name, unit in zip(COORDINATES, _UNITS, strict=True)]
    seen = [f"reprojection_rms_{camera}_px" for camera in CAMERAS]
    values = [trajectory.q * scale, trajectory.coordinate_sigma * scale, trajectory.calibration_sigma * scale]
    rows = np.column_stack([*values, trajectory.reprojection_rms_px])
    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow(["frame", "time_s", *names, *seen, "status"])
    for i, row in enumerate(rows):
        cells = ["" if np.isnan(v) else f"{v:.7f}" if column < 6 else f"{v:.7g}" for column, v in enumerate(row)]
        status = FrameStatus(trajectory.frame_status[i]).name.lower()
        writer.writerow([trajectory.frame[i], f"{trajectory.time[i]:.9g}", *cells, status])
    write_whole(path, text.getvalue().encode())


_UNITS = ("mm", "mm", "mm", "deg", "deg", "deg")


def write_c3d(path: Path, trajectory: Trajectory) -> None:
    """Write dots, centre and tips of the body axes as points in mm, world axes, z up, at the frame rate.

    The tips are one radius from the centre (AXIS_1, AXIS_2 in the face, AXIS_3 out of it), so that a program can define
    the rigid body. The residual of a point is one sigma in mm, -1 in frames without a pose. C3D has single precision:
    1e-4 mm at 1 m. Raises OutputError, also if ezc3d is not installed.
    """
    with told_as(OutputError, f"{path}: C3D needs ezc3d", ImportError, then="Install it: pip install ezc3d"):
        import ezc3d
    points, labels = body_points(trajectory)
    file = ezc3d.c3d()
    described = [_DESCRIPTIONS.get(label, "centre of a dot") for label in labels]
    header = {"UNITS": ["mm"], "RATE": [float(trajectory.frame_rate)], "LABELS": labels, "DESCRIPTIONS": described}
    for name, value in header.items():
        file["parameters"]["POINT"][name]["value"] = value
    data = np.ones((4, len(labels), len(trajectory)))
    data[:3] = np.where(trajectory.measured, 1e3 * np.moveaxis(points, 0, -1).swapaxes(0, 1), np.nan)
    file["data"]["points"] = data
    residuals = np.broadcast_to(place_sigma_mm(trajectory), (1, len(labels), len(trajectory)))
    file["data"]["meta_points"]["residuals"] = residuals.copy()
    file.add_parameter("DISC", "RADIUS", 1e3 * trajectory.disc.radius)
    file.add_parameter("DISC", "THICKNESS", 2e3 * trajectory.disc.half_thickness)
    file.add_parameter("DISC", "MASS", 1e3 * trajectory.disc.mass)
    with whole_file(path, suffix=".c3d") as part:
        file.write(str(part))


_DESCRIPTIONS = {
    "CENTRE": "centre of mass",
    "AXIS_1": "centre + radius * first body axis",
    "AXIS_2": "centre + radius * second body axis",
    "AXIS_3": "centre + radius * normal of the upper face",
}


def write_trc(path: Path, trajectory: Trajectory) -> None:
    """Write `body_points` in metres as TRC, the motion capture format of OpenSim and Pose2Sim.

    OpenSim has y up: world (Y, Z, X) are written, as in Pose2Sim. Missing points are empty. Raises OutputError.
    """
    points, labels = body_points(trajectory)
    n, k, rate = len(points), len(labels), f"{trajectory.frame_rate:g}"
    heads = [
        f"PathFileType\t4\t(X/Y/Z)\t{path.name}",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{rate}\t{rate}\t{n}\t{k}\tm\t{rate}\t{trajectory.frame[0]}\t{n}",
        "Frame#\tTime\t" + "\t\t\t".join(labels) + "\t\t",
        "\t\t" + "\t".join(f"X{i}\tY{i}\tZ{i}" for i in range(1, k + 1)),
        "",
    ]
    rows = [
        f"{frame}\t{time:.9g}\t" + "\t".join("" if np.isnan(v) else f"{v:.9f}" for v in row)
        for frame, time, row in zip(
            trajectory.frame, trajectory.time, points[..., [1, 2, 0]].reshape(n, -1), strict=True
        )
    ]
    write_whole(path, ("\n".join((*heads, *rows)) + "\n").encode())


def write_qtm(path: Path, trajectory: Trajectory) -> None:
    """Write the rigid body DISC as a 6DOF file of Qualisys Track Manager, in millimetres and degrees.

    R = Rx(roll) Ry(pitch) Rz(yaw), and Rot[0...8] is R column by column. Frames count from 1. The residual is one sigma
    of the position [mm]. A frame without a pose has zeros and residual -1. Raises OutputError.
    """
    known, R = trajectory.measured, rotations(trajectory)
    values = np.zeros((len(known), 18))
    values[:, 0], values[:, 1] = np.arange(1, len(known) + 1), trajectory.time
    values[known, 2:5] = 1e3 * trajectory.q[known, :3]
    values[known, 5:8] = Rotation.from_matrix(R[known]).as_euler("XYZ", degrees=True)
    values[:, 8] = place_sigma_mm(trajectory)
    values[known, 9:] = np.swapaxes(R[known], 1, 2).reshape(-1, 9)
    head = _QTM_HEAD.format(n=len(known), rate=trajectory.frame_rate)
    write_whole(path, head.encode() + _table(_QTM_COLUMNS, values, "\t"))


_QTM_HEAD = """NO_OF_FRAMES\t{n}
NO_OF_CAMERAS\t2
NO_OF_BODIES\t1
FREQUENCY\t{rate:g}
NO_OF_ANALOG\t0
ANALOG_FREQUENCY\t0
DESCRIPTION\t--
DATA_INCLUDED\t6D
BODY_NAMES\tDISC
"""
_QTM_COLUMNS = (
    "Frame", "Time", "DISC X", "Y", "Z", "Roll", "Pitch", "Yaw", "Residual", *(f"Rot[{i}]" for i in range(9))
)  # fmt: skip


def write_transformations(path: Path, trajectory: Trajectory) -> None:
    """Write XMALab's rigid body: one row per frame, the matrix (4, 4) body -> world column by column, in millimetres.

    NaN in frames without a pose. Raises OutputError.
    """
    T = np.zeros((len(trajectory), 4, 4))
    T[:, :3, :3], T[:, :3, 3], T[:, 3, 3] = rotations(trajectory), 1e3 * trajectory.q[:, :3], 1.0
    T[~trajectory.measured] = np.nan
    columns = np.swapaxes(T, 1, 2).reshape(-1, 16)
    write_whole(path, _table([f"DISC_{head}" for head in _TRANSFORMATION], columns))


_TRANSFORMATION = (
    "R11", "R12", "R13", "01", "R21", "R22", "R23", "02", "R31", "R32", "R33", "03", "TX", "TY", "TZ", "1"
)  # fmt: skip


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
    save_mat(path, {"disctrack": content})


# --- Image points as tables of text: a row for each frame, columns NAME_camJ_X, NAME_camJ_Y of every point and camera -


def _table(names: Sequence[str], columns: ArrayLike, separator: str = ",") -> bytes:
    """Heading and numbers (n, names) with ten digits; NaN for missing ones."""
    rows = [separator.join(names), *(separator.join(f"{v:.10g}" for v in row) for row in np.asarray(columns, float))]
    return ("\n".join(rows) + "\n").replace("nan", "NaN").encode()


def _write_points(path: Path, points: Array, names: Sequence[str]) -> None:
    """Write points (n, cameras, m, 2) with m names; NaN for missing ones."""
    headings = [f"{name}_cam{c}_{axis}" for name in names for c in range(1, points.shape[1] + 1) for axis in "XY"]
    write_whole(path, _table(headings, points.swapaxes(1, 2).reshape(len(points), -1)))


def write_points(path: Path, trajectory: Trajectory) -> None:
    """Write XMALab's DOT_i_camJ_X, DOT_i_camJ_Y [px]: dots in the images, with distortion, from 0 at the top left.

    Options for XMALab's import: "distorted", no offset, not inverted. Raises OutputError.
    """
    points, field = trajectory.markers_px, trajectory.rig.lens_field
    if field is not None:
        points = field.distorted(points)
    _write_points(path, points, [f"DOT_{i}" for i in range(points.shape[2])])


def write_xypts(path: Path, trajectory: Trajectory) -> None:
    """Write DLTdv8's ptI_camJ_X, ptI_camJ_Y [px], from 1 at the top left, without distortion. Raises OutputError.

    They belong to coefficients of the direct linear transformation, which describe a camera without distortion.
    """
    rig, seen = trajectory.rig, trajectory.markers_px
    straight = [
        normalise(seen[:, c], camera) * (camera.fx, camera.fy) + (camera.cx, camera.cy) + 1.0
        for c, camera in enumerate(rig.cameras)
    ]
    _write_points(path, np.stack(straight, axis=1), [f"pt{i}" for i in range(1, seen.shape[2] + 1)])


def read_points(path: Path) -> Array:
    """Points (n, cameras, m, 2) from a table with such headings; NaN for missing ones. Raises RigFileError."""
    first, *lines = content_of(path).splitlines() or [""]
    found = [re.fullmatch(r"\s*(.+)_cam(\d+)_([XY])\s*", name) for name in first.split(",")]
    names, cameras = dict.fromkeys(m[1] for m in found if m), {m[2] for m in found if m}
    if not found or not all(found) or len(found) != 2 * len(names) * len(cameras):
        raise RigFileError(f"{path}: the first line is '{first[:60]}'; expected NAME_cam1_X,NAME_cam1_Y,...")
    with told_as(RigFileError, f"{path}: not a table of numbers with {len(found)} columns", ValueError):
        values = np.array([[float(cell or "nan") for cell in line.split(",")] for line in lines if line.strip()])
        return values.reshape(len(values), len(names), len(cameras), 2).swapaxes(1, 2)


def read_xypts(path: Path) -> Array:
    """Points (n, cameras, points, 2) [px], counted from 0. Raises RigFileError."""
    return read_points(path) - 1.0
