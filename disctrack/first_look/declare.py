"""A recording.toml for a folder of frames: what the files tell is filled in, what they cannot tell is left to the user.

A value that no file tells stands as a comment with FILL IN: the declaration is refused until it is given, so that no
guess of ours becomes a measurement.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.board.chessboard import BoardNotFound, find_corners
from calibration.board.search import VIEWS_TRIED, board_size, evenly
from calibration.rig_file import read_rig
from disctrack.errors import DiscTrackError, OutputError, RecordingError
from disctrack.files.toml_tree import read_toml, toml_value
from disctrack.files.whole import write_whole
from disctrack.first_look.sequences import CameraPair, Sequence, find_sequences, pair_cameras
from disctrack.recording.declaration import FILE_NAME, KEYS
from disctrack.recording.readers import open_frames
from disctrack.recording.readers.base import FrameReader
from disctrack.recording.readers.decoding import decode
from disctrack.recording.readers.files import match_files, split_member


@dataclass(frozen=True)
class FolderContent:
    """What the files of a folder tell."""

    folder: Path
    frames: CameraPair
    described: str  # size, depth and number of the frames
    frame_rate: float | None  # [Hz] where a camera's header or the frames' time stamps tell it
    rate_source: str
    views: CameraPair | None
    views_count: int
    inner_corners: tuple[int, int] | None
    board_seen: str  # in how many of the views that were tried
    rig_file: str | None  # where there are no views
    parts: tuple[list[int], list[int]] | None  # x, y, width, height [px] of the cameras' images in those of the files
    notes: tuple[str, ...]


@dataclass(frozen=True)
class WrittenDeclaration:
    """What `run_init` wrote."""

    file: Path
    found: FolderContent
    missing: tuple[str, ...]  # keys that the user has to fill in


def run_init(folder: Path, known: Mapping[str, float] | None = None, like: Path | None = None) -> WrittenDeclaration:
    """Write recording.toml into a folder of frames.

    known : values by key that the user gave; like : another recording.toml, or its folder, of the same disc,
    board and table, from which everything is taken that the files do not tell
    Raises RecordingError if no two cameras are found, OutputError if there is a recording.toml already.
    """
    folder = Path(folder)
    file = folder / FILE_NAME
    if file.exists():
        raise OutputError(f"{file}: exists. Edit it, or move it away; `disctrack check {folder}` tells what it lacks.")
    example = {} if like is None else read_toml(like / FILE_NAME if like.is_dir() else like, RecordingError)
    found = look_into(folder)
    text, missing = declaration(found, known or {}, example)
    write_whole(file, text.encode())
    return WrittenDeclaration(file, found, missing)


def look_into(folder: Path) -> FolderContent:
    """What the frames of a folder tell. Raises RecordingError if no two cameras can be told apart."""
    sequences = find_sequences(folder)
    shows_once = cache(partial(_shows_the_board_once, folder))  # seconds, for large images
    pairs, parts = pair_cameras(sequences), None
    if _may_be_one_camera(pairs, sequences, shows_once) and (half := _side_by_side(folder, sequences)):
        width, height = half
        parts = [0, 0, width, height], [width, 0, width, height]
        pairs = [CameraPair(sequence, sequence, named=True) for sequence in sequences]
    if not pairs:
        raise _no_two_cameras(folder, sequences)
    notes = []
    views, inner_corners, board_seen = _views_among(folder, pairs, 1 if parts is None else 2)
    candidates = [pair for pair in pairs if pair is not views] or pairs
    lengths = {id(pair): _length(folder, pair.left) for pair in candidates}
    frames = max(candidates, key=lambda pair: lengths[id(pair)])
    if views is None and parts is None and shows_once(frames):
        raise _no_two_cameras(folder, sequences)
    if len(candidates) > 1:
        others = ", ".join(pair.left.pattern for pair in candidates if pair is not frames)
        notes.append(f"the longest of several pairs is taken for the recording; also there: {others}")
    if frames is views:
        columns, rows = inner_corners or (9, 6)
        raise RecordingError(
            f"{folder}: {frames.left.pattern} and {frames.right.pattern} show a chessboard, and nothing else is there. "
            "Put the cameras' frames of the disc beside them. The cameras alone: disctrack calibrate "
            f"--left '{folder / frames.left.pattern}' --right '{folder / frames.right.pattern}' "
            f"--corners {columns}x{rows} --square-mm SIDE -o rig.h5"
        )
    left, right = frames.left.open(folder), frames.right.open(folder, "right")
    rate, source = _frame_rate(left, right)
    if parts is not None:
        notes.append(
            "each image holds two views side by side, as the board in both halves shows: left_part, right_part"
        )
    if not frames.named:
        notes.append(f"which camera is left is a guess by the order of names: {frames.left.pattern} is taken for left")
    rig_file = None if views is not None else _rig_beside(folder)
    width, height = left.image_size
    return FolderContent(
        folder,
        frames,
        f"{len(left)} frames of {width} x {height} px, {left.bit_depth} bit",
        rate,
        source,
        views,
        0 if views is None else _length(folder, views.left),
        inner_corners,
        board_seen,
        rig_file,
        parts,
        tuple(notes),
    )


def _no_two_cameras(folder: Path, sequences: list[Sequence]) -> RecordingError:
    seen = ", ".join(sequence.pattern for sequence in sequences[:6]) or "no file that frames are read from"
    return RecordingError(
        f"{folder}: no two sequences whose names differ by the camera alone (left and right, cam1 and cam2, ...). "
        f"It holds: {seen}. Put each camera's frames into a folder of its own, e.g. left/ and right/."
    )


def _may_be_one_camera(
    pairs: list[CameraPair], sequences: list[Sequence], shows_once: Callable[[CameraPair], bool]
) -> bool:
    """Is a sequence without a partner, or are partners unlike? Where all are two and two there are two cameras."""
    if any(pair.named for pair in pairs):
        return False
    return 2 * len(pairs) < len(sequences) or any(map(shows_once, pairs))


def _shows_the_board_once(folder: Path, pair: CameraPair) -> bool:
    """Does one of two sequences show a chessboard and the other none? Those are views and frames of one camera."""
    if pair.named:
        return False
    left, right = (board_size(some_images(side.pattern, folder))[0] is None for side in (pair.left, pair.right))
    return left != right


def _side_by_side(folder: Path, sequences: list[Sequence]) -> tuple[int, int] | None:
    """Width and height [px] of half an image, where there are images whose two halves both show a chessboard."""
    for sequence in sorted(sequences, key=lambda sequence: _length(folder, sequence)):
        halves = [np.array_split(image, 2, axis=1) for image in some_images(sequence.pattern, folder)]
        if any(left.shape != right.shape for left, right in halves):
            continue
        size, _ = board_size([half for both in halves for half in both])
        if size is None:
            continue
        seen = [all(not isinstance(find_corners(half, size), BoardNotFound) for half in both) for both in halves]
        if 2 * sum(seen) > len(seen):  # half of a board passes for a smaller one in some
            height, width = halves[0][0].shape[:2]
            return width, height
    return None


def _views_among(
    folder: Path, pairs: list[CameraPair], side_by_side: int
) -> tuple[CameraPair | None, tuple[int, int] | None, str]:
    """The pair that shows the chessboard: by its names, else by what is in the images, shortest first.

    side_by_side : how many cameras' images stand beside each other in one
    """
    named = [pair for pair in pairs if pair.looks_like_calibration]
    others = sorted((pair for pair in pairs if pair not in named), key=lambda pair: _length(folder, pair.left))
    tried = [*named, *(others if not named and len(pairs) > 1 else [])]
    for pair in tried:
        sides = (pair.left, pair.right) if side_by_side == 1 else (pair.left,)
        whole = [image for side in sides for image in some_images(side.pattern, folder)]
        images = [part for image in whole for part in np.array_split(image, side_by_side, axis=1)]
        size, seen = board_size(images)
        if size is not None:
            return pair, size, f"found whole in {seen} of {len(images)} images tried"
    if named:
        return named[0], None, "no board found in the images that were tried"
    return None, None, ""


def some_images(pattern: str, folder: Path) -> list[NDArray]:
    """A few of one camera's views; they may be in colour. Raises RecordingError."""
    files = match_files(split_member(pattern)[0], folder, "left")
    if len(files) > 1:
        chosen = [files[i] for i in evenly(len(files), VIEWS_TRIED)]
        return [decode(file.read_bytes(), str(file)) for file in chosen]
    reader = open_frames(pattern, folder, "left")
    return [np.array(reader.read(i)) for i in evenly(len(reader), VIEWS_TRIED)]


def _length(folder: Path, sequence: Sequence) -> int:
    return sequence.files if sequence.files > 1 else len(sequence.open(folder))


def _frame_rate(left: FrameReader, right: FrameReader) -> tuple[float | None, str]:
    for camera, reader in (("left", left), ("right", right)):
        header = reader.header
        if header is not None:
            return header.frame_rate, f"says {Path(header.file).name}"
        if reader.timestamps is not None and len(reader.timestamps) > 2:
            step = float(np.median(np.diff(reader.timestamps)))
            if np.isfinite(step) and step > 0:
                return float(f"{1 / step:.6g}"), f"by the time stamps of the {camera} frames"
        if reader.frame_rate is not None:
            return float(reader.frame_rate), f"stated by the {camera} file"
    return None, ""


def _rig_beside(folder: Path) -> str | None:
    """A rig file of disctrack in the folder or the one above."""
    for place, shown in ((folder, ""), (folder.parent, "../")):
        for file in sorted(place.glob("*.h5")):
            try:
                read_rig(file)
            except DiscTrackError:
                continue
            return f"{shown}{file.name}"
    return None


def declaration(
    found: FolderContent, known: Mapping[str, float], example: Mapping[str, Any]
) -> tuple[str, tuple[str, ...]]:
    """Text of the recording.toml, and the keys that nobody told."""
    missing: list[str] = []

    def line(section: str, key: str, value: Any, example_text: str, remark: str) -> str:
        """One key: what the files tell, else what the user gave, else the example's, else left to fill in."""
        if value is None:
            value = known.get(key, example.get(section, {}).get(key))
        if value is None:
            missing.append(f"[{section}] {key}")
            return _aligned(f"# {key} = {example_text}", f"FILL IN: {remark}")
        return _aligned(f"{key} = {toml_value(value)}", remark)

    f = found.frames
    rate_remark = f"frames per second, {found.rate_source}" if found.rate_source else "frames per second of the cameras"
    lines = [
        "# Lengths in mm, masses in g, times in s. Every key: disctrack/docs/recording-toml.md",
        f"name = {toml_value(found.folder.resolve().name)}",
        "",
        "[cameras]                       # frame i of the left and of the right must show the same instant",
        line("cameras", "frame_rate_hz", found.frame_rate, "1000.0", rate_remark),
        _exposure(example),
        _aligned(f"left = {toml_value(f.left.pattern)}", found.described),
        f"right = {toml_value(f.right.pattern)}",
        *_part_lines(found),
        "",
        "[disc]",
        line("disc", "radius_mm", None, "37.5", "caliper"),
        line("disc", "thickness_mm", None, "6.0", "caliper, with the paper"),
        line("disc", "mass_g", None, "209.69", "balance, with the paper"),
        *_optional("disc", example),
        "",
        "[markers]                       # round dots on the upper face, all of one size",
        line("markers", "diameter_mm", None, "7.0", "as printed"),
        line(
            "markers", "centres_mm", None, "[[26.0, 0.0], [13.0, 22.5], [-13.0, 22.5], [6.5, -11.3]]",
            "[x, y] of every dot from the disc's centre",
        ),
        "",
        *_calibration_lines(found, line, example),
        "[gravity]",
        line("gravity", "g_m_s2", example.get("gravity", {}).get("g_m_s2", 9.81), "9.81", "9.78 (equator) to 9.83"),
    ]  # fmt: skip
    return "\n".join(lines) + "\n", tuple(missing)


def _part_lines(found: FolderContent) -> list[str]:
    if found.parts is None:
        return []
    left, right = map(toml_value, found.parts)
    return [_aligned(f"left_part = {left}", "x, y, width, height in px of its images"), f"right_part = {right}"]


def _exposure(example: Mapping[str, Any]) -> str:
    remark = "with it, poses are those of mid exposure; else it is taken as short"
    given = example.get("cameras", {}).get("exposure_us")
    return _aligned("# exposure_us = 200.0" if given is None else f"exposure_us = {toml_value(given)}", remark)


def _calibration_lines(found: FolderContent, line: Any, example: Mapping[str, Any]) -> list[str]:
    if found.views is None and found.rig_file is not None:
        rig = _aligned(f"rig = {toml_value(found.rig_file)}", "a rig that was calibrated before")
        return ["[calibration]", rig, ""]
    left, right = (None, None) if found.views is None else (found.views.left.pattern, found.views.right.pattern)
    corners = None if found.inner_corners is None else list(found.inner_corners)
    count = f"{found.views_count} views" if found.views is not None else "views of a chessboard, 15 to 40 of them"
    return [
        "[calibration]                   # synchronised views of a flat chessboard",
        line("calibration", "left", left, '"calibration/left/*.png"', count),
        line("calibration", "right", right, '"calibration/right/*.png"', "the same views, in the same order"),
        line("calibration", "inner_corners", corners, "[9, 6]", f"long side first; {found.board_seen or 'count them'}"),
        line("calibration", "square_mm", None, "6.0", "side of a square, measured over many squares"),
        *_optional("calibration", example),
        "",
        "[table]                         # the lab frame: k up from the table, which is z = 0",
        line("table", "view", 0, "0", "CHECK: in this view, counted from 0, the board lies flat on the table"),
        line("table", "board_thickness_mm", None, "3.0", "height of the printed face above the table"),
        *_optional("table", example),
        "",
    ]


def _optional(section: str, example: Mapping[str, Any]) -> list[str]:
    """Keys with a default, where the example gives them."""
    given = example.get(section, {})
    keys = [key for key, meant in sorted(KEYS[section].items()) if not meant.needed and key in given and key != "rig"]
    return [f"{key} = {toml_value(given[key])}" for key in keys]


def _aligned(text: str, remark: str) -> str:
    return f"{text:<32}# {remark}" if len(text) < 32 else f"{text}  # {remark}"
