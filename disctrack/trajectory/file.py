"""The trajectory file: self-describing HDF5, written completely or not at all; reading restores equal objects.

Layout (axes in brackets): at the root time, frame, x y z psi theta phi with their sigmas, quaternion, pose_covariance,
reprojection_rms_px, status; groups `markers`, `disc`, `calibration`, and those that later stages add (`write_groups`).
"""

import contextlib
import io
import json
import platform
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np

from calibration.cameras.camera import RIG_PARAMETERS, StereoRig
from calibration.kit.brief import Brief
from calibration.kit.types import AnyArray, Mask, checked
from calibration.rig_file import beside_cameras, complete_file, read_beside_cameras, sealed, versions, write_attributes
from disctrack.disc import Disc
from disctrack.errors import OutputError, TrajectoryFileError, told_as
from disctrack.files.json_text import json_sha256, json_text
from disctrack.files.labelled_arrays import Variable, copy_without, flags, read_array, write_variables
from disctrack.files.software import software_version
from disctrack.files.whole import refuse_existing, write_whole
from disctrack.findings import Finding, finding_from_json, warn_of_doubts
from disctrack.frames import CAMERAS, COORDINATES, POSE_COMPONENTS
from disctrack.trajectory import FrameStatus, MarkerStatus, Trajectory

if TYPE_CHECKING:
    import xarray

SCHEMA = "disctrack trajectory"
SCHEMA_VERSION = 1
Details = dict[str, Any]  # numbers of the run that made a trajectory, in JSON types
_DEPENDENCIES = ("numpy", "scipy", "opencv-contrib-python-headless", "h5py", "numba")
_CONVENTIONS = {
    "frame_convention": "world: k up, table z = 0; origin and heading from the calibration's table view; "
    "body: origin at the disc's centre, e3 out of the upper face",
    "euler_convention": "R_world_body = Rz(psi) Rx(theta) Rz(phi); psi precession, theta nutation, phi spin; rad",
    "quaternion_convention": "(w, x, y, z), body to world",
    "pixel_convention": "(0, 0) is the centre of the top-left pixel, x right, y down",
    "sigma_convention": "*_sigma and pose_covariance are the noise of that frame alone; *_sigma_calibration is what "
    "frames share: the rig's covariance, and systematic_covariance (misfit of the dots beyond their noise, tolerances "
    "of the disc). The whole variance is the sum of both squares",
}


@checked
@dataclass(frozen=True, repr=False)
class Provenance(Brief):
    """Inputs, settings and software version of a result; equal fingerprints mean equal results.

    >>> Provenance("by hand", inputs={}, settings={}).recording
    'by hand'
    """

    recording: str  # name
    inputs: Mapping[str, str]  # what -> SHA-256 (hex) of its content
    settings: Mapping[str, Any]  # all of the run, in JSON types
    version: str = field(default_factory=software_version)

    @property
    def declared(self) -> dict[str, object]:
        """Content of recording.toml; empty if it is not in the settings."""
        kept = self.settings.get("recording")
        return dict(kept) if isinstance(kept, dict) else {}

    @property
    def fingerprint(self) -> str:
        """SHA-256 (hex) of inputs, settings and version."""
        return json_sha256({"inputs": dict(self.inputs), "settings": dict(self.settings), "version": self.version})

    def as_attributes(self) -> dict[str, str]:
        """Attributes of a file with such a result, for `read_provenance`; and the fingerprint."""
        return {
            "software_version": self.version,
            "recording": self.recording,
            "inputs_sha256": json.dumps(dict(self.inputs), sort_keys=True),
            "settings": json.dumps(dict(self.settings), sort_keys=True),
            "fingerprint": self.fingerprint,
        }


@checked
def write_trajectory(
    path: str | Path,
    trajectory: Trajectory,
    provenance: Provenance,
    overwrite: bool = False,
    details: Details | None = None,
) -> None:
    """Write the whole file, or nothing. Raises OutputError if it exists without `overwrite`, or cannot be written.

    details : numbers of the run (blur, noise, ...), in JSON types; see `read_details`

        >>> trajectory = read_trajectory("clip")
        >>> write_trajectory("copy.h5", trajectory, Provenance("copy", inputs={}, settings={}))
        >>> np.array_equal(read_trajectory("copy.h5").q, trajectory.q)
        True
    """
    path = Path(path)
    refuse_existing(path, overwrite)
    buffer = io.BytesIO()  # so that a full disk raises an error in one plain write, not inside the HDF5 library
    with h5py.File(buffer, "w", track_order=True) as file:
        write_variables(file, _root_variables(trajectory), _axes(trajectory))
        write_variables(file.create_group("markers", track_order=True), _variables(trajectory, "markers"))
        dots = Variable(trajectory.disc.marker_centres_body, ("marker", "space_axis"), "m", "dots, body frame, as used")
        write_variables(file.create_group("disc", track_order=True), {"marker_centres_body": dots})
        file["disc"].attrs.update(disc_sizes(trajectory.disc))
        _write_rig(file.create_group("calibration", track_order=True), trajectory)
        file.attrs.update(_root_attributes(trajectory, provenance))
        file.attrs["findings"] = json_text([finding.as_json() for finding in trajectory.findings])
        file.attrs["details"] = json_text(dict(details or {}))
        made_from = {"inputs_sha256": provenance.inputs, "settings": provenance.settings, "dependencies": _versions()}
        words = [f"{finding.grave}: {finding.sentence}" for finding in trajectory.findings]
        write_attributes(file, {"findings": {"told": words, **(details or {})}, "made_from": made_from})
        file.attrs["complete"] = 1
    write_whole(path, sealed(buffer))


@checked
def read_trajectory(path: str | Path) -> Trajectory:
    """Read a trajectory. Raises TrajectoryFileError if the file is missing, damaged or of another kind.

    path : file, or folder that contains trajectory.h5 or results/trajectory.h5

        >>> len(read_trajectory("clip/results/trajectory.h5"))
        300
    """
    with _reading(trajectory_in(Path(path))) as file:
        trajectory = _trajectory(file)
    warn_of_doubts(trajectory.findings)
    return trajectory


def trajectory_in(path: Path) -> Path:
    """Path of the trajectory file, for a folder as for a file. Raises TrajectoryFileError if a folder has none."""
    if not path.is_dir():
        return path
    for file in (path / "trajectory.h5", path / "results" / "trajectory.h5"):
        if file.is_file():
            return file
    raise TrajectoryFileError(f"{path}: no results/trajectory.h5 in this folder; 'disctrack run {path}' makes it")


def kept_or_made(
    path: Path,
    provenance: Provenance,
    make: Callable[[], tuple[Trajectory, Details]],
    overwrite: bool = False,
    other: Callable[[Provenance], str] | None = None,
) -> tuple[Trajectory, Details, bool]:
    """Trajectory and details from the file if its provenance is equal; otherwise make and write them.

    overwrite : make it in any case
    other : describes a result of another provenance for the error message; without it, such a result is replaced
    returns : also True if it was made now. Raises OutputError if an existing file may not be replaced
    """
    if path.exists() and not overwrite:
        try:
            there = read_provenance(path)
        except TrajectoryFileError as error:
            raise OutputError(f"{error} It is kept: move it away, or replace it with --overwrite.") from error
        if there.fingerprint == provenance.fingerprint:
            return read_trajectory(path), read_details(path), False
        if other is not None:
            made = other(there) or f"made by {there.version}"
            said = f"exists, and is not the complete result of these images, settings and version ({made})"
            raise OutputError(f"{path}: {said}. Choose another place with -o, or replace it with --overwrite.")
    trajectory, details = make()
    write_trajectory(path, trajectory, provenance, overwrite=True, details=details)
    return trajectory, details, True


def read_provenance(path: Path) -> Provenance:
    """Provenance of the file's trajectory. Raises TrajectoryFileError."""
    with _reading(path) as file:
        return Provenance(
            recording=str(file.attrs["recording"]),
            inputs=json.loads(file.attrs["inputs_sha256"]),
            settings=json.loads(file.attrs["settings"]),
            version=str(file.attrs["software_version"]),
        )


def read_details(path: Path) -> Details:
    """Numbers of the run that wrote the file. Raises TrajectoryFileError."""
    with _reading(path) as file:
        return dict(json.loads(file.attrs["details"]))


def read_findings(path: Path) -> tuple[Finding, ...]:
    """Findings of the measurement. Raises TrajectoryFileError."""
    with _reading(path) as file:
        return _findings(file)


def _findings(file: h5py.File) -> tuple[Finding, ...]:
    return tuple(finding_from_json(document) for document in json.loads(file.attrs["findings"]))


# A stage adds to a trajectory file: variables, and attributes for `write_attributes`
Group = tuple[Mapping[str, Variable], Mapping[str, Any]]


@checked
def write_group(
    path: str | Path,
    group: str,
    variables: Mapping[str, Variable],
    axes: Mapping[str, Variable] | None = None,
    attributes: Mapping[str, Any] | None = None,
) -> None:
    """Add a stage's group to a trajectory file, or replace it, as `write_groups` does.

    >>> own = {"own": Variable(np.zeros(300), ("time",), "m/s", "a speed of my own")}
    >>> write_group("clip/results/trajectory.h5", "mine", own)
    """
    write_groups(Path(path), {group: (variables, attributes or {})}, axes)


def write_groups(path: Path, groups: Mapping[str, Group], axes: Mapping[str, Variable] | None = None) -> None:
    """Add groups of a stage to a trajectory file, all or none; they replace groups of the same names.

    The file is rewritten without the replaced groups, so it does not grow, and is complete at every instant.
    axes : used by these groups only
    Raises TrajectoryFileError, OutputError.
    """
    buffer = io.BytesIO()
    with h5py.File(buffer, "w", track_order=True) as file:
        with _reading(path) as old:
            copy_without(old, file, groups, axes or {})
        for name, (variables, attributes) in groups.items():
            created = file.create_group(name, track_order=True)
            write_variables(created, variables, axes)
            write_attributes(created, attributes)
    write_whole(path, sealed(buffer), adds_to_input=True)


@checked
def read_group(
    path: str | Path, group: str, names: Collection[str] | None = None
) -> tuple[dict[str, AnyArray], dict[str, Any]]:
    """Arrays and attributes of one group. Raises TrajectoryFileError that lists the groups of the file.

    names : of the arrays to read; by default all

        >>> variables, attributes = read_group("clip/results/trajectory.h5", "markers")
        >>> variables["centre_px"].shape
        (300, 2, 6, 2)
    """
    with _reading(Path(path)) as file:
        if group not in file or not isinstance(file[group], h5py.Group):
            groups = ", ".join(name for name, item in file.items() if isinstance(item, h5py.Group))
            raise TrajectoryFileError(f"no group '{group}'; it holds {groups}. Run the stage that writes it.")
        there = {name: item for name, item in file[group].items() if names is None or name in names}
        arrays = {name: read_array(item) for name, item in there.items() if isinstance(item, h5py.Dataset)}
        return arrays, dict(file[group].attrs)


def labelled(trajectory: Trajectory) -> dict[str, Variable]:
    """Variables of the file's root and of its dots (`marker_...`)."""
    dots = {f"marker_{name}": item for name, item in _variables(trajectory, "markers").items()}
    return _root_variables(trajectory) | dots


def to_xarray(trajectory: Trajectory) -> "xarray.Dataset":
    """`xarray.Dataset` of the variables of the file's root and of its dots (`marker_...`).

    Raises OutputError if xarray is not installed.
    """
    with told_as(OutputError, "to_xarray needs xarray", ImportError, then="Install it: pip install xarray"):
        import xarray

    def described(item: Variable) -> tuple:
        return item.dims, np.asarray(item.data), {"units": item.units, "long_name": item.long_name, **item.attributes}

    variables = labelled(trajectory)
    used = {axis for item in variables.values() for axis in item.dims}
    coordinates = {name: described(axis) for name, axis in _axes(trajectory).items() if name in used}
    numbers = recording_numbers(trajectory)
    numbers |= {f"disc_{name}": value for name, value in disc_sizes(trajectory.disc).items()}
    return xarray.Dataset({name: described(item) for name, item in variables.items()}, coordinates, numbers)


# Numbers of the whole recording: attribute of Trajectory -> attribute of the file's root
_NUMBERS = {"frame_rate": "frame_rate_hz", "gravity": "gravity_m_s2", "air_density": "air_density_kg_m3"}


def recording_numbers(trajectory: Trajectory) -> dict[str, float]:
    """Numbers of the whole recording, as the file's root has them."""
    return {key: getattr(trajectory, name) for name, key in _NUMBERS.items()}


def _root_attributes(trajectory: Trajectory, provenance: Provenance) -> dict[str, Any]:
    return {
        "schema": SCHEMA,
        "schema_version": SCHEMA_VERSION,
        "software": "disctrack",
        "dependencies": json.dumps(_versions()),
        **provenance.as_attributes(),
        **recording_numbers(trajectory),
        "table_moved_m_rad": trajectory.table_moved,
        **_CONVENTIONS,
    }


def _versions() -> dict[str, str]:
    return {"python": platform.python_version(), **versions(_DEPENDENCIES)}


# The file's layout: place, axes, unit and meaning of every array of a Trajectory
_POSE2 = ("time", "pose_component", "pose_component_2")
_DOTS = ("time", "camera", "marker", "axis")
_MIXED = "m and rad: m2, m rad, rad2"
_LAYOUT: dict[str, tuple[str, tuple[str, ...], str, str]] = {
    "frame": ("frame", ("time",), "1", "number of the frame in its sequence"),
    "quaternion": ("quaternion", ("time", "quaternion_component"), "1", "orientation, body to world, continuous"),
    "pose_covariance": ("pose_covariance", _POSE2, _MIXED,
                        "covariance of the pose, noise of this frame; calibration not included"),
    "systematic_covariance": (
        "systematic_covariance", _POSE2, _MIXED,
        "covariance of the pose from what repeats or varies slowly beside the rig's own: dots' misfit beyond noise"),
    "reprojection_rms_px": ("reprojection_rms_px", ("time", "camera"), "px",
                            "root mean square of observed - projected dots"),
    "reduced_chi_square": ("reduced_chi_square", ("time",), "1", "squared residuals over their predicted variance"),
    "frame_status": ("status", ("time",), "1", "why there is a pose, or none"),
    "markers_px": ("markers/centre_px", _DOTS, "px", "image of the dot's centre (not the ellipse's), corrected by the "
                   "lens field of the rig if it has one"),
    "markers_covariance_px2": ("markers/centre_covariance_px2", (*_DOTS, "axis_2"), "px2", "covariance of centre_px"),
    "markers_residual_px": ("markers/residual_px", _DOTS, "px", "observed - projected"),
    "marker_status": ("markers/status", ("time", "camera", "marker"), "1", "why a dot has a centre, or none"),
    "calibration_sensitivity": ("calibration/sensitivity", ("time", "pose_component", "rig_parameter"),
                                "m or rad per unit of the parameter", "d pose / d rig parameter at fixed pixels"),
}  # fmt: skip
_FLAGS = {"frame_status": flags(FrameStatus), "marker_status": flags(MarkerStatus)}
# Of the rig: variables with one row per camera
_OF_CAMERAS = {
    "camera_matrix": (("camera", "space_axis", "space_axis_2"), "px", "pinhole matrix K"),
    "distortion": (("camera", "distortion_coefficient"), "1", "Brown distortion on normalised coordinates"),
    "image_size_px": (("camera", "axis"), "px", "width, height"),
}
_COORDINATES = {
    "x": ("m", "position of the disc's centre along i"),
    "y": ("m", "position of the disc's centre along j"),
    "z": ("m", "height of the disc's centre above the table"),
    "psi": ("rad", "precession angle, unwrapped"),
    "theta": ("rad", "nutation angle"),
    "phi": ("rad", "spin angle, unwrapped"),
}
_NAMED_AXES = {
    "camera": (CAMERAS, "camera"),
    "axis": (("x", "y"), "pixel axis: x right, y down"),
    "space_axis": (("x", "y", "z"), "axis of space"),
    "quaternion_component": (("w", "x", "y", "z"), "quaternion component"),
    "pose_component": (POSE_COMPONENTS, "position, and rotation vector in world axes"),
    "rig_parameter": (RIG_PARAMETERS, "parameter of the stereo rig"),
    "distortion_coefficient": (("k1", "k2", "p1", "p2", "k3"), "Brown's coefficients as OpenCV's"),
}
_NAMED_AXES |= {f"{name}_2": _NAMED_AXES[name] for name in ("axis", "space_axis", "pose_component", "rig_parameter")}


def _axes(trajectory: Trajectory) -> dict[str, Variable]:
    markers = np.arange(trajectory.disc.n_markers)
    return {
        "time": Variable(trajectory.time, ("time",), "s", "mid exposure, from the recording's first frame"),
        "marker": Variable(markers, ("marker",), "1", "dot on the upper face, in the order of recording.toml"),
        **{name: Variable(np.array(values), (name,), "1", what) for name, (values, what) in _NAMED_AXES.items()},
    }


def _variables(trajectory: Trajectory, group: str = "") -> dict[str, Variable]:
    """Variables of one group, or of the root, according to the layout."""
    found = {}
    for attribute, (place, dims, unit, meaning) in _LAYOUT.items():
        home, _, name = place.rpartition("/")
        if home == group:
            found[name] = Variable(getattr(trajectory, attribute), dims, unit, meaning, _FLAGS.get(attribute, {}))
    return found


def _root_variables(trajectory: Trajectory) -> dict[str, Variable]:
    kinds = {
        "": ("", trajectory.q),
        "_sigma": ("standard deviation, noise of this frame: ", trajectory.coordinate_sigma),
        "_sigma_calibration": ("standard deviation that frames share: ", trajectory.calibration_sigma),
    }
    coordinates = {
        name + ending: Variable(values[:, i], ("time",), unit, what + meaning)
        for ending, (what, values) in kinds.items()
        for i, (name, (unit, meaning)) in enumerate(_COORDINATES.items())
    }
    found = _variables(trajectory)
    return {"frame": found.pop("frame"), **coordinates, **found}


# Attributes of the group `disc`: a field of Disc and its unit; tolerances only if declared
_DISC_SIZES = (
    "radius_m", "half_thickness_m", "mass_kg", "marker_diameter_m", "radius_tolerance_m", "thickness_tolerance_m"
)  # fmt: skip


def disc_sizes(disc: Disc) -> dict[str, float]:
    """Sizes of the disc in SI units, as the group `disc` has them."""
    sizes = {name: getattr(disc, name.rpartition("_")[0]) for name in _DISC_SIZES}
    return {name: value for name, value in sizes.items() if value is not None}


def _write_rig(group: h5py.Group, trajectory: Trajectory) -> None:
    rig = trajectory.rig
    variables = {
        name: Variable([getattr(camera, name.removesuffix("_px")) for camera in rig.cameras], *described)
        for name, described in _OF_CAMERAS.items()
    }
    write_variables(group, variables | _variables(trajectory, "calibration"))
    for name, (data, row, attributes) in beside_cameras(rig).items():
        scales = {d: Variable(np.arange(n), (d,), "1", "index") for d, n in zip(row.axes, np.shape(data), strict=True)}
        write_variables(group, {name: Variable(data, row.axes, row.units, row.description, attributes)}, scales)
    group.attrs["world_is_table"] = np.uint8(rig.world_is_table)
    group.attrs["baseline_m"] = rig.baseline


def _reading(path: Path) -> contextlib.AbstractContextManager[h5py.File]:
    return complete_file(path, "trajectory", SCHEMA, SCHEMA_VERSION, "track", TrajectoryFileError)


def _trajectory(file: h5py.File) -> Trajectory:
    stored = file["disc"].attrs
    sizes = {name.rpartition("_")[0]: float(stored[name]) for name in _DISC_SIZES if name in stored}
    disc = Disc(marker_centres_body=_array(file, "disc/marker_centres_body", "m"), **sizes)
    time = _array(file, "time", "s")
    lengths = {name: len(values) for name, (values, _) in _NAMED_AXES.items()}
    lengths |= {"time": len(time), "marker": disc.n_markers}
    found: dict[str, Any] = {}
    for attribute, (place, dims, unit, _) in _LAYOUT.items():
        found[attribute] = _array(file, place, unit)
        expected = tuple(lengths[axis] for axis in dims)
        if found[attribute].shape != expected:
            raise TrajectoryFileError(f"{attribute} has shape {found[attribute].shape}; expected {expected}")
    found |= {name: float(file.attrs[key]) for name, key in _NUMBERS.items()}
    trajectory = Trajectory(
        time=time,
        q=np.column_stack([_array(file, name, unit) for name, (unit, _) in _COORDINATES.items()]),
        disc=disc,
        rig=_rig(file["calibration"]),
        table_moved=tuple(file.attrs["table_moved_m_rad"].tolist()),
        findings=_findings(file),
        **found,
    )
    _check_values(trajectory)
    return trajectory


def _array(file: h5py.File, place: str, unit: str) -> AnyArray:
    """Values of a dataset. Raises ValueError if their unit is not the one that this program writes."""
    found = str(file[place].attrs.get("units", unit))
    if found != unit:
        raise ValueError(f"{place} is in {found!r}; expected {unit!r}")
    return read_array(file[place])


def _rig(group: h5py.Group) -> StereoRig:
    matrices, *others = (read_array(group[name]) for name in _OF_CAMERAS)
    focal_and_centre = matrices[:, [0, 1, 0, 1], [0, 1, 2, 2]]
    return read_beside_cameras(
        group, [(np.append(*pinhole), size) for *pinhole, size in zip(focal_and_centre, *others, strict=True)]
    )


def _check_values(trajectory: Trajectory) -> None:
    """Raise ValueError with the first frame whose values are impossible."""
    q, C, posed = trajectory.q, trajectory.pose_covariance, trajectory.measured
    sound: Mask = np.asarray(np.isfinite(C).all(axis=(1, 2)))
    sound[sound] = np.linalg.eigvalsh(C[sound])[:, 0] > 0
    wrong = {
        "time does not increase": ~(np.diff(trajectory.time, prepend=-np.inf) > 0) | ~np.isfinite(trajectory.time),
        # tolerance for files of other programs that write few digits
        "quaternion is no rotation": posed & ~(np.abs(np.linalg.norm(trajectory.quaternion, axis=1) - 1) < 1e-3),
        "pose_covariance is not positive definite": posed & ~sound,
    }
    # larger values in metres and radians are no pose of a filmed disc, and their squares lose all digits
    wrong |= {f"{name} is of no pose": np.abs(q[:, i]) > (1e3 if i < 3 else 1e6) for i, name in enumerate(COORDINATES)}
    for known, status in ((FrameStatus, trajectory.frame_status), (MarkerStatus, trajectory.marker_status)):
        for strange in np.setdiff1d(status, [*known]):
            wrong[f"unknown status {strange}"] = (status == strange).reshape(len(q), -1).any(axis=1)
    for said, frames in wrong.items():
        if frames.any():
            raise ValueError(f"{said} at frame {trajectory.frame[np.argmax(frames)]}")
    sizes = (trajectory.disc.radius, trajectory.disc.half_thickness, trajectory.disc.mass, trajectory.frame_rate)
    if not (np.isfinite(sizes).all() and min(sizes) > 0):
        raise ValueError("radius, thickness, mass and frame rate must be above 0")
