"""Which files a pattern means, and in which order."""

import glob
import os
import re
from pathlib import Path

from disctrack.errors import RecordingError
from disctrack.files.inputs import MOST_IMAGE, keep, read_regular, why_not_regular

# Suffixes of each format, by the module that reads it with `open_MODULE`: (files, camera) -> FrameReader
FORMATS = {
    "images": frozenset({".png", ".tif", ".tiff", ".bmp", ".jpg", ".jpeg"}),
    "video": frozenset({".avi", ".mp4", ".mkv", ".mov"}),
    "mraw": frozenset({".cih", ".cihx", ".mraw"}),  # Photron
    "cine": frozenset({".cine", ".cin", ".cci"}),  # Phantom
    "hdf5": frozenset({".h5", ".hdf5", ".hdf", ".he5"}),
}
SUFFIXES = frozenset().union(*FORMATS.values())
IMAGES = FORMATS["images"]
NUMBER = "{number}"  # in a pattern: these digits count the frames


def split_member(pattern: str) -> tuple[str, str]:
    """Pattern of the files and what else a pattern says, "" for most.

    "frames.h5:/left" is ("frames.h5", "/left"), "a/{number}.png" is ("a/*.png", "a/{number}.png").
    """
    if NUMBER in pattern:
        return pattern.replace(NUMBER, "*"), pattern
    file, colon, member = pattern.rpartition(":")
    if colon and Path(file).suffix.lower() in FORMATS["hdf5"]:
        return file, member
    return pattern, ""


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
    for file in files:
        if fault := why_not_regular(file):
            raise RecordingError(f"{file} ({camera} camera): cannot be read: {fault}. Move it away.")
        keep(file)
    return sorted(files, key=lambda file: natural_key(str(file)))


def _what_is_there(pattern: str, folder: Path) -> str:
    place = (folder / pattern).parent
    if not place.is_dir():
        return f"There is no folder {place}."
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


def content_of(file: Path, where: str, most: int = MOST_IMAGE) -> bytes:
    """Of a file of at most so many bytes. Raises RecordingError that begins with `where`."""
    try:
        return read_regular(file, most)
    except OSError as error:
        raise RecordingError(f"{where}: cannot be read: {error.strerror}. Copy it again.") from error
