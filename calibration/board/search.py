"""A calibration target in many images: the quick search first; and which other board they show where it is not."""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor

from numpy.typing import NDArray

from calibration.board.charuco import find_charuco
from calibration.board.chessboard import (
    SEARCH_SIZE,
    BoardNotFound,
    CornerView,
    board_in,
    find_corners,
    luminance,
    reduced,
)
from calibration.board.target import Board, Target
from calibration.kit.arrays import evenly

Progress = Callable[[str, int, int], None]
LEAST_VIEWS = 2  # that must show the whole board
SIZES_TRIED = 3  # of those that several images seem to show
VIEWS_TRIED = 8  # over a whole set: what most of them show is the board; without one, the slow search waits


def located(
    images: Sequence[NDArray], target: Target, progress: Progress | None = None
) -> list[CornerView | BoardNotFound]:
    """The target in every image.

    All are searched quickly, and slowly those without it. Where a sample over all of them shows another board, or where
    none does quickly and of a sample none slowly, that is reason enough not to search on.
    """
    views: dict[int, CornerView | BoardNotFound] = {}

    def locate(index: int, thorough: bool) -> None:
        is_new, image = index not in views, images[index]
        try:
            if isinstance(target, Board):
                views[index] = find_corners(image, target.inner_corners, thorough)
            else:
                views[index] = find_charuco(image, target)
        except ValueError as error:
            views[index] = BoardNotFound(str(error))
        if progress and is_new:
            progress("corners", len(views), len(images))

    def lost(among: Iterable[int], thorough: bool) -> list[int]:
        """Those in which it is not found."""
        indices = list(among)
        with ThreadPoolExecutor(2) as pool:  # OpenCV and the fit of corners leave the interpreter to the other
            list(pool.map(locate, indices, [thorough] * len(indices)))
        return [index for index in indices if isinstance(views[index], BoardNotFound)]

    sample = evenly(len(images), VIEWS_TRIED)
    without = lost(sample, False)
    if shown := other_board([images[i] for i in sample], [i in without for i in sample], target):
        return [BoardNotFound(f"{target} is not in it. {shown}")] * len(images)
    without += lost(sorted(set(range(len(images))) - set(sample)), False)
    tried = [without[i] for i in evenly(len(without), VIEWS_TRIED)]
    if len(without) < len(images) or lost(tried, True) != tried:
        lost(without, True)
    return [views[index] for index in range(len(images))]


def other_board(images: Sequence[NDArray], refused: Sequence[bool], target: Target) -> str:
    """The chessboard that most images show in place of the declared one, in words; "" if there is none.

    refused : whether the declared one was not found in them; where it was, a rim may have passed for a line of it
    """
    without = [image for image, lost in zip(images, refused, strict=True) if lost]
    if not isinstance(target, Board) or 2 * len(without) <= len(images):
        return ""
    size, _ = board_size([without[i] for i in evenly(len(without), VIEWS_TRIED // 2)], SEARCH_SIZE // 2)
    if size is None or size == target.inner_corners:
        return ""
    seen = sum(isinstance(find_corners(image, size, thorough=False), CornerView) for image in images)
    if seen < max(LEAST_VIEWS, 2 * (len(images) - len(without)), len(images) / 3):
        return ""
    return f"{seen} of {len(images)} images looked at show {size[0]} x {size[1]}: inner_corners = {list(size)}"


def board_size(images: Sequence[NDArray], largest: int = SEARCH_SIZE) -> tuple[tuple[int, int] | None, int]:
    """Inner corners (long side, short side) that most images show, and how many of them show these; None if none.

    largest : [px] larger images are reduced to that: OpenCV's search takes 0.3 s at 800 x 600, 5.5 s at 4000 x 3000
    """
    greys = [reduced(luminance(image)[0], largest)[0] for image in images]
    seen: dict[tuple[int, int], int] = {}
    for thorough in (False, True):
        sizes = [board_in(grey, thorough) for grey in greys]
        counts = Counter(size for size in sizes if size)
        often = [size for size, n in counts.most_common(SIZES_TRIED) if n >= LEAST_VIEWS] or list(counts)[:SIZES_TRIED]
        # a shadow hides a line of the board, a rim passes for one more: the whole board is what most corners are on
        seen |= {size: counts[size] + _found(size, greys, sizes) for size in often}
        if 2 * max(seen.values(), default=0) >= len(images):
            break
    best = max(seen, key=lambda size: seen[size] * size[0] * size[1], default=None)
    return (best, seen[best]) if best and seen[best] >= min(LEAST_VIEWS, len(images)) else (None, 0)


def _found(size: tuple[int, int], greys: Sequence[NDArray], sizes: Sequence[tuple[int, int] | None]) -> int:
    """How many images of another size, or of none, show a board of this one where it is asked for."""
    others = [grey for grey, found in zip(greys, sizes, strict=True) if found != size]
    return sum(not isinstance(find_corners(grey, size), BoardNotFound) for grey in others)
