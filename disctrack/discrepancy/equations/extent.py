"""Where declared equations hold: until when, from when on again, and how the states changed in between.

Equations that fail at one event (a blow, a gust, a hand on the bench) hold before it and after it. The first and the
last part of a run are refitted, each as long as what is left is noise. What happened between them is then the change of
the states that the equations do not give.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from calibration.kit.arrays import Array
from disctrack.discrepancy.equations import shooting
from disctrack.discrepancy.equations.declared import Samples
from disctrack.discrepancy.equations.system import EquationSystem
from disctrack.discrepancy.fit import TRIAL, Fit, fit
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
    return _Parts(system, diagnosis).extent()


class _Parts:
    """Parts of a run, refitted with what was declared."""

    def __init__(self, system: EquationSystem, diagnosis: Diagnosis) -> None:
        self.system, self.diagnosis = system, diagnosis
        (self.run,) = system.stretches

    def extent(self) -> Extent:
        n, changes = len(self.run.time), dict[str, tuple[float, float]]()
        until, since = 0, n
        with suppress(GivenUp), self.system.budget.trial(self.system.trial_steps):
            until, since = self._longest(at_end=False), n - self._longest(at_end=True)
            if until > 0 and since < n:  # both may contain the first samples after an event
                changes = self._changes(*sorted((until, since)))
        if changes:
            until, since = sorted((until, since))
        time = self.run.time.tolist()
        return Extent(time[until - 1] if until else None, time[since] if since < n else None, changes)

    def _longest(self, at_end: bool) -> int:
        """The most samples of a first part, or of a last part `at_end`, of which the equations leave noise."""
        n, values = len(self.run.time), self.diagnosis.before.values
        duration = min(SHORTEST * float(np.ptp(self.run.time)), shooting.period(self.run))
        low, high, count = 0, n, int(np.searchsorted(self.run.time - self.run.time[0], duration))
        while high - low > 1:
            part = self.run.part(n - count, n) if at_end else self.run.part(0, count)
            fitted = self._described(part, values, at_end)
            if fitted is None and low == 0:
                return 0
            if fitted is None:
                high = count
            else:
                low, values = count, fitted.values
            count = (low + high) // 2
        return low

    def _described(self, part: Samples, values: Values, at_end: bool) -> Fit | None:
        """The fit to a part, the initial state first; None if it leaves more than noise, there or where it ends."""
        there = replace(self.system, stretches=[part])
        begin = dict(values) | shooting.initial_guess(there)[0]
        begin |= fit(there, [q for q in there.base if q.is_initial], begin, TRIAL).values
        fitted = fit(there, [shooting.with_weak_prior(q) for q in there.base], begin, TRIAL)
        if not self._is_noise(fitted):
            return None
        m = max(int(END * len(self.run.time)), 1)
        rows = slice(m) if at_end else slice(len(part.time) - m, len(part.time))
        left = float(np.sum(there.linearise(fitted.values, [])[0][rows] ** 2)) / self.diagnosis.noise
        n_data = max(float(np.sum(there.weights[rows])), 1.0)
        return fitted if left < stats.chi2.isf(self.diagnosis.settings.false_alarm, n_data) else None

    def _is_noise(self, fitted: Fit) -> bool:
        return is_noise(fitted, self.diagnosis.settings, self.diagnosis.noise)

    def _changes(self, first: int, last: int) -> dict[str, tuple[float, float]]:
        """Change of every state from sample `first` - 1 to `last`; empty if no numbers hold before and after."""
        before, after = self.run.part(0, first), self.run.part(last, len(self.run.time))
        both = replace(self.system, stretches=[before, after])
        begin = self.diagnosis.before.values | shooting.initial_guess(both)[0]
        shared = [replace(q, slot="") for q in both.base]  # for the covariance of all of them
        fitted = fit(both, shared, begin)
        if not (fitted.converged and self._is_noise(fitted)):
            return {}
        between = self.run.part(0, last + 1)

        def change(values: Values) -> Array:
            motion = both.predict(values, between)
            return both.start_of(values, after) - (np.nan if motion is None else motion.states[-1])

        now, steps = change(fitted.values), {name: fitted.sigma(name) or 1.0 for name in fitted.names}
        moved = ({**fitted.values, name: fitted.values[name] + step} for name, step in steps.items())
        slopes = np.stack([(change(values) - now) / step for values, step in zip(moved, steps.values(), strict=True)])
        sigmas = np.sqrt(np.diag(slopes.T @ fitted.covariance @ slopes))
        states = self.system.formulas.equations.states
        return {name: (float(x), float(sigma)) for name, x, sigma in zip(states, now, sigmas, strict=True)}
