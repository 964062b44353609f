"""The same function on parts of the frames, by several threads."""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Part = TypeVar("Part")
Answer = TypeVar("Answer")


def side_by_side(function: Callable[[Part], Answer], parts: Iterable[Part], workers: int) -> list[Answer]:
    """What the function makes of each part, in their order.

    NumPy lets go of the interpreter where arrays are large: parts of some hundred frames are worked on side by side.
    """
    parts = list(parts)
    if min(workers, len(parts)) < 2:
        return [function(part) for part in parts]
    with ThreadPoolExecutor(workers, thread_name_prefix="part") as pool:
        return list(pool.map(function, parts))
