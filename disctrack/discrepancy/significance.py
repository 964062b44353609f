"""Significance of a decrease of chi-square, with the trials penalty, and tests of white residuals.

To first order, the gains of all candidates are squared projections of one vector of noise. Candidates overlap, so there
are fewer independent trials than candidates. The distribution of the largest gain is therefore simulated: it includes
the number of trials, their correlation, and one-sided bounds.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy import signal, special, stats

from calibration.kit.types import Array
from disctrack.discrepancy.score import Linearisation, Score, span

FALSE_ALARM = 0.005  # probability that noise alone produces a finding, over all that is tested
SURE = 3.0  # sigmas, below which one number alone is not significant
TWO_SIDED = float(stats.norm.isf(0.025))  # sigmas: 95 % between both limits


def log_tail(gain: float, n: int) -> float:
    """Logarithm of the probability that noise gains so much by n parameters."""
    if not gain > 0:
        return 0.0
    x, a = gain / 2, n / 2  # Gamma(a, x) = x^a e^-x U(1, 1 + a, x), which does not underflow before its logarithm
    return min(float(a * np.log(x) - x + np.log(special.hyperu(1.0, 1.0 + a, x)) - special.gammaln(a)), 0.0)


def bic_penalty(weights: Array) -> float:
    """BIC penalty of one more parameter, for samples with these weights (n,) (Schwarz 1978)."""
    return float(np.log(np.sum(weights)))


def as_sigmas(gain: float, n: int) -> float:
    """Sigmas of a normal distribution with the same two-sided probability; for one parameter, the root of the gain.

    Without a trials penalty: the thresholds include that.
    """
    return float(-special.ndtri_exp(log_tail(gain, n) - np.log(2.0))) if gain > 0 else 0.0


def wald(amounts: Array, covariance: Array) -> float:
    """Wald's statistic a' C^-1 a of amounts a (k,) with covariance C (k, k), without those of zero variance (1943)."""
    sigma = np.sqrt(np.diag(covariance))
    safe = np.where(sigma > 0, sigma, np.inf)  # zero: at a bound, or not determined
    inverse = np.linalg.pinv(covariance / np.outer(safe, safe), rcond=1e-10, hermitian=True)
    return float((amounts / safe) @ inverse @ (amounts / safe))


def evidence(shown: Array, along: Array, sizes: Array) -> Array:
    """-2 log evidence (s,), up to a constant, of a Gaussian process with these prior sizes (s,) (MacKay 1992).

    shown : (k,) singular values of its whitened design matrix, for size 1
    along : (k,) components of the residuals along the left singular vectors
    """
    power = (sizes[:, None] * shown) ** 2
    return np.asarray(np.sum(np.log1p(power) - along**2 * power / (1 + power), axis=1), float)


DRAWS = 4000
LAST = 40  # largest draws: beyond them the tail is taken for exponential
SEED = 20261122


def tail(observed: float, draws: Array, scale: float | None = None) -> float:
    """Probability that a value as large is drawn; draws (n,) : simulated and sorted.

    scale : by which the logarithm of the tail falls by 1; by default that of the largest draws
    """
    last = float(draws[-LAST])
    if observed < last:
        return float(1.0 - np.searchsorted(draws, observed) / len(draws))
    scale = float(np.mean(draws[-LAST:] - last)) if scale is None else scale
    return LAST / len(draws) * float(np.exp(-(observed - last) / scale))


@dataclass(frozen=True)
class Chance:
    """Significance of the largest gain."""

    p_value: float  # uniform between 0 and 1 where nothing is missing
    tests: float  # effective number of independent trials


def chance(linear: Linearisation, scores: Sequence[Score], noise: float, draws: int = DRAWS) -> Chance:
    """Significance of the best of these scores at `linear`.   noise : variance over that stated.

    Candidates with a threshold have no first-order score and do not count.
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
            along = np.maximum(along, 0.0)  # one-sided: an effect that may only brake
        np.maximum(largest, -stats.chi2.logsf(np.sum(along**2, axis=1), len(quantities)), out=largest)
    largest.sort()
    tests = LAST / draws * float(np.exp(largest[-LAST]))  # beyond it the tail is that of so many single trials
    return Chance(tail(observed, largest, 1.0), tests)


def _directions(linear: Linearisation, names: Sequence[str]) -> Array:
    """Orthonormal (m, k) signals of these quantities, orthogonalised to the fitted ones; one alone keeps its sign."""
    seen = linear.seen(names)
    return seen / np.linalg.norm(seen) if seen.shape[1] == 1 else span(seen)


LAGS = 20
LONG = 1500  # samples from which on the statistic's distribution is the asymptotic one even in its tail


@dataclass(frozen=True)
class Whiteness:
    """Tests of a whitened residual with several channels."""

    ljung_box: Array  # (c,) statistic per channel
    p_value: float  # smallest over the channels, times their number (Bonferroni), at most 1
    peak_frequency_hz: Array  # (c,) highest line of the periodogram
    peak_p_value: Array  # (c,) probability of one as high in white noise
    peak_near: tuple[str, ...]  # (c,) which of the named frequencies it lies at, or ""


def ljung_box(residual: Array, lags: int = LAGS) -> Array:
    """Ljung-Box statistic per channel of residuals (n, c): chi-square of `lags` degrees of freedom for white noise."""
    x = residual - residual.mean(axis=0)
    n = len(x)
    variance = np.sum(x * x, axis=0)
    rho = np.array([np.sum(x[k:] * x[:-k], axis=0) for k in range(1, lags + 1)]) / np.where(variance > 0, variance, 1.0)
    return np.asarray(n * (n + 2) * np.sum(rho**2 / (n - np.arange(1, lags + 1))[:, None], axis=0), float)


def ljung_box_p_value(statistic: float, n: int, lags: int = LAGS) -> float:
    """Probability that the Ljung-Box statistic of n samples of white noise is as large.

    In short series the tail is heavier than that of chi-square (200 samples: 1e-4 where chi-square has 5e-6), as one
    high line of the periodogram contributes to all lags. The distribution is simulated.
    """
    if n >= LONG:
        return float(stats.chi2.sf(statistic, lags))
    return tail(statistic, _drawn(int(2.0 ** (np.floor(2 * np.log2(n)) / 2)), lags))


@lru_cache(maxsize=8)
def _drawn(n: int, lags: int) -> Array:
    """Sorted statistics of simulated white noise."""
    return np.sort(ljung_box(np.random.default_rng(n).standard_normal((n, DRAWS)), lags))


def whiteness(residual: Array, rate: float, lines: Mapping[str, float]) -> Whiteness:
    """Ljung-Box test and periodogram of residuals (n, c) sampled at `rate` [Hz], without gaps.

    lines : frequencies [Hz] by name, at which a physical effect would show
    """
    n, channels = residual.shape
    lags = min(LAGS, max(1, n // 4))
    statistic = ljung_box(residual, lags)
    p = min(1.0, channels * ljung_box_p_value(float(statistic.max()), n, lags))
    frequency, power = signal.periodogram(residual, rate, detrend="constant", axis=0)
    frequency, power = frequency[1:], power[1:]
    mean = np.where(power.mean(axis=0) > 0, power.mean(axis=0), 1.0)
    top = power.argmax(axis=0)
    height = power.max(axis=0) / mean
    with np.errstate(divide="ignore"):  # a channel without power, as of a camera that sees nothing, has p = 1
        peak_p = -np.expm1(len(frequency) * np.log1p(-np.exp(-height)))  # Fisher's g, large n
    resolution = 1.5 * rate / n
    near = tuple(next((name for name, f in lines.items() if abs(f - frequency[i]) <= resolution), "") for i in top)
    return Whiteness(statistic, p, frequency[top], np.asarray(peak_p, float), near)
