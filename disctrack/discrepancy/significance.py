"""How surprising a gain of chi-square is; and how many of many findings may be false."""

from collections.abc import Sequence

import numpy as np
from scipy import special, stats

from calibration.kit.arrays import Array

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


def false_discovery(p_values: Sequence[float]) -> Array:
    """For each of many p values, the share of false ones among all that are as small (Benjamini and Hochberg 1995).

    Who believes every finding whose number is below 0.05 has 5 % false ones among them on average, if their noise is
    independent or goes together (Benjamini and Yekutieli 2001).
    """
    p = np.asarray(p_values, float)
    order = np.argsort(p)
    n = len(p)
    adjusted = np.empty(n)
    adjusted[order] = np.minimum.accumulate((p[order] * n / np.arange(1, n + 1))[::-1])[::-1]
    return np.minimum(adjusted, 1.0)
