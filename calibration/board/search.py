"""Search for a calibration target in many images; if it is missing, search for the board that they show instead."""

from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

from calibration.board.charuco import find_charuco
from calibration.board.chessboard import SEARCH_SIZE, BoardNotFound, Located, board_in, find_corners, luminance, reduced
from calibration.board.target import Board, Target
from calibration.kit.types import AnyArray, evenly

Progress = Callable[[str, int, int], None]
LEAST_VIEWS = 2  # with the whole board, for its size to be believed
SIZES_TRIED = 3  # most frequent board sizes that are tested
VIEWS_TRIED = 8  # sample of a set of images; if it shows no board, the slow search of the others is skipped


def located(images: Sequence[AnyArray], target: Target, progress: Progress | None = None) -> list[Located]:
    """The target in every image.

    The quick search is tried in all images, the slow one in those without a result. The search ends early if a sample
    of the images shows another board, or if the quick search found nothing and the slow one fails in a sample.
    """
    views: dict[int, Located] = {}

    def locate(index: int, thorough: bool) -> None:
        try:
            if isinstance(target, Board):
                views[index] = find_corners(images[index], target.inner_corners, thorough)
            else:
                views[index] = find_charuco(images[index], target)
        except ValueError as error:
            views[index] = BoardNotFound(str(error))
        if progress and not thorough:
            progress("corners", len(views), len(images))

    def lost(indices: list[int], thorough: bool) -> list[int]:
        """Images in which it is not found."""
        with ThreadPoolExecutor(2) as pool:  # OpenCV and the fit of corners release the interpreter lock
            list(pool.map(locate, indices, [thorough] * len(indices)))
        return [index for index in indices if isinstance(views[index], BoardNotFound)]

    sample = evenly(len(images), VIEWS_TRIED)
    without = lost(sample, False)
    if shown := other_board([images[i] for i in sample], [i in without for i in sample], target):
        return [BoardNotFound(f"{target} is not in it. {shown}")] * len(images)
    without += lost([i for i in range(len(images)) if i not in sample], False)
    tried = without if len(without) < len(images) else sample
    if lost(tried, True) != tried:
        lost([i for i in without if i not in tried], True)
    return [views[index] for index in range(len(images))]


def other_board(images: Sequence[AnyArray], refused: Sequence[bool], target: Target) -> str:
    """The chessboard that most images show instead of the declared one, in words; "" if there is none.

    refused : whether the declared one was not found in an image; if it was, its rim may be mistaken for a line
    """
    without = [image for image, lost in zip(images, refused, strict=True) if lost]
    if not isinstance(target, Board) or 2 * len(without) <= len(images):
        return ""
    size, _ = board_size([without[i] for i in evenly(len(without), VIEWS_TRIED // 2)], SEARCH_SIZE // 2)
    if size is None or size == target.inner_corners:
        return ""
    seen = sum(not isinstance(find_corners(image, size, thorough=False), BoardNotFound) for image in images)
    if seen < max(LEAST_VIEWS, 2 * (len(images) - len(without)), len(images) / 3):
        return ""
    return f"{seen} of {len(images)} images looked at show {size[0]} x {size[1]}: inner_corners = {list(size)}"


def board_size(images: Sequence[AnyArray], largest: int = SEARCH_SIZE) -> tuple[tuple[int, int] | None, int]:
    """Inner corners (long side, short side) of the board in most images, or None; and the number of these images.

    largest : [px] to which images are reduced: OpenCV's search takes 0.3 s at 800 x 600, 5.5 s at 4000 x 3000
    """
    greys = [reduced(luminance(image)[0], largest)[0] for image in images]
    seen: dict[tuple[int, int], int] = {}
    for thorough in (False, True):
        sizes = [board_in(grey, thorough) for grey in greys]
        counts = Counter(size for size in sizes if size)
        often = [size for size, n in counts.most_common(SIZES_TRIED) if n >= LEAST_VIEWS] or list(counts)[:SIZES_TRIED]
        # a shadow may hide a line, a rim may appear as another: the whole board is the size with most corners in total
        seen |= {size: counts[size] + _found(size, greys, sizes) for size in often}
        if 2 * max(seen.values(), default=0) >= len(images):
            break
    best = max(seen, key=lambda size: seen[size] * size[0] * size[1], default=None)
    return (best, seen[best]) if best and seen[best] >= min(LEAST_VIEWS, len(images)) else (None, 0)


def _found(size: tuple[int, int], greys: Sequence[AnyArray], sizes: Sequence[tuple[int, int] | None]) -> int:
    """Number of images with another size, or none, in which a search for this size succeeds."""
    others = [grey for grey, found in zip(greys, sizes, strict=True) if found != size]
    return sum(not isinstance(find_corners(grey, size), BoardNotFound) for grey in others)
