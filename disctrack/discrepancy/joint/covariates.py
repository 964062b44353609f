"""Does the coefficient of a law depend on the surface, or on a power of the mass, or on nothing declared?"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy import stats
from scipy.optimize import least_squares

from calibration.kit.types import Array, Indices
from disctrack.discrepancy.score import INVISIBLE
from disctrack.discrepancy.significance import FALSE_ALARM


@dataclass(frozen=True)
class Hypothesis:
    """A relation between the values of the groups."""

    text: str
    numbers: dict[str, tuple[float, float]]  # constant and exponent with their standard deviations
    chi_square: float
    degrees: int
    criterion: float  # chi-square and the penalty of its parameters
    parts: int  # number of covariates and kinds that it uses

    @property
    def p_value(self) -> float:
        """Probability of the scatter of the values about it; NaN without degrees of freedom."""
        return float(stats.chi2.sf(self.chi_square, self.degrees)) if self.degrees > 0 else float("nan")

    @property
    def holds(self) -> bool:
        """Is it compatible with the values?"""
        return self.degrees <= 0 or self.p_value > FALSE_ALARM


def hypotheses(
    values: Array,
    covariance: Array,
    covariates: Mapping[str, Sequence[float]],
    kinds: Mapping[str, Sequence[str]] | None = None,
) -> list[Hypothesis]:
    """Constant, or a constant for each surface or disc; proportional to powers of covariates; the best first.

    values (g,), covariance (g, g) : of the coefficient in each group, fitted together
    covariates : by name, one number per group
    kinds : "surface" (or "disc") -> which one it is in each group
    Generalised least squares. The penalty of a parameter is what the best of so many hypotheses gains by chance with
    probability `FALSE_ALARM`: a dependence is ranked first only where it gains more.
    """
    n = len(values)
    unit = float(np.mean(np.abs(values))) or 1.0  # coefficients may be 1e-8 and exponents 1: scale to the same size
    root = np.linalg.cholesky(covariance / unit**2)
    shapes = list(_shapes(n, covariates, kinds or {}))
    price = max(float(np.log(n)), float(stats.chi2.isf(FALSE_ALARM / max(len(shapes) - 1, 1), 1)))

    def tested(kind: str, names: Sequence[str], level: Indices, powers: Array) -> Hypothesis:
        """Level : (g,) which of the constants.   powers (k, g) : logarithms of covariates over geometric means."""
        constants = int(level.max()) + 1

        def power(x: Array) -> Array:
            return np.asarray(np.exp(x[constants:] @ powers), float)

        def misfit(x: Array) -> Array:
            return np.asarray(np.linalg.solve(root, values / unit - x[level] * power(x)), float)

        def derivative(x: Array) -> Array:
            by_number = np.column_stack([level[:, None] == np.arange(constants), powers.T * x[level][:, None]])
            return -np.asarray(np.linalg.solve(root, by_number * power(x)[:, None]), float)

        of_level = [float(np.mean(values[level == i])) / unit for i in range(constants)]
        found = least_squares(misfit, np.array([*of_level, *np.zeros(len(powers))]), derivative)
        units = np.array([*[unit] * constants, *np.ones(len(powers))])
        spread = units * np.sqrt(np.diag(np.linalg.pinv(found.jac.T @ found.jac)))
        labels = kinds[kind] if kinds and kind else []
        which = [f"constant ({labels[int(np.argmax(level == i))]})" if kind else "constant" for i in range(constants)]
        called = [*which, *(f"exponent of the {name}" for name in names)]
        numbers = {k: (float(v), float(s)) for k, v, s in zip(called, units * found.x, spread, strict=True)}
        chi_square, k = float(2 * found.cost), len(called)
        parts = len(names) + bool(kind)
        return Hypothesis(_text(kind, names), numbers, chi_square, n - k, chi_square + k * price, parts)

    return sorted((tested(*shape) for shape in shapes), key=lambda h: h.criterion)


def _text(kind: str, names: Sequence[str]) -> str:
    if not names:
        return f"a value for each {kind}" if kind else "the same for all"
    powers = " and of the ".join(names)
    return f"in proportion to a power of the {powers}" + (f", with a constant for each {kind}" if kind else "")


def _shapes(
    n: int, covariates: Mapping[str, Sequence[float]], kinds: Mapping[str, Sequence[str]]
) -> Iterator[tuple[str, tuple[str, ...], Indices, Array]]:
    """Kind and covariates of each hypothesis that n groups can test; index of its constant and logarithms, by group."""
    usable = {k: x for k, v in covariates.items() if np.isfinite(x := np.asarray(v, float)).all() and (x > 0).all()}
    logarithms: dict[str, Array] = {k: np.log(x) - np.mean(np.log(x)) for k, x in usable.items()}
    names: list[tuple[str, ...]] = [(), *((k,) for k in logarithms), *combinations(logarithms, 2)]
    for kind in ("", *kinds):
        labels = list(kinds[kind]) if kind else [""] * n
        level = np.asarray(np.unique(labels, return_inverse=True)[1], np.intp)
        constants = int(level.max()) + 1
        if kind and not 1 < constants < n:
            continue
        for chosen in names:
            powers = np.array([logarithms[k] for k in chosen]).reshape(-1, n)
            columns = np.column_stack([level[:, None] == np.arange(constants), powers.T]).astype(float)
            # a covariate that is constant, or a combination of the others, is none
            dependent = np.linalg.svd(columns, compute_uv=False).min() <= INVISIBLE * np.sqrt(n)
            if not chosen or (not dependent and n > columns.shape[1]):
                yield kind, chosen, level, powers


def equivalent(found: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Hypotheses that fit as well as the first one, with as many parameters."""
    best, *rest = found
    near = best.chi_square + float(stats.chi2.isf(FALSE_ALARM, 1))
    return [h for h in rest if h.degrees == best.degrees and h.chi_square < near and best.degrees > 0 and h.holds]
