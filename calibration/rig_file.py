"""Rig files: HDF5 that explains itself, with the corners it came from: it can be judged and redone years later."""

import contextlib
import json
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from importlib import metadata
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from calibration.board.target import Board, Target, target_of
from calibration.cameras.camera import INTRINSIC_PARAMETERS, N_RIG, RIG_PARAMETERS, Allowance, Camera, StereoRig
from calibration.cameras.splines import LensField
from calibration.fit.stereo_model import Observations
from calibration.kit.arrays import Array, Mask
from calibration.kit.errors import CalibrationError, RigFileError
from calibration.stereo import StereoCalibration

SCHEMA = "disctrack stereo rig"
SCHEMA_VERSION = 1
MAX_VALUES = 50_000_000  # of one dataset: beyond, the file is not a rig whatever it says
_READ_ERRORS = (OSError, KeyError, ValueError, TypeError, RuntimeError, AttributeError, OverflowError, IndexError)


@dataclass(frozen=True)
class CalibrationRecord:
    """What a rig file holds beside the rig: where it comes from."""

    board: Target
    board_points: Array  # (n, 3) [m] as refined
    table_view: int | None
    board_thickness: float  # [m]
    view_names: tuple[tuple[str, str], ...]
    observations: Observations  # all located corners that were offered to the refinement
    kept: Mask  # (m,)
    residuals: Array  # (m, 2) observed - predicted [px]
    unexplained_sigma: float  # [px]
    R_left_board: Array  # (n_views + those apart, 3, 3), to which the observations' `view` refers
    t_left_board: Array  # (n_views + those apart, 3) [m]
    settings: dict[str, Any]
    figures: dict[str, Any]  # rms, chosen terms, cross-validation table, assessment
    rejected_views: dict[int, str]
    rejected_corners: tuple[tuple[int, int, int, str], ...]  # view, camera, corner, reason
    warnings: tuple[str, ...]
    versions: dict[str, str] = field(default_factory=dict)
    apart: tuple[int, ...] = ()  # views whose right image has a place of the board of its own, n_views + 0, 1, ...


@dataclass(frozen=True)
class RigFile:
    """Content of a rig file."""

    rig: StereoRig
    record: CalibrationRecord | None  # None for a rig that was imported without its corners


def record_of(calibration: StereoCalibration) -> CalibrationRecord:
    """What is worth keeping of a calibration, without the images."""
    r = calibration.refinement
    figures = {
        "rms_px": calibration.rms_px,
        "rms_per_camera_px": list(calibration.rms_per_camera_px),
        "distortion_terms": r.terms.distortion,
        "board_model": r.terms.board,
        "iterations": r.iterations,
        "converged": r.converged,
        "cross_validation": [
            {
                "distortion": c.terms.distortion,
                "board": c.terms.board,
                "parameters": c.n_parameters,
                "rms_px": c.rms_px,
                "held_out_rms_px": c.held_out_rms_px,
                "held_out_chi_square": c.held_out_chi_square,
                "noise_px": c.noise_px,
            }
            for c in calibration.candidates
        ],
        "assessment": asdict(calibration.assessment),
    }
    model, observations, apart = r.model, r.observations, calibration.apart
    if model.boards_right is not None:  # every right image has a place of its own
        n = len(model.R_left_board)
        apart = (*apart, *range(n - len(apart)), *apart)
        observations = replace(observations, view=observations.view + n * observations.camera)
        R, t = (
            np.concatenate(both)
            for both in zip((model.R_left_board, model.t_left_board), model.boards_right, strict=True)
        )
        model = replace(model, R_left_board=R, t_left_board=t, boards_right=None)
    return CalibrationRecord(
        board=calibration.board,
        board_points=calibration.board_points,
        table_view=calibration.table_view,
        board_thickness=calibration.board_thickness,
        view_names=tuple((str(a), str(b)) for a, b in calibration.view_names),
        observations=observations,
        kept=r.kept,
        residuals=r.residuals,
        unexplained_sigma=r.unexplained_sigma,
        R_left_board=model.R_left_board,
        t_left_board=model.t_left_board,
        settings=_plain(asdict(calibration.settings)),
        figures=_plain(figures),
        rejected_views=dict(calibration.rejected_views),
        rejected_corners=tuple(calibration.rejected_corners()),
        warnings=tuple(calibration.warnings),
        versions=versions(),
        apart=apart,
    )


def versions() -> dict[str, str]:
    """Versions of this software and of what its numbers depend on."""
    found = {}
    for name in ("disctrack", "numpy", "scipy", "opencv-contrib-python-headless", "numba", "h5py"):
        with contextlib.suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(name)
    return found


def _plain(value: Any) -> Any:
    """The value as JSON gives it back."""
    return json.loads(json.dumps(value, default=lambda o: o.item() if hasattr(o, "item") else str(o)))


# --- writing ---------------------------------------------------------------------------------------------------------


def write_rig(path: str | os.PathLike[str], content: StereoRig | StereoCalibration | RigFile) -> None:
    """Write a rig file: whole or not at all (a temporary file beside it, fsync, rename).

    Raises RigFileError if it cannot be written.
    """
    if isinstance(content, StereoCalibration):
        content = RigFile(content.rig, record_of(content))
    elif isinstance(content, StereoRig):
        content = RigFile(content, None)
    path = Path(path)
    part = path.with_name(path.name + ".part")
    try:
        with h5py.File(part, "w") as file:
            file.attrs.update(schema=SCHEMA, schema_version=SCHEMA_VERSION)
            file.attrs["description"] = (
                "Two calibrated cameras. points_left = R_left_world @ points_world + t_left_world; "
                "points_right = R_right_left @ points_left + t_right_left; Brown distortion, OpenCV's coefficients; "
                "pixel (0, 0) is the centre of the top-left pixel; camera axes: x right, y down, z along the view."
            )
            write_rig_group(file.create_group("rig"), content.rig)
            if content.record is not None:
                _write_record(file.create_group("calibration"), content.record)
            file.attrs["complete"] = 1
        with open(part, "rb") as handle:
            os.fsync(handle.fileno())
        os.replace(part, path)
    except (OSError, RuntimeError) as error:
        with contextlib.suppress(OSError):
            part.unlink()
        raise RigFileError(f"{path}: the rig cannot be written ({error}): no such folder, or no room in it") from error


def _put(group: h5py.Group, name: str, value: Any, units: str, description: str) -> None:
    data = np.asarray(value)
    options = {"compression": "gzip", "shuffle": True, "fletcher32": True} if data.size > 1000 else {}
    dataset = group.create_dataset(name, data=data, **options)
    dataset.attrs.update(units=units, description=description)


def write_rig_group(group: h5py.Group, rig: StereoRig) -> None:
    """A rig as datasets of an HDF5 group. (A trajectory file holds the same numbers with labelled axes.)"""
    group.attrs["world"] = "table, k up" if rig.world_is_table else "axes of the left camera"
    group.attrs["world_is_table"] = int(rig.world_is_table)
    for name, camera in zip(("left", "right"), rig.cameras, strict=True):
        _put(
            group,
            f"{name}_intrinsics",
            camera.parameters,
            "px (first four), 1",
            f"{name} camera: {', '.join(INTRINSIC_PARAMETERS)}",
        )
        _put(group, f"{name}_image_size", camera.image_size, "px", f"{name} camera: width, height")
    _put(group, "R_right_left", rig.R_right_left, "1", "rotation from left to right camera axes")
    _put(group, "t_right_left", rig.t_right_left, "m", "origin of the left camera in right camera axes")
    _put(group, "R_left_world", rig.R_left_world, "1", "rotation from world to left camera axes")
    _put(group, "t_left_world", rig.t_left_world, "m", "origin of the world in left camera axes")
    _put(
        group,
        "covariance",
        rig.covariance,
        "products of the units of the parameters (px, 1, rad, m)",
        "of the parameters named in `parameters`; rotation vectors multiply from the left; common to all frames",
    )
    group["covariance"].attrs["parameters"] = ", ".join(RIG_PARAMETERS)
    for name, (values, units, told, attributes) in beyond_model(rig).items():
        _put(group, name, values, units, told)
        group[name].attrs.update(attributes)


def beyond_model(rig: StereoRig) -> dict[str, tuple[Any, str, str, dict[str, str]]]:
    """What a rig may have beside cameras and places: by name of the dataset its values, units, meaning, attributes.

    `read_beyond_model` reads it from any group.
    """
    found: dict[str, tuple[Any, str, str, dict[str, str]]] = {}
    if rig.allowances:
        told = "parts of the covariance that no image tells, one row for one standard deviation of each cause"
        marks = {"causes": [a.cause for a in rig.allowances], "assumed": [a.assumed for a in rig.allowances]}
        shifts = np.stack([a.shift for a in rig.allowances])
        found["allowances"] = shifts, "px, 1, rad, m", told, {name: json.dumps(mark) for name, mark in marks.items()}
    if rig.lens_field is not None:
        told = (
            "coefficients of cubic B-splines (camera, axis, y, x): displacement of image points beyond the polynomial"
        )
        found["lens_field"] = rig.lens_field.coefficients, "px", told, {}
        found["lens_field_spacing"] = rig.lens_field.spacing, "px", "of the splines' grid", {}
    return found


def write_attributes(group: h5py.Group, document: Mapping[str, Any]) -> None:
    """A document as HDF5 has it: numbers, texts and lists of them (texts a line each) as attributes, objects as groups.

    What HDF5 has no attribute for, a list of objects or nothing at all, is left out.
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


def _write_record(group: h5py.Group, record: CalibrationRecord) -> None:
    write_attributes(group, {"settings": record.settings, "figures": record.figures, "versions": record.versions})
    group.attrs["settings"] = json.dumps(record.settings)
    group.attrs["figures"] = json.dumps(record.figures)
    group.attrs["versions"] = json.dumps(record.versions)
    group.attrs["warnings"] = json.dumps(record.warnings)
    group.attrs["view_names"] = json.dumps(record.view_names)
    group.attrs["rejected_views"] = json.dumps(record.rejected_views)
    if record.apart:
        group.attrs["apart"] = json.dumps(record.apart)
    group.attrs["table_view"] = -1 if record.table_view is None else record.table_view
    text = h5py.string_dtype()
    group.create_dataset("rejected_corners", data=json.dumps(record.rejected_corners), dtype=text)
    group["rejected_corners"].attrs["description"] = "JSON list of view, camera, corner, reason"
    group.create_dataset("board", data=json.dumps(record.board.described()), dtype=text)
    group["board"].attrs["description"] = "JSON object: kind of target and its fields, lengths in m"
    _put(group, "board_points", record.board_points, "m", "target points in board axes as refined")
    _put(group, "board_thickness", record.board_thickness, "m", "from the table to the printed face")
    _put(group, "unexplained_sigma", record.unexplained_sigma, "px", "per axis, added to each corner's own noise")
    _put(
        group,
        "R_left_board",
        record.R_left_board,
        "1",
        "rotation from board to left camera axes, per place: views, then right images apart",
    )
    _put(group, "t_left_board", record.t_left_board, "m", "corner 0 in left camera axes, per place")
    o = record.observations
    for name, description in (("view", "index of the place"), ("camera", "0 left, 1 right"), ("point", "board point")):
        _put(group, name, getattr(o, name).astype(np.int64), "1", description)
    _put(group, "pixels", o.pixels, "px", "located corner")
    _put(group, "pixels_covariance", o.covariance, "px^2", "of the located corner, from the image's own noise")
    _put(group, "kept", record.kept.astype(np.uint8), "1", "1 where the corner was used")
    _put(group, "residuals", record.residuals, "px", "located minus predicted corner")


# --- reading ---------------------------------------------------------------------------------------------------------


def read_rig(path: str | os.PathLike[str]) -> StereoRig:
    """The rig of a rig file. Raises RigFileError."""
    return read_rig_file(path).rig


def read_rig_file(path: str | os.PathLike[str]) -> RigFile:
    """Everything in a rig file. Raises RigFileError if the file is missing, damaged or something else."""
    path = Path(path)
    if not path.is_file():
        raise RigFileError(f"{path}: no such rig file; `disctrack calibrate` makes one")
    try:
        with h5py.File(path, "r") as file, np.errstate(all="ignore"):
            if file.attrs.get("schema") != SCHEMA:
                raise RigFileError(
                    f"{path}: an HDF5 file, but not a rig (its schema is {file.attrs.get('schema')!r}, "
                    f"expected {SCHEMA!r})"
                )
            if int(file.attrs.get("schema_version", -1)) > SCHEMA_VERSION:
                raise RigFileError(f"{path}: written by a newer version of disctrack; update to read it")
            if int(file.attrs.get("complete", 0)) != 1:
                raise RigFileError(f"{path}: was not written to its end; calibrate again")
            rig = read_rig_group(file["rig"])
            record = _read_record(file["calibration"]) if "calibration" in file else None
        return RigFile(rig, record)
    except RigFileError as error:
        if str(error).startswith(str(path)):
            raise
        raise RigFileError(f"{path}: {error}") from error
    except _READ_ERRORS as error:
        raise RigFileError(
            f"{path}: cannot be read as a rig file ({type(error).__name__}: {error}): damaged, cut short or another "
            "format; calibrate again or take the original"
        ) from error


def _get(group: h5py.Group, name: str, shape: tuple[int | None, ...], kind: str = "f") -> NDArray:
    """A dataset after a look at its shape and kind, so that no hostile size is ever read."""
    if name not in group:
        raise RigFileError(f"{group.name}/{name} is missing; present: {', '.join(group)}")
    dataset = group[name]
    if not isinstance(dataset, h5py.Dataset) or dataset.dtype.kind not in kind:
        raise RigFileError(f"{group.name}/{name} does not hold numbers of the right kind")
    if len(dataset.shape) != len(shape) or any(
        w is not None and n != w for n, w in zip(dataset.shape, shape, strict=True)
    ):
        raise RigFileError(f"{group.name}/{name} has shape {dataset.shape}, expected {shape}")
    if dataset.size > MAX_VALUES:
        raise RigFileError(f"{group.name}/{name} has {dataset.size} values, more than any rig")
    values = np.asarray(dataset[()])
    if values.dtype.kind == "f" and not np.isfinite(values).all():
        raise RigFileError(f"{group.name}/{name} holds values that are not finite")
    return values


def read_rig_group(group: h5py.Group) -> StereoRig:
    """Inverse of `write_rig_group`. Raises RigFileError on content that is not a rig."""
    cameras = []
    for name in ("left", "right"):
        width, height = (int(n) for n in _get(group, f"{name}_image_size", (2,), "iu"))
        parameters = _get(group, f"{name}_intrinsics", (9,))
        if not (0 < width < 10**6 and 0 < height < 10**6 and parameters[0] > 0 and parameters[1] > 0):
            raise RigFileError(f"{group.name}: {name} camera of {width} x {height} px, focal lengths {parameters[:2]}")
        cameras.append(Camera.from_parameters(parameters, (width, height)))
    rotations = {name: _get(group, name, (3, 3)) for name in ("R_right_left", "R_left_world")}
    for name, R in rotations.items():
        if not (np.abs(R @ R.T - np.eye(3)).max() < 1e-6 and np.linalg.det(R) > 0):
            raise RigFileError(f"{group.name}/{name} is not a rotation")
    covariance = _get(group, "covariance", (N_RIG, N_RIG))
    scale = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    correlation = covariance / scale / scale[:, None]
    if (
        np.diag(covariance).min() < 0
        or np.abs(correlation).max() > 1 + 1e-6
        or not np.allclose(correlation, correlation.T)
    ):
        raise RigFileError(f"{group.name}/covariance is not a covariance")
    return StereoRig(
        left=cameras[0],
        right=cameras[1],
        R_right_left=rotations["R_right_left"],
        t_right_left=_get(group, "t_right_left", (3,)),
        R_left_world=rotations["R_left_world"],
        t_left_world=_get(group, "t_left_world", (3,)),
        covariance=covariance,
        world_is_table=bool(group.attrs.get("world_is_table", 0)),
        **read_beyond_model(group),
    )


def read_beyond_model(group: h5py.Group) -> dict[str, Any]:
    """`lens_field` and `allowances` of a rig, as `beyond_model` names them. Raises RigFileError."""
    return {
        "lens_field": _lens_field(group) if "lens_field" in group else None,
        "allowances": _allowances(group) if "allowances" in group else (),
    }


def _allowances(group: h5py.Group) -> tuple[Allowance, ...]:
    shifts = _get(group, "allowances", (None, N_RIG))
    causes, assumed = (json.loads(group["allowances"].attrs[name]) for name in ("causes", "assumed"))
    if not len(shifts) == len(causes) == len(assumed) <= N_RIG:
        raise RigFileError(f"{group.name}/allowances: {len(shifts)} rows, {len(causes)} causes, {len(assumed)} marks")
    return tuple(Allowance(str(c), s, bool(a)) for c, s, a in zip(causes, shifts, assumed, strict=True))


def _lens_field(group: h5py.Group) -> LensField:
    coefficients, spacing = _get(group, "lens_field", (2, 2, None, None)), float(_get(group, "lens_field_spacing", ()))
    if min(coefficients.shape[2:]) < 4 or not spacing > 0:
        raise RigFileError(f"{group.name}/lens_field of shape {coefficients.shape}, spacing {spacing} is not a field")
    return LensField(coefficients, spacing)


def _board(group: h5py.Group) -> Target:
    if "board" in group:
        try:
            return target_of(json.loads(group["board"].asstr()[()]))
        except CalibrationError as error:
            raise RigFileError(f"{group.name}: {error}") from error
    counts = _get(group, "inner_corners", (2,), "iu")  # files that knew chessboards only
    return Board((int(counts[0]), int(counts[1])), float(_get(group, "square", ())))


def _read_record(group: h5py.Group) -> CalibrationRecord:
    def attribute(name: str) -> Any:
        return json.loads(group.attrs[name])

    board = _board(group)
    n = len(board.points)
    pixels = _get(group, "pixels", (None, 2))
    apart = json.loads(group.attrs.get("apart", "[]"))
    m, n_views = len(pixels), len(attribute("view_names")) + len(apart)
    indices = [_get(group, name, (m,), "iu").astype(np.intp) for name in ("view", "camera", "point")]
    for name, index, limit in zip(("view", "camera", "point"), indices, (n_views, 2, n), strict=True):
        if m and not (index.min() >= 0 and index.max() < limit):
            raise RigFileError(f"{group.name}/{name} points beyond the {limit} there are")
    table_view = int(group.attrs["table_view"])
    rejected = json.loads(group["rejected_corners"].asstr()[()])
    return CalibrationRecord(
        board=board,
        board_points=_get(group, "board_points", (n, 3)),
        table_view=None if table_view < 0 else table_view,
        board_thickness=float(_get(group, "board_thickness", ())),
        view_names=tuple((str(a), str(b)) for a, b in attribute("view_names")),
        observations=Observations(
            indices[0], indices[1], indices[2], pixels, _get(group, "pixels_covariance", (m, 2, 2))
        ),
        kept=_get(group, "kept", (m,), "u").astype(bool),
        residuals=_get(group, "residuals", (m, 2)),
        unexplained_sigma=float(_get(group, "unexplained_sigma", ())),
        R_left_board=_get(group, "R_left_board", (n_views, 3, 3)),
        t_left_board=_get(group, "t_left_board", (n_views, 3)),
        settings=attribute("settings"),
        figures=attribute("figures"),
        rejected_views={int(v): str(reason) for v, reason in attribute("rejected_views").items()},
        rejected_corners=tuple((int(v), int(c), int(i), str(reason)) for v, c, i, reason in rejected),
        warnings=tuple(attribute("warnings")),
        versions=attribute("versions"),
        apart=tuple(int(v) for v in apart),
    )
