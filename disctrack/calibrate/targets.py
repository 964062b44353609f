"""A calibration target of any kind, found in the images of both cameras."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.board import Board, CharucoBoard, CircleGrid, DotTarget, Target
from calibration.chessboard import BoardNotFound, CornerView, find_corners, grey_values
from calibration.stereo import Progress, located
from disctrack.calibrate.dot_target import DotView, find_dots, on_common_lattice

TargetView = CornerView | BoardNotFound
VIEWS_TRIED = 8  # of each camera; the size that most of them show is the board's
LEAST_CORNERS = 12  # 3 x 4: what is smaller is found by chance among dots and shadows
LEAST_VIEWS = 2  # that must show the whole board


def find_target(
    left: Sequence[NDArray], right: Sequence[NDArray], target: Target, threads: int, progress: Progress | None = None
) -> tuple[Target, list[TargetView], list[TargetView]]:
    """The target's points in every image of both cameras; a lattice of dots comes back with the dots that are there."""
    images = [*left, *right]
    if isinstance(target, DotTarget):
        dots: dict[int, DotView | BoardNotFound] = {}
        for index, image in enumerate(images):
            dots[index] = find_dots(image, target)
            if progress:
                progress("corners", len(dots), len(images))
        target, views = on_common_lattice([dots[index] for index in range(len(images))], target)
    else:
        views = located(images, _finder(target), threads, progress)
    return target, views[: len(left)], views[len(left) :]


def _finder(target: Target) -> Callable[[NDArray, bool], TargetView]:
    if isinstance(target, Board):
        return lambda image, thorough: find_corners(image, target.inner_corners, thorough)
    if isinstance(target, CharucoBoard):
        from calibration.charuco import find_charuco

        return lambda image, _: find_charuco(image, target)
    if isinstance(target, CircleGrid):
        from disctrack.calibrate.circles import find_circles

        return lambda image, thorough: find_circles(image, target, thorough)
    raise TypeError(f"no finder for {target}")


def board_size(images: Sequence[NDArray]) -> tuple[tuple[int, int] | None, int]:
    """Inner corners (long side, short side) that most images show, and how many of them show these; None if none."""
    counts: Counter[tuple[int, int]] = Counter()
    flags = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_NORMALIZE_IMAGE
    greys = [np.asarray(grey_values(image)[0]) for image in images]
    for grey in greys:
        stretched = cv2.normalize(grey.astype(np.float32), None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)  # type: ignore[call-overload]
        found, _, squares = cv2.findChessboardCornersSBWithMeta(stretched, (3, 3), flags)
        if found and squares is not None and squares.size >= LEAST_CORNERS:
            short, long = sorted(squares.shape[:2])
            counts[long, short] += 1
    # part of a board is often taken for one: of sizes seen twice the largest, and then what `calibrate` itself finds
    for size, _ in sorted(counts.items(), key=lambda item: (item[1] < LEAST_VIEWS, -item[0][0] * item[0][1])):
        seen = sum(not isinstance(find_corners(grey, size), BoardNotFound) for grey in greys)
        if seen >= min(LEAST_VIEWS, len(images)):
            return size, seen
    return None, 0


def evenly(n: int, most: int) -> list[int]:
    """Numbers of at most `most` of n things, evenly over them."""
    return sorted({round(i) for i in np.linspace(0, n - 1, min(n, most))})


def other_board(left: Sequence[NDArray], right: Sequence[NDArray], target: Target) -> str:
    """The chessboard that the images show, in words, if it is another than was declared; otherwise ""."""
    if not isinstance(target, Board):
        return ""
    images = [side[i] for side in (left, right) for i in evenly(len(side), VIEWS_TRIED)]
    size, seen = board_size(images)
    if size is None or size == target.inner_corners:
        return ""
    shown = f"{size[0]} x {size[1]} inner corners, in {seen} of {len(images)} images"
    return f"Shown are {shown}: inner_corners = {list(size)}"
