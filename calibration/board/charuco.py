"""Inner corners of a ChArUco board in one image: OpenCV reads the markers, `corner_fit` locates the corners.

The board may be partly out of view or covered, or printed as a negative: every marker has a known position.
"""

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.board.chessboard import BoardNotFound, Located, as_8_bit, luminance, reduced
from calibration.board.corner_fit import fit_view, smooth_grid
from calibration.board.target import LEAST_POINTS, CharucoBoard
from calibration.kit.errors import CalibrationError
from calibration.kit.types import AnyArray, Array, Indices


def find_charuco(image: AnyArray, board: CharucoBoard) -> Located:
    """Locate the inner corners of a ChArUco board; corners out of view are not accepted, with an empty reason.

    image : (h, w) or (h, w, 3) as OpenCV reads it; see `chessboard.luminance`
    """
    values, notes = luminance(image)
    corners, ids = _detected(as_8_bit(values), board)
    if len(ids) < LEAST_POINTS:  # some prints are negatives, which their markers reveal
        negative = np.asarray(values.max() - values, values.dtype)
        found, numbers = _detected(as_8_bit(negative), board)
        if len(numbers) > len(ids):
            values, corners, ids = negative, found, numbers
    if len(ids) < LEAST_POINTS:
        return BoardNotFound(
            f"{len(ids)} corners of {board} found, at least {LEAST_POINTS} are needed: is it sharp and lit, and are "
            "squares, dictionary, square_mm and marker_mm those of the print?"
        )
    rough, seen = np.zeros_like(board.points[:, :2]), np.zeros(len(board.points), bool)
    rough[ids], seen[ids] = corners, True
    rough = np.where(seen[:, None], rough, smooth_grid(rough, board.inner_corners, seen)[0])
    plain = 0.5 * (1.0 - board.marker / board.square)
    view = fit_view(np.ascontiguousarray(values, np.float64), rough, board.inner_corners, seen, plain)
    if view.accepted.sum() < LEAST_POINTS:
        return BoardNotFound(
            f"only {view.accepted.sum()} of the {seen.sum()} corners of {board} in view lie on a regular grid: is the "
            "board bent, and is marker_mm the side of the markers?"
        )
    return replace(view, notes=notes)


def _detected(grey: NDArray[np.uint8], board: CharucoBoard) -> tuple[Array, Indices]:
    """Rough corners (k, 2) [px] and their numbers in the order of `CharucoBoard.points`."""
    number = getattr(cv2.aruco, board.dictionary, None)
    if number is None or not board.dictionary.startswith("DICT_"):
        known = ", ".join(name for name in dir(cv2.aruco) if name.startswith("DICT_") and "_50" in name)
        raise CalibrationError(f"dictionary {board.dictionary!r} is not one of OpenCV's: {known}, ...")
    grey, scale = reduced(grey)
    markers = cv2.aruco.getPredefinedDictionary(number)
    best: tuple[Array, Indices] = (np.zeros((0, 2)), np.zeros(0, np.intp))
    # boards with an even number of rows began with a light square before OpenCV 4.6; such prints exist
    for legacy in (False, True) if board.squares[1] % 2 == 0 else (False,):
        pattern = cv2.aruco.CharucoBoard(board.squares, board.square, board.marker, markers)
        pattern.setLegacyPattern(legacy)
        found, ids, _, _ = cv2.aruco.CharucoDetector(pattern).detectBoard(grey)
        if ids is not None and found is not None and len(ids) > len(best[1]):
            best = np.asarray(found, float).reshape(-1, 2), np.asarray(ids, np.intp).ravel()
    return (best[0] + 0.5) / scale - 0.5, best[1]
