"""The lowest place of a function of a few variables by the simplex of Nelder and Mead (1965).

In the order of steps of Lagarias et al. 1998, SIAM J. Optim. 9, 112, section 2, and from the start that is usual: each
variable in turn made larger by a twentieth. `scipy.optimize` does the same, and takes a quarter of a second to import.
"""

from collections.abc import Callable

import numpy as np

from calibration.arrays import Array

LARGER, FROM_NOUGHT = 1.05, 2.5e-4  # what a variable of the start is multiplied by; what it becomes where it is nought
STEPS = 200  # at most, per variable


def lowest(function: Callable[[Array], float], start: Array, near: float, alike: float) -> tuple[Array, float]:
    """Place (p,) and value of a minimum found from `start` (p,).

    It ends when no corner lies farther than `near` from the best, in any variable, nor higher by more than `alike`.
    """
    count = len(start)
    corners = np.tile(np.asarray(start, float), (count + 1, 1))
    for i in range(count):
        corners[i + 1, i] = LARGER * corners[i + 1, i] if corners[i + 1, i] != 0 else FROM_NOUGHT
    values = np.array([function(corner) for corner in corners])
    for _ in range(STEPS * count):
        order = np.argsort(values)
        corners, values = corners[order], values[order]
        if np.abs(corners[1:] - corners[0]).max() <= near and np.abs(values[1:] - values[0]).max() <= alike:
            break
        middle, worst = corners[:-1].sum(axis=0) / count, corners[-1]

        def at(factor: float, middle: Array = middle, worst: Array = worst) -> tuple[Array, float]:
            """The place so many times as far from the middle as the worst corner, on the other side."""
            place = (1.0 + factor) * middle - factor * worst
            return place, function(place)

        reflected = at(1.0)
        best_so_far, second_worst = values[0], values[-2]
        if reflected[1] < best_so_far:
            expanded = at(2.0)
            taken = expanded if expanded[1] < reflected[1] else reflected
        elif reflected[1] < second_worst:
            taken = reflected
        else:
            outside = reflected[1] < values[-1]
            taken = at(0.5 if outside else -0.5)
            if not (taken[1] <= reflected[1] if outside else taken[1] < values[-1]):  # towards the best corner, all
                corners[1:] = corners[0] + 0.5 * (corners[1:] - corners[0])
                values[1:] = [function(corner) for corner in corners[1:]]
                continue
        corners[-1], values[-1] = taken
    best = int(np.argmin(values))
    return corners[best], float(values[best])
