"""Which recordings do not fit the others?"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from calibration.arrays import Array
from disctrack.diagnosis.engine.fit import Fit, prior_rows, triangle
from disctrack.diagnosis.together.joint import JointSystem

LAW = 1e6  # sigmas: length to which the derivative by a number without a prior is scaled, so that it is never left out
SPOILT = 1e-2  # of the first one's statistic: by so much less the others may be judged wrongly where it moved the fit
TWIN = 0.5  # of the statistic of the one that fits worst, from which on another may be the one that is wrong
DETERMINED = 3.0  # sigmas that a prior's sigma makes in a recording, from which the recording itself tells of it


@dataclass(frozen=True)
class FitsIn:
    """One recording against all others."""

    statistic: float  # chi-square that falls when it may have shared quantities of its own
    degrees: int
    p_value: float
    chi_square: float  # of its data with the shared quantities


class Blocks:
    """Every recording's least-squares problem in the shared quantities, at one point."""

    def __init__(self, system: JointSystem, fit: Fit) -> None:
        """Fit : of the joint system."""
        residual, derivative = system.linearise(fit.values, fit.names)
        free = [i for i, q in enumerate(fit.quantities) if q.lower < fit.values[q.name] < q.upper]
        self.names = tuple(fit.names[i] for i in free)
        self.right, self.matrix = residual, derivative[..., free]
        quantities = [fit.quantities[i] for i in free]
        self.prior = prior_rows(quantities, fit.values)
        self._sigma = np.array([q.prior_sigma for q in quantities])
        self.chi_square = np.sum(residual**2, axis=1)

    def others(self, kept: list[int]) -> tuple[Array, Array]:
        """The problem (right, matrix) of these recordings and the priors together, compressed."""
        right = np.concatenate([self.right[kept].reshape(-1), self.prior[0]])
        matrix = np.concatenate([self.matrix[kept].reshape(len(right) - len(self.prior[0]), -1), self.prior[1]])
        R = triangle(np.column_stack([matrix, right]))
        return R[:, -1], R[:, :-1]

    def fits_in(self, i: int, kept: list[int]) -> FitsIn:
        """Recording i against those of `kept` that it is not.

        What the others foretell of the combinations of shared quantities that the recording itself determines, in
        sigmas of both: chi-square of as many degrees. Combinations of cameras' and dots' errors that the recording
        knows no better than the calibration does are left out: their derivatives are mostly noise of its poses.
        """
        rest = self.others([k for k in kept if k != i])
        length = np.linalg.norm(self.matrix[i], axis=0)
        scale = np.where(np.isfinite(self._sigma), self._sigma, LAW / np.where(length > 0, length, 1.0))
        U, singular, _ = np.linalg.svd(self.matrix[i] * scale, full_matrices=False)
        U = U[:, singular > DETERMINED]
        mine = U.T @ self.right[i], U.T @ self.matrix[i]
        together = np.concatenate([rest[0], mine[0]]), np.concatenate([rest[1], mine[1]])
        least, rank = _least(*rest, scale)
        both, rank_of_both = _least(*together, scale)
        statistic, degrees = max(both - least, 0.0), U.shape[1] - (rank_of_both - rank)
        p = float(stats.chi2.sf(statistic, degrees)) if degrees > 0 else 1.0
        return FitsIn(statistic, max(degrees, 0), p, float(self.chi_square[i]))


def _least(right: Array, matrix: Array, scale: Array) -> tuple[float, int]:
    """Smallest sum of squares of right - matrix x, and how many combinations of x the matrix determines."""
    x, _, rank, _ = np.linalg.lstsq(matrix * scale, right, rcond=1e-12)
    return float(np.sum((right - matrix @ (scale * x)) ** 2)), int(rank)


def apart(system: JointSystem, fit: Fit, level: float, most: int | None = None) -> list[int]:
    """Recordings that do not fit the others, one after the other, the worst first.

    level : probability that one recording of many that do fit is named
    most : that may be taken away; a third of them, if not given
    Each is judged by those that are left, to first order about a fit that the first one has moved: those that stand out
    by far less than it did have to be judged after another fit. Of two either of which fits without the other, as where
    nobody else has their disc, nobody knows which is wrong: both are named.
    """
    n = len(system.time)
    blocks = Blocks(system, fit)
    kept, named, first = list(range(n)), list[int](), 0.0
    most = n // 3 if most is None else most
    while len(kept) > 2 and len(named) < most:
        judged = {i: blocks.fits_in(i, kept) for i in kept}
        worst = max(judged, key=lambda i: (-judged[i].p_value, judged[i].statistic / max(judged[i].degrees, 1)))
        statistic = judged[worst].statistic
        if judged[worst].p_value * n > level or statistic < SPOILT * first:
            break
        first = first or statistic
        alike = [i for i in kept if i != worst and judged[i].statistic > TWIN * statistic]
        twins = [i for i in alike if _either_fits(blocks, (i, worst), kept, level / n, SPOILT * first)]
        for i in (worst, *twins[:1])[: most - len(named)]:
            kept.remove(i)
            named.append(i)
    return named


def _either_fits(blocks: Blocks, pair: tuple[int, int], kept: Sequence[int], level: float, small: float) -> bool:
    """Does each of the two fit those of `kept` but the other?   small : a statistic that tells nothing"""
    for i, other in (pair, pair[::-1]):
        judged = blocks.fits_in(i, [k for k in kept if k != other])
        if judged.p_value <= level and judged.statistic >= small:
            return False
    return True
