"""A calibration target of any kind, found in the images of both cameras."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from numpy.typing import NDArray

from calibration.board import Board, CharucoBoard, CircleGrid, DotTarget, Target
from calibration.chessboard import BoardNotFound, CornerView, find_corners
from calibration.stereo import Progress, located
from disctrack.calibrate.dot_target import DotView, find_dots, on_common_lattice

TargetView = CornerView | BoardNotFound


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
