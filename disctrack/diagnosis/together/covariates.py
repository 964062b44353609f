"""How does the coefficient of a law depend on what was declared: on nothing, on a power of the mass, on the air?"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats
from scipy.optimize import least_squares

from calibration.arrays import Array

LEVEL = 0.01  # probability below which a hypothesis is refused


@dataclass(frozen=True)
class Hypothesis:
    """One way in which the values of the groups may hang together."""

    text: str
    numbers: dict[str, tuple[float, float]]  # constant and exponent with their standard deviations
    chi_square: float
    degrees: int
    criterion: float  # chi-square and the price of its numbers (Bayesian information criterion over the groups)

    @property
    def p_value(self) -> float:
        """Of values that scatter so much about it; NaN where it has as many numbers as there are groups."""
        return float(stats.chi2.sf(self.chi_square, self.degrees)) if self.degrees > 0 else float("nan")

    @property
    def holds(self) -> bool:
        """Is it compatible with the values?"""
        return self.degrees <= 0 or self.p_value > LEVEL


def hypotheses(values: Array, covariance: Array, covariates: Mapping[str, Sequence[float]]) -> list[Hypothesis]:
    """Constant, and in proportion to a power of each covariate that differs between the groups; the best first.

    values (g,), covariance (g, g) : of the coefficient in each group, fitted together
    covariates : by name, one number per group
    Generalised least squares, exact to first order of the groups' uncertainties.
    """
    n = len(values)
    unit = float(np.mean(np.abs(values))) or 1.0  # a friction of 1e-8 m s^2 beside an exponent: numbers of one size
    root = np.linalg.cholesky(covariance / unit**2)

    def tested(text: str, shape: Mapping[str, Array | float]) -> Hypothesis:
        """Shape : covariate over its geometric mean, by its exponent's name, or with a given exponent."""
        free = {k: np.asarray(v) for k, v in shape.items()}

        def misfit(x: Array) -> Array:
            model = x[0] * np.exp(sum((a * np.log(f) for a, f in zip(x[1:], free.values(), strict=True)), np.zeros(n)))
            return np.asarray(np.linalg.solve(root, values / unit - model), float)

        start = np.array([float(np.mean(values)) / unit, *np.zeros(len(free))])
        found = least_squares(misfit, start)
        units = np.array([unit, *np.ones(len(free))])
        spread = units * np.sqrt(np.diag(np.linalg.pinv(found.jac.T @ found.jac)))
        numbers = {
            k: (float(v), float(s)) for k, v, s in zip(["constant", *free], units * found.x, spread, strict=True)
        }
        chi_square = float(2 * found.cost)
        return Hypothesis(text, numbers, chi_square, n - len(start), chi_square + len(start) * float(np.log(n)))

    answers = [tested("the same for all", {})]
    for name, numbers in covariates.items():
        x = np.asarray(numbers, float)
        if not (np.isfinite(x).all() and (x > 0).all()) or np.ptp(np.log(x)) < 1e-6:
            continue
        relative = x / np.exp(np.mean(np.log(x)))
        if n > 2:
            answers.append(tested(f"in proportion to a power of the {name}", {f"exponent of the {name}": relative}))
    return sorted(answers, key=lambda h: h.criterion)
