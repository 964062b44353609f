"""Inner corners of a chessboard in one image, in an order that the squares' colours make unambiguous.

OpenCV finds the board roughly; `corner_fit` locates the corners.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.board.corner_fit import CornerView, fit_view, grey_at, local_axes, squares_round
from calibration.board.target import Board, board_orders
from calibration.kit.errors import ArgumentError
from calibration.kit.grey_levels import level_step
from calibration.kit.types import AnyArray, Array, checked

MARGIN = 1.15  # squares from the outermost corners: just outside the printed squares
SEARCH_SIZE = 1600  # px, to which larger images are reduced for the rough search, which would take seconds
MIN_ALTERNATION = 0.6  # fraction of neighbouring squares that alternate minus fraction that do not
LEAST_CORNERS = 12  # 3 x 4: smaller boards are detected by chance among dots and shadows
MOST_UNEVEN = 1.6  # ratio of neighbouring squares: perspective and lenses stay below 1.3, a skipped line gives 2
MIN_ACCEPTED = 0.5  # fraction of corners that must be accepted in a view


@dataclass(frozen=True)
class BoardNotFound:
    """A view in which the board was not found, with the reason."""

    reason: str


Located = CornerView | BoardNotFound  # in an image


def luminance(image: AnyArray) -> tuple[AnyArray, tuple[str, ...]]:
    """Grey values (h, w) of an image as cv2.IMREAD_UNCHANGED returns it, and a note if information was discarded.

    Grey images, 8 or 16 bit, are divided by the common factor of their values. Three equal channels are one grey image.
    Colour becomes luminance (0.114 B + 0.587 G + 0.299 R) in float; transparency is dropped.
    """
    image = np.asarray(image)
    if image.dtype not in (np.uint8, np.uint16, np.float32, np.float64):
        raise ArgumentError(f"images of type {image.dtype} are not grey values; expected 8 or 16 bit")
    image = image[..., None] if image.ndim == 2 else image
    if image.ndim != 3 or image.shape[2] not in (1, 3, 4):
        raise ArgumentError(f"an image is (height, width) or (height, width, 3 or 4), got {image.shape}")
    if not (image[..., :1] == image[..., :3]).all():
        return image[..., :3] @ np.array([0.114, 0.587, 0.299]), ("colour image read as luminance",)
    step = level_step(image[..., 0])
    return image[..., 0] if step == 1 else image[..., 0] // step, ()


@checked
def find_corners(image: AnyArray, inner_corners: tuple[int, int], thorough: bool = True) -> Located:
    """Locate the inner corners of a chessboard.

    image : (h, w) or (h, w, 3) uint8 or uint16, blue-green-red order as OpenCV reads it; see `luminance`
    inner_corners : counts along the board's i and j; see `Board` for the order of the corners
    thorough : search with OpenCV's slow finder if its quick one finds nothing
    """
    grey, notes = luminance(image)
    start = _rough_corners(as_8_bit(grey), inner_corners, thorough)
    if start is None:
        return BoardNotFound(
            f"no board of {inner_corners[0]} x {inner_corners[1]} inner corners: it must be wholly in view with a "
            "light rim round it, and the counts must be those of the INNER corners"
        )
    view = _view_at(start, grey, inner_corners)
    return view if isinstance(view, BoardNotFound) else replace(view, notes=notes)


def board_in(grey: AnyArray, thorough: bool = False) -> tuple[int, int] | None:
    """Inner corners (long side, short side) of the whole chessboard, of any size, in an image of grey values.

    thorough : OpenCV's exhaustive search, 0.3 s for 1280 x 720; without it, often only a part of a board is found
    """
    flags = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_NORMALIZE_IMAGE | (cv2.CALIB_CB_EXHAUSTIVE if thorough else 0)
    found, corners, squares = cv2.findChessboardCornersSBWithMeta(as_8_bit(grey), (3, 3), flags)
    if not found or squares is None or squares.size < LEAST_CORNERS:
        return None
    grid = np.asarray(corners, np.float64).reshape(*squares.shape[:2], 2)
    if len(grid) > grid.shape[1]:
        grid = grid.swapaxes(0, 1)
    size = grid.shape[1], grid.shape[0]
    whole = _even(grid) and isinstance(_view_at(grid.reshape(-1, 2), grey, size), CornerView)
    return size if whole else None


def _view_at(start: Array, grey: AnyArray, inner_corners: tuple[int, int]) -> Located:
    """Corners of the view; `start` (n, 2) is their position to about a pixel, in any order of the board."""
    values = np.ascontiguousarray(grey, dtype=np.float64)
    rough = _orient(start, values, inner_corners)
    if isinstance(rough, BoardNotFound):
        return rough
    view = fit_view(values, rough, inner_corners, np.ones(len(rough), bool))
    if view.accepted.mean() < MIN_ACCEPTED:
        return BoardNotFound(
            f"only {view.accepted.sum()} of {len(view.accepted)} corners lie on a regular grid: the board is covered "
            f"or bent, or {inner_corners[0]} x {inner_corners[1]} is not the number of its inner corners"
        )
    return _if_whole(view, values, inner_corners)


def as_8_bit(grey: AnyArray) -> NDArray[np.uint8]:
    """Grey values stretched to 8 bit, for the rough search only."""
    if grey.dtype.kind == "u" and grey.max(initial=0) < 256:
        return grey.astype(np.uint8, copy=False)
    low, high = np.percentile(grey, [0.5, 99.5])
    return np.clip((grey - low) * (255.0 / max(high - low, 1e-12)), 0, 255).astype(np.uint8)


def reduced(grey: AnyArray, largest: int = SEARCH_SIZE) -> tuple[AnyArray, float]:
    """The image, scaled down if its longer side exceeds `largest` [px], and the scale."""
    scale = min(1.0, largest / max(grey.shape))
    small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1.0 else grey
    return np.asarray(small), scale


def _rough_corners(grey: NDArray[np.uint8], inner_corners: tuple[int, int], thorough: bool) -> Array | None:
    """Corners (n, 2) [px] to about a pixel, in any order of the board, or None."""
    if min(grey.shape) < 2 * min(inner_corners):  # squares would be smaller than a pixel or two
        return None
    grey, scale = reduced(grey)
    quick, slow = cv2.findChessboardCorners, cv2.findChessboardCornersSB
    flags, exhaustive = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE, cv2.CALIB_CB_EXHAUSTIVE
    tried = [(quick, 1, flags)]
    if thorough:
        tried.append((slow, 1, exhaustive))
    if thorough and 2 * max(grey.shape) <= SEARCH_SIZE:  # squares of 5 to 10 px have to be enlarged
        tried += [(quick, 2, flags), (slow, 1, exhaustive | cv2.CALIB_CB_ACCURACY)]
    for find, finer, how in tried:
        image = grey if finer == 1 else cv2.resize(grey, None, fx=finer, fy=finer, interpolation=cv2.INTER_CUBIC)
        found, corners = find(image, inner_corners, None, how)
        # finders may mistake a part of a board for the whole
        if found and _even(grid := np.asarray(corners, np.float64).reshape(*inner_corners[::-1], 2)):
            return (grid.reshape(-1, 2) + 0.5) / (scale * finer) - 0.5
    return None


def _even(grid: AnyArray) -> bool:
    """Whether the grid of corners (rows, columns, 2) has no skipped line."""
    for along in (grid, grid.swapaxes(0, 1)):
        step = np.median(np.linalg.norm(np.diff(along, axis=0), axis=-1), axis=1)
        if len(step) > 1 and (np.abs(np.diff(np.log(np.maximum(step, 1e-9)))) > np.log(MOST_UNEVEN)).any():
            return False
    return True


def _orient(corners: Array, grey: Array, inner_corners: tuple[int, int]) -> Array | BoardNotFound:
    """Order the corners as `Board` defines: seen from the printed side, with a dark corner square at corner 0."""
    columns, rows = inner_corners
    grid = corners.reshape(rows, columns, 2)
    i_px, j_px = grid[:, 1:].mean((0, 1)) - grid[:, :-1].mean((0, 1)), grid[1:].mean((0, 1)) - grid[:-1].mean((0, 1))
    if i_px[0] * j_px[1] - i_px[1] * j_px[0] > 0:  # y points down in the image: i x j must come out of the print
        grid = grid[::-1] if columns != rows else grid.transpose(1, 0, 2)
    ordered = [grid.reshape(-1, 2)[order] for order in board_orders(inner_corners)]
    signs = [_first_square_is_dark(corners, grey, inner_corners) for corners in ordered]
    if max(abs(sign) for sign in signs) < MIN_ALTERNATION:
        return BoardNotFound(
            f"the squares between the corners found are not light and dark in turn: {columns} x {rows} is not the "
            "number of the board's inner corners, or it is no chessboard"
        )
    dark = [corners for corners, sign in zip(ordered, signs, strict=True) if sign > 0]
    # if the colouring allows several orders, i points right in this image; the stereo pair makes the cameras agree.
    # With such counts all corner squares may be light, if the print begins with a light one
    return max(dark or ordered, key=lambda c: float((c[columns - 1] - c[0]) @ [1.0, -1e-3]))


def _first_square_is_dark(corners: Array, grey: Array, inner_corners: tuple[int, int]) -> float:
    """Positive if the square outside corner 0 is dark, negative if light; +-1 if the squares at all corners agree.

    Neighbouring squares are compared, so that a shadow across the board has no effect.
    """
    columns, rows = inner_corners
    axes = local_axes(corners, np.ones(len(corners), bool), inner_corners)
    signs = np.sign(_saddles(grey, corners, axes, 0.5)).reshape(rows, columns)
    signs[1::2] *= -1.0
    signs[:, 1::2] *= -1.0
    return float(-np.nansum(signs) / signs.size)


def _if_whole(view: CornerView, grey: Array, inner_corners: tuple[int, int]) -> Located:
    """The view, unless full lines of corners continue beyond a side: the board is larger than declared."""
    columns, rows = inner_corners
    grid = view.points.reshape(rows, columns, 2)
    axes = local_axes(view.points, view.accepted, inner_corners)
    least = 0.5 * float(np.median(np.abs(_saddles(grey, view.points, axes)[view.accepted])))
    axes = axes.reshape(rows, columns, 2, 2)
    further = [0, 0]  # rows, columns
    for side in range(4):
        line, before = np.rot90(grid, side)[:2]
        step = line - before
        while _crosses(grey, line + step, np.rot90(axes, side)[0], least):
            line, further[side % 2] = line + step, further[side % 2] + 1
    if not any(further):
        return view
    all_columns, all_rows = columns + further[1], rows + further[0]
    return BoardNotFound(
        f"the board goes on beyond the {columns} x {rows} inner corners that were declared: {all_columns} x {all_rows} "
        f"are in view. If that is all of them, declare inner_corners = [{all_columns}, {all_rows}]; a part of a board "
        "cannot be distinguished from its neighbour, one square further on"
    )


def _crosses(grey: Array, line: Array, axes: Array, least: float) -> bool:
    """Whether two light and two dark squares meet at most points (n, 2) of a line."""
    contrast = np.abs(_saddles(grey, line, axes))
    inside = np.isfinite(contrast)
    return bool(inside.sum() >= 3 and inside.mean() >= 0.5 and np.mean(contrast[inside] > least) > 0.7)


def _saddles(grey: Array, points: Array, axes: Array, aside: float = 0.3) -> Array:
    """(n,) Grey values of two opposite squares at points (n, 2) minus those of the two others.

    NaN outside the image; axes, aside : as in `squares_round`
    """
    a, b = squares_round(grey, points, axes, aside).transpose(1, 0, 2)
    lighter, darker = a.min(axis=1) - b.max(axis=1), b.min(axis=1) - a.max(axis=1)
    return np.where(lighter > 0, lighter, -np.maximum(darker, 0.0))


def negatives(images: Sequence[AnyArray], views: Sequence[Located], board: Board) -> str:
    """Reason for which images of a chessboard appear to be negatives, in words; "" if there is none.

    The pattern itself gives no evidence: the colouring of a negative is that of the board turned by 180 deg.
    """
    pairs = zip(images, views, strict=True)
    dark = [margin_is_dark(image, view, board.inner_corners) for image, view in pairs if isinstance(view, CornerView)]
    if not dark or np.mean(dark) <= 0.5:
        return ""
    return (
        "the paper round the board's squares is as dark as its dark squares: are the images negative? Then the lab "
        "frame is turned by 180 deg"
    )


def margin_is_dark(image: AnyArray, view: CornerView, inner_corners: tuple[int, int]) -> bool:
    """Whether the paper just outside a chessboard's squares is as dark as the dark squares.

    False if too little of it is in view.
    """
    grid = view.points.reshape(*inner_corners[::-1], 2)
    edges = (np.rot90(grid, side)[:2] for side in range(4))
    margin = np.concatenate([grey_at(image, line + MARGIN * (line - before)) for line, before in edges])
    light, dark = np.nanquantile(grey_at(image, 0.5 * (grid[1:, 1:] + grid[:-1, :-1])), [0.8, 0.2])
    seen = np.isfinite(margin)
    return bool(seen.mean() > 0.5 and np.median(margin[seen]) < dark + 0.25 * (light - dark))
