"""Which effects does the model lack? Sets of terms compete by one length, in units of -2 log evidence.

An explanation is a set of effects fitted together with all that the base fit moves. Its length is chi-square at the
noise found, the price of its terms (of each pick among so many, and of each further number), and the surprise of their
values; what no one would believe has none. Whatever linearisation says may be shorter is refitted: terms are added,
exchanged and taken out, from each of the shortest few. The answer is the shortest explanation that also predicts data
which its fit has not seen better than the shorter sets of its terms do, and whose terms stand out from the memory of
what is left.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Literal, TypeVar

import numpy as np
from scipy import stats

from calibration.kit.arrays import Mask
from calibration.kit.brief import Brief
from disctrack.discrepancy.fit import Fit, attempt, fit
from disctrack.discrepancy.held_out import HeldOut, held_out, training_rows
from disctrack.discrepancy.noise import THIRD, inflation, noise_variance, whitened
from disctrack.discrepancy.score import Linearisation, Score, angle, score_all
from disctrack.discrepancy.shape import WORTH_A_SHAPE, with_free_shape, with_shape
from disctrack.discrepancy.significance import TWO_SIDED, Chance, chance, price_of_a_number
from disctrack.discrepancy.system import Candidate, Quantity, System, Values

CLASS_GAIN = 10.0  # two explanations whose lengths differ by less are not told apart (odds of e^5)
OBVIOUS = 5.0  # times its price: a gain that the fitted part alone may know
WIDTH = 2  # explanations that are enlarged, or led on otherwise, as long as none leaves noise
ROUGH = 1e-2  # of chi-square at stake, below which what a fit may still gain in a rough valley decides nothing
FAINT = 1e3  # chi-square of an effect, below which many others may do as well as it
MOST_ALTERNATIVES = 12
FOR_LAWS = 0.5  # of the budget, that the known effects leave to laws that nobody named
CANCELLING = 0.1  # share of the least effect's power that a sum of effects keeps, below which they undo each other
FAR, AGREES = 10.0, 2.0  # variances of the noise: a motion far from the data, and one that a beginning agrees with
FIRST_ORDER = 1.0 / 3.0  # of what a faint effect is to describe, that it does to first order, at the shape assumed

Verdict = Literal["nothing missing", "found", "unexplained"]


@dataclass(frozen=True)
class Settings:
    """How hard to look, and how sure to be."""

    false_alarm: float = 0.005  # probability that noise alone brings a claim, over all candidates
    max_effects: int = 3
    shortlist: int = 8  # proposals of one term more that are refitted in full for each explanation
    judged: int = 4  # explanations that may be put to the free run
    at_noise: float = 1.1  # reduced chi-square over the noise found in the data, up to which nothing is left
    unexplained_share: float = 0.05  # of the excess chi-square, up to which effects are named although more is left
    noise: float | None = None  # variance over that stated; None: from the residual's fast part


@dataclass(frozen=True)
class Explanation:
    """Effects fitted together with all that the base fit moves."""

    candidates: tuple[Candidate, ...]
    fit: Fit
    credible: bool = True  # a fit that has converged, to amounts that may be
    length: float = np.inf  # as `length` has it, once the noise is known

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of its effects, sorted."""
        return tuple(sorted(c.name for c in self.candidates))

    @property
    def names(self) -> frozenset[str]:
        """Names of its effects, and of what is free of their shapes."""
        return _names(self.candidates)


@dataclass(frozen=True)
class Alternative:
    """Another effect that explains the same."""

    candidate: Candidate
    angle: float  # [rad] between the predicted residuals, cleared of what other quantities absorb
    loss: float  # chi-square with the alternative in place of the effect, minus that with the effect
    fit: Fit


@dataclass(frozen=True)
class Found:
    """An effect that is missing in the model."""

    candidate: Candidate
    gain: float  # chi-square lost when the effect is taken out again
    held_out_gain: float
    threshold: float  # gain that noise alone does not reach
    cannot_be_told_from: tuple[Alternative, ...]


@dataclass(frozen=True)
class Tried:
    """What became of one candidate."""

    candidate: Candidate
    score: float  # first-order gain against the base fit
    gain: float | None  # of the first refit, over the fit that was the best before it
    held_out_gain: float | None
    reason: str
    stuck: bool = False  # its refit has not converged


@dataclass(frozen=True, repr=False)
class Diagnosis(Brief):
    """Answer of the search."""

    verdict: Verdict
    reason: str  # in words
    found: tuple[Found, ...]
    before: Fit
    after: Fit
    held_out_before: HeldOut | None
    held_out_after: HeldOut | None
    noise: float  # variance of the noise found in the residual's fast part, over that stated
    tried: tuple[Tried, ...]
    settings: Settings = field(default_factory=Settings)
    nearest: Explanation | None = None  # by effects that help most, refused because they leave too much
    ranked: tuple[Explanation, ...] = ()  # all that can be believed, the shortest first
    length: float = np.nan  # of the answer
    judged: System | None = None  # what the fits were made of: the system with its noise as found; None: unchanged
    remarks: tuple[str, ...] = ()  # on shapes of laws that the data leave open
    chance: Chance | None = None  # with which noise alone would let some candidate gain as much as the best does

    @property
    def explanations(self) -> tuple[tuple[tuple[str, ...], float], ...]:
        """Sets of effects whose length does not tell them from the answer, the shortest first, and by how much."""
        listed = ((e.effects, e.length - self.length) for e in self.ranked)
        return tuple(item for item in listed if abs(item[1]) < CLASS_GAIN)


Former = Mapping[frozenset[str], Values]  # by names of effects
E = TypeVar("E", bound=Explanation)


def alike(explanations: Iterable[E]) -> list[E]:
    """The shortest, and after it those that the data do not tell from it."""
    ranked = sorted(explanations, key=lambda e: e.length)
    return [e for e in ranked if e.length <= ranked[0].length + CLASS_GAIN]


def explain(
    system: System, start: Values, settings: Settings | None = None, rows: Mask | None = None,
    former: Former | None = None,
) -> Diagnosis:  # fmt: skip
    """Fit the base model, look for what it lacks, and say how sure that is.

    start : values of the base quantities from which Gauss-Newton converges
    rows : (n,) samples of the fits that are judged by the others; the first part of the time, if not given
    former : explanations that are known to lead somewhere, as where their fits may begin: without one the base model
        has to follow the data
    """
    settings = settings or Settings()
    answer = _searched(system, start, settings, rows, former)
    # looked for only here: what a large effect does from frame to frame would pass for scatter
    wanted = settings.noise is None and answer.verdict != "unexplained"
    if wanted and (judged := whitened(system, answer.after)) is not None:
        answer = replace(_searched(judged, answer.before.values, settings, rows, former), judged=judged)
    return with_shapes(system, answer) if system.frees_shapes else answer


def _searched(system: System, start: Values, settings: Settings, rows: Mask | None, former: Former | None) -> Diagnosis:
    base = fit(system, system.base, start)
    if not (base.converged or _near_enough(system, base) or (former and np.isfinite(base.cost))):
        return _refusal(base, settings)
    return _Search(system, settings, rows, former).run(base)


def with_shapes(system: System, diagnosis: Diagnosis) -> Diagnosis:
    """The diagnosis with the shapes of the laws that were found fitted along, where the data determine them."""
    system, before = diagnosis.judged or system, diagnosis.after
    for i, found in enumerate(diagnosis.found):
        candidate, after = found.candidate, diagnosis.after
        if not candidate.shape or {q.name for q in candidate.shape} & set(after.names):
            continue
        fitted, known, notes = with_shape(system, after, candidate)
        larger = replace(candidate, quantities=(*candidate.quantities, *known))
        better = replace(found, candidate=larger, gain=found.gain + (after.cost - fitted.cost) / diagnosis.noise)
        everything = (*diagnosis.found[:i], better, *diagnosis.found[i + 1 :])
        diagnosis = replace(diagnosis, found=everything, after=fitted, remarks=(*diagnosis.remarks, *notes))
    if diagnosis.after is before:
        return diagnosis
    rows = training_rows(system)
    held = held_out(system, diagnosis.after.quantities, diagnosis.after.values, rows)
    return replace(diagnosis, held_out_after=held)


def with_found(diagnosis: Diagnosis, found: Sequence[Found]) -> Diagnosis:
    """The diagnosis with what was found before its search among what was found."""
    verdict = "found" if diagnosis.verdict == "nothing missing" else diagnosis.verdict
    tried = *_chosen(found), *diagnosis.tried
    return replace(diagnosis, verdict=verdict, found=(*found, *diagnosis.found), tried=tried)


def _chosen(found: Sequence[Found]) -> list[Tried]:
    return [Tried(f.candidate, f.gain, f.gain, f.held_out_gain, "chosen") for f in found]


def threshold(system: System, settings: Settings, k: int) -> float:
    """Gain with k quantities that noise reaches with the allowed probability, over all candidates."""
    return float(stats.chi2.isf(settings.false_alarm / max(len(system.candidates), 1), k))


def gain_of_memory(system: System, fitted: Fit, noise: float, candidate: Candidate, alone: float) -> float:
    """Gain that a residual with the memory of what a fit leaves may give an effect, where white noise gives `alone`."""
    factors = dict(zip(fitted.names, inflation(system, fitted), strict=True))
    left = max(1.0, fitted.reduced_chi_square / noise)  # what is left counts as noise does
    return left * alone * max(factors[n] for n in candidate.names) ** 2


def length(system: System, settings: Settings, noise: float, fitted: Fit, picked: Sequence[Candidate]) -> float:
    """Of an explanation, in units of -2 log evidence, but for a constant of the system.

    Chi-square of data and priors at this noise; Schwarz's price of every number without a prior; for every effect
    picked from the catalogue, what the best of so many gains by noise beyond that, and more where its place had to be
    looked for; and how surprising its values are.
    """
    number = price_of_a_number(system.weights)
    picks = len(picked) * (threshold(system, settings, 1) - number) + CLASS_GAIN * sum(c.sought for c in picked)
    return fitted.cost / noise + fitted.n_free * number + picks + sum(_surprise(c, fitted) for c in picked)


def is_noise(fit_: Fit, settings: Settings, noise: float, gain: float = 0.0) -> bool:
    """Is what a fit leaves noise of this variance, once chi-square has fallen by a gain?"""
    # in a short recording chi-square scatters, and so does the noise where it is found in the same data
    variance = 2.0 * (1.0 + (THIRD if settings.noise is None else 0.0)) / max(fit_.n_data, 1)
    limit = max(settings.at_noise, 1.0 + 4.0 * float(np.sqrt(variance)))
    return (fit_.chi_square - gain) / max(fit_.degrees_of_freedom, 1) <= limit * noise


class _Search:
    """The explanations of a system's data, and what was done with each, by its names."""

    def __init__(self, system: System, settings: Settings, rows: Mask | None, former: Former | None) -> None:
        self.system, self.settings, self.former = system, settings, former or {}
        self.rows = training_rows(system) if rows is None else rows
        self.candidates = tuple(c for c in system.candidates if not c.sought)
        self.noise = 1.0
        self.rough = system.several_minima
        self.pool: dict[frozenset[str], Explanation] = {}

        self.expanded: set[frozenset[str]] = set()
        self.scored: dict[frozenset[str], tuple[Linearisation, list[Score]]] = {}
        self.first: dict[str, tuple[float, Explanation]] = {}  # by effect: gain of its first refit, and that
        self.free_runs: dict[Fit, HeldOut] = {}

    @property
    def nothing(self) -> Explanation:
        """The base model alone."""
        return self.pool[frozenset()]

    def run(self, base: Fit) -> Diagnosis:
        self.pool[frozenset()] = Explanation((), base)
        self.noise = self._noise(base)
        first = self._begun()
        if first is None:
            return _refusal(base, self.settings)
        linear, scores = self._scored(first)
        by_chance = chance(linear, scores, self.noise) if scores else None
        best, alike = self._settled()
        if self.system.frees_shapes and first is self.nothing and self._shapes_freed(best):
            best, alike = self._settled()
        after = self.nothing if alike is None else best
        found = tuple(self._found(best, c, r) for c, r in zip(best.candidates, alike or (), strict=alike is not None))
        ranked = tuple(replace(e, length=self.length(e)) for e in self._ranked())
        return Diagnosis(
            *self._verdict(after, found),
            found,
            base,
            after.fit,
            self._held_out(base),
            self._held_out(after.fit),
            self.noise,
            self._tried_all(scores, found),
            self.settings,
            best if alike is None else None,
            ranked,
            self.length(after),
            chance=by_chance,
        )

    def _verdict(self, after: Explanation, found: tuple[Found, ...]) -> tuple[Verdict, str]:
        """Verdict and reason."""
        left = f"{after.fit.reduced_chi_square:.3g} per degree of freedom at a noise of {self.noise:.3g}"
        if not self._at_noise(after.fit):
            return "unexplained", f"chi-square stays at {left}: no effect of the catalogue brings it to noise"
        if not found:
            return "nothing missing", f"chi-square is {left}, and no effect gains more than noise does"
        ratio = self._held_out(after.fit).ratio_to_floor / np.sqrt(self.noise)
        return "found", f"chi-square falls to {left}; the error of prediction is {ratio:.2f} of its floor"

    def _begun(self) -> Explanation | None:
        """The explanation in whose residual others are scored first; None where nothing follows the data.

        Of a motion that the base model loses no first order says anything: then it is the shortest known one.
        """
        for names, values in self.former.items():
            together = tuple(c for c in self.system.candidates if c.name in names)
            self._explanation(together, values)
        if self.nothing.fit.converged or _near_enough(self.system, self.nothing.fit):
            return self.nothing
        self.expanded.add(frozenset())
        return min((e for e in self._ranked() if e.candidates), key=self.length, default=None)

    def _settled(self) -> tuple[Explanation, list[list[Alternative]] | None]:
        """The explanation that stands, and alternatives of each of its effects; None where it explains too little."""
        self._explore()
        alike: list[list[Alternative]] = []
        while (best := self._shortest_that_stands()).candidates:
            if not self._at_noise(best.fit) and not self._worth_naming(best):
                return best, None
            if (smaller := self._without_idle(best)) is not None:
                self.pool[best.names] = replace(best, credible=False)  # it does not stand out from its residual
                self.pool.setdefault(smaller.names, smaller)
                self._explore()
                continue
            alike = [self._alternatives(best, c) for c in best.candidates]
            self._explore()
            if self._shortest_that_stands() is best:
                break
        return best, alike

    def _shapes_freed(self, best: Explanation) -> bool:
        """Do laws with a free shape join the explanations: in the place of all effects, or of a faint one of several?

        At its null an effect whose place has to be looked for has no derivative, so that no score proposes it: it is
        tried beside effects that leave too much, too. Beside another effect, a faint one that a flat of the rim makes
        is an inertia's or a pattern's off centre.
        """
        at_noise, nothing, before = self._at_noise(best.fit), self.nothing, len(self.pool)
        if at_noise and len(best.candidates) < 2:
            return False
        for e in (nothing,) if at_noise or best is nothing else (nothing, best):
            below = e.fit.cost - (1.0 - WORTH_A_SHAPE) * self.noise * e.fit.excess(self.noise)
            for c in self.system.candidates:
                wanted = c.shape if e is nothing else c.sought and c.name not in e.names
                if wanted and self.system.budget.open(kept=FOR_LAWS):
                    self._with_free_shape(e, c, 0.0, below)
        faint = [c for c in best.candidates if c.kind == "motion" and at_noise]
        for rest in (self._refit_without(best, c) for c in faint):
            gain = rest.fit.cost - best.fit.cost
            for c in self.system.candidates:
                wanted = c.sought and c.name not in best.names and gain <= FAINT * self.noise
                if wanted and self.system.budget.open(kept=FOR_LAWS):
                    self._with_free_shape(rest, c, FIRST_ORDER * max(gain, 0.0), best.fit.cost)
        return len(self.pool) > before

    def _with_free_shape(self, e: Explanation, candidate: Candidate, least: float, below: float) -> None:
        """An explanation that leaves noise with one law more, its shape free."""
        goal = self.settings.at_noise * self.noise * e.fit.degrees_of_freedom + e.fit.penalty
        answer = with_free_shape(self.system, e.fit, candidate, least, below, goal)
        if answer is not None and self._at_noise(answer[1]):
            new = Explanation((*e.candidates, answer[0]), answer[1])
            self.pool.setdefault(new.names, new)

    def _noise(self, fit_: Fit) -> float:
        stated = self.settings.noise
        return max(noise_variance(self.system, fit_) if stated is None else stated, 1e-12)

    def length(self, e: Explanation) -> float:
        """As the function of that name; infinite for what cannot be believed."""
        return length(self.system, self.settings, self.noise, e.fit, e.candidates) if e.credible else np.inf

    def _price(self, candidates: Sequence[Candidate]) -> float:
        """Of more terms, as in their length."""
        numbers, one = len({n for c in candidates for n in c.names}), price_of_a_number(self.system.weights)
        return len(candidates) * self.threshold(1) + (numbers - len(candidates)) * one

    def threshold(self, k: int) -> float:
        """As the function of that name."""
        return threshold(self.system, self.settings, k)

    def _ranked(self) -> list[Explanation]:
        """Explanations that may be believed, shortest first."""
        return sorted((e for e in self.pool.values() if np.isfinite(self.length(e))), key=self.length)

    def _explore(self) -> None:
        """Enlarge and shorten the shortest explanations, until none comes of it that is shorter."""
        while True:
            ranked = self._ranked()
            best = ranked[0]
            if best.candidates:
                # a large effect reaches into the fast part of the residual: with it, the noise is seen better
                self.noise = min(self.noise, self._noise(best.fit))
            few = ranked[: 1 if self._at_noise(best.fit) else WIDTH]
            new = next((e for e in few if e.names not in self.expanded), None)
            if new is None:
                return
            self.expanded.add(new.names)
            for extra in self._enlarged(new, new is best):
                if self.system.budget.open(kept=FOR_LAWS):
                    self._refit(new, extra)
            if len(new.candidates) > 1:
                for c in new.candidates:
                    self._refit_without(new, c)

    def _refit(self, e: Explanation, extra: tuple[Candidate, ...]) -> None:
        together = (*e.candidates, *extra)
        names = _names(together)
        if names in self.pool and not self.rough:
            return
        # beyond thresholds the prediction has kinks and a refit is long: only where no other will do
        if any(c.threshold for c in extra) and any(self._nearly_all(e, other) for other in self.pool.values()):
            return
        fitted = self._best_fit(e, extra)
        if fitted is None:  # no start leads anywhere
            return
        gain = (e.fit.cost - fitted.cost) / self.noise
        new = Explanation(together, fitted)
        rough = self.rough and fitted.promised < ROUGH * gain
        if not (fitted.converged or rough) or (self.length(new) < self.length(e) and self._incredible(new, extra)):
            new = replace(new, credible=False)
        if names not in self.pool or self.length(new) < self.length(self.pool[names]):
            self.pool[names] = new
        if len(extra) == 1:
            self.first.setdefault(extra[0].name, (gain, new))

    def _explanation(
        self, together: tuple[Candidate, ...], start: Values, tested: Sequence[Candidate] = ()
    ) -> Explanation:
        """By these effects, fitted from `start` if they were not before.   tested : to credible amounts"""
        names = _names(together)
        if names not in self.pool:
            fitted = self._fit(together, start)
            new = Explanation(together, fitted, fitted.converged)
            self.pool[names] = replace(new, credible=False) if tested and self._incredible(new, tested) else new
        return self.pool[names]

    def _refit_without(self, e: Explanation, c: Candidate) -> Explanation:
        return self._explanation(*_without(e, c))

    def _enlarged(self, e: Explanation, with_thresholds: bool) -> list[tuple[Candidate, ...]]:
        """Terms, and pairs of them where one alone will not do, that are worth a refit beside those of `e`."""
        if len(e.candidates) >= self.settings.max_effects:
            return []
        linear, scores = self._scored(e)
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
        proposed: list[tuple[Candidate, ...]] = [(s.candidate,) for s in worth]
        if self._at_noise(e.fit, best):
            return proposed
        if worth and len(e.candidates) + 2 <= self.settings.max_effects:
            visible = [s.candidate for s in ranked[:14] if s.visible]
            pairs = list(combinations(visible, 2))
            gains = [linear.gain_of(list(dict.fromkeys([*a.names, *b.names])))[0] for a, b in pairs]
            longer = [self._price(pair) - gain / self.noise for pair, gain in zip(pairs, gains, strict=True)]
            proposed += [pairs[i] for i in np.argsort(longer, kind="stable")[:3]]
        if with_thresholds:
            proposed += [(c,) for c in self.system.candidates if c.threshold and c.name not in e.names]
        return proposed

    def _scored(self, e: Explanation) -> tuple[Linearisation, list[Score]]:
        """What each term more would gain to first order."""
        if e.names not in self.scored:
            linear = Linearisation(self.system, e.fit, self.candidates)
            others = [c for c in self.candidates if c.name not in e.names]
            self.scored[e.names] = linear, score_all(linear, others)
        return self.scored[e.names]

    def _shortest_that_stands(self) -> Explanation:
        """The shortest explanation that predicts what was kept back better than shorter sets of its terms do."""
        ranked = self._ranked()
        for e in [e for e in ranked if e.candidates][: self.settings.judged]:
            if self.length(e) > self.length(self.nothing):
                break
            parent = next((other for other in ranked if other.names < e.names), self.nothing)
            held = self._held_out_gain(parent, e)
            enough = OBVIOUS * self._price([c for c in e.candidates if c.name not in parent.names])
            obvious = held > -CLASS_GAIN and (parent.fit.cost - e.fit.cost) / self.noise > enough
            if held > 0 or obvious:
                return e
        return self.nothing

    def _held_out_gain(self, before: Explanation, after: Explanation) -> float:
        """Of twice the log density of what was kept back, in units of the noise."""
        return self._held_out(after.fit).gain_over(self._held_out(before.fit), self.noise)

    def _worth_naming(self, after: Explanation) -> bool:
        """Does what was found explain the residual, if not to noise then nearly all of it, in the free run too?

        In a residual that none of them makes, wrong effects gain a lot as well; they leave a good part of it.
        """
        before = self.nothing
        excess = [e.fit.excess(self.noise) for e in (before, after)]
        held = [self._held_out(e.fit) for e in (before, after)]
        free = [h.chi_square / self.noise - h.expected for h in held]
        # where next to nothing moves in what was kept back, no model errs there: what it lacks elsewhere is the measure
        at_stake = max(free[0], excess[0] * held[0].n_data / max(before.fit.n_data, 1))
        share = self.settings.unexplained_share
        return excess[1] < share * excess[0] and free[1] < share * at_stake

    def _quantities(self, candidates: Sequence[Candidate]) -> tuple[Quantity, ...]:
        new = {q.name: q for c in candidates for q in c.quantities}
        return tuple(q for q in self.system.base if q.name not in new) + tuple(new.values())

    def _held_out(self, fit_: Fit) -> HeldOut:
        if fit_ not in self.free_runs:
            self.free_runs[fit_] = held_out(self.system, fit_.quantities, fit_.values, self.rows)
        return self.free_runs[fit_]

    def _fit(self, candidates: Sequence[Candidate], start: Values, patient: bool = False) -> Fit:
        """With these effects.   patient : however long it takes; else a fit that is given up has not converged"""
        key = _names(candidates)
        known = self.pool[key].fit if key in self.pool else None
        if known is not None and (known.converged or not key):
            return known
        return (fit if patient else attempt)(self.system, self._quantities(candidates), start)

    def _best_fit(self, current: Explanation, extra: Sequence[Candidate]) -> Fit | None:
        """Refit with the extra candidates; where one acts beyond a threshold only, from its start, if it has any."""
        together, start = [*current.candidates, *extra], dict[str, float]()
        for c in extra:
            if c.threshold:
                if not (starts := self.system.starts(c, current.fit.values)):
                    return None
                start |= dict(zip(c.names, starts[0], strict=True))
        if extra and all(c.threshold for c in extra):
            followed = self._followed(current, together, start)
            if followed is not None and self._at_noise(followed):
                return followed
        fits = [self._fit(together, current.fit.values | start)]
        declared = {q.name: q.declared for q in self.system.base if q.declared is not None}
        if declared and not fits[0].converged:
            # without the effect the others may have gone so far to make up for it that no step leads back
            fits.append(self._fit(together, current.fit.values | declared))
        return min(fits, key=lambda f: (not f.converged, f.cost))

    def _followed(self, current: Explanation, together: Sequence[Candidate], start: Values) -> Fit | None:
        """Refit that comes from longer and longer beginnings; None where one of them does not fit to the noise.

        Each instant at which a threshold is passed is a valley of its own: from a motion that ignores it no step leads
        to the one in which all of them are right. Where the residual is small, a step does.
        """
        values, quantities = {**current.fit.values, **start}, self._quantities(together)
        if current.fit.reduced_chi_square < FAR * self.noise:
            return None
        for part in self.system.beginnings():
            found = attempt(part, quantities, values)
            if not found.converged or found.reduced_chi_square > AGREES * self.noise:
                return None
            values = found.values
        return self._fit(together, values)

    def _nearly_all(self, before: Explanation, after: Explanation) -> bool:
        """Does the other remove nine tenths of what exceeds the noise, and is little left?"""
        near = after.fit.reduced_chi_square < FAR * self.noise
        return after.fit.converged and near and after.fit.excess(self.noise) < 0.1 * before.fit.excess(self.noise)

    def _at_noise(self, fit_: Fit, gain: float = 0.0) -> bool:
        return is_noise(fit_, self.settings, self.noise, gain)

    def _incredible(self, trial: Explanation, extra: Sequence[Candidate]) -> bool:
        """Is an amount at the limit of what is ever met, or do effects cancel each other in all that they predict?

        Enough terms of opposite signs describe any motion that they were fitted to, as polynomials do: such a sum says
        nothing of what acts.
        """
        values = trial.fit.values
        limits = [(values[q.name], q) for c in extra if c.kind == "measurement" for q in c.quantities]
        if any(v != q.null and not q.lower < v < q.upper for v, q in limits):
            return True
        if len(trial.candidates) < 2:
            return False
        signals = []
        for c in trial.candidates:
            amount = np.array([values[q.name] - q.null for q in c.quantities])
            signals.append(self.system.linearise(values, c.names)[1] @ amount)
        sums = [several for k in range(2, len(signals) + 1) for several in combinations(signals, k)]
        return any(np.sum(sum(own) ** 2) < CANCELLING * min(np.sum(x**2) for x in own) for own in sums)

    def _without_idle(self, e: Explanation) -> Explanation | None:
        """Without the effect that gains least, if a residual with the memory of what is left may give it as much."""
        if self.settings.noise is not None:
            return None
        losses = []
        for c in e.candidates:
            smaller = self._refit_without(e, c)
            loss = (smaller.fit.cost - e.fit.cost) / self.noise
            enough = gain_of_memory(self.system, e.fit, self.noise, c, self.threshold(len(c.names)))
            if smaller.fit.converged or loss < enough:  # a fit that has not converged loses even less further on
                losses.append((loss / enough, c.name, smaller))
        least, _, smaller = min(losses, default=(np.inf, "", e))
        return smaller if least < 1.0 else None

    def _alternatives(self, e: Explanation, effect: Candidate) -> list[Alternative]:
        """Effects that predict nearly the same residual, refitted in place of one; they join the explanations."""
        rest, start = _without(e, effect)
        reduced = _restricted(e.fit, self._quantities(rest))
        linear = Linearisation(self.system, reduced, [*self.candidates, effect])
        shape = {q.name for q in effect.shape}  # of which no amount is a part of the effect
        amount = np.array([(e.fit.values[q.name] - q.null) * (q.name not in shape) for q in effect.quantities])
        signal = linear.columns(effect.names) @ amount
        strength = float(np.sum(linear.cleared(signal[:, None]) ** 2)) / self.noise
        others = [c for c in self.candidates if c.name not in e.names]
        angles = {c.name: angle(linear, signal, c.names) for c in others}
        near = sorted(others, key=lambda c: angles[c.name])
        near = [c for c in near if strength * np.sin(angles[c.name]) ** 2 < 4 * CLASS_GAIN + 0.02 * strength]
        near = near[: MOST_ALTERNATIVES if strength < FAINT else MOST_ALTERNATIVES // 2]
        found = []
        for candidate in near:
            other = self._explanation((*rest, candidate), start, (candidate,))
            loss = (other.fit.cost - e.fit.cost) / self.noise
            if other.fit.converged and loss < CLASS_GAIN:
                found.append(Alternative(candidate, angles[candidate.name], loss, other.fit))
        return found

    def _found(self, e: Explanation, candidate: Candidate, alike: list[Alternative]) -> Found:
        without = self._fit(*_without(e, candidate), patient=True)
        held_gain = self._held_out(e.fit).gain_over(self._held_out(without), self.noise)
        gain = (without.cost - e.fit.cost) / self.noise
        return Found(candidate, gain, held_gain, self.threshold(len(candidate.names)), tuple(alike))

    def _tried_all(self, scores: Sequence[Score], found: tuple[Found, ...]) -> tuple[Tried, ...]:
        scored = {s.candidate.name for s in scores}  # in the residual of the other effects found, if there are such
        others = [f for f in found if f.candidate.name not in scored]
        return (*_chosen(others), *(self._tried(s, found) for s in scores))

    def _tried(self, score: Score, found: tuple[Found, ...]) -> Tried:
        c, limit, first_order = score.candidate, self.threshold(len(score.candidate.names)), score.gain / self.noise
        refit_gain, trial = self.first.get(c.name, (None, None))
        gain, held, stuck = first_order if refit_gain is None else refit_gain, None, False
        if trial is not None:
            stuck = not trial.fit.converged
            held = self._held_out_gain(self.nothing, trial) if trial.fit in self.free_runs else None
        same = {r.candidate.name: f.candidate.name for f in found for r in f.cannot_be_told_from}
        if c.name in {f.candidate.name for f in found}:
            reason = "chosen"
        elif c.name in same:
            reason = f"indistinguishable from {same[c.name]}"
        elif not score.visible and trial is None:
            reason = "leaves no trace in this recording that other fitted quantities do not absorb"
        elif gain <= limit:
            # together with an effect that was found, the first score says nothing of what may be there
            reason = f"gains {gain:.3g}, noise alone reaches {limit:.3g}{'' if found else _bounds(score)}"
        elif stuck:
            reason = "its refit does not converge"
        elif held is not None and held <= 0:
            reason = "the prediction of held-out data does not improve"
        else:
            reason = f"gains {gain:.4g}, {'less than what was chosen' if found else 'too little of what is missing'}"
        return Tried(c, first_order, refit_gain, held, reason, stuck)


def _names(candidates: Sequence[Candidate]) -> frozenset[str]:
    free = {q.name for c in candidates for q in c.shape} & {q.name for c in candidates for q in c.quantities}
    return frozenset(free | {c.name for c in candidates})


def _near_enough(system: System, base: Fit) -> bool:
    """Is what a fit has not gained yet nothing beside what no fit of it will?

    Where equations jump, chi-square is rough: far above the noise no step may lead to the bottom of a rough valley.
    """
    return system.several_minima and base.promised < ROUGH * base.excess(1.0)


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
    """Minus twice the logarithm of a heavy-tailed (Cauchy) prior, against that at the size which surprises nobody."""
    size = max(abs(fit_.values[q.name] - q.null) / q.typical for q in candidate.quantities)
    return max(0.0, 2.0 * float(np.log((1.0 + size**2) / 2.0)))


def _without(e: Explanation, candidate: Candidate) -> tuple[tuple[Candidate, ...], dict[str, float]]:
    """The other effects, and values with the candidate's quantities at null, unless another effect has them too."""
    rest = tuple(c for c in e.candidates if c is not candidate)
    kept = {n for c in rest for n in c.names}
    return rest, e.fit.values | {q.name: q.null for q in candidate.quantities if q.name not in kept}


def _restricted(fit_: Fit, quantities: tuple[Quantity, ...]) -> Fit:
    """The same fit with fewer quantities counted as free."""
    kept = {q.name for q in quantities}
    index = [i for i, name in enumerate(fit_.shared) if name in kept]
    return replace(fit_, quantities=quantities, covariance=fit_.covariance[np.ix_(index, index)])
