"""Numbers that move together in a fit: how strongly, and which combination of them is well known."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from disctrack.discrepancy.fit import Fit

STRONG = 0.9  # of a correlation, from which on a standard deviation alone misleads by more than twice


@dataclass(frozen=True)
class Correlated:
    """Two fitted quantities, and first + factor * second with the factor that makes it known best."""

    first: str
    second: str
    correlation: float
    factor: float  # in the unit of the first per unit of the second
    value: float  # of the combination, in the unit of the first
    sigma: float


def correlated(fit: Fit, names: Sequence[str], among: Sequence[str], strong: float = STRONG) -> tuple[Correlated, ...]:
    """The strongest partner of each of `names`, from `among`; every pair once, and only where it is strong."""
    found: dict[frozenset[str], Correlated] = {}
    index = {name: i for i, name in enumerate(fit.shared)}
    for first in names:
        pairs = [pair for second in among if second != first and (pair := _pair(fit, index, first, second))]
        best = max(pairs, key=lambda p: abs(p.correlation), default=None)
        if best is not None and abs(best.correlation) >= strong:
            found.setdefault(frozenset((best.first, best.second)), best)
    return tuple(found.values())


def _pair(fit: Fit, index: dict[str, int], first: str, second: str) -> Correlated | None:
    if first not in index or second not in index:
        return None
    chosen = [index[first], index[second]]
    (a, cross), (_, b) = fit.covariance[np.ix_(chosen, chosen)]
    if not (a > 0 and b > 0):  # one stands at a bound
        return None
    factor = float(-cross / b)
    value = fit.values[first] + factor * fit.values[second]
    rho = float(np.clip(cross / np.sqrt(a * b), -1.0, 1.0))
    return Correlated(first, second, rho, factor, float(value), float(np.sqrt(max(a - cross * cross / b, 0.0))))
