"""`disctrack init`: a recording.toml for a folder of frames."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `disctrack init`."""
    parser.add_argument("folder", type=Path, help="folder with the frames of two cameras and views of a chessboard")
    parser.add_argument(
        "--like",
        type=Path,
        metavar="RECORDING",
        help="take disc, dots, board and table from this recording.toml where the files do not tell",
    )
    group = parser.add_argument_group("what no file tells", "left to fill in where it is not given")
    for option, what in _WHAT.items():
        group.add_argument(
            f"--{option.replace('_', '-')}", type=float, metavar=option.rsplit("_", 1)[-1].upper(), help=what
        )


_WHAT = {
    "frame_rate_hz": "frames per second",
    "radius_mm": "radius of the disc",
    "thickness_mm": "its thickness",
    "mass_g": "its mass",
    "diameter_mm": "diameter of a dot",
    "square_mm": "side of a square of the board",
    "board_thickness_mm": "height of the board's printed face above the table",
}


def run(arguments: argparse.Namespace) -> int:
    """Look, write, and tell what is left to fill in; returns the exit code."""
    from disctrack.commands import DONE
    from disctrack.first_look.declare import run_init

    known = {key: getattr(arguments, key) for key in _WHAT if getattr(arguments, key) is not None}
    done = run_init(arguments.folder, known, arguments.like)
    found = done.found
    print(f"{'cameras':<13} {found.frames.left.pattern} and {found.frames.right.pattern}: {found.described}")
    if found.frame_rate is not None:
        print(f"{'':<13} {found.frame_rate:g} Hz, {found.rate_source}")
    if found.views is not None:
        corners = (
            "" if found.inner_corners is None else f", {found.inner_corners[0]} x {found.inner_corners[1]} corners"
        )
        print(f"{'chessboard':<13} {found.views.left.pattern}: {found.views_count} views{corners} ({found.board_seen})")
    elif found.rig_file is not None:
        print(f"{'rig':<13} {found.rig_file}")
    for note in found.notes:
        print(f"{'note':<13} {note}")
    print(f"{'written':<13} {done.file}")
    if done.missing:
        print(f"{'fill in':<13} {', '.join(done.missing)}")
    print(f"{'then':<13} disctrack check {arguments.folder}")
    return DONE
