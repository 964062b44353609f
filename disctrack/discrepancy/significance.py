"""How surprising a gain of chi-square is, and whether a residual is noise.

To first order all gains over a catalogue are lengths of projections of one vector of noise, and candidates overlap:
fifty of them are fewer independent chances than fifty. So vectors of noise are drawn and put to the same candidates:
the probability counts the looking, the overlap, and bounds that let an effect act one way only.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy import signal, special, stats

from calibration.kit.arrays import Array
from disctrack.discrepancy.score import Linearisation, Score, span

TWO_SIDED = float(stats.norm.isf(0.025))  # sigmas: 95 % between both limits
LARGE = 500.0  # chi-square beyond which its tail is taken from the asymptotic series: the probability underflows


def log_tail(gain: float, n: int) -> float:
    """Logarithm of the probability with which noise gains so much by n numbers."""
    if not gain > 0:
        return 0.0
    if gain < LARGE:
        return float(stats.chi2.logsf(gain, n))
    x, a = gain / 2, n / 2  # Gamma(a, x) = x^(a-1) e^-x (1 + (a-1)/x + (a-1)(a-2)/x^2 + ...)
    series = 1 + (a - 1) / x + (a - 1) * (a - 2) / x**2 + (a - 1) * (a - 2) * (a - 3) / x**3
    return float((a - 1) * np.log(x) - x + np.log(series) - special.gammaln(a))


def price_of_a_number(weights: Array) -> float:
    """Chi-square that one more number has to gain, of samples with these weights (n,) (Schwarz 1978)."""
    return float(np.log(np.sum(weights)))


def as_sigmas(gain: float, n: int) -> float:
    """Sigmas whose two-sided probability is that of noise gaining so much by n numbers; for one, the root of the gain.

    No pay is taken here for having looked among many candidates: that is what thresholds are for.
    """
    return float(-special.ndtri_exp(log_tail(gain, n) - np.log(2.0))) if gain > 0 else 0.0


def wald(amounts: Array, covariance: Array) -> float:
    """Gain a' C^-1 a of amounts a (k,) with covariance C (k, k); what has no variance gains nothing (Wald 1943)."""
    sigma = np.sqrt(np.diag(covariance))
    safe = np.where(sigma > 0, sigma, np.inf)  # a number at its bound, or that the data do not show, tells nothing
    inverse = np.linalg.pinv(covariance / np.outer(safe, safe), rcond=1e-10, hermitian=True)
    return float((amounts / safe) @ inverse @ (amounts / safe))


def evidence(shown: Array, along: Array, sizes: Array) -> Array:
    """-2 log evidence (s,), but for a constant, of a normal process of these prior sizes (MacKay 1992).

    shown : (k,) singular values of what it adds to the whitened data, for size 1.   along : (k,) the residual there
    """
    power = (sizes[:, None] * shown) ** 2
    return np.asarray(np.sum(np.log1p(power) - along**2 * power / (1 + power), axis=1), float)


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
    seen = linear.seen(names)
    return seen / np.linalg.norm(seen) if seen.shape[1] == 1 else span(seen)


def _among(observed: float, sorted_draws: Array) -> Chance:
    """Share of the draws at or above what was observed; beyond the largest of them, by the tail of single chances."""
    n = len(sorted_draws)
    last = float(sorted_draws[-min(LAST, n)])
    tests = min(LAST, n) / n * float(np.exp(last))
    if observed < last:
        above = n - int(np.searchsorted(sorted_draws, observed))
        return Chance(above / n, tests)
    return Chance(float(tests * np.exp(-observed)), tests)


LAGS = 20
LONG = 1500  # samples from which on the statistic's distribution is the asymptotic one even in its tail
SERIES, TAIL = 6000, 0.01  # series of noise, and the share of them beyond which the tail is taken for exponential


@dataclass(frozen=True)
class Whiteness:
    """Tests of a whitened residual with several channels."""

    ljung_box: Array  # (c,) statistic per channel
    p_value: float  # smallest over the channels, times their number (Bonferroni), at most 1
    peak_frequency: Array  # (c,) [Hz] highest line of the periodogram
    peak_p_value: Array  # (c,) probability of one as high in white noise
    peak_near: tuple[str, ...]  # (c,) which of the named frequencies it lies at, or ""


def ljung_box(residual: Array, lags: int = LAGS) -> Array:
    """Ljung and Box's statistic per channel of a residual (n, c): chi-square of `lags` degrees if it has no memory."""
    x = residual - residual.mean(axis=0)
    n = len(x)
    variance = np.sum(x * x, axis=0)
    rho = np.array([np.sum(x[k:] * x[:-k], axis=0) for k in range(1, lags + 1)]) / np.where(variance > 0, variance, 1.0)
    return np.asarray(n * (n + 2) * np.sum(rho**2 / (n - np.arange(1, lags + 1))[:, None], axis=0), float)


def no_memory(statistic: float, n: int, lags: int = LAGS) -> float:
    """Probability with which white noise of n samples has a statistic of Ljung and Box as large.

    In short series the tail is heavier than chi-square's, whose 5e-6 is 1e-4 of 200 samples: a line in the periodogram
    that is high by chance reaches all lags. Series of noise are drawn.
    """
    if n >= LONG:
        return float(stats.chi2.sf(statistic, lags))
    draws = _drawn(int(2.0 ** (np.floor(2 * np.log2(n)) / 2)), lags)
    start = float(draws[-int(TAIL * SERIES)])
    if statistic < start:
        return float(1.0 - np.searchsorted(draws, statistic) / SERIES)
    scale = float(np.mean(draws[draws >= start] - start))
    return TAIL * float(np.exp(-(statistic - start) / scale))


@lru_cache(maxsize=8)
def _drawn(n: int, lags: int) -> Array:
    """Statistics of series of white noise, sorted."""
    return np.sort(ljung_box(np.random.default_rng(n).standard_normal((n, SERIES)), lags))


def whiteness(residual: Array, rate: float, lines: Mapping[str, float], lags: int = LAGS) -> Whiteness:
    """Ljung-Box and periodogram of a residual (n, c) sampled at `rate` [Hz]; gaps must have been taken out.

    lines : frequencies [Hz] by name at which a physical effect would show
    """
    n, channels = residual.shape
    lags = min(lags, max(1, n // 4))
    statistic = ljung_box(residual, lags)
    p = min(1.0, channels * no_memory(float(statistic.max()), n, lags))
    frequency, power = signal.periodogram(residual, rate, detrend="constant", axis=0)
    frequency, power = frequency[1:], power[1:]
    mean = np.where(power.mean(axis=0) > 0, power.mean(axis=0), 1.0)
    top = power.argmax(axis=0)
    height = power.max(axis=0) / mean
    peak_p = -np.expm1(len(frequency) * np.log1p(-np.exp(-height)))  # Fisher's g, large n
    resolution = 1.5 * rate / n
    near = tuple(next((name for name, f in lines.items() if abs(f - frequency[i]) <= resolution), "") for i in top)
    return Whiteness(statistic, p, frequency[top], np.asarray(peak_p, float), near)
