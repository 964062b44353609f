"""Frames of one camera from files of any format: one small module per format, one interface."""

from importlib import import_module
from pathlib import Path

from calibration.kit.types import checked
from disctrack.errors import RecordingError, told_as
from disctrack.recording.readers.base import FrameReader
from disctrack.recording.readers.files import FORMATS, IMAGES, NUMBER, match_files, split_member


@checked
def open_frames(pattern: str, folder: str | Path, camera: str) -> FrameReader:
    """Reader of one camera's frames.

    pattern : of files, relative to `folder`: `left/*.png`, `left.mkv`, `stack.tif`, or `frames.h5:/left` for a data
        set in an HDF5 file; `left/*_{number}_a.png` if it is ambiguous which digits count the frames
    camera  : "left" or "right", for messages
    Raises RecordingError if nothing matches, or if no frame can be read.

        >>> len(open_frames("left/*.png", "clip", "left"))
        300
    """
    pattern, member = split_member(pattern)
    files = match_files(pattern, Path(folder), camera)
    suffix = files[0].suffix.lower()
    module = next(module for module, suffixes in FORMATS.items() if suffix in suffixes)
    if NUMBER in member and suffix not in IMAGES:
        raise RecordingError(f"{files[0]}: {NUMBER} in a pattern numbers images of a file each; leave it out here.")
    remedy = "Install it: pip install disctrack[video]"  # the only format of an optional package
    with told_as(RecordingError, f"{files[0]}: videos need PyAV", ImportError, then=remedy):
        opener = getattr(import_module(f"disctrack.recording.readers.{module}"), f"open_{module}")
    reader: FrameReader = opener(files, camera, member) if member else opener(files, camera)
    reader.camera = camera
    reader.notes = tuple(f"{camera} camera: {note}" for note in reader.notes)
    reader.doubts = tuple(f"{camera} camera: {doubt}" for doubt in reader.doubts)
    return reader
