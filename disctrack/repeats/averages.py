"""Averages of a number that several runs measured, and whether the runs agree.

Weighted mean, chi-square of consistency, and the Birge ratio sqrt(chi^2 / (n - 1)) by which stated sigmas must be
stretched to explain the scatter (Birge 1932, Phys. Rev. 40:207; the Particle Data Group's scale factor).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from calibration.kit.arrays import Array

CONSISTENT = 0.05  # probability of a larger chi-square below which the runs are said not to agree
# Probability, over all runs of a group, that one is pointed at by chance, per quantity: where the others agree within
# their sigmas, and where their scatter has to stand in for these (the usual level of Grubbs' test).
FALSE_OUTLIER = 0.01
FALSE_OUTLIER_OF_SCATTER = 0.05


@dataclass(frozen=True)
class Average:
    """Average over the runs that determine a number."""

    n: int
    mean: float  # arithmetic, as in the paper's tables
    standard_error: float  # from the scatter alone; NaN for one run
    weighted: float  # with weights 1 / sigma^2
    sigma_internal: float  # of the weighted mean, from the stated sigmas
    sigma_external: float  # times the Birge ratio: from the scatter
    chi_square: float
    degrees_of_freedom: int
    p_value: float  # of a larger chi-square, if the runs measured one and the same number
    birge_ratio: float
    outliers: tuple[int, ...]  # which of the values given lie away from all others

    @property
    def sigma(self) -> float:
        """Of the weighted mean; the scatter counts where it is larger than stated."""
        return self.sigma_internal * max(1.0, self.birge_ratio if np.isfinite(self.birge_ratio) else 1.0)

    @property
    def best(self) -> tuple[float, float]:
        """Value and sigma to quote: weighted while the runs agree; otherwise all count alike, and the scatter tells."""
        return (self.weighted, self.sigma) if self.agree else (self.mean, self.standard_error)

    @property
    def agree(self) -> bool:
        """True when the scatter is what the sigmas let expect."""
        return not self.p_value < CONSISTENT

    @property
    def verdict(self) -> str:
        """In words."""
        if self.n < 2:
            return "no repeat" if self.n else "not determined"
        if self.agree:
            return f"the {self.n} runs agree (Birge ratio {self.birge_ratio:.2f}, p = {self.p_value:.2g})"
        return (
            f"the {self.n} runs do not agree: they scatter by {self.birge_ratio:.2g} times their sigmas "
            f"(p = {self.p_value:.2g})"
        )


def average(values: Sequence[float] | Array, sigmas: Sequence[float] | Array) -> Average:
    """Average of values with standard deviations; those that are not finite are left out (indices stay)."""
    values, sigmas = np.asarray(values, float), np.asarray(sigmas, float)
    rows = np.flatnonzero(np.isfinite(values) & np.isfinite(sigmas) & (sigmas > 0))
    v, s = values[rows], sigmas[rows]
    n, nan = len(v), float("nan")
    if n == 0:
        return Average(0, nan, nan, nan, nan, nan, nan, 0, nan, nan, ())
    mean, sigma = _weighted(v, s)
    chi_square = float(np.sum(((v - mean) / s) ** 2))
    birge = float(np.sqrt(chi_square / (n - 1))) if n > 1 else nan
    return Average(
        n=n,
        mean=float(v.mean()),
        standard_error=float(v.std(ddof=1) / np.sqrt(n)) if n > 1 else nan,
        weighted=mean,
        sigma_internal=sigma,
        sigma_external=sigma * birge,
        chi_square=chi_square,
        degrees_of_freedom=n - 1,
        p_value=float(stats.chi2.sf(chi_square, n - 1)) if n > 1 else nan,
        birge_ratio=birge,
        outliers=tuple(int(rows[i]) for i in range(n) if n > 2 and stands_apart(v, s, i)),
    )


def stands_apart(values: Array, sigmas: Array, i: int) -> bool:
    """True where value i lies farther from the others than chance would put one of them.

    The others' scatter beyond their sigmas (moment estimate of DerSimonian & Laird 1986) is granted to value i, too;
    where it is needed it is known from n - 2 degrees of freedom only, and Student's t replaces the normal law.
    """
    others, own = np.delete(values, i), np.delete(sigmas, i)
    mean, _ = _weighted(others, own)
    chi_square = float(np.sum(((others - mean) / own) ** 2))
    w, dof = 1 / own**2, len(others) - 1
    beyond = max(0.0, (chi_square - dof) / (w.sum() - np.sum(w**2) / w.sum()))
    agree = stats.chi2.sf(chi_square, dof) >= CONSISTENT
    mean, sigma = _weighted(others, np.sqrt(own**2 + beyond))
    t = abs(values[i] - mean) / np.sqrt(sigmas[i] ** 2 + beyond + sigma**2)
    return improbable(float(t), len(values), bool(agree))


def improbable(t: float, n: int, others_agree: bool) -> bool:
    """True where one of n runs is t sigmas away; sigmas from the scatter of the others unless these agree."""
    if others_agree:
        return bool(2 * stats.norm.sf(t) < FALSE_OUTLIER / n)
    return bool(2 * stats.t.sf(t, n - 2) < FALSE_OUTLIER_OF_SCATTER / n)


def _weighted(values: Array, sigmas: Array) -> tuple[float, float]:
    w = 1 / sigmas**2
    return float(np.sum(w * values) / w.sum()), float(1 / np.sqrt(w.sum()))
