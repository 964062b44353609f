"""How surprising a gain of chi-square is, in the sigmas of a normal number."""

from __future__ import annotations

import numpy as np
from scipy import special, stats

LARGE = 500.0  # chi-square beyond which its tail is taken from the asymptotic series: the probability underflows


def as_sigmas(gain: float, n: int) -> float:
    """Sigmas whose two-sided probability is that of noise gaining so much by n numbers; for one, the root of the gain.

    No pay is taken here for having looked among many candidates: that is what thresholds are for.
    """
    if not gain > 0:
        return 0.0
    if gain < LARGE:
        log_tail = float(stats.chi2.logsf(gain, n))
    else:
        x, a = gain / 2, n / 2  # Gamma(a, x) = x^(a-1) e^-x (1 + (a-1)/x + (a-1)(a-2)/x^2 + ...)
        series = 1 + (a - 1) / x + (a - 1) * (a - 2) / x**2 + (a - 1) * (a - 2) * (a - 3) / x**3
        log_tail = float((a - 1) * np.log(x) - x + np.log(series) - special.gammaln(a))
    return float(-special.ndtri_exp(log_tail - np.log(2.0)))
