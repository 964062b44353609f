"""The calibration views of a recording, or of two file patterns, brought to the calibration."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from numpy.typing import NDArray

from calibration import Board, CalibrationSettings, StereoCalibration, calibrate_stereo
from calibration.stereo import Progress
from disctrack.errors import RecordingError
from disctrack.frames import CAMERAS
from disctrack.readers.files import file_number, match_files
from disctrack.readers.images import decode
from disctrack.recording import Recording


@dataclass(frozen=True)
class ChessboardImages:
    """Files of synchronised views; file i of the left and of the right show the board in the same place."""

    left: tuple[Path, ...]
    right: tuple[Path, ...]

    def __len__(self) -> int:
        return len(self.left)

    def sha256(self) -> str:
        """SHA-256 (hex) of all files' content, in order."""
        digest = hashlib.sha256()
        for file in (*self.left, *self.right):
            digest.update(hashlib.sha256(_content(file)).digest())
        return digest.hexdigest()


def find_views(left: str, right: str, folder: Path) -> ChessboardImages:
    """Files that the two patterns match, paired by their order. Raises RecordingError if they do not pair up."""
    files = [match_files(pattern, folder, camera) for pattern, camera in zip((left, right), CAMERAS, strict=True)]
    numbers = [[file_number(file) for file in side] for side in files]
    if numbers[0] != numbers[1] or len(files[0]) != len(files[1]):
        _refuse_unpaired(files, numbers)
    return ChessboardImages(tuple(files[0]), tuple(files[1]))


def _refuse_unpaired(files: Sequence[Sequence[Path]], numbers: Sequence[Sequence[int | None]]) -> None:
    """Different counts are an error; equal counts are, too, where the numbers overlap but for a few."""
    alone = [
        [file for file, number in zip(files[c], numbers[c], strict=True) if number not in numbers[1 - c]]
        for c in (0, 1)
    ]
    if len(files[0]) == len(files[1]) and len(alone[0]) in (0, len(files[0])):
        return  # no number in common: the two cameras count from different starts
    odd = [f"{CAMERAS[c]} {', '.join(file.name for file in alone[c][:3])}" for c in (0, 1) if alone[c]]
    raise RecordingError(
        f"{files[0][0].parent}: {len(files[0])} left and {len(files[1])} right calibration views do not pair up"
        + (f": without a partner are {' and '.join(odd)}" if odd else "")
        + ". Views are pairs, one image of each camera: add the missing ones, or move these away."
    )


def calibrate_recording(
    recording: Recording, settings: CalibrationSettings | None = None, progress: Progress | None = None
) -> tuple[StereoCalibration, tuple[str, ...]]:
    """`calibrate_views` with the views, board and table that a recording names. RecordingError without them."""
    chessboard, table = recording.chessboard, recording.table
    if chessboard is None or table is None:
        raise RecordingError(
            f"{recording.file}: [calibration] names a rig file, so there are no views to calibrate from. "
            "Use that rig as it is, or give left, right, inner_corners and square_mm instead."
        )
    views = find_views(chessboard.left, chessboard.right, recording.folder)
    board = Board(chessboard.inner_corners, chessboard.square)
    return calibrate_views(views, board, table.view, table.board_thickness, settings, progress)


def calibrate_views(
    views: ChessboardImages,
    board: Board,
    table_view: int | None = None,
    board_thickness: float = 0.0,
    settings: CalibrationSettings | None = None,
    progress: Progress | None = None,
) -> tuple[StereoCalibration, tuple[str, ...]]:
    """Calibrate from files; views that cannot be read are left out, and named in the second item.

    table_view : index among all views; board_thickness [m]
    Raises RecordingError if the table view cannot be read, CalibrationError if the views do not allow a calibration.
    """
    if table_view is not None and table_view >= len(views):
        raise RecordingError(
            f"{views.left[0].parent}: [table] view = {table_view}, but there are {len(views)} calibration views, "
            "counted from 0. Name the view whose board lies flat on the table."
        )
    images: tuple[list[NDArray], list[NDArray]] = ([], [])
    used, problems = [], []
    for i, pair in enumerate(zip(views.left, views.right, strict=True)):
        try:
            left, right = (decode(_content(file), f"{file} (calibration view {i})") for file in pair)
        except RecordingError as error:
            if i == table_view:
                raise RecordingError(f"{error} It is the table view: without it there is no lab frame.") from error
            problems.append(f"calibration view {i} is left out: {error}")
            continue
        used.append(i)
        images[0].append(left)
        images[1].append(right)
    names = [(str(views.left[i]), str(views.right[i])) for i in used]
    position = None if table_view is None else used.index(table_view)
    found = calibrate_stereo(*images, board, settings, position, board_thickness, names, progress)
    return found, tuple(problems)


def _content(file: Path) -> bytes:
    try:
        return file.read_bytes()
    except OSError as error:
        raise RecordingError(f"{file}: cannot be read: {error.strerror}. Copy it again.") from error
