"""The largest part of the data for which something holds."""

from collections.abc import Callable


def most_that_hold(holds: Callable[[int], bool], least: int, whole: int, resolution: int = 1) -> int:
    """The most samples, fewer than the whole, for which `holds` is true; 0 if not even for the least.

    By bisection: it has to hold for fewer samples, too. The result is smaller by less than the resolution.
    """
    if least >= whole or not holds(least):
        return 0
    while whole - least > resolution:
        middle = (least + whole) // 2
        least, whole = (middle, whole) if holds(middle) else (least, middle)
    return least
