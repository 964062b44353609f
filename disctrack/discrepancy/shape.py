"""Shape parameters of laws (exponents, scales), fitted where the data determine them.

The search uses laws in the shape that their sources give. A law of another shape is then found as a similar one, or not
at all; therefore shapes are freed where the residuals stay large, and the shapes of the effects found are fitted too.
"""

from dataclasses import replace

import numpy as np

from disctrack.discrepancy.fit import TRIAL, Fit, attempt, fit
from disctrack.discrepancy.score import Linearisation, score
from disctrack.discrepancy.system import Candidate, Quantity, System

WORTH_A_SHAPE = 0.5  # share of the excess that a law must remove before its shape is fitted too
DETERMINED = 0.3  # sigma over size, up to which a shape parameter is determined


def leaves_most(left: float, before: float) -> bool:
    """Is less removed of an excess chi-square than a law must remove to be worth more?"""
    return left > (1 - WORTH_A_SHAPE) * before


def with_free_shape(
    system: System, base: Fit, candidate: Candidate, least: float, below: float, price: float
) -> tuple[Candidate, Fit] | None:
    """The candidate with its shape free, and the fit with it; None where the data do not determine that shape.

    least : first-order gain, below which an unknown location is not worth a refit
    below : cost that the fit from the best start must reach
    price : decrease of the cost that more shape parameters than the first are worth, each
    """
    names = [q.name for q in candidate.shape]
    starts = [dict(zip(names, s, strict=True)) for s in system.starts(candidate, base.values, least)]
    if candidate.sought and not starts:
        return None
    quantities = *base.quantities, *candidate.quantities
    fits = [attempt(system, quantities, base.values | start, TRIAL) for start in starts or _grid(candidate)]
    fitted = min(fits, key=lambda f: f.cost)
    if not fitted.cost < below:
        return None
    free = [q for q in candidate.shape if np.isfinite(expected_sigma(system, fitted, q))]
    several = [free[:1], free] if len(free) > 1 else [free]
    trials = [(attempt(system, (*fitted.quantities, *some), fitted.values), some) for some in several]
    fitted, free = min(trials, key=lambda trial: (not trial[0].converged, trial[0].cost + price * len(trial[1])))
    if not (fitted.converged and all(is_determined(fitted, q) for q in free)):
        return None
    return replace(candidate, quantities=(*candidate.quantities, *free)), fitted


def with_shape(system: System, fitted: Fit, candidate: Candidate) -> tuple[Fit, tuple[Quantity, ...], list[str]]:
    """The fit with those shape parameters free that the data determine; these; and remarks on the others."""
    known, notes = list[Quantity](), list[str]()
    for q in candidate.shape:
        expected = expected_sigma(system, fitted, q)
        trial = fit(system, (*fitted.quantities, q), fitted.values) if expected < _size(q, q.null) else None
        if trial is not None and trial.converged and is_determined(trial, q):
            fitted = trial
            known.append(q)
            continue
        sigma = trial.sigma(q.name) if trial is not None else expected
        size = f"sigma {sigma:.2g} {q.unit if q.unit != '1' else ''}".rstrip() if np.isfinite(sigma) else "unseen"
        notes.append(f"{candidate.name}: this recording does not determine {q.part} ({size}); {q.null:g} is assumed")
    return fitted, tuple(known), notes


def _grid(candidate: Candidate) -> list[dict[str, float]]:
    """Initial guesses: a grid over the range of the first shape parameter, or over two decades."""
    q, values = candidate.shape[0], {s.name: s.null for s in candidate.shape}
    if np.isfinite(q.lower) and np.isfinite(q.upper):
        steps = q.lower + (q.upper - q.lower) * np.array([0.1, 0.25, 0.4, 0.6, 0.75, 0.9])
    else:
        steps = q.null * np.array([0.1, 0.3, 1.0, 3.0, 10.0])
    return [values | {q.name: float(np.clip(v, q.lower, q.upper))} for v in steps]


def _size(q: Quantity, value: float) -> float:
    return max(abs(value), abs(q.null), abs(q.scale))


def is_determined(fitted: Fit, q: Quantity) -> bool:
    """Is this shape parameter known better than its order of magnitude?"""
    value, sigma = fitted.values[q.name], fitted.sigma(q.name)
    return q.lower < value < q.upper and 0 < sigma < DETERMINED * _size(q, value)


def expected_sigma(system: System, after: Fit, q: Quantity) -> float:
    """Expected standard deviation; infinite where the data do not show the quantity at all."""
    alone = Candidate(q.name, q.name, "shape", "", "", (q,))
    return float(score(Linearisation(system, after, [alone]), alone).sigma[0])
