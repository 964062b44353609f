"""A calibration target of any kind, found in the images of both cameras."""

from collections import Counter
from collections.abc import Callable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.board.chessboard import SEARCH_SIZE, BoardNotFound, CornerView, board_in, find_corners, grey_values
from calibration.board.target import Board, CharucoBoard, CircleGrid, DotTarget, Target
from calibration.stereo import Progress, located
from disctrack.calibrate.dot_target import DotView, find_dots, on_common_lattice

TargetView = CornerView | BoardNotFound
VIEWS_TRIED = 8  # of each camera; the size that most of them show is the board's
LEAST_VIEWS = 2  # that must show the whole board
SIZES_TRIED = 3  # of those that several images seem to show
COMMON_SIZE = (9, 6)  # asked for where no size is seen: OpenCV's own board
REFUSED_TRIED = 4  # images without the declared board in which another is looked for, a quarter of a second each


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
        from calibration.board.charuco import find_charuco

        return lambda image, _: find_charuco(image, target)
    if isinstance(target, CircleGrid):
        from disctrack.calibrate.circles import find_circles

        return lambda image, thorough: find_circles(image, target, thorough)
    raise TypeError(f"no finder for {target}")


def board_size(images: Sequence[NDArray], largest: int = SEARCH_SIZE) -> tuple[tuple[int, int] | None, int]:
    """Inner corners (long side, short side) that most images show, and how many of them show these; None if none.

    largest : [px] larger images are reduced to that: OpenCV's search takes 0.3 s at 800 x 600, 5.5 s at 4000 x 3000
    """
    greys = [_reduced(grey_values(image)[0], largest) for image in images]
    seen: dict[tuple[int, int], int] = {}
    for thorough in (False, True):
        sizes = [board_in(grey, thorough) for grey in greys]
        counts = Counter(size for size in sizes if size)
        often = [size for size, n in counts.most_common(SIZES_TRIED) if n >= LEAST_VIEWS] or list(counts)[:SIZES_TRIED]
        # a shadow hides a line of the board, a rim passes for one more: the whole board is what most corners are on
        seen |= {size: counts[size] + _found(size, greys, sizes) for size in often}
        if 2 * max(seen.values(), default=0) >= len(images):
            break
    else:
        seen.setdefault(COMMON_SIZE, _found(COMMON_SIZE, greys, sizes))
    best = max(seen, key=lambda size: seen[size] * size[0] * size[1])
    return (best, seen[best]) if seen[best] >= min(LEAST_VIEWS, len(images)) else (None, 0)


def _found(size: tuple[int, int], greys: Sequence[NDArray], sizes: Sequence[tuple[int, int] | None]) -> int:
    """How many images of another size, or of none, show a board of this one where it is asked for."""
    others = [grey for grey, found in zip(greys, sizes, strict=True) if found != size]
    return sum(not isinstance(find_corners(grey, size), BoardNotFound) for grey in others)


def _reduced(grey: NDArray, largest: int) -> NDArray:
    """Grey values (h, w), or a smaller image of them whose longer side has the largest size allowed [px]."""
    scale = largest / max(grey.shape)
    return np.asarray(cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else grey)


def evenly(n: int, most: int) -> list[int]:
    """Numbers of at most `most` of n things, evenly over them."""
    return sorted({round(i) for i in np.linspace(0, n - 1, min(n, most))})


def other_board(images: Sequence[NDArray], views: Sequence[TargetView], target: Target) -> str:
    """The chessboard that images show in which the declared one was not found, in words; "" if there is none.

    views : what `find_target` made of the images. Where most of them show the board as declared, it is declared well,
    and what is seen in the others may be a part of it.
    """
    refused = [image for image, view in zip(images, views, strict=True) if isinstance(view, BoardNotFound)]
    if not isinstance(target, Board) or 2 * len(refused) < len(images):
        return ""
    tried = [refused[i] for i in evenly(len(refused), REFUSED_TRIED)]
    size, seen = board_size(tried, SEARCH_SIZE // 2)
    if size is None or size == target.inner_corners:
        return ""
    shown = f"{size[0]} x {size[1]} inner corners, in {seen} of {len(tried)} images looked at"
    return f"Shown are {shown}: inner_corners = {list(size)}"
