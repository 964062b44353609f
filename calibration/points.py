"""Calibration from corners located by another program, with one sigma for all."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from calibration.board.chessboard import BoardNotFound, CornerView
from calibration.board.target import Board
from calibration.cameras.camera import CAMERA_NAMES
from calibration.judge.tolerances import BoardTolerances
from calibration.kit.arguments import Thickness, checked
from calibration.kit.errors import CalibrationError
from calibration.stereo import StereoCalibration, calibrate_from_corners

LARGEST_SQUARE = 0.5  # m: above, the value was given in millimetres
OVERSTATED = 0.7  # scatter of corners over the declared sigma, below which the sigma is too large
_NOT_SEEN = BoardNotFound("no corners were given")


@checked
def calibrate_from_points(
    left: Sequence[ArrayLike | None],
    right: Sequence[ArrayLike | None],
    board: Board,
    image_size: tuple[int, int] | tuple[tuple[int, int], tuple[int, int]],
    sigma_px: float,
    tolerances: BoardTolerances | None = None,
    table_view: int | None = None,
    board_thickness: Thickness = 0.0,
) -> StereoCalibration:
    """Calibrate a stereo pair from corners located elsewhere; items i of both lists show the board in the same place.

    left, right : per view (n, 2) [px] in the order of `Board.points`, pixel (0, 0) the centre of the top-left pixel;
        None if the camera did not see the board
    image_size : (width, height) [px] of both cameras, or of each
    sigma_px : standard deviation of a corner per axis; further noise is estimated from the residuals and added; a
        warning is given if the residuals are smaller

    Raises CalibrationError that names camera, view and corner of invalid data.
    """
    if len(left) != len(right):
        raise CalibrationError(f"{len(left)} left and {len(right)} right views: give None where a camera saw no board")
    if not (np.isfinite(sigma_px) and sigma_px > 0):
        raise CalibrationError(f"sigma_px = {sigma_px}: the standard deviation of a corner must be above 0 px")
    if board.square > LARGEST_SQUARE:
        raise CalibrationError(
            f"the board's squares are {board.square:g} m: lengths are in metres, {board.square:g} mm is "
            f"{board.square * 1e-3:g}"
        )
    sizes = np.broadcast_to(np.asarray(image_size), (2, 2))
    views = [
        [
            _view(points, board, (int(size[0]), int(size[1])), sigma_px, f"{name} view {v}")
            for v, points in enumerate(side)
        ]
        for side, size, name in zip((left, right), sizes, CAMERA_NAMES, strict=True)
    ]
    found = calibrate_from_corners(views[0], views[1], board, tolerances, table_view, board_thickness)
    shown = sigma_px * float(np.sqrt(found.refinement.chi_square))
    if shown < OVERSTATED * sigma_px:
        note = f"the corners scatter by {shown:.3g} px, {sigma_px:g} px were declared: the stated sigmas are too large"
        found = replace(found, warnings=(*found.warnings, note))
    return found


def _view(
    points: ArrayLike | None, board: Board, image_size: tuple[int, int], sigma: float, where: str
) -> CornerView | BoardNotFound:
    if points is None:
        return _NOT_SEEN
    pixels, n, size = np.asarray(points, float), len(board.points), np.array(image_size)
    if pixels.shape not in ((n, 2), (n, 1, 2)):
        raise CalibrationError(
            f"{where}: corners of shape {pixels.shape}, expected ({n}, 2) for {board}; a view with a corner missing "
            "must be left out (None)"
        )
    pixels = pixels.reshape(n, 2)
    bad = np.flatnonzero(~((pixels >= -0.5) & (pixels <= size - 0.5)).all(axis=1))
    if len(bad):
        x, y = pixels[bad[0]]
        raise CalibrationError(
            f"{where}: corner {bad[0]} at ({x:.1f}, {y:.1f}) does not lie in the image of {size[0]} x {size[1]} px: "
            "leave the view out (None), or mend it; are width and height, or x and y, exchanged?"
        )
    return CornerView(image_size, pixels, np.tile(sigma**2 * np.eye(2), (n, 1, 1)), np.ones(n, bool), ("",) * n)
