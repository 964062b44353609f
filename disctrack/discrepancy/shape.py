"""Exponents and scales of the laws that were found: refined where the data determine them, and said where not.

The search takes laws as they are written down, with the shape that their sources give. A law of another shape is then
found as the nearest one, or not at all; so the shape of what was found is fitted along, and where the catalogue leaves
something unexplained, its laws with a shape get a second trial with the shape free.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from calibration.kit.arrays import Array
from disctrack.discrepancy.fit import Fit, fit
from disctrack.discrepancy.held_out import HeldOut, held_out, training_rows
from disctrack.discrepancy.score import Linearisation, score
from disctrack.discrepancy.search import CLASS_GAIN, FAINT, Diagnosis, Found, Tried, length, threshold
from disctrack.discrepancy.system import Candidate, Quantity, System, TrialGivenUp

MAX_TRIALS = 24  # values of a shape at which the rest is refitted
ALONG = 5.0  # times the time of a trial, for all that follows from the best start
HOPELESS = 0.02  # of what is still too much: a step that gains less does not lead to noise
ENOUGH = 0.01  # of chi-square: a tenth of a sigma, beyond which a shape is not pursued
STEEP = 1.0  # of chi-square above the lowest point, beyond which a neighbour says nothing of the valley's floor
NARROW = 1e-6  # of a shape's size: as close as two values need to be
MAX_STARTED = 12  # iterations at each shape of the grid, and ...
WORTH_A_SHAPE = 0.5  # ... share of what exceeds the noise that the best of them may leave, for its shape to be sought
FIRST_ORDER = 1.0 / 3.0  # of what a faint effect is to describe, that it does to first order, at the shape assumed
DETERMINED = 0.3  # sigma over size, up to which a number is more than an order of magnitude


def refine_shapes(system: System, diagnosis: Diagnosis) -> tuple[Diagnosis, tuple[str, ...]]:
    """The diagnosis with the shapes of the laws fitted along, and remarks on those that the data leave open."""
    if diagnosis.held_out_before is None or diagnosis.verdict == "nothing missing":
        return diagnosis, ()
    system = diagnosis.judged or system
    notes: list[str] = []
    if diagnosis.verdict == "unexplained" or len(diagnosis.found) > 1:
        diagnosis = _second_trial(system, diagnosis)
    for position, found in enumerate(diagnosis.found):
        if found.candidate.shape and not set(_names(found.candidate.shape)) & set(diagnosis.after.names):
            diagnosis, remarks = _refined(system, diagnosis, position)
            notes += remarks
    return diagnosis, tuple(notes)


def _names(quantities: Sequence[Quantity]) -> list[str]:
    return [q.name for q in quantities]


def _refined(system: System, diagnosis: Diagnosis, position: int) -> tuple[Diagnosis, list[str]]:
    """One effect with those numbers of its shape fitted that the data determine."""
    found, fitted = diagnosis.found[position], diagnosis.after
    known, notes = list[Quantity](), []
    for q in found.candidate.shape:
        expected = _first_order(system, fitted, q)
        trial = profiled(system, fitted, q, expected) if expected < _size(q, q.null) else None
        if trial is not None and _determined(trial, q):
            fitted = trial
            known.append(q)
        else:
            sigma = trial.sigma(q.name) if trial is not None else expected
            size = f"sigma {sigma:.2g} {q.unit if q.unit != '1' else ''}".rstrip() if np.isfinite(sigma) else "unseen"
            name = q.part
            notes.append(
                f"{found.candidate.name}: this recording does not determine {name} ({size}); {q.null:g} is assumed"
            )
    if not known:
        return diagnosis, notes
    gain = (diagnosis.after.cost - fitted.cost) / diagnosis.noise
    enlarged = replace(found.candidate, quantities=(*found.candidate.quantities, *known))
    better = replace(found, candidate=enlarged, gain=found.gain + gain)
    everything = tuple(better if i == position else f for i, f in enumerate(diagnosis.found))
    held = _held_out(system, diagnosis, fitted)
    return replace(diagnosis, found=everything, after=fitted, held_out_after=held), notes


def profiled(system: System, fitted: Fit, q: Quantity, step: float, goal: float = np.inf) -> Fit:
    """The fit with one more quantity free, found along its profile: the others are refitted at each value of it.

    An exponent and the amounts of two laws lie in a curved valley in which Gauss-Newton halves its steps for ever.

    goal : cost down to which it has to lead; where no step leads there, the search for the best one ends
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
        values = np.array(sorted(points))
        costs = np.array([points[v].cost for v in values])
        best = int(np.argmin(costs))
        if 0 < best < len(values) - 1:
            x, y = values[best - 1 : best + 2], costs[best - 1 : best + 2]
            target, gain = _vertex(x, y)
            side = 0 if y[0] > y[2] else 2
            if y[side] - y[1] > STEEP and (target - x[1]) * (x[side] - x[1]) <= 0:
                # where another number comes to stand at its bound the profile has a kink: no parabola fits its sides
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
    # along the profile nothing is left to gain, whatever Gauss-Newton says of the valley
    return replace(joint, converged=lowest.converged and joint.cost <= lowest.cost + ENOUGH)


def _vertex(x: Array, y: Array) -> tuple[float, float]:
    """Minimum of the parabola through three points, kept between them, and how far it lies below the middle one."""
    if not np.isfinite(y).all():
        return float(x[1]), 0.0
    a, b, _ = np.polyfit((x - x[1]) / (x[2] - x[0]), y - y[1], 2)
    if a <= 0:
        return float(x[1]), 0.0
    move = -b / (2 * a) * (x[2] - x[0])
    return float(x[1] + move), float(b * b / (4 * a))


def _size(q: Quantity, value: float) -> float:
    return max(abs(value), abs(q.null), abs(q.scale))


def _determined(fitted: Fit, q: Quantity) -> bool:
    value, sigma = fitted.values[q.name], fitted.sigma(q.name)
    inside = q.lower < value < q.upper
    return inside and 0 < sigma < DETERMINED * _size(q, value)


def _first_order(system: System, after: Fit, q: Quantity) -> float:
    """Standard deviation to expect; infinite where the data do not see the number at all."""
    alone = Candidate(q.name, q.name, "shape", "", "", (q,))
    return float(score(Linearisation(system, after, [alone]), alone).sigma[0])


def _held_out(system: System, diagnosis: Diagnosis, fitted: Fit) -> HeldOut:
    return held_out(system, fitted.quantities, fitted.values, training_rows(system, diagnosis.settings.train_fraction))


def _second_trial(system: System, diagnosis: Diagnosis) -> Diagnosis:
    """A single law with a free shape in place of all that was found, if it leaves noise and is the shorter answer."""
    best, chosen = diagnosis, _length(system, diagnosis) if diagnosis.found else np.inf
    for candidate in system.candidates:
        try:
            answer = _with_free_shape(system, diagnosis, candidate) if candidate.shape else None
        except TrialGivenUp:
            continue
        if answer is not None and _length(system, answer) < chosen:
            best, chosen = answer, _length(system, answer)
    return _with_one_looked_for(system, diagnosis, best)


def _with_one_looked_for(system: System, diagnosis: Diagnosis, best: Diagnosis) -> Diagnosis:
    """An effect whose place has to be looked for in that of one of several, if that is the shorter answer; else `best`.

    At its null such an effect has no derivative, so that the search never meets it. Beside another effect, a faint one
    that a flat of the rim makes is an inertia's or a pattern's off centre.
    """
    if diagnosis.verdict != "found" or len(diagnosis.found) < 2:
        return best
    taken = {f.candidate.name for f in diagnosis.found}
    for found in diagnosis.found:
        if found.candidate.kind != "motion" or found.gain > FAINT:
            continue
        kept = tuple(f for f in diagnosis.found if f is not found)
        for candidate in system.candidates:
            if not candidate.sought or candidate.name in taken:
                continue
            with suppress(TrialGivenUp):
                answer = _with_free_shape(system, diagnosis, candidate, kept)
                # of two that describe the same, the one that needed no looking for
                if answer is not None and _length(system, answer) < _length(system, best) - CLASS_GAIN:
                    best = answer
    return best


def _length(system: System, answer: Diagnosis) -> float:
    return length(system, answer.settings, answer.noise, answer.after, [f.candidate for f in answer.found])


def _grid(candidate: Candidate) -> list[dict[str, float]]:
    """Shapes to begin with: over the range of the first number, where it has one, or over two decades."""
    q, values = candidate.shape[0], {s.name: s.null for s in candidate.shape}
    if np.isfinite(q.lower) and np.isfinite(q.upper):
        steps = q.lower + (q.upper - q.lower) * np.array([0.1, 0.25, 0.4, 0.6, 0.75, 0.9])
    else:
        steps = q.null * np.array([0.1, 0.3, 1.0, 3.0, 10.0])
    return [values | {q.name: float(np.clip(v, q.lower, q.upper))} for v in steps]


def _started(system: System, base: Fit, candidate: Candidate, shape: dict[str, float]) -> Fit:
    return fit(system, (*base.quantities, *candidate.quantities), base.values | shape, MAX_STARTED)


def _with_free_shape(
    system: System, diagnosis: Diagnosis, candidate: Candidate, kept: tuple[Found, ...] = ()
) -> Diagnosis | None:
    """The answer with this effect and its shape in place of all that was found but for `kept`; None if it is none."""
    base, before = diagnosis.before, diagnosis.held_out_before
    if kept:
        base = _without_others(system, diagnosis, kept)
    least = FIRST_ORDER * max(base.cost - diagnosis.after.cost, 0.0) if kept else 0.0  # of what it would stand in for
    places = system.starts(candidate, base.values, least)
    if kept and not places:
        return None
    starts = [dict(zip(_names(candidate.shape), s, strict=True)) for s in places]
    fits = []
    for shape in starts or _grid(candidate):
        with suppress(TrialGivenUp):
            fits.append(_started(system.hurried(), base, candidate, shape))
    if not fits:
        return None
    system = system.hurried(ALONG)
    first = min(fits, key=lambda f: f.cost)
    excess = [f.chi_square / diagnosis.noise - f.degrees_of_freedom for f in (base, first)]
    # beside others little may exceed the noise: there it is to describe more than what it stands in for
    if not (first.cost < diagnosis.after.cost if kept else excess[1] < WORTH_A_SHAPE * excess[0]):
        return None
    if kept:
        before = _held_out(system, diagnosis, base)
    expected = {q.name: _first_order(system, first, q) for q in candidate.shape}
    free = tuple(q for q in candidate.shape if np.isfinite(expected[q.name]))
    fitted = first
    noise, settings = diagnosis.noise, diagnosis.settings
    goal = settings.at_noise * noise * first.degrees_of_freedom + first.penalty
    for q in free:
        fitted = profiled(system, fitted, q, expected[q.name], goal)
    at_noise = fitted.reduced_chi_square <= settings.at_noise * noise
    if not (fitted.converged and at_noise and all(_determined(fitted, q) for q in free)) or before is None:
        return None
    quantities = (*candidate.quantities, *free)
    gain = (base.cost - fitted.cost) / noise
    enough = threshold(system, settings, len(quantities))
    held = _held_out(system, diagnosis, fitted)
    held_gain = 2 * (held.log_density - before.log_density) / noise
    if not (gain > enough and held_gain > 0):
        return None
    found = Found(replace(candidate, quantities=quantities), float(gain), float(held_gain), enough, ())
    reason = f"chi-square falls to {fitted.reduced_chi_square:.3g} per degree of freedom at a noise of {noise:.3g}"
    tried = tuple(
        Tried(t.candidate, t.score, float(gain), float(held_gain), "chosen, with its shape free")
        if t.candidate.name == candidate.name
        else replace(t, reason="explains less than the law that was chosen")
        if t.reason == "chosen" and t.candidate.name not in {f.candidate.name for f in kept}
        else t
        for t in diagnosis.tried
    )
    return replace(
        diagnosis,
        verdict="found",
        reason=reason,
        found=(*kept, found),
        after=fitted,
        held_out_after=held,
        tried=tried,
        partial=(),
    )


def _without_others(system: System, diagnosis: Diagnosis, kept: Sequence[Found]) -> Fit:
    """The fit with these of the effects that were found, and without the others."""
    quantities = {q.name: q for q in diagnosis.before.quantities}
    quantities |= {q.name: q for f in kept for q in f.candidate.quantities}
    null = {q.name: q.null for f in diagnosis.found for q in f.candidate.quantities if q.name not in quantities}
    return fit(system, tuple(quantities.values()), diagnosis.after.values | null)
