"""`disctrack init`: a recording.toml for a folder of frames."""

import argparse

from disctrack.commands.options import UNKNOWN_TO_FILES
from disctrack.files.toml_tree import toml_value
from disctrack.first_look.declare import run_init


def run(arguments: argparse.Namespace) -> None:
    """Write the file, and print the values from the files and the keys to fill in."""
    known = {key: getattr(arguments, key) for key in UNKNOWN_TO_FILES if getattr(arguments, key) is not None}
    file, found, notes, missing = run_init(arguments.folder, known, arguments.like)
    rows = [(s, f"{key} = {toml_value(value)}  {remark}".rstrip()) for (s, key), (value, remark) in found.items()]
    rows += [*(("note", note) for note in notes), ("written", str(file))]
    rows += [("fill in", ", ".join(missing))] if missing else []
    for heading, text in (*rows, ("then", f"disctrack check {arguments.folder}")):
        print(f"{heading:<13} {text}")
