"""Which files a pattern means, in which order, and which numbers are missing among them."""

from __future__ import annotations

import glob
import itertools
import os
import re
from collections.abc import Sequence
from pathlib import Path

from disctrack.errors import RecordingError
from disctrack.readers import SUFFIXES


def match_files(pattern: str, folder: Path, camera: str) -> list[Path]:
    """Image or video files that the pattern matches, in natural order (2 before 10).

    Raises RecordingError if there is none, naming what lies there instead.
    """
    found = glob.glob(os.path.join(glob.escape(str(folder)), pattern), recursive=True)
    files = [Path(name) for name in found if Path(name).suffix.lower() in SUFFIXES]
    if not files:
        raise RecordingError(
            f"{folder / pattern}: no image matched for the {camera} camera. {_what_is_there(pattern, folder)}"
        )
    return sorted(files, key=lambda file: natural_key(str(file)))


def _what_is_there(pattern: str, folder: Path) -> str:
    place = (folder / pattern).parent
    if glob.has_magic(str(place)) or not place.is_dir():
        return f"There is no folder {place}." if not place.is_dir() else "Correct the pattern."
    names = sorted(os.listdir(place), key=natural_key)
    if not names:
        return f"The folder {place} is empty."
    shown = ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")
    return f"The folder holds {shown}; frames are {', '.join(sorted(SUFFIXES))}. Correct the pattern."


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Sort key in which runs of digits count as numbers: frame_2 before frame_10."""
    parts = re.split(r"([0-9]+)", name)
    return [(1, int(part), part) if part.isdigit() else (0, 0, part) for part in parts]


def file_number(file: Path) -> int | None:
    """The last run of digits in a file's name, which is the frame's number as the camera counted; None without one."""
    runs = re.findall(r"[0-9]+", file.stem)
    return int(runs[-1]) if runs else None


# A camera drops or a disk loses a few files; where more are missing, the numbers are no frame count (time stamps, say).
MOST_MISSING = 0.1


def with_gaps(files: Sequence[Path]) -> tuple[list[Path | None], str | None]:
    """Files with None in place of each missing number, and a note for the user where numbers are not consecutive.

    Time is the frame's place in the sequence: closing a gap would shift all that follows.
    """
    numbers = [file_number(file) for file in files]
    counted = [number for number in numbers if number is not None]
    if len(counted) < len(files) or len(files) < 2:
        return list(files), None
    steps = {b - a for a, b in itertools.pairwise(counted)}
    if steps == {1}:
        return list(files), None
    if len(steps) == 1 and min(steps) > 1:
        return list(files), (
            f"the file numbers go in steps of {min(steps)}; frames are taken as consecutive at the given frame rate"
        )
    missing = counted[-1] - counted[0] + 1 - len(counted)
    if min(steps) < 1 or missing > MOST_MISSING * len(counted):
        return list(files), "the file numbers are not consecutive; frames are taken as consecutive"
    slots: list[Path | None] = [None] * (counted[-1] - counted[0] + 1)
    for number, file in zip(counted, files, strict=True):
        slots[number - counted[0]] = file
    return slots, f"{missing} file(s) missing in the sequence; these frames are left without an answer"
