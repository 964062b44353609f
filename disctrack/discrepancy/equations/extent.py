"""Where declared equations hold: until when, from when on again, and how the states changed in between.

Equations that fail at one event (a blow, a gust, a hand on the bench) hold before it and after it. The first and the
last part of a run are refitted, each as long as what is left is noise. What happened between them is then the change of
the states that the equations do not give.
"""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from calibration.kit.types import Array, Indices
from disctrack.discrepancy.equations import shooting
from disctrack.discrepancy.equations.system import EquationSystem
from disctrack.discrepancy.fit import TRIAL, Fit, fit
from disctrack.discrepancy.held_out import most_that_hold
from disctrack.discrepancy.search import Diagnosis, is_noise
from disctrack.discrepancy.system import GivenUp, Values
from disctrack.numbers import measured

SHORTEST = 0.2  # share of a run, of a part that is tested, if that is less than a period: any equations follow less
END = 1.0 / 64.0  # share of a run, at the end of a part, that has to be noise by itself: a long part hides its end


@dataclass(frozen=True)
class Extent:
    """The parts of a run in which the equations hold."""

    until: float | None  # [s] last sample of the first part; None: they do not hold at first
    since: float | None  # [s] first sample of the last part; None: they do not hold at last
    changes: Mapping[str, tuple[float, float]]  # of states between both, beyond the equations, with their sigmas

    def text(self, units: Mapping[str, str]) -> str:
        """In words; empty where the equations hold in no part."""
        parts = [f"until {self.until:.5g} s"] if self.until is not None else []
        parts += [f"from {self.since:.5g} s on"] if self.since is not None else []
        if not parts:
            return ""
        text = f"Refitted, the equations hold {' and '.join(parts)}"
        changes = [f"{name} by {measured(*change, units.get(name, ''))}" for name, change in self.changes.items()]
        between = f"; in between the states changed by more than they say: {', '.join(changes)}" if changes else ""
        return f"{text}{between}."


def extent(system: EquationSystem, diagnosis: Diagnosis) -> Extent:
    """The longest first and last part of the only run that the equations, refitted, describe to noise."""
    (run,), changes = system.stretches, dict[str, tuple[float, float]]()
    seen = np.flatnonzero(np.isfinite(run.data).any(axis=1))
    first, last, few = 0, 0, max(int(END * len(seen)), 1)
    with suppress(GivenUp), system.budget.trial(system.trial_work):
        first = _longest(system, diagnosis, seen, few, at_end=False)
        last = _longest(system, diagnosis, seen, few, at_end=True)
    until, since = int(seen[first - 1]) if first else None, int(seen[-last]) if last else None
    # both parts may contain the first samples after an event
    if until is not None and since is not None and first + last <= len(seen) + 2 * few:
        ends = sorted((until, since))
        with suppress(GivenUp), system.budget.trial(system.trial_work):
            changes = _changes(system, diagnosis, *ends)
        until, since = ends if changes else (until, since)
    at = run.time.tolist()
    return Extent(None if until is None else at[until], None if since is None else at[since], changes)


def _longest(system: EquationSystem, diagnosis: Diagnosis, seen: Indices, few: int, at_end: bool) -> int:
    """The most of the samples with data in a first part, or a last one `at_end`, of which the equations leave noise."""
    (run,), n, values = system.stretches, len(seen), dict(diagnosis.before.values)

    def holds(count: int) -> bool:
        part = run.part(seen[n - count], len(run.time)) if at_end else run.part(0, seen[count - 1] + 1)
        fitted = _described(replace(system, stretches=[part]), diagnosis, values, few, at_end)
        values.update(fitted.values if fitted else {})
        return fitted is not None

    time = run.time[seen] - run.time[seen[0]]
    shortest = int(np.searchsorted(time, min(SHORTEST * float(time[-1]), shooting.period(run))))
    return most_that_hold(holds, max(shortest, 2 * len(system.base)), n)


def _described(part: EquationSystem, diagnosis: Diagnosis, values: Values, few: int, at_end: bool) -> Fit | None:
    """The fit to a part, the initial state first; None if it leaves more than noise, also in the few that end it."""
    begin = dict(values) | shooting.initial_guess(part)[0]
    begin |= fit(part, [q for q in part.base if q.is_initial], begin, TRIAL).values
    fitted = fit(part, [shooting.with_weak_prior(q) for q in part.base], begin, TRIAL)
    if not is_noise(fitted, diagnosis.settings, diagnosis.noise):
        return None
    rows = np.flatnonzero(part.weights)[slice(few) if at_end else slice(-few, None)]
    left = float(np.sum(part.linearise(fitted.values, [])[0][rows] ** 2)) / diagnosis.noise
    bisections = 2.0 * np.log2(len(part.weights))  # on both sides, whose false alarms add up
    limit = stats.chi2.isf(diagnosis.settings.false_alarm / bisections, np.sum(part.weights[rows]))
    return fitted if left < limit else None


def _changes(system: EquationSystem, diagnosis: Diagnosis, first: int, last: int) -> dict[str, tuple[float, float]]:
    """Change of every state from sample `first` to `last`; empty if no numbers hold before and after."""
    (run,) = system.stretches
    before, after, between = run.part(0, first + 1), run.part(last, len(run.time)), run.part(0, last + 1)
    both = replace(system, stretches=[before, after])
    begin = diagnosis.before.values | shooting.initial_guess(both)[0]
    fitted = fit(both, [replace(q, slot="") for q in both.base], begin)  # for the covariance of all of them
    if not (fitted.converged and is_noise(fitted, diagnosis.settings, diagnosis.noise)):
        return {}

    def change(values: Values) -> Array:
        motion = both.predict(values, between)
        return both.start_of(values, after) - (np.nan if motion is None else motion.states[-1])

    now, steps = change(fitted.values), {name: fitted.sigma(name) or 1.0 for name in fitted.names}
    moved = [change({**fitted.values, name: fitted.values[name] + step}) - now for name, step in steps.items()]
    slopes = np.stack(moved, axis=1) / [*steps.values()]
    sigmas = np.sqrt(np.maximum(np.diag(slopes @ fitted.covariance @ slopes.T), 0.0))
    states = system.formulas.equations.states
    return {name: (float(x), float(sigma)) for name, x, sigma in zip(states, now, sigmas, strict=True)}
