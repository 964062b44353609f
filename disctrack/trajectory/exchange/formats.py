"""The table of formats, and conversion between them."""

import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from functools import partial
from inspect import signature
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np

from calibration.cameras.camera import StereoRig
from calibration.kit.types import checked
from calibration.rig_file import SCHEMA as RIG
from calibration.rig_file import check_seal, read_rig, write_rig
from disctrack.errors import OutputError, TrajectoryFileError, told_as
from disctrack.files.whole import keep, refuse_existing, write_whole
from disctrack.trajectory import Trajectory
from disctrack.trajectory.exchange import motion, rigs
from disctrack.trajectory.exchange.rigs import BROWN, content_of, the_one, within_brown
from disctrack.trajectory.file import read_trajectory, trajectory_in

OWN = (".h5", ".nc")  # netCDF-4 is HDF5: other programs recognise it by .nc
FOUR = BROWN[:4]


@dataclass(frozen=True)
class Format:
    """One format of another program."""

    name: str
    endings: tuple[str, ...]  # of file names; the longest match counts
    holds: str  # "trajectory", "rig" or "points"
    write: Callable[[Path, Any], object]  # path, Trajectory or StereoRig
    # path (or `paths`, if a rig may be in several files) -> StereoRig, or points (n, 2, m, 2); its other arguments may
    # be given by the user: world_is_table, cameras, image_size, unit
    read: Callable[..., Any] | None
    lost: str  # data of ours that it cannot store
    # Distortion coefficients that it stores, fitted in place of the others; None: points are without distortion
    terms: tuple[str, ...] | None = BROWN
    mark: str = ""  # text that distinguishes a file from others with the same ending


SIGMAS = "sigmas but one of the place, the rig, the dots in the images"
ROWS = (
    Format("table", (".csv",), "trajectory", partial(motion.write_csv, overwrite=True), None,
           "covariances, the rig, the dots"),
    Format("MATLAB", (".mat",), "trajectory", motion.write_mat, None, "the rig"),
    Format("C3D", (".c3d",), "trajectory", motion.write_c3d, None, SIGMAS),
    Format("TRC", (".trc",), "trajectory", motion.write_trc, None, "sigmas, the rig, the dots in the images"),
    Format("QTM", (".tsv",), "trajectory", motion.write_qtm, None, SIGMAS),
    Format("XMALab transformations", ("transformation.csv", "transformations.csv"), "trajectory",
           motion.write_transformations, None, "sigmas, times, the rig, the dots"),
    Format("XMALab points", ("points.csv",), "points", motion.write_points, motion.read_points, "sigmas",
           mark="_cam1_X"),
    Format("DLTdv8 points", ("xypts.csv",), "points", motion.write_xypts, motion.read_xypts, "sigmas, the lenses: the "
           "points are without their distortion, as dltcoefs.csv needs them", mark="pt1_cam1_X"),
    Format("OpenCV", (".yml", ".yaml", ".xml"), "rig", rigs.write_opencv, rigs.read_opencv, "covariances"),
    Format("Kalibr", ("camchain.yaml", "kalibr.yaml"), "rig", rigs.write_kalibr, rigs.read_kalibr,
           "covariances, the world frame", FOUR, mark="cam0:"),
    Format("Caliscope", (".toml",), "rig", rigs.write_caliscope, rigs.read_caliscope, "covariances"),
    Format("Pose2Sim", ("pose2sim.toml", "calib.toml"), "rig", rigs.write_pose2sim, rigs.read_caliscope, "covariances",
           FOUR),
    Format("mrcal", (".cameramodel",), "rig", rigs.write_mrcal, rigs.read_mrcal, "covariances"),
    Format("DLT", ("dltcoefs.csv",), "rig", rigs.write_dlt, rigs.read_dlt, "covariances, the lenses: they belong to "
           "points without distortion, those of xypts.csv", None),
    Format("MATLAB stereoParameters", (".mat",), "rig", rigs.write_stereo_parameters, rigs.read_stereo_parameters,
           "covariances"),
)  # fmt: skip


class Converted(NamedTuple):
    """Written files, and notes on data that the format cannot store."""

    paths: tuple[Path, ...]
    notes: tuple[str, ...]


@checked
def convert(
    source: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    target: str | os.PathLike[str],
    *,
    form: str | None = None,
    overwrite: bool = False,
    **stated: Any,
) -> Converted:
    """Convert a trajectory, its points or a rig from or to another program's format, by the ending of the target.

    source : our trajectory or rig file, a recording's folder, or a foreign rig (two files if it has one per camera)
    form : name of the target's format in `ROWS`, if the ending is ambiguous
    stated : properties missing in a foreign rig file: world_is_table, cameras (two names), image_size (width, height)
        [px], unit [m]
    Raises DiscTrackError that lists the known formats.

        >>> convert("clip/results/rig.h5", "rig.yml").paths
        (PosixPath('rig.yml'),)
    """
    paths = [trajectory_in(Path(p)) for p in ([source] if isinstance(source, (str, os.PathLike)) else source)]
    path = Path(target)
    for one in paths:
        keep(one)
    refuse_existing(path, overwrite)
    stated = {name: value for name, value in stated.items() if value}
    if not (paths[0].suffix in OWN or h5py.is_hdf5(paths[0])):
        value = read_foreign(paths, **stated)
    elif stated:
        raise OutputError(f"{_options(stated)}: says nothing about {paths[0]}, a file of ours; leave it out")
    else:
        value = _own(paths)
    if path.suffix in OWN and form is None:
        _write_own(path, value, paths[0])
        return Converted((path,), ())
    row = _row_for(path, form, value)
    written = rigs.sides_of(path) if row.name == "mrcal" else (path,)
    for one in written:
        refuse_existing(one, overwrite)
    notes = [f"{row.name} has no place for {row.lost}"]
    if row.holds == "rig":
        value = value.rig if isinstance(value, Trajectory) else value
        if row.terms is not None:
            value, words = within_brown(value, row.terms)
            notes += [words] if words else []
    row.write(path, value)
    return Converted(written, tuple(notes))


def read_foreign(paths: Sequence[Path], **stated: Any) -> Any:
    """A StereoRig, or points (n, 2, m, 2) [px], of another program; stated: as in `convert`. Raises DiscTrackError."""
    first = paths[0]
    head = content_of(first)[:4096] if first.suffix in (".csv", ".yaml", ".yml") else ""
    readable = [row for row in ROWS if row.read]
    row = _fitting(readable, first, head)
    if row is None or row.read is None:
        raise OutputError(f"{first}: no file of ours, and no format of this name is read; known are {_known(readable)}")
    accepted = signature(row.read).parameters
    if idle := [word for word in stated if word not in accepted]:
        raise OutputError(f"{_options(idle)}: says nothing about {first} as {row.name}; leave it out")
    return row.read(paths if "paths" in accepted else the_one(paths), **stated)


def _fitting(rows: Sequence[Format], path: Path, head: str = "") -> Format | None:
    """The format that matches a file best, by its content, then by its name; None if there is no match."""
    ends = [max((len(e) for e in row.endings if path.name.lower().endswith(e)), default=0) for row in rows]
    ranks = [(len(row.mark) * (row.mark in head), end) for row, end in zip(rows, ends, strict=True)]
    return rows[ranks.index(max(ranks))] if any(max(ranks)) else None


def _row_for(path: Path, form: str | None, value: Any) -> Format:
    """The format to write. Raises OutputError that lists the known ones."""
    if isinstance(value, np.ndarray):
        raise OutputError(f"{path}: points are read in Python, with `read_foreign`, and written of a trajectory")
    kinds = ("trajectory", "points", "rig") if isinstance(value, Trajectory) else ("rig",)
    rows = [row for row in ROWS if row.holds in kinds]
    if form is None:
        if (row := _fitting(rows, path)) is None:
            raise OutputError(f"{path}: no format of this name for a {kinds[0]}; known are {_known(rows)}, and .h5")
        return row
    named = {row.name.lower(): row for row in rows}
    if form.lower() not in named:
        near = get_close_matches(form.lower(), named, 1, 0.5)
        hint = f" Did you mean '{named[near[0]].name}'?" if near else ""
        known = ", ".join(row.name for row in rows)
        raise OutputError(f"{form}: no format for a {kinds[0]}.{hint} Known are {known}")
    return named[form.lower()]


def _known(rows: Iterable[Format]) -> str:
    return ", ".join(f"{row.endings[0]} ({row.name})" for row in rows)


def _options(stated: Iterable[str]) -> str:
    names = {"world_is_table": "table", "unit": "unit-mm"}
    return ", ".join(f"--{names.get(word, word).replace('_', '-')}" for word in stated)


def _own(paths: Sequence[Path]) -> Trajectory | StereoRig:
    path, schema = the_one(paths), None
    if path.is_file() and h5py.is_hdf5(path):
        with told_as(TrajectoryFileError, f"{path}: damaged", ValueError, then="Take the original."):
            check_seal(path)
        with h5py.File(path, "r") as file:
            schema = file.attrs.get("schema")
    return read_rig(path) if schema == RIG else read_trajectory(path)


def _write_own(path: Path, value: Any, source: Path) -> None:
    if h5py.is_hdf5(source):
        write_whole(path, source.read_bytes())
    elif isinstance(value, StereoRig):
        write_rig(path, value)
    else:
        raise OutputError(f"{source}: only a rig of another program becomes a file of ours")
