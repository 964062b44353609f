"""Which recordings do not fit the others?

Two tests of each against all others. Of what they share: do the numbers that it determines differ from those that the
others predict? Of what the model does not hold: does an effect of the catalogue (a table that leans, a dot misprinted,
a camera that was touched) have another size in it than in the others? Of an effect that the others do not see at all it
may have any size, and nobody differs by it.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
from scipy import stats

from calibration.kit.arrays import Array
from calibration.kit.least_squares import triangle
from disctrack.discrepancy.elimination import prior_rows
from disctrack.discrepancy.fit import Fit
from disctrack.discrepancy.joint.sharing import JointSystem
from disctrack.discrepancy.score import INVISIBLE
from disctrack.discrepancy.search import CLASS_GAIN
from disctrack.discrepancy.system import Candidate

SPOILT = 1e-2  # of the first one's statistic: by so much less the others may be judged wrongly where it moved the fit
TWIN = 0.5  # of the statistic of the one that fits worst, from which on another may be the one that is wrong

NOISE = 2.0  # median of some falls of chi-square over that of noise, up to which it is noise

ALIKE_SHARE = 0.05  # of all that it tells, which is to first order
STANDS_OUT = 0.05  # probability below which it tells something
NAMED = 3  # effects that one recording may differ by
DETERMINED = 3.0  # sigmas that a prior's sigma makes in a recording, from which the recording itself tells of it


@dataclass(frozen=True)
class FitsIn:
    """One recording against all others."""

    statistic: float  # chi-square that falls when it may have shared quantities of its own
    degrees: int
    p_value: float
    chi_square: float  # of its data with the shared quantities
    differs_by: str = ""  # the effect that has another size in it, where that tells most


class Blocks:
    """Every recording's least-squares problem in the shared quantities, at one point."""

    def __init__(self, system: JointSystem, fit: Fit, candidates: Sequence[Candidate] = ()) -> None:
        """Fit : of the joint system.   candidates : that a recording may have in another size than the others."""
        self.candidates = [c for c in candidates if not set(c.names) & set(fit.names)]
        new = {q.name: q.null for c in self.candidates for q in c.quantities}
        residual, every = system.linearise(new | fit.values, [*fit.names, *new])
        if not np.isfinite(every).all():  # some effect has no derivative there
            self.candidates, new = [], {}
            residual, every = system.linearise(fit.values, fit.names)
        derivative, self._by_candidate = every[..., : len(fit.names)], every[..., len(fit.names) :]
        length = np.sqrt(np.sum(self._by_candidate**2, axis=(0, 1)))
        self._by_candidate = self._by_candidate / np.where(length > 0, length, 1.0)
        column = {name: i for i, name in enumerate(new)}
        self._columns = [[column[n] for n in c.names] for c in self.candidates]
        free = [i for i, q in enumerate(fit.quantities) if q.lower < fit.values[q.name] < q.upper]
        self.names = tuple(fit.names[i] for i in free)
        self.right, self.matrix = residual, derivative[..., free]
        quantities = [fit.quantities[i] for i in free]
        self.prior = prior_rows(quantities, fit.values)
        self._sigma = np.array([q.prior_sigma for q in quantities])
        self.chi_square = np.sum(residual**2, axis=1)

    def others(self, kept: Sequence[int]) -> Iterator[tuple[int, Array]]:
        """Each recording of `kept`, and rows (m, b + c + 1) of what the others say, and what is known beforehand.

        They are by what is shared, by the candidates' sizes, and the right side. No recording is passed over twice.
        """
        c = self._by_candidate.shape[-1]
        rows = [np.concatenate([self.matrix[k], self._by_candidate[k], self.right[k][:, None]], axis=1) for k in kept]
        prior = np.concatenate([self.prior[1], np.zeros((len(self.prior[0]), c)), self.prior[0][:, None]], axis=1)
        before, after = [triangle(prior)], [np.zeros((0, prior.shape[1]))]
        for block in rows[:-1]:
            before.append(triangle(np.concatenate([before[-1], block])))
        for block in rows[:0:-1]:
            after.append(triangle(np.concatenate([after[-1], block])))
        for i, *rest in zip(kept, before, reversed(after), strict=True):
            yield i, np.concatenate(rest)

    def fits_in(self, i: int, others: Array) -> FitsIn:
        """Recording i against the others.

        What the others predict of the combinations of shared quantities that the recording itself determines, in
        sigmas of both: chi-square of as many degrees. Combinations of cameras' and dots' errors that the recording
        knows no better than the calibration does are left out: their derivatives are mostly noise of its poses.
        """
        rest = others[:, -1], others[:, : len(self.names)]
        length = np.linalg.norm(self.matrix[i], axis=0)
        # without a prior a number is left out only where the recording sees nothing of it
        free = 1.0 / INVISIBLE / np.where(length > 0, length, 1.0)
        scale = np.where(np.isfinite(self._sigma), self._sigma, free)
        U, singular, _ = np.linalg.svd(self.matrix[i] * scale, full_matrices=False)
        U = U[:, singular > DETERMINED]
        mine = U.T @ self.right[i], U.T @ self.matrix[i]
        together = np.concatenate([rest[0], mine[0]]), np.concatenate([rest[1], mine[1]])
        least, rank = _least(*rest)
        both, rank_of_both = _least(*together)
        statistic, degrees = max(both - least, 0.0), U.shape[1] - (rank_of_both - rank)
        p = float(stats.chi2.sf(statistic, degrees)) if degrees > 0 else 1.0
        return FitsIn(statistic, max(degrees, 0), p, float(self.chi_square[i]))

    def differences(self, i: int, others: Array) -> list[tuple[float, int]]:
        """Of each candidate: fall of chi-square where recording i has a size of its own, and of degrees.

        All that is shared is free; the candidate has one size for the others, which is its own size, too, before.
        """
        c, b = self._by_candidate.shape[-1], len(self.names)
        theirs = np.concatenate([others[:, :-1], np.zeros((len(others), c)), others[:, -1:]], axis=1)
        own = self._by_candidate[i]
        mine = np.concatenate([self.matrix[i], 0 * own, own, self.right[i][:, None]], axis=1)
        left = triangle(np.concatenate([theirs, mine]))[b:, b:]  # what is shared takes its best values
        return [self._difference(left, columns, c) for columns in self._columns]

    def _difference(self, left: Array, columns: list[int], c: int) -> tuple[float, int]:
        """Left : (m, 2 c + 1) by the candidates' sizes in the others, in the recording itself, and what is left."""
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


def against_the_others(blocks: Blocks, kept: list[int]) -> dict[int, FitsIn]:
    """Each recording of `kept` against the others, by what is shared or by the candidates that tell most.

    Where the candidates' sizes scatter over all recordings by more than the noise, as in every laboratory a little, a
    recording has to stand out of that. p is the smaller of both tests', for the number of candidates.
    """
    found, falls = dict[int, FitsIn](), dict[int, list[tuple[float, int]]]()
    for i, others in blocks.others(kept):
        found[i], falls[i] = blocks.fits_in(i, others), blocks.differences(i, others)
    scatter = _scatter(blocks, falls)
    for i, fall in falls.items():
        told = [
            (2.0 * len(falls[i]) * float(stats.chi2.sf(difference / scatter[k], degrees)), -difference, degrees, k)
            for k, (difference, degrees) in enumerate(fall)
            if degrees > 0
        ]
        if not told:
            continue
        (p, minus, degrees, k), own = min(told), found[i]
        words = _differs_by(blocks, [(-x, d, k) for p, x, d, k in told if p < STANDS_OUT], own.statistic)
        if (p, minus) < (own.p_value, -own.statistic):
            own = replace(own, statistic=-minus / scatter[k], degrees=degrees, p_value=min(p, 1.0))
        found[i] = replace(own, differs_by=words)
    return found


def _differs_by(blocks: Blocks, standing: Sequence[tuple[float, int, int]], shared: float) -> str:
    """The effects that tell most, those with the fewest numbers first; none where what is shared tells more.

    By the chi-square alone: what scatters among the others may be what first order leaves of this recording.
    standing : difference of chi-square, its degrees, and number of each candidate that tells something
    shared : fall of chi-square with shared numbers of its own
    """
    most = max((difference for difference, _, _ in standing), default=0.0)
    if most < shared or not standing:
        return ""
    alike = [(d, -x, k) for x, d, k in standing if most - x < max(CLASS_GAIN, ALIKE_SHARE * most)]
    first, *others = (blocks.candidates[k] for _, _, k in sorted(alike)[:NAMED])
    return f"{first.title} [{first.name}]" + "".join(f" or [{c.name}]" for c in others)


def _scatter(blocks: Blocks, falls: dict[int, list[tuple[float, int]]]) -> list[float]:
    """Of each candidate: by how much its sizes scatter over the recordings, as a factor on chi-square; 1 for noise.

    One recording that stands apart draws the sizes of the others away from all of them: those that stand out most are
    left aside, a third of them, and what they would have added to the scatter is put back on.
    """

    def stands_out(fall: list[tuple[float, int]]) -> float:
        return min((float(stats.chi2.logsf(x, degrees)) for x, degrees in fall if degrees > 0), default=0.0)

    calm = sorted(falls, key=lambda i: -stands_out(falls[i]))[: len(falls) - len(falls) // 3]
    found, aside = [], float(stats.chi2.ppf(1 / 2, 1) / stats.chi2.ppf(1 / 3, 1))
    among = [blocks.differences(*each) for each in blocks.others(sorted(calm))] if len(calm) > 2 else []
    for k in range(len(blocks.candidates)):
        usual = [fall[k][0] / stats.chi2.median(fall[k][1]) for fall in among if fall[k][1] > 0]
        ratio = float(np.median(usual)) if usual else 1.0
        found.append(aside * ratio if ratio > NOISE else 1.0)
    return found


def apart(
    system: JointSystem, fit: Fit, level: float, most: int | None = None, candidates: Sequence[Candidate] = ()
) -> dict[int, str]:
    """Recordings that do not fit the others, the worst first, and what they differ by where an effect tells it.

    level : probability that one recording of many that do fit is named
    most : that may be taken away; a third of them, if not given
    candidates : effects of which a recording may have another size than the others
    Each is judged by those that are left, to first order about a fit that the first one has moved: those that stand out
    by far less than it did have to be judged after another fit. Of two either of which fits without the other, as where
    nobody else has their disc, nobody knows which is wrong: both are named.
    """
    n = len(system.time)
    blocks = Blocks(system, fit, candidates)
    kept, named, first = list(range(n)), dict[int, str](), 0.0
    most = n // 3 if most is None else most
    while len(kept) > 2 and len(named) < most:
        judged = against_the_others(blocks, kept)
        worst = max(judged, key=lambda i: (-judged[i].p_value, judged[i].statistic / max(judged[i].degrees, 1)))
        statistic = judged[worst].statistic
        if judged[worst].p_value * n > level or statistic < SPOILT * first:
            break
        first = first or statistic
        alike = [i for i in kept if i != worst and judged[i].statistic > TWIN * statistic]
        alike = sorted(alike, key=lambda i: -judged[i].statistic)
        twins = (i for i in alike if _either_fits(blocks, (i, worst), kept, level / n, SPOILT * first))
        for i in (worst, *islice(twins, 1))[: most - len(named)]:
            kept.remove(i)
            named[i] = judged[i].differs_by
    return named


def _either_fits(blocks: Blocks, pair: tuple[int, int], kept: Sequence[int], level: float, small: float) -> bool:
    """Does each of the two fit those of `kept` but the other?   small : a statistic that tells nothing"""
    without = (against_the_others(blocks, [k for k in kept if k != other])[i] for i, other in (pair, pair[::-1]))
    return not any(judged.p_value <= level and judged.statistic >= small for judged in without)
