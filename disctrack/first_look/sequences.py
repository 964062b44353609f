"""Sequences of frames in a folder: which two are of the cameras, which two show the chessboard."""

import re
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import h5py
import numpy as np

from calibration.board.search import VIEWS_TRIED, board_size
from calibration.kit.arrays import AnyArray, evenly
from disctrack.calibrate.views import pixels_of, views_of
from disctrack.errors import RecordingError
from disctrack.recording.readers import open_frames
from disctrack.recording.readers.base import FrameReader
from disctrack.recording.readers.files import FORMATS, IMAGES, SUFFIXES, folders_below, natural_key
from disctrack.recording.readers.hdf5 import stacks_of

_OWN_FOLDERS = re.compile(r"(results|batch_results|.*_analysis|.*_diagnosis)$")
_CALIBRATION_WORDS = re.compile(r"cal|chess|checker|board|target|views", re.IGNORECASE)
# Words for the two cameras, left first; numbers and single letters are compared by their order.
_SIDES = (("left", "right"), ("l", "r"), ("links", "rechts"), ("gauche", "droite"), ("izquierda", "derecha"))
_TOKEN = re.compile(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|[0-9]+|[^A-Za-z0-9]+")


@dataclass(frozen=True)
class Sequence:
    """Frames of one camera, as `[cameras] left` would name them."""

    folder: Path  # of the recording
    pattern: str  # relative to it
    kind: str  # suffix of the files
    files: int

    def __len__(self) -> int:
        return self.files if self.files > 1 else len(self.open())

    def open(self, camera: str = "left") -> FrameReader:
        """Reader of its frames. Raises RecordingError."""
        return open_frames(self.pattern, self.folder, camera)

    def some_images(self) -> list[AnyArray]:
        """A few images, evenly distributed; views may be in colour. Raises RecordingError."""
        views = views_of(self.pattern, self.folder, "left", most=np.inf)
        return [pixels_of(views[i]) for i in evenly(len(views), VIEWS_TRIED)]


@dataclass(frozen=True)
class CameraPair:
    """Two sequences whose names differ only by the camera."""

    left: Sequence
    right: Sequence
    named: bool  # True if the names say which is left

    @property
    def looks_like_calibration(self) -> bool:
        """True if both names contain a word of calibration."""
        return bool(_CALIBRATION_WORDS.search(self.left.pattern) and _CALIBRATION_WORDS.search(self.right.pattern))

    @cached_property
    def shows_the_board_once(self) -> bool:
        """True if only one shows a chessboard: they are views and frames of one camera."""
        return (
            not self.named and len({board_size(side.some_images())[0] is None for side in (self.left, self.right)}) > 1
        )


def find_sequences(folder: Path) -> list[Sequence]:
    """Sequences of frames in the folder and below, without results of earlier runs."""
    if not folder.is_dir():
        raise RecordingError(f"{folder}: no such folder. Give the folder that holds the frames.")
    found: list[Sequence] = []
    for place, below, unsorted in folders_below(folder, set()):
        inside, names = place.relative_to(folder), sorted(unsorted, key=natural_key)
        below[:] = [name for name in below if not _OWN_FOLDERS.match(name)]
        images = [name for name in names if Path(name).suffix.lower() in IMAGES]
        found += _image_sequences(folder, inside, images)
        headers = {Path(name).stem for name in names if Path(name).suffix.lower() in FORMATS["mraw"] - {".mraw"}}
        for name in names:
            suffix, path = Path(name).suffix.lower(), (inside / name).as_posix()
            if suffix in FORMATS["hdf5"]:
                found += [Sequence(folder, f"{path}:{stack}", suffix, 1) for stack in _stacks(place / name)]
            elif suffix in SUFFIXES - IMAGES and not (suffix == ".mraw" and Path(name).stem in headers):
                found.append(Sequence(folder, path, suffix, 1))
    return found


def pair_cameras(sequences: Iterable[Sequence]) -> list[CameraPair]:
    """Pairs of sequences whose names differ in one word or number, each sequence in at most one pair."""
    waiting = sorted(sequences, key=lambda sequence: natural_key(sequence.pattern))
    pairs = []
    while waiting:
        first = waiting.pop(0)
        tokens = _TOKEN.findall(first.pattern)
        partners = [
            (other, difference)
            for other in waiting
            if (difference := _difference(tokens, other, first)) and (_is_side(*difference) or _as_many(other, first))
        ]
        if partners:
            # a known pair of words first, then numbers, then anything
            other, words = min(partners, key=lambda item: (not _is_side(*item[1]), not item[1][0].isdigit()))
            waiting.remove(other)
            both = (other, first) if _sides(*words)[::-1] in _SIDES else (first, other)
            pairs.append(CameraPair(*both, _is_side(*words)))
    return pairs


def _image_sequences(folder: Path, inside: Path, names: list[str]) -> Iterator[Sequence]:
    """Images of one folder, grouped by their names without the frame number."""
    by_words: dict[tuple[str, ...], list[list[str]]] = defaultdict(list)
    for name in names:
        parts = re.split(r"([0-9]+)", name)
        by_words[tuple(parts[::2])].append(parts)
    groups: dict[tuple[str, str], int] = defaultdict(int)
    for members in by_words.values():
        runs = list(zip(*(parts[1::2] for parts in members), strict=True))
        counter = max(range(len(runs)), key=lambda k: (len(set(runs[k])), len(runs[k][0]), k), default=None)
        for parts in members:
            shown, suffix = list(parts), Path("".join(parts)).suffix.lower()
            if counter is not None and (len(members) > 1 or suffix not in (".tif", ".tiff")):  # these may be stacks
                shown[2 * counter + 1] = "*"
            groups["".join(shown), suffix] += 1
    suffixes = [suffix for _, suffix in groups]
    for (pattern, suffix), count in groups.items():
        alone = suffixes.count(suffix) == 1 and "*" in pattern
        shown_pattern = f"*{Path(pattern).suffix}" if alone and inside != Path() else pattern
        yield Sequence(folder, (inside / shown_pattern).as_posix(), suffix, count)


def _stacks(file: Path) -> list[str]:
    """Paths of data sets of an HDF5 file that may be frames: (n, height, width) of 8 or 16 bit."""
    try:
        with h5py.File(file, "r") as opened:
            return sorted((stack.name for stack in stacks_of(opened)), key=natural_key)
    except OSError:  # not HDF5, or damaged
        return []


def _difference(tokens: list[str], other: Sequence, first: Sequence) -> tuple[str, str] | None:
    """The token in which the other name differs, as (ours, theirs); None unless there is exactly one."""
    theirs = _TOKEN.findall(other.pattern)
    if other.kind != first.kind or len(theirs) != len(tokens):
        return None
    differing = {(a, b) for a, b in zip(tokens, theirs, strict=True) if a != b}
    if len(differing) != 1:
        return None
    a, b = differing.pop()
    return (a, b) if a[0].isalnum() and b[0].isalnum() else None


def _as_many(one: Sequence, other: Sequence) -> bool:
    """Whether the numbers of files allow that two sequences are of one motion; some may be missing."""
    few, many = sorted((one.files, other.files))
    return 2 * few >= many


def _sides(ours: str, theirs: str) -> tuple[str, str]:
    """The differing ends of two words: "left" and "right" of "camleft" and "camright"."""
    common = next((i for i, (a, b) in enumerate(zip(ours, theirs, strict=False)) if a != b), 0)
    return ours[common:].lower(), theirs[common:].lower()


def _is_side(ours: str, theirs: str) -> bool:
    words = _sides(ours, theirs)
    return words in _SIDES or words[::-1] in _SIDES
