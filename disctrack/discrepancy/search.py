"""Which effects does the model lack? Forward search with refits, judged by information criterion and held-out data.

Guards against what is known to mislead: nothing is attributed before the base fit has converged; every candidate that
counts is refitted together with all that the base fit moves, within its bounds; the gain must beat the best of as many
candidates as were looked at; and a free run over data that the fit has not seen must become more probable.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np
from scipy import stats

from calibration.kit.arrays import Mask
from calibration.kit.brief import Outline
from disctrack.discrepancy.chance import Chance, chance
from disctrack.discrepancy.fit import Fit, fit, no_fit, prior_residual
from disctrack.discrepancy.held_out import TRAIN_FRACTION, HeldOut, held_out, training_rows
from disctrack.discrepancy.memory import inflation
from disctrack.discrepancy.row_noise import THIRD, RowWhitened, common_modes, third_differences, whitened
from disctrack.discrepancy.score import Linearisation, Score, angle, score_all, score_pairs
from disctrack.discrepancy.significance import TWO_SIDED
from disctrack.discrepancy.system import (
    Candidate,
    Quantity,
    System,
    TrialGivenUp,
    Values,
)

CLASS_GAIN = 10.0  # two explanations whose chi-square differs by less are not told apart (odds of e^5)
OBVIOUS = 5.0  # times the gain that noise alone does not reach
ROUGH = 1e-2  # of chi-square at stake, below which what a fit may still gain in a rough valley decides nothing
FAINT = 1e3  # chi-square of an effect, below which many others may do as well as it
MOST_RIVALS = 12
NOT_CONVERGED = "its refit does not converge"
CANCELLING = 0.1  # share of the lesser of two faults' power that their sum keeps, below which they undo each other
SOON = 0.3  # of the time that a trial has, for the first steps of one beyond a threshold
FIRST_STEPS, PROMISING = 4, 0.7  # of a refit beyond a threshold, and the share of chi-square that they must get below
FAR, AGREES = 10.0, 2.0  # variances of the noise: a motion far from the data, and one that a beginning agrees with
UNEXPLAINED_SHARE = 0.05  # of the excess chi-square, up to which effects are named although something else is left


@dataclass(frozen=True)
class Settings:
    """How hard to look, and how sure to be."""

    false_alarm: float = 0.005  # probability that noise alone brings a claim, over all candidates
    max_effects: int = 3
    shortlist: int = 8  # candidates that are refitted in full in each round
    judged: int = 3  # of them, that also have to stand a free run
    train_fraction: float = TRAIN_FRACTION
    at_noise: float = 1.1  # reduced chi-square over the noise found in the data, up to which nothing is left
    unexplained_share: float = UNEXPLAINED_SHARE
    noise: float | None = None  # variance over that stated; None: from the residual's fast part


@dataclass(frozen=True)
class Trial:
    """One more candidate fitted together with everything before it."""

    candidates: tuple[Candidate, ...]  # all effects of the fit
    fit: Fit
    gain: float  # decrease of chi-square against the fit before, in units of the noise found
    held_out: HeldOut | None = None  # not asked for where something else decides already
    held_out_gain: float | None = None  # increase of 2 log density of the test data, in the same units


@dataclass(frozen=True)
class Rival:
    """Another effect that explains the same."""

    candidate: Candidate
    angle: float  # [rad] between the predicted residuals, cleared of what other quantities absorb
    loss: float  # chi-square with the rival in place of the effect, minus that with the effect
    fit: Fit


@dataclass(frozen=True)
class Found:
    """An effect that is missing in the model."""

    candidate: Candidate
    gain: float  # chi-square lost when the effect is taken out again
    held_out_gain: float
    threshold: float  # gain that noise alone does not reach
    cannot_be_told_from: tuple[Rival, ...]


@dataclass(frozen=True)
class Tried:
    """What became of one candidate."""

    candidate: Candidate
    score: float  # first-order gain against the base fit
    gain: float | None  # of the first refit, over the fit that was the best before it
    held_out_gain: float | None
    reason: str


@dataclass(frozen=True, repr=False)
class Diagnosis(Outline):
    """Answer of the search."""

    verdict: str  # "nothing missing", "found" or "unexplained"
    reason: str  # in words
    found: tuple[Found, ...]
    before: Fit
    after: Fit
    held_out_before: HeldOut | None
    held_out_after: HeldOut | None
    noise: float  # variance of the noise found in the residual's fast part, over that stated
    tried: tuple[Tried, ...]
    settings: Settings = field(default_factory=Settings)
    partial: tuple[Candidate, ...] = ()  # effects that help most, refused because they leave too much
    nearest: Fit | None = None  # with them
    judged: System | None = None  # what the fits were made of: the system with its noise as found; None: unchanged
    chance: Chance | None = None  # with which noise alone would let some candidate gain as much as the best does


def diagnose(
    system: System, start: Values, settings: Settings | None = None, rows: Mask | None = None,
    former: Diagnosis | None = None,
) -> Diagnosis:  # fmt: skip
    """Fit the base model, look for what it lacks, and say how sure that is.

    start : values of the base quantities from which Gauss-Newton converges
    rows : (n,) samples of the fits that are judged by the others; the first part of the time, if not given
    former : of nearly the same system: the fits of the effects that it found begin where its fits ended, too
    """
    settings = settings or Settings()
    base = fit(system, system.base, start)
    if not (base.converged or _near_enough(system, base)):
        return _refusal(base, settings)
    answer = _Search(system, settings, rows, former).run(base)
    if settings.noise is not None or answer.verdict == "unexplained":
        return answer
    # looked for only here: what a large effect does from frame to frame would pass for scatter
    modes = common_modes(system, answer.after)
    if modes is None:
        return answer
    judged = whitened(system, modes)
    return replace(_Search(judged, settings, rows, former).run(base), judged=judged)


def noise_variance(system: System, fit_: Fit) -> float:
    """Variance of the fast part of the residual over that stated, from third differences in time.

    1 where there are too few samples for that.
    """
    difference, rows = third_differences(system, fit_)
    if len(rows) < 20:
        return 1.0
    return float(np.sum(difference**2) / 20.0 / np.sum(system.weights[rows]))


class _Search:
    def __init__(
        self, system: System, settings: Settings, rows: Mask | None = None, former: Diagnosis | None = None
    ) -> None:
        self.system, self.settings = system, settings
        self.former: dict[frozenset[str], Values] = {}  # by the effects fitted: where their fits ended
        if former is not None:
            self.former[frozenset(f.candidate.name for f in former.found)] = former.after.values
            if former.nearest is not None:
                self.former[frozenset(c.name for c in former.partial)] = former.nearest.values
        self.rows = training_rows(system, settings.train_fraction) if rows is None else rows
        self.candidates = tuple(c for c in system.candidates if not c.sought)
        self.noise = 1.0
        self.refits: dict[str, Trial] = {}
        self.rough = system.several_minima
        self.fits: dict[frozenset[str], Fit] = {}  # by the effects fitted: each combination has one minimum
        self.free_runs: list[tuple[Fit, HeldOut]] = []

    def run(self, start: Fit) -> Diagnosis:
        base = start
        if isinstance(self.system, RowWhitened):
            base = fit(self.system, self.system.base, start.values)
            if not base.converged:
                return _refusal(base, self.settings)
        self.fits[frozenset()] = base
        self.noise = self._noise(base)
        current = Trial((), base, 0.0, self._held_out(base), 0.0)
        before = current
        linear = Linearisation(self.system, base, self.candidates)
        scores = score_all(linear, self.candidates)
        by_chance = chance(linear, scores, self.noise) if scores else None
        while len(current.candidates) < self.settings.max_effects:
            better = self._next(current, linear, scores if not current.candidates else None)
            if better is None:
                break
            current = self._pruned(better)
            # a large effect reaches into the fast part of the residual: with it in the model, the noise is seen better
            self.noise = min(self.noise, self._noise(current.fit))
            linear = Linearisation(self.system, current.fit, self.candidates)
        if current.candidates and not self._worth_naming(before, current):
            answer = self._answer(before, before, (), scores, partial=current)
            return replace(answer, chance=by_chance, nearest=current.fit)
        current = self._standing(current)
        current, rivals = self._settled(current)
        found = tuple(self._found(current, c, rivals[c.name]) for c in current.candidates)
        return replace(self._answer(before, current, found, scores), chance=by_chance)

    def _noise(self, fit_: Fit) -> float:
        stated = self.settings.noise
        return max(noise_variance(self.system, fit_) if stated is None else stated, 1e-12)

    def _worth_naming(self, before: Trial, after: Trial) -> bool:
        """Does what was found explain the residual, if not to noise then nearly all of it, in the free run too?

        In a residual that none of them makes, wrong effects gain a lot as well; they leave a good part of it.
        """
        if self._at_noise(after.fit):
            return True
        excess = [trial.fit.chi_square / self.noise - trial.fit.degrees_of_freedom for trial in (before, after)]
        held = [t.held_out for t in (before, after) if t.held_out]
        free = [h.chi_square / self.noise - h.expected for h in held]
        # where next to nothing moves in what was kept back, no model errs there: what it lacks elsewhere is the measure
        at_stake = max(free[0], excess[0] * held[0].n_data / max(before.fit.n_data, 1))
        share = self.settings.unexplained_share
        return excess[1] < share * excess[0] and free[1] < share * at_stake

    def threshold(self, k: int) -> float:
        """Gain with k quantities that noise reaches with the allowed probability, over all candidates."""
        return float(stats.chi2.isf(self.settings.false_alarm / max(len(self.system.candidates), 1), k))

    def _cost(self, trial: Fit) -> float:
        return trial.cost / self.noise

    def _price(self, candidates: Iterable[Candidate]) -> float:
        """Bayesian information criterion's price of the quantities."""
        names = {n for c in candidates for n in c.names}
        return len(names) * float(np.log(max(np.sum(self.system.weights), 2)))

    def _quantities(self, candidates: Sequence[Candidate]) -> tuple[Quantity, ...]:
        new = {q.name: q for c in candidates for q in c.quantities}
        return tuple(q for q in self.system.base if q.name not in new) + tuple(new.values())

    def _held_out(self, fit_: Fit) -> HeldOut:
        known = next((held for of, held in self.free_runs if of is fit_), None)
        if known is None:
            known = held_out(self.system, fit_.quantities, fit_.values, self.rows)
            self.free_runs.append((fit_, known))
        return known

    def _fit(self, candidates: Sequence[Candidate], start: Values, patient: bool = False) -> Fit:
        """With these effects.   patient : however long it takes; else a fit that is given up has not converged"""
        key = frozenset(c.name for c in candidates)
        if key in self.fits and not self._better(start, self.fits[key]):
            return self.fits[key]
        values = dict(start)
        for c in candidates:
            for name, value in zip(c.names, c.start, strict=False):
                values.setdefault(name, value)
        quantities = self._quantities(candidates)
        try:
            found = fit(self.system if patient else self.system.hurried(), quantities, values)
        except TrialGivenUp:
            return no_fit(quantities, values)
        if found.converged and not any(c.threshold for c in candidates):  # beyond thresholds there are several minima
            self.fits[key] = found
        return found

    def _better(self, start: Values, known: Fit) -> bool:
        """Does a fit begin below the minimum that is known of its effects? Then that was not the lowest."""
        if not self.rough:
            return False
        values = known.values | {q.name: start.get(q.name, q.null) for q in known.quantities}
        right = prior_residual(known.quantities, values)
        cost = float(np.sum(self.system.linearise(values, ())[0] ** 2) + right @ right)
        return cost < known.cost - CLASS_GAIN * self.noise

    def _best_fit(self, current: Trial, extra: Sequence[Candidate]) -> Fit:
        """Refit with the extra candidates, from each of its starts where one acts beyond a threshold only."""
        together = [*current.candidates, *extra]
        starts: list[dict[str, float]] = [{}]
        for c in extra:
            if c.threshold:
                starts = [dict(zip(c.names, s, strict=True)) for s in self.system.starts(c, current.fit.values)]
        if extra and all(c.threshold for c in extra):
            for start in starts:
                followed = self._followed(current, together, start)
                if followed is not None and self._at_noise(followed):
                    return followed
            # a refit beyond a threshold is long: only where it leads somewhere
            starts = [s for s in starts if self._promising(current, together, s)]
        fits = [self._fit(together, current.fit.values | start) for start in starts]
        if (ended := self.former.get(frozenset(c.name for c in together))) is not None:
            fits.append(self._fit(together, ended))
        declared = {q.name: q.declared for q in self.system.base if q.declared is not None}
        if declared and fits and not any(f.converged for f in fits):
            # without the effect the others may have gone so far to make up for it that no step leads back
            fits.append(self._fit(together, current.fit.values | declared))
        return min(fits, key=lambda f: (not f.converged, f.cost)) if fits else current.fit

    def _promising(self, current: Trial, together: Sequence[Candidate], start: Values) -> bool:
        """Have some steps from this start removed a good part of the residual?"""
        values = dict(current.fit.values) | dict(start)
        try:
            few = fit(self.system.hurried(SOON), self._quantities(together), values, max_iterations=FIRST_STEPS)
        except TrialGivenUp:
            return False
        return few.cost < PROMISING * current.fit.cost

    def _followed(self, current: Trial, together: Sequence[Candidate], start: Values) -> Fit | None:
        """Refit that comes from longer and longer beginnings; None where one of them does not fit to the noise.

        Each instant at which a threshold is passed is a valley of its own: from a motion that ignores it no step leads
        to the one in which all of them are right. Where the residual is small, a step does.
        """
        values, quantities = {**current.fit.values, **start}, self._quantities(together)
        if current.fit.reduced_chi_square < FAR * self.noise:
            return None
        for part in self.system.beginnings():
            try:
                found = fit(part.hurried(len(self.system.time) / len(part.time)), quantities, values)
            except TrialGivenUp:
                return None
            if not found.converged or found.reduced_chi_square > AGREES * self.noise:
                return None
            values = found.values
        return self._fit(together, values)

    def _judged(self, current: Trial, trial: Trial) -> Trial:
        """With the free run over held-out data."""
        assert current.held_out is not None
        held = self._held_out(trial.fit)
        gain = 2 * (held.log_density - current.held_out.log_density) / self.noise
        if np.isnan(gain):  # neither predicts anything
            gain = -np.inf
        return replace(trial, held_out=held, held_out_gain=float(gain))

    def _next(self, current: Trial, linear: Linearisation, scores: list[Score] | None) -> Trial | None:
        """The best admissible enlargement, or None."""
        trials: list[tuple[tuple[Candidate, ...], Trial]] = []
        # beyond thresholds the prediction has kinks and a refit is long: last, and only where no other will do
        for extra in sorted(self._shortlist(current, linear, scores), key=lambda e: any(c.threshold for c in e)):
            if any(c.threshold for c in extra) and any(self._nearly_all(current, t) for _, t in trials):
                continue
            refitted = self._best_fit(current, extra)
            trial = Trial((*current.candidates, *extra), refitted, self._cost(current.fit) - self._cost(refitted))
            trials.append((extra, trial))
            if len(extra) == 1:
                self.refits.setdefault(extra[0].name, trial)
        trials.sort(key=lambda item: self._criterion(item[1]))
        chosen: Trial | None = None
        obvious: Trial | None = None
        for rank, (extra, trial) in enumerate(trials):
            # where fits have several minima the best of them may stand no free run, and the next ones do
            if rank >= self.settings.judged and (chosen or obvious or not self.rough):
                break
            if not self._enough(trial, extra):
                continue
            judged = self._judged(current, trial)
            if len(extra) == 1 and self.refits[extra[0].name] is trial:
                self.refits[extra[0].name] = judged
            held = judged.held_out_gain
            if chosen is None and held is not None and held > 0:
                chosen = judged
            elif obvious is None and self._obvious(judged, extra):
                obvious = judged
        return chosen or obvious

    def _obvious(self, trial: Trial, extra: Sequence[Candidate]) -> bool:
        """Does it gain far more than noise does, while samples that were not fitted do not speak against it?

        The fitted part may know all that there is to know of it.
        """
        held = trial.held_out_gain
        k = len({n for c in extra for n in c.names})
        return held is not None and held > -CLASS_GAIN and trial.gain > OBVIOUS * self.threshold(k)

    def _nearly_all(self, before: Trial, after: Trial) -> bool:
        """Does the enlargement remove nine tenths of what exceeds the noise, and is little left?"""
        excess = [t.fit.chi_square / self.noise - t.fit.degrees_of_freedom for t in (before, after)]
        near = after.fit.reduced_chi_square < FAR * self.noise
        return after.fit.converged and near and excess[1] < 0.1 * excess[0]

    def _shortlist(
        self, current: Trial, linear: Linearisation, scores: list[Score] | None
    ) -> list[tuple[Candidate, ...]]:
        """Candidates, and pairs of them where one alone will not do, that are worth a refit."""
        taken = {c.name for c in current.candidates}
        scores = scores or score_all(linear, [c for c in self.candidates if c.name not in taken])
        if not scores:
            return []
        ranked = sorted(scores, key=lambda s: self._price([s.candidate]) - s.gain / self.noise)
        best = ranked[0].gain
        # near noise the first order is exact; far from it, a nonlinear refit may do better than its score
        worth = [
            s
            for i, s in enumerate(ranked[: self.settings.shortlist])
            if s.gain / self.noise > 0.5 * self.threshold(len(s.candidate.names)) and (i < 4 or s.gain > 0.3 * best)
        ]
        shortlist: list[tuple[Candidate, ...]] = [(s.candidate,) for s in worth]
        if self._at_noise(current.fit, best):
            return shortlist
        shortlist += [(c,) for c in self.system.candidates if c.threshold and c.name not in taken]
        room = len(taken) + 2 <= self.settings.max_effects
        if room and worth:
            shortlist += self._pairs(linear, [s.candidate for s in ranked[:14] if s.visible])
        return shortlist

    def _pairs(self, linear: Linearisation, candidates: Sequence[Candidate]) -> list[tuple[Candidate, ...]]:
        pairs = score_pairs(linear, candidates)
        pairs.sort(key=lambda p: self._price(p[1:]) - p[0] / self.noise)
        return [(a, b) for _, a, b in pairs[:3]]

    def _at_noise(self, fit_: Fit, gain: float = 0.0) -> bool:
        left = (fit_.chi_square - gain) / max(fit_.degrees_of_freedom, 1)
        limit = self.settings.at_noise
        if self.settings.noise is None:  # in a short recording both chi-square and the noise found in it scatter
            limit = max(limit, 1.0 + 4.0 * float(np.sqrt(2.0 * (1.0 + THIRD) / max(fit_.n_data, 1))))
        return left <= limit * self.noise

    def _criterion(self, trial: Trial) -> float:
        return self._cost(trial.fit) + self._price(trial.candidates)

    def _enough(self, trial: Trial, extra: Sequence[Candidate]) -> bool:
        k = len({n for c in extra for n in c.names})
        enough = self.threshold(k) if len(extra) == 1 else self.threshold(k) + self.threshold(1)
        rough = self.rough and trial.fit.promised < ROUGH * trial.gain
        return (trial.fit.converged or rough) and trial.gain > enough and not self._incredible(trial, extra)

    def _incredible(self, trial: Trial, extra: Sequence[Candidate]) -> bool:
        """Is an amount at the limit of what is ever met, or do forces or faults of the measurement undo each other?"""
        values = trial.fit.values
        limits = [(values[q.name], q) for c in extra if c.kind == "measurement" for q in c.quantities]
        if any(v != q.null and not q.lower < v < q.upper for v, q in limits):
            return True
        if self.system.undo_each_other(trial.candidates, values, self.fits[frozenset()].values):
            return True
        faults = [c for c in trial.candidates if c.kind == "measurement"]
        if len(faults) < 2:
            return False
        names = [q.name for c in faults for q in c.quantities]
        _, derivative = self.system.linearise(values, names)
        signals, first = [], 0
        for c in faults:
            amount = np.array([values[q.name] - q.null for q in c.quantities])
            signals.append((derivative[..., first : first + len(amount)] @ amount).ravel())
            first += len(amount)
        powers = [float(s @ s) for s in signals]
        pairs = combinations(range(len(faults)), 2)
        return any(np.sum((signals[a] + signals[b]) ** 2) < CANCELLING * min(powers[a], powers[b]) for a, b in pairs)

    def _pruned(self, trial: Trial) -> Trial:
        """Without effects that have become unnecessary."""
        for candidate in trial.candidates[:-1]:
            rest = tuple(c for c in trial.candidates if c is not candidate)
            smaller = self._fit(rest, _without(trial.fit.values, candidate, rest))
            loss = self._cost(smaller) - self._cost(trial.fit)
            if loss < self.threshold(len(candidate.names)):  # converged or not: further on it would lose less
                trial = replace(trial, candidates=rest, fit=smaller, held_out=self._held_out(smaller))
        return trial

    def _standing(self, trial: Trial) -> Trial:
        """Without effects that gain no more than a residual with the memory of what is left may give them."""
        while trial.candidates and self.settings.noise is None:
            left = max(1.0, trial.fit.reduced_chi_square / self.noise)  # what is left counts as noise does
            factors = dict(zip(trial.fit.names, inflation(self.system, trial.fit), strict=True))
            losses = []
            for candidate in trial.candidates:
                rest = tuple(c for c in trial.candidates if c is not candidate)
                smaller = self._fit(rest, _without(trial.fit.values, candidate, rest))
                loss = self._cost(smaller) - self._cost(trial.fit)
                enough = left * self.threshold(len(candidate.names)) * max(factors[n] for n in candidate.names) ** 2
                if smaller.converged or loss < enough:  # a fit that has not converged loses even less further on
                    losses.append((loss / enough, candidate.name, rest, smaller))
            if not losses or min(losses, key=lambda item: item[0])[0] >= 1.0:
                return trial
            _, _, rest, smaller = min(losses, key=lambda item: item[0])
            trial = replace(trial, candidates=rest, fit=smaller, held_out=self._held_out(smaller))
        return trial

    def _settled(self, trial: Trial) -> tuple[Trial, dict[str, list[Rival]]]:
        """Every effect exchanged for each of its rivals; a better one stays. Returns the rivals per effect too."""
        rivals: dict[str, list[Rival]] = {}
        for position in range(len(trial.candidates)):
            found = self._rivals(trial, position)
            better = min(found, key=lambda r: self._swapped_criterion(trial, position, r), default=None)
            if better and self._swapped_criterion(trial, position, better) < self._criterion(trial) - 1e-6:
                swapped = list(trial.candidates)
                swapped[position] = better.candidate
                new = replace(trial, candidates=tuple(swapped), fit=better.fit, held_out=self._held_out(better.fit))
                undone = self.system.undo_each_other(swapped, better.fit.values, self.fits[frozenset()].values)
                if not undone and self._log_density(new) > self._log_density(trial) - CLASS_GAIN / 2 * self.noise:
                    trial = new
                    found = self._rivals(trial, position)
            rivals[trial.candidates[position].name] = [r for r in found if r.loss < CLASS_GAIN]
        return trial, rivals

    @staticmethod
    def _log_density(trial: Trial) -> float:
        return trial.held_out.log_density if trial.held_out is not None else -np.inf

    def _swapped_criterion(self, trial: Trial, position: int, rival: Rival) -> float:
        others = [c for i, c in enumerate(trial.candidates) if i != position]
        fitted = self._cost(rival.fit) + self._price([*others, rival.candidate])
        # only against the one that it would replace: how surprising is each value?
        return fitted + _surprise(rival.candidate, rival.fit) - _surprise(trial.candidates[position], trial.fit)

    def _rivals(self, trial: Trial, position: int) -> list[Rival]:
        """Effects that predict nearly the same residual, refitted in place of the effect."""
        effect = trial.candidates[position]
        rest = tuple(c for c in trial.candidates if c is not effect)
        reduced = _restricted(trial.fit, self._quantities(rest))
        linear = Linearisation(self.system, reduced, self.candidates)
        amount = np.array([trial.fit.values[q.name] - q.null for q in effect.quantities])
        signal = linear.columns(effect.names) @ amount
        strength = float(np.sum(linear.cleared(signal[:, None]) ** 2)) / self.noise
        others = [c for c in self.candidates if c.name not in {d.name for d in trial.candidates}]
        angles = {c.name: angle(linear, signal, c.names) for c in others}
        near = sorted(others, key=lambda c: angles[c.name])
        near = [c for c in near if strength * np.sin(angles[c.name]) ** 2 < 4 * CLASS_GAIN + 0.02 * strength]
        near = near[: MOST_RIVALS if strength < FAINT else MOST_RIVALS // 2]
        found = []
        for candidate in near:
            refitted = self._fit((*rest, candidate), _without(trial.fit.values, effect, rest))
            loss = self._cost(refitted) - self._cost(trial.fit)
            if refitted.converged:
                found.append(Rival(candidate, angles[candidate.name], loss, refitted))
        return found

    def _found(self, trial: Trial, candidate: Candidate, rivals: list[Rival]) -> Found:
        rest = tuple(c for c in trial.candidates if c is not candidate)
        without = self._fit(rest, _without(trial.fit.values, candidate, rest), patient=True)
        held = self._held_out(without)
        held_gain = 2 * (self._log_density(trial) - held.log_density) / self.noise
        gain = self._cost(without) - self._cost(trial.fit)
        return Found(candidate, gain, held_gain, self.threshold(len(candidate.names)), tuple(rivals))

    def _answer(
        self,
        before: Trial,
        after: Trial,
        found: tuple[Found, ...],
        scores: list[Score],
        partial: Trial | None = None,
    ) -> Diagnosis:
        explained = self._at_noise(after.fit)
        assert after.held_out is not None
        ratio = after.held_out.ratio_to_floor / np.sqrt(self.noise)
        left = f"{after.fit.reduced_chi_square:.3g} per degree of freedom at a noise of {self.noise:.3g}"
        if explained and found:
            verdict, reason = "found", f"chi-square falls to {left}; the free run errs by {ratio:.2f} of its floor"
        elif explained:
            verdict, reason = "nothing missing", f"chi-square is {left}, and no effect gains more than noise does"
        else:
            verdict, reason = (
                "unexplained",
                f"chi-square stays at {left}: no effect of the catalogue brings it to noise",
            )
        tried = tuple(self._tried(s, after, found) for s in scores)
        return Diagnosis(
            verdict,
            reason,
            found,
            before.fit,
            after.fit,
            before.held_out,
            after.held_out,
            self.noise,
            tried,
            self.settings,
            partial.candidates if partial is not None else (),
        )

    def _tried(self, score: Score, after: Trial, found: tuple[Found, ...]) -> Tried:
        c = score.candidate
        trial = self.refits.get(c.name)
        gain, held = (trial.gain, trial.held_out_gain) if trial else (None, None)
        return Tried(c, score.gain / self.noise, gain, held, self._why(score, trial, found))

    def _why(self, score: Score, trial: Trial | None, found: tuple[Found, ...]) -> str:
        c = score.candidate
        if any(c.name == f.candidate.name for f in found):
            return "chosen"
        for f in found:
            if any(c.name == r.candidate.name for r in f.cannot_be_told_from):
                return f"cannot be told from {f.candidate.name}"
        if c.threshold and trial is None:
            return "nothing is left that it could explain; beyond its threshold it does nothing"
        if not score.visible and trial is None:
            return "leaves no trace in this recording that other fitted quantities do not absorb"
        threshold = self.threshold(len(c.names))
        gain = trial.gain if trial else score.gain / self.noise
        if gain <= threshold:
            # beside an effect that was found, the first score says nothing of what may be there
            bound = "" if found else _bounds(score)
            return f"gains {gain:.3g}, noise alone reaches {threshold:.3g}{bound}"
        if trial and not trial.fit.converged:
            return NOT_CONVERGED
        if trial and trial.held_out_gain is not None and trial.held_out_gain <= 0:
            return "the free run over held-out data does not improve"
        than_chosen = "less than what was chosen" if found else "too little of what is missing"
        return f"gains {gain:.4g}, {than_chosen}"


def _near_enough(system: System, base: Fit) -> bool:
    """Is what a fit has not gained yet nothing beside what no fit of it will?

    Where equations jump, chi-square is rough: far above the noise no step may lead to the bottom of a rough valley.
    """
    excess = base.chi_square - base.degrees_of_freedom
    return system.several_minima and base.promised < ROUGH * excess


def _refusal(base: Fit, settings: Settings) -> Diagnosis:
    reason = (
        f"the base fit has not converged (chi-square {base.reduced_chi_square:.3g} per degree of freedom after "
        f"{base.n_iterations} iterations): before it has, every candidate seems to help, so "
        "that nothing is attributed"
    )
    return Diagnosis("unexplained", reason, (), base, base, None, None, np.nan, (), settings)


def _bounds(score: Score) -> str:
    """What the data leave room for, where they show no more than noise does."""
    sizes = zip(score.candidate.quantities, np.abs(score.values), score.sigma, strict=True)
    open_ = [(q, size + TWO_SIDED * sigma) for q, size, sigma in sizes if np.isfinite(size + sigma)]
    most = ", ".join(f"{q.part} < {b:.2g} {'' if q.unit == '1' else q.unit}".rstrip() for q, b in open_)
    return f"; only bounded: {most} (95 %)" if most else ""


def _surprise(candidate: Candidate, fit_: Fit) -> float:
    """Minus twice the logarithm of a heavy-tailed (Cauchy) prior as wide as the quantities' typical sizes."""
    sizes = [abs(fit_.values[q.name] - q.null) / q.typical for q in candidate.quantities]
    return 2.0 * float(np.log1p(max(sizes) ** 2))


def _without(values: Values, candidate: Candidate, rest: Sequence[Candidate]) -> dict[str, float]:
    """Values with the candidate's quantities back at null, unless another effect has them too."""
    kept = {n for c in rest for n in c.names}
    return dict(values) | {q.name: q.null for q in candidate.quantities if q.name not in kept}


def _restricted(fit_: Fit, quantities: tuple[Quantity, ...]) -> Fit:
    """The same fit with fewer quantities counted as free."""
    kept = {q.name for q in quantities}
    index = [i for i, name in enumerate(fit_.shared) if name in kept]
    return replace(fit_, quantities=quantities, covariance=fit_.covariance[np.ix_(index, index)])
