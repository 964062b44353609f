"""Is a residual noise? Size, memory and lines in its spectrum."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy import signal, stats

from calibration.kit.arrays import Array

LAGS = 20
LONG = 1500  # samples from which on the statistic's distribution is the asymptotic one even in its tail
DRAWS, TAIL = 6000, 0.01  # series of noise, and the share of them beyond which the tail is taken for exponential


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
    start = float(draws[-int(TAIL * DRAWS)])
    if statistic < start:
        return float(1.0 - np.searchsorted(draws, statistic) / DRAWS)
    scale = float(np.mean(draws[draws >= start] - start))
    return TAIL * float(np.exp(-(statistic - start) / scale))


@lru_cache(maxsize=8)
def _drawn(n: int, lags: int) -> Array:
    """Statistics of series of white noise, sorted."""
    return np.sort(ljung_box(np.random.default_rng(n).standard_normal((n, DRAWS)), lags))


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
