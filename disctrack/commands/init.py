"""`disctrack init`: a recording.toml for a folder of frames."""

import argparse

from disctrack.commands import DONE
from disctrack.commands.options import UNKNOWN_TO_FILES
from disctrack.first_look.declare import run_init


def run(arguments: argparse.Namespace) -> int:
    """Look, write, and tell what is left to fill in; returns the exit code."""
    known = {key: getattr(arguments, key) for key in UNKNOWN_TO_FILES if getattr(arguments, key) is not None}
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
