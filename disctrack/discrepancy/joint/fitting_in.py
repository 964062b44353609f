"""Which recordings are inconsistent with the others?

Two tests of each recording against all others. Shared quantities: do the values that it determines differ from those
that the others predict? Effects outside the model: does an effect of the catalogue (a tilted table, a misprinted dot, a
camera that was touched) have another size in it than in the others? An effect that the others do not determine at all
is no difference.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from calibration.kit.least_squares import triangle
from calibration.kit.types import Array
from disctrack.discrepancy.elimination import prior_rows
from disctrack.discrepancy.fit import Fit
from disctrack.discrepancy.joint.sharing import JointSystem
from disctrack.discrepancy.score import INVISIBLE
from disctrack.discrepancy.search import CLASS_GAIN
from disctrack.discrepancy.system import Candidate

NOISE = 2.0  # median decrease of chi-square over that of noise, up to which it is noise
REFIT_SHARE = 1e-2  # of a statistic: its error to first order, below which another fit has to decide
NAMED = 3  # effects that are named for one recording


@dataclass(frozen=True)
class ConsistencyTest:
    """One recording against all others."""

    statistic: float  # decrease of chi-square if it has its own values of the shared quantities
    degrees: int
    p_value: float
    chi_square: float  # of its data with the shared quantities
    differs_by: str = ""  # the effect whose size differs, where that is more significant


class Blocks:
    """Least-squares problem of every recording in the shared quantities, linearised at one point."""

    def __init__(self, system: JointSystem, fit: Fit, candidates: Sequence[Candidate] = ()) -> None:
        """Fit : of the joint system.   candidates : effects whose sizes may differ."""
        self.candidates = [c for c in candidates if not set(c.names) & set(fit.names)]
        new = {q.name: q.null for c in self.candidates for q in c.quantities}
        residual, every = system.linearise(new | fit.values, [*fit.names, *new])
        if not np.isfinite(every).all():  # an effect without a derivative
            self.candidates, new = [], {}
            residual, every = system.linearise(fit.values, fit.names)
        derivative, by_candidate = every[..., : len(fit.names)], every[..., len(fit.names) :]
        length = np.sqrt(np.sum(by_candidate**2, axis=(0, 1)))
        by_candidate = by_candidate / np.where(length > 0, length, 1.0)
        column = {name: i for i, name in enumerate(new)}
        self._columns = [[column[n] for n in c.names] for c in self.candidates]
        free = [i for i, q in enumerate(fit.quantities) if q.lower < fit.values[q.name] < q.upper]
        self.names = tuple(fit.names[i] for i in free)
        # (n, m, b + c + 1) by the shared quantities, by the sizes of the candidates, and the right side
        self._rows = np.concatenate([derivative[..., free], by_candidate, residual[..., None]], axis=-1)
        quantities = [fit.quantities[i] for i in free]
        prior, matrix = prior_rows(quantities, fit.values)
        self._prior = np.column_stack([matrix, np.zeros((len(prior), len(new))), prior])
        self._sigma = np.array([q.prior_sigma for q in quantities])
        self.chi_square = np.sum(residual**2, axis=1)

    def others(self, kept: Sequence[int]) -> Iterator[tuple[int, Array]]:
        """Each recording of `kept`, and the compressed rows (m, b + c + 1) of all others and of the priors.

        By prefix and suffix products, in linear time.
        """
        before, after = [triangle(self._prior)], [np.zeros((0, self._prior.shape[1]))]
        for k in kept[:-1]:
            before.append(triangle(np.concatenate([before[-1], self._rows[k]])))
        for k in kept[:0:-1]:
            after.append(triangle(np.concatenate([after[-1], self._rows[k]])))
        for i, *rest in zip(kept, before, reversed(after), strict=True):
            yield i, np.concatenate(rest)

    def consistency(self, i: int, others: Array) -> ConsistencyTest:
        """Recording i against the others.

        Chi-square of the combinations of shared quantities that the recording determines, against the prediction of the
        others. Combinations of errors of cameras and dots that it determines no better than the calibration are left
        out: their derivatives are mostly noise of its poses.
        """
        theirs, mine = others[:, : len(self.names)], self._rows[i][:, : len(self.names)]
        length = np.linalg.norm(mine, axis=0)
        # a quantity without a prior is left out only where the recording does not show it
        free = 1.0 / INVISIBLE / np.where(length > 0, length, 1.0)
        scale = np.where(np.isfinite(self._sigma), self._sigma, free)
        U, singular, _ = np.linalg.svd(mine * scale, full_matrices=False)
        U = U[:, singular > 1.0]
        least, rank = _least(others[:, -1], theirs)
        right = np.concatenate([others[:, -1], U.T @ self._rows[i][:, -1]])
        both, rank_of_both = _least(right, np.concatenate([theirs, U.T @ mine]))
        statistic, degrees = max(both - least, 0.0), U.shape[1] - (rank_of_both - rank)
        p = float(stats.chi2.sf(statistic, degrees)) if degrees > 0 else 1.0
        return ConsistencyTest(statistic, max(degrees, 0), p, float(self.chi_square[i]))

    def differences(self, i: int, others: Array) -> list[tuple[float, int]]:
        """Of each candidate: decrease of chi-square if recording i has a size of its own, and degrees of freedom.

        All shared quantities are free; under the null hypothesis the candidate has one size in all recordings.
        """
        b, c = len(self.names), others.shape[1] - len(self.names) - 1
        theirs = np.insert(others, [-1] * c, 0.0, axis=1)
        mine = np.insert(self._rows[i], [b] * c, 0.0, axis=1)
        left = triangle(np.concatenate([theirs, mine]))[b:, b:]  # shared quantities eliminated
        return [self._difference(left, columns, c) for columns in self._columns]

    def _difference(self, left: Array, columns: list[int], c: int) -> tuple[float, int]:
        """Left : (m, 2 c + 1) by the candidates' sizes in the others, by those in the recording, and the residuals."""
        theirs, mine, right = left[:, columns], left[:, [c + j for j in columns]], left[:, -1]
        one, rank_of_one = _least(right, theirs + mine)
        two, rank_of_two = _least(right, np.concatenate([theirs, mine], axis=1))
        return max(one - two, 0.0), rank_of_two - rank_of_one


def _least(right: Array, matrix: Array) -> tuple[float, int]:
    """Smallest sum of squares of right - matrix x, and how many combinations of the columns are determined."""
    length = np.linalg.norm(matrix, axis=0)
    scaled = matrix[:, length > INVISIBLE] / length[length > INVISIBLE]
    x, _, rank, _ = np.linalg.lstsq(scaled, right, rcond=INVISIBLE)
    return float(np.sum((right - scaled @ x) ** 2)), int(rank)


def all_consistencies(blocks: Blocks, kept: Sequence[int]) -> dict[int, tuple[ConsistencyTest, ConsistencyTest]]:
    """Each recording of `kept` against the others: by shared quantities, and by the more significant of two tests.

    The other test is that of the most significant candidate. Where the size of a candidate has intrinsic scatter over
    all recordings, as in every laboratory a little, its chi-square is scaled by it; its p has the trials penalty of the
    candidates.
    """
    found, falls = dict[int, tuple[ConsistencyTest, ConsistencyTest]](), dict[int, list[tuple[float, int]]]()
    for i, others in blocks.others(kept):
        found[i], falls[i] = (blocks.consistency(i, others),) * 2, blocks.differences(i, others)
    scatter = _scatter(blocks, falls)
    for i, fall in falls.items():
        significant = [
            (2.0 * len(falls[i]) * float(stats.chi2.sf(difference / scatter[k], degrees)), -difference, degrees, k)
            for k, (difference, degrees) in enumerate(fall)
            if degrees > 0
        ]
        if not significant:
            continue
        (p, minus, degrees, k), shared = min(significant), found[i][0]
        words = _named_difference(blocks, [(-x, d, k) for _, x, d, k in significant], shared.statistic)
        judged = shared = replace(shared, differs_by=words)
        if (p, minus) < (shared.p_value, -shared.statistic):
            judged = replace(shared, statistic=-minus / scatter[k], degrees=degrees, p_value=min(p, 1.0))
        found[i] = shared, judged
    return found


def _named_difference(blocks: Blocks, standing: Sequence[tuple[float, int, int]], shared: float) -> str:
    """The most significant effects, those with the fewest parameters first; none where shared quantities differ more.

    By chi-square without scaling, as the scatter may be a nonlinear effect of this very recording.
    standing : decrease of chi-square, its degrees of freedom, and index of each candidate
    shared : decrease of chi-square with own values of the shared quantities
    """
    most = max(difference for difference, _, _ in standing)
    if most < shared:
        return ""
    similar = [(d, -x, k) for x, d, k in standing if most - x < max(CLASS_GAIN, REFIT_SHARE * most)]
    first, *others = (blocks.candidates[k] for _, _, k in sorted(similar)[:NAMED])
    return f"{first.title} [{first.name}]" + "".join(f" or [{c.name}]" for c in others)


def _scatter(blocks: Blocks, falls: dict[int, list[tuple[float, int]]]) -> list[float]:
    """Of each candidate: intrinsic scatter of its sizes over the recordings, as a factor on chi-square; 1 for noise.

    Robust: the third of the recordings that differ most is trimmed, and the median is corrected for the trimming.
    """

    def log_p(fall: list[tuple[float, int]]) -> float:
        return min((float(stats.chi2.logsf(x, degrees)) for x, degrees in fall if degrees > 0), default=0.0)

    calm = sorted(falls, key=lambda i: -log_p(falls[i]))[: len(falls) - len(falls) // 3]
    found, aside = [], float(stats.chi2.ppf(1 / 2, 1) / stats.chi2.ppf(1 / 3, 1))
    among = [blocks.differences(*each) for each in blocks.others(sorted(calm))] if len(calm) > 2 else []
    for k in range(len(blocks.candidates)):
        usual = [fall[k][0] / stats.chi2.median(fall[k][1]) for fall in among if fall[k][1] > 0]
        ratio = float(np.median(usual)) if usual else 1.0
        found.append(aside * ratio if ratio > NOISE else 1.0)
    return found


def inconsistent(blocks: Blocks, level: float, most: int | None = None) -> dict[int, str]:
    """Recordings that are inconsistent with the others, the worst first, and the effect by which they differ, if known.

    level : false-alarm probability over all recordings
    most : largest number of recordings that may be removed; by default a third
    Each is tested against the remaining ones, to first order about a fit that the first one has biased: much smaller
    statistics have to be tested after another fit. Of two recordings, each of which is consistent without the other
    (as where only these two have the same disc), either may be wrong: both are named.
    """
    n = len(blocks.chi_square)
    kept, named, first = list(range(n)), dict[int, str](), 0.0
    most = n // 3 if most is None else most
    while len(kept) > 2 and len(named) < most:
        judged = {i: worse for i, (_, worse) in all_consistencies(blocks, kept).items()}
        worst, second, *_ = sorted(
            kept, key=lambda i: (judged[i].p_value, -judged[i].statistic / max(judged[i].degrees, 1))
        )
        statistic = judged[worst].statistic
        if judged[worst].p_value * n > level or statistic < REFIT_SHARE * first:
            break
        first = first or statistic
        twins = _interchangeable(blocks, (second, worst), kept, level / n, REFIT_SHARE * first)
        for i in (worst, *[second] * twins)[: most - len(named)]:
            kept.remove(i)
            named[i] = judged[i].differs_by
    return named


def _interchangeable(blocks: Blocks, pair: tuple[int, int], kept: Sequence[int], level: float, small: float) -> bool:
    """Is each of the two consistent with `kept` without the other?   small : a statistic below it is not significant"""
    without = (all_consistencies(blocks, [k for k in kept if k != other])[i][1] for i, other in (pair, pair[::-1]))
    return not any(judged.p_value <= level and judged.statistic >= small for judged in without)
