"""Shape parameters of laws (exponents, scales), fitted along their profile likelihood where the data determine them.

The search uses laws in the shape that their sources give. A law of another shape is then found as a similar one, or not
at all; therefore shapes are freed where the residuals stay large, and the shapes of the effects found are fitted too.
"""

from contextlib import suppress
from dataclasses import replace

import numpy as np

from calibration.kit.arrays import Array
from disctrack.discrepancy.fit import TRIAL, Fit, attempt, fit
from disctrack.discrepancy.score import Linearisation, score
from disctrack.discrepancy.system import Candidate, GivenUp, Quantity, System

MAX_TRIALS = 24  # points of a profile
ALONG = 5.0  # times the steps of a trial, for all profiles from the best start
HOPELESS = 0.02  # share of the excess over the goal: a step that gains less will not reach it
ENOUGH = 0.01  # of chi-square: a tenth of a sigma, the precision of a minimum
STEEP = 1.0  # of chi-square above the lowest point, beyond which a neighbour is no point of the same parabola
NARROW = 1e-6  # of a shape's size: smallest distance of two points
WORTH_A_SHAPE = 0.5  # share of the excess that a law, and then its shape to first order, must remove
DETERMINED = 0.3  # sigma over size, up to which a shape parameter is determined


def with_free_shape(
    system: System, base: Fit, candidate: Candidate, least: float, below: float, goal: float
) -> tuple[Candidate, Fit] | None:
    """The candidate with its shape free, and the fit with it; None where the data do not determine that shape.

    least : first-order gain, below which an unknown location is not worth a refit
    below : cost that the fit from the best start must reach
    goal : see `profile_fit`
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
    shape = replace(candidate, quantities=candidate.shape)
    gain, _ = Linearisation(system, fitted, [shape]).gain_of(shape.names)
    if fitted.cost - gain > goal and gain < WORTH_A_SHAPE * (fitted.cost - goal):
        return None
    free = [(q, expected) for q in candidate.shape if np.isfinite(expected := expected_sigma(system, fitted, q))]
    with suppress(GivenUp), system.budget.trial(ALONG * system.trial_steps):
        for q, expected in free:
            fitted = profile_fit(system, fitted, q, expected, goal)
        if fitted.converged and all(is_determined(fitted, q) for q, _ in free):
            return replace(candidate, quantities=(*candidate.quantities, *(q for q, _ in free))), fitted
    return None


def with_shape(system: System, fitted: Fit, candidate: Candidate) -> tuple[Fit, tuple[Quantity, ...], list[str]]:
    """The fit with those shape parameters free that the data determine; these; and remarks on the others."""
    known, notes = list[Quantity](), list[str]()
    for q in candidate.shape:
        expected = expected_sigma(system, fitted, q)
        trial = profile_fit(system, fitted, q, expected) if expected < _size(q, q.null) else None
        if trial is not None and is_determined(trial, q):
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


def profile_fit(system: System, fitted: Fit, q: Quantity, step: float, goal: float = np.inf) -> Fit:
    """The fit with one more quantity free, by minimising its profile: the others are refitted at each of its values.

    An exponent and the amounts of two laws are strongly correlated, and Gauss-Newton converges slowly in the curved
    valley of chi-square.

    goal : cost that is to be reached; the search ends where a step promises too little to reach it
    """
    points: dict[float, Fit] = {}

    def at(value: float) -> None:
        value = float(np.clip(value, q.lower, q.upper))
        if value not in points:
            near = points[min(points, key=lambda v: abs(v - value))] if points else fitted
            points[value] = fit(system, fitted.quantities, near.values | {q.name: value})

    start = fitted.values.get(q.name, q.null)
    step = min(step, 0.5 * _size(q, start))
    for offset in (0.0, -step, step):
        at(start + offset)
    for _ in range(MAX_TRIALS):
        if not system.budget.open():
            break
        values = np.array(sorted(points))
        costs = np.array([points[v].cost for v in values])
        best = int(np.argmin(costs))
        if 0 < best < len(values) - 1:
            x, y = values[best - 1 : best + 2], costs[best - 1 : best + 2]
            target, gain = _vertex(x, y)
            side = 0 if y[0] > y[2] else 2
            if y[side] - y[1] > STEEP and (target - x[1]) * (x[side] - x[1]) <= 0:
                # where another quantity reaches its bound, the profile has a kink, and no parabola fits
                target, gain = 0.5 * float(x[1] + x[side]), np.inf
            if gain < max(ENOUGH, HOPELESS * (y[1] - goal)) or x[2] - x[0] < NARROW * _size(q, float(x[1])):
                break
            at(target)
        else:
            outwards = values[best] + 2 * (values[best] - values[1 if best == 0 else -2])
            at(outwards)
            if float(np.clip(outwards, q.lower, q.upper)) == values[best]:
                break
    lowest = min(points.values(), key=lambda f: f.cost)
    joint = fit(system, (*fitted.quantities, q), lowest.values, max_iterations=4)
    # converged along the profile, whether or not the joint Gauss-Newton iteration is
    return replace(joint, converged=lowest.converged and joint.cost <= lowest.cost + ENOUGH)


def _vertex(x: Array, y: Array) -> tuple[float, float]:
    """Minimum of the parabola through three points, and its depth below the middle one."""
    if not np.isfinite(y).all():
        return float(x[1]), 0.0
    a, b, _ = np.polyfit((x - x[1]) / (x[2] - x[0]), y - y[1], 2)
    if a <= 0:
        return float(x[1]), 0.0
    move = -b / (2 * a) * (x[2] - x[0])
    return float(x[1] + move), float(b * b / (4 * a))


def _size(q: Quantity, value: float) -> float:
    return max(abs(value), abs(q.null), abs(q.scale))


def is_determined(fitted: Fit, q: Quantity) -> bool:
    """Is this shape parameter known better than its order of magnitude?"""
    value, sigma = fitted.values[q.name], fitted.sigma(q.name)
    inside = q.lower < value < q.upper
    return inside and 0 < sigma < DETERMINED * _size(q, value)


def expected_sigma(system: System, after: Fit, q: Quantity) -> float:
    """Expected standard deviation; infinite where the data do not show the quantity at all."""
    alone = Candidate(q.name, q.name, "shape", "", "", (q,))
    return float(score(Linearisation(system, after, [alone]), alone).sigma[0])
