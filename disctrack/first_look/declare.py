"""A recording.toml for a folder of frames: values known from the files are filled in, others are left to the user.

An unknown value is a comment with FILL IN: the declaration is refused until it is given, so that no guess enters a
measurement. Which sequences of frames are of the two cameras, and which two show the chessboard, follows from their
names, then from their content.
"""

import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import h5py
import numpy as np

from calibration.board.chessboard import BoardNotFound, find_corners
from calibration.board.search import VIEWS_TRIED, board_size
from calibration.kit.types import AnyArray, evenly
from calibration.rig_file import read_rig
from disctrack.calibrate.stage import pixels_of, views_of
from disctrack.errors import DiscTrackError, OutputError, RecordingError
from disctrack.files.toml_tree import read_toml
from disctrack.files.whole import write_whole
from disctrack.recording.declaration import FILE_NAME, Told, declaration_text
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


def run_init(
    folder: Path, known: Mapping[str, float], like: Path | None
) -> tuple[Path, Told, list[str], tuple[str, ...]]:
    """Write recording.toml into a folder of frames. Returns it, values from the files, notes, and keys to fill in.

    known : values of the user by key; like : another recording.toml, or its folder, of the same disc, board and table,
    for values that the files do not contain
    Raises RecordingError if no two cameras are found, OutputError if there is a recording.toml already.
    """
    file = folder / FILE_NAME
    if file.exists():
        raise OutputError(f"{file}: exists. Edit it, or move it away; `disctrack check {folder}` names what it lacks.")
    example = {} if like is None else read_toml(like / FILE_NAME if like.is_dir() else like, RecordingError)
    found, notes = look_into(folder)
    given = {"gravity": {"g_m_s2": 9.81}} | example
    text, missing = declaration_text(folder.resolve().name, found, known, given)
    write_whole(file, text.encode())
    return file, found, notes, missing


def look_into(folder: Path) -> tuple[Told, list[str]]:
    """Values known from the files of a folder, and notes. Raises RecordingError if no two cameras are recognised."""
    sequences = find_sequences(folder)
    pairs, half = pair_cameras(sequences), None
    # one camera: a sequence without partner, or partners of different content; two pairs are two cameras
    named = any(pair.named for pair in pairs)
    unlike = not named and (2 * len(pairs) < len(sequences) or any(pair.shows_the_board_once for pair in pairs))
    if unlike and (half := _side_by_side(sequences)):
        pairs = [CameraPair(sequence, sequence, named=True) for sequence in sequences]
    if not pairs:
        raise _no_two_cameras(folder, sequences)
    views, inner_corners, board_seen = _views_among(pairs, 1 if half is None else 2)
    candidates = [pair for pair in pairs if pair is not views] or pairs
    frames = max(candidates, key=lambda pair: len(pair.left))
    if views is None and half is None and frames.shows_the_board_once:
        raise _no_two_cameras(folder, sequences)
    if frames is views:
        corners = inner_corners or (9, 6)
        raise RecordingError(
            f"{folder}: {views.left.pattern} and {views.right.pattern} show a chessboard, and nothing else is there. "
            "Put the cameras' frames of the disc into the same folder. The cameras alone: disctrack calibrate "
            f"--left '{folder / views.left.pattern}' --right '{folder / views.right.pattern}' "
            f"--corners {corners[0]}x{corners[1]} --square-mm SIDE -o rig.h5"
        )
    found, notes = _of_frames(frames)
    if len(candidates) > 1:
        others = ", ".join(pair.left.pattern for pair in candidates if pair is not frames)
        notes.append(f"the longest of several pairs is taken for the recording; also there: {others}")
    if half is not None:
        width, height = half
        found["cameras", "left_part"] = [0, 0, width, height], ""
        found["cameras", "right_part"] = [width, 0, width, height], ""
        notes.append("each image holds two views side by side, as the board in both halves shows")
    if views is not None:
        left, right, count = views.left.pattern, views.right.pattern, len(views.left)
        found["calibration", "left"], found["calibration", "right"] = (left, f"{count} views"), (right, "")
        if inner_corners is None:
            notes.append(f"{left}: {board_seen}")
        else:
            found["calibration", "inner_corners"] = list(inner_corners), f"long side first; {board_seen}"
    elif (rig_file := _rig_near(folder)) is not None:
        found["calibration", "rig"] = rig_file, "a rig that was calibrated before"
    else:
        said = "no views of a chessboard are there: put them into calibration/left and calibration/right, or name a rig"
        notes.append(said)
    return found, notes


def _of_frames(frames: CameraPair) -> tuple[Told, list[str]]:
    """Values known from the frames of the cameras, and notes."""
    left, right = frames.left.open(), frames.right.open("right")
    width, height = left.image_size
    described, notes = f"{len(left)} frames of {width} x {height} px, {left.bit_depth} bit", []
    found: Told = {
        ("cameras", "left"): (frames.left.pattern, described),
        ("cameras", "right"): (frames.right.pattern, ""),
        ("table", "view"): (0, ""),
    }
    if len(left) != len(right):
        many = f"left has {len(left)} frames, right has {len(right)}"
        notes.append(f"{many}: a run wants as many of both, of the same instants")
    rate, source = _frame_rate(left, right)
    if rate is not None:
        found["cameras", "frame_rate_hz"] = rate, f"frames per second, {source}"
    if not frames.named:
        notes.append(f"which camera is left is a guess by the order of names: {frames.left.pattern} is taken for left")
    return found, notes


def _no_two_cameras(folder: Path, sequences: list[Sequence]) -> RecordingError:
    seen = ", ".join(sequence.pattern for sequence in sequences[:6]) or "no file that frames are read from"
    return RecordingError(
        f"{folder}: no two sequences whose names differ by the camera alone (left and right, cam1 and cam2, ...). "
        f"It holds: {seen}. Put each camera's frames into a folder of its own, e.g. left/ and right/."
    )


def _side_by_side(sequences: list[Sequence]) -> tuple[int, int] | None:
    """Width and height [px] of half an image, if both halves of some images show a chessboard."""
    for sequence in sorted(sequences, key=len):
        halves = [np.array_split(image, 2, axis=1) for image in sequence.some_images()]
        if any(left.shape != right.shape for left, right in halves):
            continue
        size, _ = board_size([half for both in halves for half in both])
        if size is None:
            continue
        seen = [all(not isinstance(find_corners(half, size), BoardNotFound) for half in both) for both in halves]
        if 2 * sum(seen) > len(seen):  # in some images, half of a board looks like a smaller one
            height, width = halves[0][0].shape[:2]
            return width, height
    return None


def _views_among(pairs: list[CameraPair], side_by_side: int) -> tuple[CameraPair | None, tuple[int, int] | None, str]:
    """The pair that shows the chessboard: by its names, else by the content of its images, shortest first.

    side_by_side : number of cameras whose images are combined in one, side by side
    """
    named = [pair for pair in pairs if pair.looks_like_calibration]
    others = sorted((pair for pair in pairs if pair not in named), key=lambda pair: len(pair.left))
    tried = [*named, *(others if not named and len(pairs) > 1 else [])]
    for pair in tried:
        sides = (pair.left, pair.right) if side_by_side == 1 else (pair.left,)
        whole = [image for side in sides for image in side.some_images()]
        images = [part for image in whole for part in np.array_split(image, side_by_side, axis=1)]
        size, seen = board_size(images)
        if size is not None:
            return pair, size, f"found whole in {seen} of {len(images)} images tried"
    if named:
        return named[0], None, "no board found in the images that were tried"
    return None, None, ""


def _frame_rate(left: FrameReader, right: FrameReader) -> tuple[float | None, str]:
    for camera, reader in (("left", left), ("right", right)):
        if reader.frame_rate is not None:
            return float(reader.frame_rate), f"stated by the {camera} file"
        if reader.timestamps is not None and len(reader.timestamps) > 2:
            step = float(np.median(np.diff(reader.timestamps)))
            if np.isfinite(step) and step > 0:
                return float(f"{1 / step:.6g}"), f"by the time stamps of the {camera} frames"
    return None, ""


def _rig_near(folder: Path) -> str | None:
    """A rig file of disctrack in the folder or its parent."""
    for place, shown in ((folder, ""), (folder.parent, "../")):
        for file in sorted(place.glob("*.h5")):
            with suppress(DiscTrackError):
                read_rig(file)
                return f"{shown}{file.name}"
    return None


# --- Sequences of frames in a folder, and the two of them that differ only by the camera ------------------------------


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
