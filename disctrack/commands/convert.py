"""`disctrack convert`: trajectories and rigs from and to the formats of other programs."""

import argparse
from pathlib import Path

from calibration.cameras.foreign_rigs import export_caliscope, export_mrcal, import_caliscope, import_mrcal
from calibration.cameras.opencv_yaml import export_opencv, import_opencv
from calibration.rig_file import read_rig, write_rig
from disctrack.commands import DONE
from disctrack.errors import OutputError, RigFileError
from disctrack.files.inputs import keep, refuse_input
from disctrack.files.whole import refuse_existing
from disctrack.trajectory.exchange.c3d import write_c3d
from disctrack.trajectory.exchange.matlab import write_mat
from disctrack.trajectory.file import read_trajectory, write_csv

TRAJECTORY = (".csv", ".mat", ".c3d")
OPENCV = (".yml", ".yaml", ".xml")
WORDS = ("table", "cameras", "image_size", "unit_mm")  # options that say what a foreign rig does not
UNDERSTOOD = {".cameramodel": ("table",), ".toml": ("table", "cameras")} | dict.fromkeys(
    OPENCV, ("table", "image_size", "unit_mm")
)


def run(arguments: argparse.Namespace) -> int:
    """Convert; returns the exit code."""
    target: Path = arguments.target
    for source in arguments.source:
        keep(source)
    refuse_existing(target, arguments.overwrite)
    refuse_input(target)
    understood = UNDERSTOOD.get(arguments.source[0].suffix, ()) if target.suffix == ".h5" else ()
    idle = [word for word in WORDS if getattr(arguments, word) and word not in understood]
    if idle:
        options = ", ".join(f"--{word.replace('_', '-')}" for word in idle)
        raise OutputError(f"{options}: says nothing about {arguments.source[0]} as {target.suffix}; leave it out")
    if target.suffix in TRAJECTORY:
        written = [_trajectory(arguments)]
    elif target.suffix == ".h5":
        written = [_foreign_rig(arguments)]
    else:
        written = _own_rig(arguments)
    print(f"{'written':<13} {', '.join(str(path) for path in written)}")
    return DONE


def _trajectory(arguments: argparse.Namespace) -> Path:
    trajectory = read_trajectory(_single(arguments.source))
    target: Path = arguments.target
    if target.suffix == ".csv":
        write_csv(target, trajectory, overwrite=True)
        return target
    if target.suffix == ".mat":
        return write_mat(target, trajectory, overwrite=True)
    return write_c3d(target, trajectory, overwrite=True)


def _foreign_rig(arguments: argparse.Namespace) -> Path:
    source, first = arguments.source, arguments.source[0]
    if first.suffix == ".cameramodel":
        if len(source) != 2:
            raise RigFileError(f"{first}: mrcal keeps one camera per file; give two, left first")
        rig = import_mrcal(*source, world_is_table=arguments.table)
    elif first.suffix == ".toml":
        cameras = None if arguments.cameras is None else tuple(arguments.cameras)
        rig = import_caliscope(_single(source), cameras, world_is_table=arguments.table)
    elif first.suffix in OPENCV:
        size = None if arguments.image_size is None else tuple(arguments.image_size)
        unit = None if arguments.unit_mm is None else 1e-3 * arguments.unit_mm
        rig = import_opencv(*source, image_size=size, unit=unit, world_is_table=arguments.table)
    else:
        raise RigFileError(f"{first}: rigs are read from .yml (OpenCV), .toml (Caliscope) and .cameramodel (mrcal)")
    write_rig(arguments.target, rig)
    return arguments.target


def _own_rig(arguments: argparse.Namespace) -> list[Path]:
    target: Path = arguments.target
    if target.suffix not in (*OPENCV, ".toml", ".cameramodel"):
        known = ", ".join((*TRAJECTORY, *OPENCV, ".toml", ".cameramodel", ".h5"))
        raise OutputError(f"{target}: no format of this name; known are {known}")
    rig = read_rig(_single(arguments.source))
    if target.suffix == ".toml":
        export_caliscope(target, rig)
    elif target.suffix == ".cameramodel":
        sides = [target.with_name(f"{target.stem}-{side}.cameramodel") for side in ("left", "right")]
        for side in sides:
            refuse_existing(side, arguments.overwrite)
        export_mrcal((sides[0], sides[1]), rig)
        return sides
    else:
        export_opencv(target, rig)
    return [target]


def _single(source: list[Path]) -> Path:
    if len(source) != 1:
        raise OutputError(f"{len(source)} files given; one is converted at a time")
    return source[0]
