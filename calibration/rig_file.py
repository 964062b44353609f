"""Rig files: self-describing HDF5 with the corners used, so that a calibration can be checked and repeated later.

A checksum at the end is checked before reading, as the HDF5 library may hang or crash on damaged files. HDF5 stores its
own length and ignores what follows; if it writes to a file, it cuts that off.
"""

import contextlib
import io
import json
import os
import secrets
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np

from calibration.board.target import described, target_of
from calibration.cameras.camera import CAMERA_NAMES, INTRINSIC_PARAMETERS, RIG_PARAMETERS, Allowance, Camera, StereoRig
from calibration.cameras.splines import LensField
from calibration.kit.errors import RigFileError
from calibration.kit.types import AnyArray, checked
from calibration.stereo import StereoCalibration

SCHEMA = "disctrack stereo rig"
SCHEMA_VERSION = 1
_MARK = b"\ncrc32 "
MAX_VALUES = 50_000_000  # of one dataset: with more, the file is no rig


class Dataset(NamedTuple):
    """Description of a dataset of a rig file."""

    axes: tuple[str, ...]
    units: str = ""
    description: str = ""
    kind: str = "f"  # of its values, as NumPy abbreviates it


# Lengths of axes; those of others are free, or follow from the record
_SIZES = {"camera": 2, "axis": 2, "space_axis": 3, "intrinsic_parameter": len(INTRINSIC_PARAMETERS)}
_SIZES |= {"space_axis_2": 3, "rig_parameter": len(RIG_PARAMETERS), "rig_parameter_2": len(RIG_PARAMETERS)}
_TURN = ("space_axis", "space_axis_2")
_OF_CAMERA = {
    "intrinsics": Dataset(("intrinsic_parameter",), "px (first four), 1", ", ".join(INTRINSIC_PARAMETERS)),
    "image_size": Dataset(("axis",), "px", "width, height", "iu"),
}
_BESIDE_CAMERAS = {
    "R_right_left": Dataset(_TURN, "1", "rotation from left to right camera axes"),
    "t_right_left": Dataset(("space_axis",), "m", "origin of the left camera in right camera axes"),
    "R_left_world": Dataset(_TURN, "1", "rotation from world to left camera axes"),
    "t_left_world": Dataset(("space_axis",), "m", "origin of the world in left camera axes"),
    "covariance": Dataset(
        ("rig_parameter", "rig_parameter_2"),
        "products of the units of the parameters (px, 1, rad, m)",
        "of the parameters named in `parameters`; rotation vectors multiply from the left; common to all frames",
    ),
    "allowances": Dataset(
        ("allowance", "rig_parameter"),
        "px, 1, rad, m",
        "parts of the covariance that no image tells, one row for one standard deviation of each cause",
    ),
    "lens_field": Dataset(
        ("camera", "axis", "spline_y", "spline_x"),
        "px",
        "coefficients of cubic B-splines (camera, axis, y, x): displacement of image points beyond the polynomial",
    ),
    "lens_field_spacing": Dataset((), "px", "of the splines' grid"),
}
_SELDOM = ("allowances", "lens_field", "lens_field_spacing")  # those that are optional
_OF_RECORD = {
    "board_points": Dataset(("points", "space_axis"), "m", "target points in board axes as refined"),
    "board_thickness": Dataset((), "m", "from the table to the printed face"),
    "unexplained_sigma": Dataset((), "px", "per axis, added to each corner's own noise"),
    "R_left_board": Dataset(
        ("places", *_TURN), "1", "rotation from board to left camera axes, per place: views, then right images apart"
    ),
    "t_left_board": Dataset(("places", "space_axis"), "m", "corner 0 in left camera axes, per place"),
    "kept": Dataset(("seen",), "1", "1 where the corner was used", "u"),
    "residuals": Dataset(("seen", "axis"), "px", "located minus predicted corner"),
    "view": Dataset(("seen",), "1", "index of the place", "iu"),
    "camera": Dataset(("seen",), "1", "0 left, 1 right", "iu"),
    "point": Dataset(("seen",), "1", "board point", "iu"),
    "pixels": Dataset(("seen", "axis"), "px", "located corner"),
    "pixels_covariance": Dataset(("seen", "axis", "axis"), "px^2", "of the located corner, from the image's own noise"),
}
_TOLD = ("settings", "figures", "versions", "doubts", "warnings", "rejected_views", "rejected_corners")
_IN_JSON = (*_TOLD, "board", "view_names", "apart")
_LONG = {  # of these, what is a dataset, as an attribute has 64 kB at most
    "rejected_corners": "JSON list of view, camera, corner, reason",
    "board": "JSON object: kind of target and its fields, lengths in m",
}
# The origin of a rig, by its names in a rig file: the arrays of `_OF_RECORD`, entries in JSON, and `table_view`, None
# without one. Observations are all located corners, including the rejected ones; those of the right images of views
# `apart` refer to board poses n_views + 0, 1, ...
Record = dict[str, Any]


def record_of(calibration: StereoCalibration) -> Record:
    """The record of a calibration, without the images."""
    r = calibration.refinement
    model, seen = r.model, r.observations
    apart = np.flatnonzero(model.apart)  # poses of the right images follow those of the views
    place = np.arange(len(model.apart))
    place[apart] = len(place) + np.arange(len(apart))
    R, t = (np.concatenate([of[:, 0], of[apart, 1]]) for of in (model.R_left_board, model.t_left_board))
    document = {
        "settings": {"tolerances": asdict(calibration.tolerances)},
        "figures": {
            "rms_px": calibration.rms_px,
            "rms_per_camera_px": list(calibration.rms_per_camera_px),
            "iterations": r.iterations,
            "converged": r.converged,
            "assessment": asdict(calibration.assessment),
        },
        "versions": versions(("disctrack", "numpy", "scipy", "opencv-contrib-python-headless", "numba", "h5py")),
        **{name: getattr(calibration, name) for name in ("doubts", "warnings", "rejected_views", "view_names")},
        "rejected_corners": calibration.rejected_corners(),
        "board": described(calibration.board),
        "apart": apart.tolist(),
    }
    return {
        **json.loads(json.dumps(document, default=lambda o: o.item() if hasattr(o, "item") else str(o))),
        **vars(seen),
        **{name: getattr(calibration, name) for name in ("board_points", "table_view", "board_thickness")},
        "pixels_covariance": seen.covariance,
        "view": np.where(seen.camera == 1, place[seen.view], seen.view),
        "kept": r.kept.astype(np.uint8),
        "residuals": r.residuals,
        "unexplained_sigma": r.unexplained_sigma,
        "R_left_board": R,
        "t_left_board": t,
    }


def versions(packages: Sequence[str]) -> dict[str, str]:
    """Versions of those packages that are installed."""
    found = {}
    for name in packages:
        with contextlib.suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(name)
    return found


# --- writing ---------------------------------------------------------------------------------------------------------


@checked
def write_rig(path: str | os.PathLike[str], content: StereoRig | StereoCalibration) -> None:
    """Write a rig file, completely or not at all (by a temporary file in its folder, fsync, rename).

    Raises RigFileError if it cannot be written.

        >>> write_rig("rig.h5", read_rig("clip/results/rig.h5"))
        >>> read_rig("rig.h5").baseline == read_rig("clip/results/rig.h5").baseline
        True
    """
    path = Path(path)
    part = path.with_name(f"{path.name}.{secrets.token_hex(4)}.part")
    try:
        with open(part, "wb") as handle:
            handle.write(rig_bytes(content))
            handle.flush()
            os.fsync(handle.fileno())
        os.replace(part, path)
    except OSError as error:
        with contextlib.suppress(OSError):
            part.unlink()
        raise RigFileError(f"{path}: the rig cannot be written ({error}): no such folder, or no room in it") from error


def rig_bytes(content: StereoRig | StereoCalibration, attributes: Mapping[str, Any] = {}) -> memoryview:
    """A rig file in memory, as the HDF5 library crashes if a disk is full.

    attributes : of the root, in addition to its own
    """
    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        file.attrs.update(schema=SCHEMA, schema_version=SCHEMA_VERSION)
        file.attrs["description"] = (
            "Two calibrated cameras. points_left = R_left_world @ points_world + t_left_world; "
            "points_right = R_right_left @ points_left + t_right_left; Brown distortion, OpenCV's coefficients; "
            "pixel (0, 0) is the centre of the top-left pixel; camera axes: x right, y down, z along the view."
        )
        write_rig_group(file.create_group("rig"), content if isinstance(content, StereoRig) else content.rig)
        if isinstance(content, StereoCalibration):
            _write_record(file.create_group("calibration"), record_of(content))
        file.attrs.update(attributes, complete=1)
    return sealed(buffer)


def _seal(content: bytes | memoryview) -> bytes:
    return _MARK + f"{zlib.crc32(content):08x}".encode()


def sealed(buffer: io.BytesIO) -> memoryview:
    """A file in memory, with the checksum of all its bytes appended."""
    buffer.seek(0, os.SEEK_END)
    buffer.write(_seal(buffer.getbuffer()))
    return buffer.getbuffer()


def put_array(group: h5py.Group, name: str, value: Any, row: Dataset, attributes: Mapping[str, str] = {}) -> None:
    """A dataset with its unit and description, and further attributes."""
    data = np.asarray(value)
    options = {"compression": "gzip", "shuffle": True, "fletcher32": True} if data.size > 1000 else {}
    dataset = group.create_dataset(name, data=data, **options)
    dataset.attrs.update(units=row.units, description=row.description, **attributes)


def write_rig_group(group: h5py.Group, rig: StereoRig) -> None:
    """Write a rig as datasets of an HDF5 group. (A trajectory file has the same numbers with labelled axes.)"""
    group.attrs["world"] = "table, k up" if rig.world_is_table else "axes of the left camera"
    group.attrs["world_is_table"] = int(rig.world_is_table)
    for name, camera in zip(CAMERA_NAMES, rig.cameras, strict=True):
        for (what, row), value in zip(_OF_CAMERA.items(), (camera.parameters, camera.image_size), strict=True):
            put_array(group, f"{name}_{what}", value, row._replace(description=f"{name} camera: {row.description}"))
    for name, (value, row, attributes) in beside_cameras(rig).items():
        put_array(group, name, value, row, attributes)


def beside_cameras(rig: StereoRig) -> dict[str, tuple[Any, Dataset, dict[str, str]]]:
    """Everything in a rig except its cameras: name of the dataset -> values, description, attributes.

    `read_beside_cameras` reads it from any group.
    """
    values: dict[str, Any] = {name: getattr(rig, name) for name in _BESIDE_CAMERAS if name not in _SELDOM}
    marks = {"covariance": {"parameters": ", ".join(RIG_PARAMETERS)}}
    if rig.allowances:
        values["allowances"] = np.stack([a.shift for a in rig.allowances])
        causes, assumed = [a.cause for a in rig.allowances], [a.assumed for a in rig.allowances]
        marks["allowances"] = {"causes": json.dumps(causes), "assumed": json.dumps(assumed)}
    if rig.lens_field is not None:
        values |= {"lens_field": rig.lens_field.coefficients, "lens_field_spacing": rig.lens_field.spacing}
    return {name: (value, _BESIDE_CAMERAS[name], marks.get(name, {})) for name, value in values.items()}


def write_attributes(group: h5py.Group, document: Mapping[str, Any]) -> None:
    """A document in HDF5: numbers, texts and lists of them (texts one per line) as attributes, objects as groups.

    Lists of objects and None, which are not possible as attributes, are left out.
    """
    for key, value in document.items():
        name = str(key).replace("/", "|")
        if isinstance(value, Mapping):
            write_attributes(group.create_group(name, track_order=True), value)
        elif isinstance(value, str):
            group.attrs[name] = value
        elif isinstance(value, list | tuple) and all(isinstance(item, str) for item in value):
            group.attrs[name] = "\n".join(value)
        else:
            with contextlib.suppress(ValueError, TypeError):  # rows of unequal length; nothing, or objects
                array = np.asarray(value)
                group.attrs[name] = array.astype(np.uint8 if array.dtype == bool else array.dtype)


def _write_record(group: h5py.Group, record: Record) -> None:
    write_attributes(group, {name: record[name] for name in ("settings", "figures", "versions")})
    group.attrs["table_view"] = -1 if record["table_view"] is None else record["table_view"]
    for name in _IN_JSON:
        if name in _LONG:
            group.create_dataset(name, data=json.dumps(record[name]), dtype=h5py.string_dtype())
            group[name].attrs["description"] = _LONG[name]
        else:
            group.attrs[name] = json.dumps(record[name])
    for name, row in _OF_RECORD.items():
        put_array(group, name, record[name], row)


# --- reading ---------------------------------------------------------------------------------------------------------


@checked
def read_rig(path: str | os.PathLike[str]) -> StereoRig:
    """The rig of a rig file. Raises RigFileError.

    >>> read_rig("clip/results/rig.h5").left.image_size
    (272, 272)
    """
    return read_rig_file(path)[0]


def read_rig_file(path: str | os.PathLike[str]) -> tuple[StereoRig, Record | None]:
    """The rig and its record, which is None if the rig was imported without corners.

    Raises RigFileError if the file is missing, damaged or something else.
    """
    with complete_rig(Path(path)) as file:
        record = _read_record(file["calibration"]) if "calibration" in file else None
        return read_rig_group(file["rig"]), record


def check_seal(path: Path) -> None:
    """Raises ValueError if a sealed file has changed; OSError if it cannot be read."""
    content, n = np.memmap(path, np.uint8, "r"), len(_seal(b""))
    end = content[-n:].tobytes()
    if end.startswith(_MARK) and end != _seal(content[:-n].data):
        raise ValueError("its bytes are not those that were written: damaged on the disk or by a copy")


def complete_rig(path: Path, command: str = "calibrate") -> contextlib.AbstractContextManager[h5py.File]:
    """A complete rig file, open for reading. Raises RigFileError, which advises the command."""
    return complete_file(path, "rig", SCHEMA, SCHEMA_VERSION, command, RigFileError)


@contextlib.contextmanager
def complete_file(
    path: Path, kind: str, schema: str, version: int, command: str, raised: type[Exception]
) -> Iterator[h5py.File]:
    """A sealed HDF5 file of the packages, open for reading; all problems are `raised` with its name.

    kind, schema, version : required values;  command : of disctrack, which writes such files
    """
    if not path.is_file():
        raise raised(f"{path}: no such {kind} file; `disctrack {command}` makes one")
    try:
        check_seal(path)
        with h5py.File(path, "r") as file, np.errstate(all="ignore"):
            if (found := file.attrs.get("schema")) != schema:
                raise raised(f"an HDF5 file, but not a {kind} (its schema is {found!r}, expected {schema!r})")
            if int(file.attrs.get("schema_version", -1)) > version:
                raise raised("written by a newer version of disctrack; update to read it")
            if int(file.attrs.get("complete", 0)) != 1:
                raise raised(f"is not complete: it was not written to its end; {command} again")
            yield file
    except raised as error:
        raise raised(f"{path}: {error}") from error
    except Exception as error:  # the HDF5 library raises many kinds of errors for damaged files
        reason = " ".join(str(error).split())[:200]
        raise raised(
            f"{path}: cannot be read as a {kind} file ({type(error).__name__}: {reason}): damaged, cut short or "
            f"another format; {command} again or take the original"
        ) from error


def _get(group: h5py.Group, name: str, row: Dataset, sizes: Mapping[str, int] = {}) -> AnyArray:
    """A dataset, read after a check of its shape and kind against excessive sizes; unknown sizes are free."""
    if name not in group:
        raise RigFileError(f"{group.name}/{name} is missing; present: {', '.join(group)}")
    dataset = group[name]
    if not isinstance(dataset, h5py.Dataset) or dataset.dtype.kind not in row.kind:
        raise RigFileError(f"{group.name}/{name} does not hold numbers of the right kind")
    shape = tuple(map({**_SIZES, **sizes}.get, row.axes))
    same = len(dataset.shape) == len(shape) and all(w in (n, None) for n, w in zip(dataset.shape, shape, strict=True))
    if not same or dataset.size > MAX_VALUES:
        raise RigFileError(f"{group.name}/{name} has shape {dataset.shape}, expected {shape}")
    values = np.asarray(dataset[()])
    if values.dtype.kind == "f" and not np.isfinite(values).all():
        raise RigFileError(f"{group.name}/{name} holds values that are not finite")
    return values[()]


def read_rig_group(group: h5py.Group) -> StereoRig:
    """Inverse of `write_rig_group`. Raises RigFileError if the content is not a rig."""
    cameras = [[_get(group, f"{name}_{what}", row) for what, row in _OF_CAMERA.items()] for name in CAMERA_NAMES]
    return read_beside_cameras(group, cameras)


def read_beside_cameras(group: h5py.Group, of_cameras: Iterable[Sequence[AnyArray]]) -> StereoRig:
    """A rig from a group with the datasets of `beside_cameras`; of_cameras : parameters and image size of each.

    Raises RigFileError if the content is not a rig.
    """
    cameras = []
    for name, (parameters, (width, height)) in zip(CAMERA_NAMES, of_cameras, strict=True):
        if not (0 < width < 10**6 and 0 < height < 10**6 and parameters[0] > 0 and parameters[1] > 0):
            raise RigFileError(f"{group.name}: {name} camera of {width} x {height} px, focal lengths {parameters[:2]}")
        cameras.append(Camera.from_parameters(parameters, (int(width), int(height))))
    there = {name: row for name, row in _BESIDE_CAMERAS.items() if name in group or name not in _SELDOM}
    values: dict[str, Any] = {name: _get(group, name, row) for name, row in there.items()}
    for name in ("R_right_left", "R_left_world"):
        if not (np.abs(values[name] @ values[name].T - np.eye(3)).max() < 1e-6 and np.linalg.det(values[name]) > 0):
            raise RigFileError(f"{group.name}/{name} is not a rotation")
    variance = np.diag(values["covariance"])
    scale = np.sqrt(np.maximum(variance, 1e-300))
    correlation = values["covariance"] / scale / scale[:, None]
    if variance.min() < 0 or np.abs(correlation).max() > 1 + 1e-6 or not np.allclose(correlation, correlation.T):
        raise RigFileError(f"{group.name}/covariance is not a covariance")
    if "lens_field" in values:
        values["lens_field"] = LensField(values["lens_field"], float(values.pop("lens_field_spacing")))
        if min(values["lens_field"].coefficients.shape[2:]) < 4 or not values["lens_field"].spacing > 0:
            raise RigFileError(f"{group.name}/lens_field is not a field of splines")
    if "allowances" in values:
        shifts, marks = values["allowances"], group["allowances"].attrs
        causes, assumed = json.loads(marks["causes"]), json.loads(marks["assumed"])
        if not len(causes) == len(assumed) == len(shifts):
            raise RigFileError(f"{group.name}/allowances: rows and causes do not match")
        values["allowances"] = tuple(map(Allowance, causes, shifts, assumed))
    return StereoRig(cameras[0], cameras[1], world_is_table=bool(group.attrs.get("world_is_table", 0)), **values)


def _read_record(group: h5py.Group) -> Record:
    def text(name: str) -> Any:
        if name == "doubts" and name not in group.attrs:  # of an earlier file
            return []
        return json.loads(group[name].asstr()[()] if name in _LONG else group.attrs[name])

    record, table_view = {name: text(name) for name in _IN_JSON}, int(group.attrs["table_view"])
    points, places = len(target_of(record["board"]).points), len(record["view_names"]) + len(record["apart"])
    sizes = {"points": points, "places": places, "seen": len(group["pixels"])}
    record |= {name: _get(group, name, row, sizes) for name, row in _OF_RECORD.items()}
    for name, limit in (("view", places), ("camera", 2), ("point", points)):
        if len(record[name]) and not (record[name].min() >= 0 and record[name].max() < limit):
            raise RigFileError(f"{group.name}/{name} points beyond the {limit} there are")
    return record | {"table_view": None if table_view < 0 else table_view}
