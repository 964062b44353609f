"""A measured motion as a file for the 3-D viewer rerun (.rrd): disc, dots, contact point, cameras and curves over time.

Needs the optional package: pip install rerun-sdk.
"""

from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration import StereoRig
from calibration.kit.arrays import Array
from disctrack.analyse.analysis import Analysis
from disctrack.disc import Disc
from disctrack.errors import OutputError
from disctrack.files.whole import whole_file
from disctrack.frames import CAMERAS, quaternion_from_rotation

TIMELINE = "recording"
_RIM_POINTS = 96
_DISC, _DOT, _CONTACT, _TABLE = (120, 132, 148), (20, 20, 20), (214, 39, 40), (200, 200, 200)


def require_rerun(path: Path) -> None:
    """Raise OutputError if the package that writes `path` is not installed."""
    try:
        found = find_spec("rerun")
    except ValueError:  # blocked
        found = None
    if found is None:
        raise OutputError(
            f"{path}: writing it needs the package rerun-sdk, which is not installed. Install it with "
            "pip install rerun-sdk, or leave out --rerun."
        )


def write_rerun(path: Path, analysis: Analysis) -> None:
    """Write the motion for the 3-D viewer: world in metres, k up; frames without a pose are left out.

    Raises OutputError if the package rerun-sdk is not installed, or the file cannot be written.
    """
    require_rerun(path)
    import rerun

    with whole_file(path) as part:
        stream = rerun.RecordingStream("disctrack", send_properties=False)
        stream.save(part)
        _log_scene(rerun, stream, analysis)
        _log_motion(rerun, stream, analysis)
        stream.flush()
        stream.disconnect()


def _log_scene(rr: Any, stream: Any, analysis: Analysis) -> None:
    disc, motion = analysis.motion.disc, analysis.motion
    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    centre = np.append(np.nanmean(motion.position[:, :2], axis=0), 0.0)
    stream.log("world/table", rr.LineStrips3D(_grid(centre, 3 * disc.radius), colors=[_TABLE]), static=True)
    vertices, triangles = _cylinder(disc)
    normals = _normals(vertices, triangles)
    mesh = rr.Mesh3D(
        vertex_positions=vertices, triangle_indices=triangles, vertex_normals=normals, albedo_factor=(*_DISC, 255)
    )
    stream.log("world/disc/body", mesh, static=True)
    dots = rr.Points3D(
        disc.marker_centres_body,
        radii=0.03 * disc.radius,
        colors=[_DOT],
        labels=[str(i) for i in range(disc.n_markers)],
    )
    stream.log("world/disc/dots", dots, static=True)
    _log_cameras(rr, stream, analysis.trajectory.rig)


def _log_cameras(rr: Any, stream: Any, rig: StereoRig) -> None:
    for name, (R, t), camera in zip(CAMERAS, rig.camera_poses(), rig.cameras, strict=True):
        stream.log(f"world/{name}", rr.Transform3D(translation=-R.T @ t, mat3x3=R.T), static=True)
        pinhole = rr.Pinhole(
            image_from_camera=camera.camera_matrix,
            resolution=camera.image_size,
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=0.2 * float(np.linalg.norm(t)),
        )
        stream.log(f"world/{name}", pinhole, static=True)


def _log_motion(rr: Any, stream: Any, analysis: Analysis) -> None:
    motion = analysis.motion
    known = motion.known
    times = [rr.TimeColumn(TIMELINE, duration=motion.time[known])]

    def send(entity: str, columns: Any) -> None:
        rr.send_columns(entity, indexes=times, columns=columns, recording=stream)

    wxyz = quaternion_from_rotation(motion.R_world_body[known])
    send("world/disc", rr.Transform3D.columns(translation=motion.position[known], quaternion=wxyz[:, [1, 2, 3, 0]]))
    touching = [analysis.series(name).value[known] for name in ("contact_x", "contact_y")]
    contact = np.column_stack([*touching, np.zeros(known.sum())])
    send("world/contact", rr.Points3D.columns(positions=contact))
    stream.log(
        "world/contact", rr.Points3D.from_fields(colors=[_CONTACT], radii=0.02 * motion.disc.radius), static=True
    )
    stream.log(
        "world/locus", rr.LineStrips3D([contact[np.isfinite(contact).all(axis=1)]], colors=[_CONTACT]), static=True
    )
    for name, value in zip(("psi", "theta", "phi"), np.degrees(motion.euler[known]).T, strict=True):
        send(f"curves/{name}_deg", rr.Scalars.columns(scalars=value))
    for name in ("psidot", "total", "power"):
        send(f"curves/{name}", rr.Scalars.columns(scalars=analysis.series(name).value[known]))


def _grid(centre: Array, half_width: float, n: int = 13) -> list[Array]:
    """Lines of the table, z = 0."""
    ticks = np.linspace(-half_width, half_width, n)
    ends = np.array([-half_width, half_width])
    along = [centre + np.column_stack([ends, np.full(2, tick), np.zeros(2)]) for tick in ticks]
    across = [centre + np.column_stack([np.full(2, tick), ends, np.zeros(2)]) for tick in ticks]
    return along + across


def _cylinder(disc: Disc) -> tuple[Array, NDArray[np.int64]]:
    """Vertices (m, 3) in body axes and triangles (t, 3), outside to the front; every face has vertices of its own."""
    angle = 2 * np.pi * np.arange(_RIM_POINTS) / _RIM_POINTS
    rim = disc.radius * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(_RIM_POINTS)])
    up = np.array([0.0, 0.0, disc.half_thickness])
    here = np.arange(_RIM_POINTS)
    there = (here + 1) % _RIM_POINTS
    top, bottom, wall = 0, _RIM_POINTS + 1, 2 * _RIM_POINTS + 2  # each cap: its rim, then its centre
    triangles = np.concatenate(
        [
            np.column_stack([top + here, top + there, np.full(_RIM_POINTS, top + _RIM_POINTS)]),
            np.column_stack([bottom + there, bottom + here, np.full(_RIM_POINTS, bottom + _RIM_POINTS)]),
            np.column_stack([wall + _RIM_POINTS + here, wall + _RIM_POINTS + there, wall + here]),
            np.column_stack([wall + _RIM_POINTS + there, wall + there, wall + here]),
        ]
    )
    return np.vstack([rim + up, up, rim - up, -up, rim + up, rim - up]), triangles


def _normals(vertices: Array, triangles: NDArray[np.int64]) -> Array:
    """(m, 3) outward normals, averaged over the triangles that share a vertex."""
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    normals = np.zeros_like(vertices)
    for i in range(3):
        np.add.at(normals, triangles[:, i], np.cross(b - a, c - a))
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)
