"""Files that match a pattern, their order, and their frame numbers: the digits in the names that count the frames.

The time of a frame follows from its position in the sequence: an unnoticed gap, or a file that is not a frame, would
shift all later frames. If the names are ambiguous, an error lists the files.
"""

import fnmatch
import glob
import math
import os
import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path

from disctrack.errors import RecordingError, told_as
from disctrack.files.whole import MOST_IMAGE, keep, read_regular, why_not_regular

# Suffixes of each format, by the module whose function `open_MODULE`, (files, camera) -> FrameReader, reads it
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
MOST_SLOTS_PER_FILE = 100  # frame numbers per file; if more are missing, the digits are time stamps or typing errors
_SHOWN = 3


def split_member(pattern: str) -> tuple[str, str]:
    """File pattern, and data set or numbering pattern, "" if there is none.

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

    Raises RecordingError if there is none, with the content of the folder.
    """
    found = glob.glob(os.path.join(glob.escape(str(folder)), pattern), recursive=True)
    files = [Path(name) for name in found if Path(name).suffix.lower() in SUFFIXES]
    if not files:
        there = _what_is_there((folder / pattern).parent)
        raise RecordingError(f"{folder / pattern}: no image matched for the {camera} camera. {there}")
    for file in files:
        if fault := why_not_regular(file):
            raise RecordingError(f"{file} ({camera} camera): cannot be read: {fault}. Move it away.")
        keep(file)
    return sorted(files, key=lambda file: natural_key(str(file)))


def folders_below(
    root: Path, seen: set[Path], failed: Callable[[OSError], object] | None = None
) -> Iterator[tuple[Path, list[str], list[str]]]:
    """The folder and all below it, each once, with the names of folders and files in it.

    Folders whose names the caller removes from the list are not visited, as with `os.walk`.
    seen : resolved paths of folders that are not visited again; grows
    failed : is called for folders that cannot be read
    """
    for place, inside, names in os.walk(root, onerror=failed, followlinks=True):
        real = Path(place).resolve()
        inside[:] = sorted(name for name in inside if not name.startswith(".") and real not in seen)
        if real not in seen:
            seen.add(real)
            yield Path(place), inside, [name for name in names if not name.startswith(".")]


def _what_is_there(place: Path) -> str:
    if not place.is_dir():
        return f"There is no folder {place}."
    names = sorted(os.listdir(place), key=natural_key)
    there = f"The folder holds {_listed(names)}" if names else f"The folder {place} is empty"
    return f"{there}; frames are {', '.join(sorted(SUFFIXES))}. Correct the pattern."


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Sort key that compares runs of digits as numbers: frame_2 before frame_10."""
    parts = re.split(r"([0-9]+)", name)
    return [(1, int(part), part) if part.isdigit() else (0, 0, part) for part in parts]


def file_number(file: Path) -> int | None:
    """The last run of digits in a file's name, the camera's number of the frame; None if there is none."""
    runs = re.findall(r"[0-9]+", file.stem)
    return int(runs[-1]) if runs else None


def content_of(file: Path, where: str, most: int = MOST_IMAGE) -> bytes:
    """Content of a file of at most `most` bytes. Raises RecordingError that begins with `where`."""
    with told_as(RecordingError, f"{where}: cannot be read", OSError, then="Copy it again."):
        return read_regular(file, most)


def number_files(
    files: Sequence[Path], camera: str, pattern: str = ""
) -> tuple[tuple[Path | None, ...], range | None, tuple[str, ...], tuple[str, ...]]:
    """Files in temporal order (None for missing numbers), their numbers, notes, and doubts.

    pattern : {number} in it marks the digits that count the frames; "" to find them from the names
    Raises RecordingError with the files if the names have different forms, no number, or the same number twice, or if
    the numbers have no common step.
    """
    if len(files) == 1:
        number = file_number(files[0])
        return tuple(files), None if number is None else range(number, number + 1), (), ()
    columns = [_numbers_by_pattern(files, pattern)] if pattern else _numbers_by_form(files, camera)
    found = [(step, column) for column in columns if (step := _common_step(column, given=bool(pattern)))]
    clocks = {tuple(n - min(column) for n in column): (step, column) for step, column in found}
    if len(clocks) > 1:
        clocks = {counts: clock for counts, clock in clocks.items() if not _missing(*clock)} or clocks
    if len(clocks) > 1:
        said = f"several numbers in the names of the {camera} frames could count them"
        raise RecordingError(f'{files[0]} ...: {said}. Say which, as in {camera} = "{camera}/*_{NUMBER}.png".')
    if not clocks:
        _refuse_clock(files, columns[-1], camera)
    ((step, column),) = clocks.values()
    numbers, by_number = range(min(column), max(column) + 1, step), dict(zip(column, files, strict=True))
    notes, doubts = [], []
    if missing := _missing(step, column):
        n, first = len(missing), missing[0]
        lost = f"{n} file{'s' * (n > 1)} missing in the sequence, the first is number {first}"
        notes.append(f"{lost}; this camera says nothing of these frames")
    if step > 1:
        said = f"the file numbers go in steps of {step}; they are taken as consecutive frames at frame_rate_hz"
        doubts.append(f"{said}. If that is the camera's own rate, declare {step} times less")
    return tuple(map(by_number.get, numbers)), numbers, tuple(notes), tuple(doubts)


def check_continuation(files: Sequence[Path], camera: str) -> None:
    """Raise RecordingError unless the files of a stack are numbered without a gap (the first may have no number)."""
    if len(files) < 2:
        return
    rest = files[1:] if files[1].stem.startswith(files[0].stem) else files
    _, _, notes, doubts = number_files(rest, camera)
    if notes or doubts:
        said = f"a {camera} stack that goes on in several files lacks one: {(*notes, *doubts)[0]}"
        remedy = "What follows would be shifted in time: copy it again, or measure the files before it"
        raise RecordingError(f"{files[0]} ...: {said}. {remedy}.")


def _numbers_by_pattern(files: Sequence[Path], pattern: str) -> list[int]:
    before, after = (
        fnmatch.translate(part)[len("(?s:") : -len(r")\Z")] for part in Path(pattern).name.split(NUMBER, 1)
    )
    form = re.compile(f"(?s:{before}(?<![0-9])([0-9]+)(?![0-9]){after})\\Z")
    matches = [form.match(file.name) for file in files]
    if odd := [file for file, match in zip(files, matches, strict=True) if match is None]:
        raise RecordingError(f"{_listed(odd)}: no number where {pattern} has {NUMBER}. Correct the pattern.")
    return [int(match[1]) for match in matches if match is not None]


def _numbers_by_form(files: Sequence[Path], camera: str) -> list[list[int]]:
    """Numbers of the files, for each run of digits that differs among names of one form. Raises RecordingError."""
    forms = [re.split(r"[0-9]+", file.stem) for file in files]
    if all(len(form) == 1 for form in forms):
        said = f"the names of the {camera} frames hold no number, so nothing tells whether one is missing"
        raise RecordingError(f"{_listed(files)}: {said}. Number them as the camera counted them.")
    usual = [*Counter(map(tuple, forms)).most_common(1)[0][0]]
    if odd := [file for file, form in zip(files, forms, strict=True) if form != usual]:
        others = [file for file, form in zip(files, forms, strict=True) if form == usual]
        said = f"{_listed(odd)}: not named like the other {len(others)} {camera} frames ({_listed(others)})"
        remedy = f"move it away, or write a pattern that leaves it out; {NUMBER} says which digits count"
        raise RecordingError(f"{said}. It would shift those after it: {remedy}.")
    runs = [re.findall(r"[0-9]+", file.stem) for file in files]
    columns = [[int(run) for run in column] for column in zip(*runs, strict=True)]
    return [column for column in columns if len(set(column)) > 1] or columns[-1:]


def _common_step(numbers: Sequence[int], given: bool) -> int | None:
    """Step of numbers that count frames, some of which may be missing; None for others, such as time stamps.

    If a camera counts in steps of d, d is the most frequent difference. The greatest common divisor of jittering time
    stamps is not. given : the user declares that these are the numbers.
    """
    ordered = sorted(numbers)
    steps = Counter(b - a for a, b in pairwise(ordered))
    if 0 in steps:
        return None
    step = math.gcd(*steps)
    if (ordered[-1] - ordered[0]) // step >= MOST_SLOTS_PER_FILE * len(ordered):
        return None
    return step if given or steps[step] == max(steps.values()) else None


def _missing(step: int, numbers: Sequence[int]) -> list[int]:
    return sorted(set(range(min(numbers), max(numbers) + 1, step)) - set(numbers))


def _refuse_clock(files: Sequence[Path], numbers: Sequence[int], camera: str) -> None:
    order = sorted(range(len(files)), key=lambda i: numbers[i])
    for a, b in pairwise(order):
        if numbers[a] == numbers[b]:
            said = f"{files[a]}, {files[b]}: two {camera} frames of number {numbers[a]}"
            raise RecordingError(f"{said}. Move one away, or say with {NUMBER} in the pattern which digits count.")
    steps = sorted(b - a for a, b in pairwise(sorted(numbers)))
    said = f"the numbers of the {camera} frames have no common step ({steps[0]} to {steps[-1]}), like time stamps"
    remedy = f"Number the frames as the camera counted them, or say with {NUMBER} in the pattern which digits count"
    raise RecordingError(f"{_listed([files[i] for i in order])}: {said}. {remedy}.")


def _listed(files: Sequence[Path | str]) -> str:
    shown = ", ".join([str(files[0]), *(os.path.basename(file) for file in files[1:_SHOWN])])
    return shown + (f", ... {len(files) - _SHOWN} more" if len(files) > _SHOWN else "")
