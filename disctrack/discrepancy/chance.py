"""With which probability would noise alone let some effect of the catalogue gain as much as the best one did?

To first order all gains are lengths of projections of one vector of noise, and candidates overlap: fifty of them are
fewer independent chances than fifty. Vectors of noise are drawn and put to the same candidates, so that the
probability counts the looking, the overlap, and bounds that let an effect act one way only.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from calibration.kit.arrays import Array
from disctrack.discrepancy.score import INVISIBLE, Linearisation, Score
from disctrack.discrepancy.significance import log_tail

DRAWS = 4000
LAST = 40  # of the draws that are largest: beyond them the tail is that of one chance, times their number
SEED = 20261122


@dataclass(frozen=True)
class Chance:
    """Of the largest gain."""

    p_value: float  # uniform between 0 and 1 where nothing is missing
    tests: float  # independent candidates that would have such a largest gain


def chance(linear: Linearisation, scores: Sequence[Score], noise: float, draws: int = DRAWS) -> Chance:
    """Of the best of these scores, which were taken at `linear`. noise : variance over that stated.

    Candidates beyond a threshold have no first order and do not count.
    """
    visible = [s for s in scores if s.visible and not s.candidate.threshold]
    if not visible:
        return Chance(1.0, 0.0)
    observed = max(-log_tail(s.gain / noise, len(s.candidate.names)) for s in visible)
    bases = [_directions(linear, s.candidate.names) for s in visible]
    vectors = np.random.default_rng(SEED).standard_normal((draws, len(linear.right)))
    largest = np.zeros(draws)
    for s, basis in zip(visible, bases, strict=True):
        along = vectors @ basis
        quantities = [linear.quantities[n] for n in s.candidate.names]
        if len(quantities) == 1 and linear.values[quantities[0].name] <= quantities[0].lower:
            along = np.maximum(along, 0.0)  # an effect that may only brake
        tail = stats.chi2.logsf(np.sum(along**2, axis=1), len(s.candidate.names))
        np.maximum(largest, -tail, out=largest)
    return _among(observed, np.sort(largest))


def _directions(linear: Linearisation, names: Sequence[str]) -> Array:
    """Orthonormal (m, k) of what these can predict and the fitted quantities cannot; a single one keeps its sign."""
    columns = linear.columns(names)
    cleared = linear.cleared(columns)
    before, after = np.linalg.norm(columns, axis=0), np.linalg.norm(cleared, axis=0)
    cleared = cleared[:, after > INVISIBLE * np.maximum(before, 1e-300)]
    cleared = cleared / np.linalg.norm(cleared, axis=0)
    if cleared.shape[1] == 1:
        return cleared
    U, singular, _ = np.linalg.svd(cleared, full_matrices=False)
    return np.asarray(U[:, singular > INVISIBLE * singular[0]], float)


def _among(observed: float, sorted_draws: Array) -> Chance:
    """Share of the draws at or above what was observed; beyond the largest of them, by the tail of single chances."""
    n = len(sorted_draws)
    last = float(sorted_draws[-min(LAST, n)])
    tests = min(LAST, n) / n * float(np.exp(last))
    if observed < last:
        above = n - int(np.searchsorted(sorted_draws, observed))
        return Chance(above / n, tests)
    return Chance(float(tests * np.exp(-observed)), tests)
