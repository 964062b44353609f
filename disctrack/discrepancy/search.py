"""Which effects does the model lack? Model selection over sets of effects, by an approximate -2 log evidence.

An explanation is a set of effects fitted together with all quantities of the base model. Its length approximates
-2 log evidence: chi-square at the estimated noise, a trials penalty for each effect picked from the catalogue, the BIC
penalty for each further parameter, and a heavy-tailed prior on the parameters' sizes. Implausible fits have an infinite
length. Effects that would shorten an explanation to first order are refitted in full: they are added, exchanged and
removed, starting from the shortest explanations. The answer is the shortest explanation that predicts held-out data
better than its subsets do, and whose effects remain significant when the residuals are autocorrelated.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Literal, TypeVar

import numpy as np
from scipy import stats

from calibration.kit.brief import Brief
from calibration.kit.types import Mask
from disctrack.discrepancy.fit import Fit, attempt, fit, settled
from disctrack.discrepancy.held_out import HeldOut, held_out, training_rows
from disctrack.discrepancy.noise import THIRD, inflation, noise_variance, whitened
from disctrack.discrepancy.score import Linearisation, Score, angle, score_all
from disctrack.discrepancy.shape import WORTH_A_SHAPE, leaves_most, with_free_shape, with_shape
from disctrack.discrepancy.significance import FALSE_ALARM, TWO_SIDED, Chance, bic_penalty, chance
from disctrack.discrepancy.system import Candidate, Quantity, System, Values

CLASS_GAIN = 10.0  # two explanations whose lengths differ by less are indistinguishable (odds of e^5)
OBVIOUS = 5.0  # times its penalty: a gain so large needs no confirmation by held-out data
WIDTH = 2  # explanations of each number of effects that are extended as long as the residuals of none are noise
ROUGH = 1e-2  # share of the chi-square at stake: a promised gain below it does not matter where chi-square is rough
FAINT = 1e3  # chi-square of an effect, below which many others may explain the same
MOST_ALTERNATIVES = 12
FOR_LAWS = 0.5  # share of the budget that is reserved for learned laws
CANCELLING = 0.1  # power of a sum of effects over that of the weakest, below which they cancel each other
FAR, AGREES = 10.0, 2.0  # reduced chi-square over the noise: a motion far from the data, and one that agrees with them
FIRST_ORDER = 1.0 / 3.0  # share of a faint effect's gain that its replacement must reach to first order

Verdict = Literal["nothing missing", "found", "unexplained"]


@dataclass(frozen=True)
class Settings:
    """Extent of the search, and its significance level."""

    false_alarm: float = FALSE_ALARM  # over all candidates
    max_effects: int = 3
    shortlist: int = 8  # further effects that are refitted in full for each explanation
    judged: int = 4  # explanations that may be tested on held-out data
    at_noise: float = 1.1  # reduced chi-square over the estimated noise, up to which the residuals are noise
    unexplained_share: float = 0.05  # of the excess chi-square, up to which effects are named although more remains
    noise: float | None = None  # variance over that stated; None: estimated from differences of the residuals


@dataclass(frozen=True)
class Explanation:
    """Effects fitted together with all quantities of the base model."""

    candidates: tuple[Candidate, ...]
    fit: Fit
    plausible: bool = True  # converged, to plausible amounts
    length: float = np.inf  # approximate -2 log evidence (see the function `length`), once the noise is known

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of its effects, sorted."""
        return tuple(sorted(c.name for c in self.candidates))

    @property
    def names(self) -> frozenset[str]:
        """Names of its effects, and of their shape parameters that are free."""
        return _names(self.candidates)


@dataclass(frozen=True)
class Alternative:
    """Another effect that explains the same data."""

    candidate: Candidate
    angle: float  # [rad] between the predicted signals, orthogonalised to what other quantities absorb
    loss: float  # chi-square with the alternative in place of the effect, minus that with the effect
    fit: Fit


@dataclass(frozen=True)
class Found:
    """An effect that the model lacks."""

    candidate: Candidate
    gain: float  # increase of chi-square when the effect is removed again
    held_out_gain: float
    threshold: float  # gain that noise alone does not reach
    cannot_be_told_from: tuple[Alternative, ...]


@dataclass(frozen=True)
class Tried:
    """Outcome of one candidate."""

    candidate: Candidate
    score: float  # first-order gain over the base fit
    gain: float | None  # of its first refit, over the explanation that it extends
    held_out_gain: float | None
    reason: str
    stuck: bool = False  # its refit has not converged


@dataclass(frozen=True, repr=False)
class Diagnosis(Brief):
    """Result of the search."""

    verdict: Verdict
    reason: str  # in words
    found: tuple[Found, ...]
    before: Fit
    after: Fit
    held_out_before: HeldOut | None
    held_out_after: HeldOut | None
    noise: float  # estimated variance of the noise over that stated
    tried: tuple[Tried, ...]
    settings: Settings = field(default_factory=Settings)
    nearest: Explanation | None = None  # the best explanation, where its residuals are too large for a finding
    ranked: tuple[Explanation, ...] = ()  # all plausible ones, the shortest first
    length: float = np.nan  # of the answer
    judged: System | None = None  # system with its noise as estimated, to which the fits belong; None: unchanged
    remarks: tuple[str, ...] = ()  # on shape parameters that the data do not determine
    chance: Chance | None = None  # probability that noise alone lets some candidate gain as much as the best does

    @property
    def explanations(self) -> tuple[tuple[tuple[str, ...], float], ...]:
        """Sets of effects indistinguishable from the answer, with their difference in length, the shortest first."""
        listed = ((e.effects, e.length - self.length) for e in self.ranked)
        return tuple(item for item in listed if abs(item[1]) < CLASS_GAIN)


Former = Mapping[frozenset[str], Values]  # by names of effects
E = TypeVar("E", bound=Explanation)


def equivalent(explanations: Iterable[E]) -> list[E]:
    """The shortest explanation, followed by those that the data do not distinguish from it."""
    ranked = sorted(explanations, key=lambda e: e.length)
    return [e for e in ranked if e.length <= ranked[0].length + CLASS_GAIN]


def explain(
    system: System, start: Values, settings: Settings | None = None, rows: Mask | None = None,
    former: Former | None = None,
) -> Diagnosis:  # fmt: skip
    """Fit the base model and search for the effects that it lacks.

    start : values of the base quantities from which Gauss-Newton converges
    rows : (n,) training samples; the others are held out. By default the first part of the time
    former : initial values of known explanations. Without them, the fit of the base model has to converge
    """
    settings = settings or Settings()
    answer = _searched(system, start, settings, rows, former)
    # only now: before, fast signals of a large effect would be taken for common scatter of the rows
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
    """The diagnosis with the shape parameters of the effects found fitted too, where the data determine them."""
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
    after = diagnosis.after
    return replace(diagnosis, held_out_after=held_out(system, after.quantities, after.values, training_rows(system)))


def with_found(diagnosis: Diagnosis, found: Sequence[Found]) -> Diagnosis:
    """The diagnosis with further effects, which were found outside its search, listed first."""
    verdict = "found" if diagnosis.verdict == "nothing missing" else diagnosis.verdict
    tried = *_chosen(found), *diagnosis.tried
    return replace(diagnosis, verdict=verdict, found=(*found, *diagnosis.found), tried=tried)


def _chosen(found: Sequence[Found]) -> list[Tried]:
    return [Tried(f.candidate, f.gain, f.gain, f.held_out_gain, "chosen") for f in found]


def threshold(system: System, settings: Settings, k: int) -> float:
    """Gain of k quantities that noise exceeds with the false-alarm probability, over all candidates (Bonferroni)."""
    return float(stats.chi2.isf(settings.false_alarm / max(len(system.candidates), 1), k))


def noise_gain(system: System, fitted: Fit, noise: float, candidate: Candidate, alone: float) -> float:
    """Gain that an effect may have by noise autocorrelated as the residuals are, where white noise gives `alone`."""
    factors = dict(zip(fitted.names, inflation(system, fitted), strict=True))
    left = max(1.0, fitted.reduced_chi_square / noise)  # all of the residuals counts as noise
    return left * alone * max(factors[n] for n in candidate.names) ** 2


def length(system: System, settings: Settings, noise: float, fitted: Fit, picked: Sequence[Candidate]) -> float:
    """Approximate -2 log evidence of an explanation, up to a constant of the system.

    Chi-square of data and priors at this noise; the BIC penalty of every quantity without a prior; for every effect
    picked from the catalogue, a trials penalty (what the best of so many gains by noise), larger where its location was
    searched for; and the heavy-tailed prior of its sizes.
    """
    number = bic_penalty(system.weights)
    picks = len(picked) * (threshold(system, settings, 1) - number) + CLASS_GAIN * sum(c.sought for c in picked)
    return fitted.cost / noise + fitted.n_free * number + picks + sum(_surprise(c, fitted) for c in picked)


def is_noise(fit_: Fit, settings: Settings, noise: float, gain: float = 0.0) -> bool:
    """Are the residuals noise of this variance, once chi-square has decreased by `gain`?"""
    # in a short recording chi-square scatters, and so does the noise where it is found in the same data
    variance = 2.0 * (1.0 + (THIRD if settings.noise is None else 0.0)) / max(fit_.n_data, 1)
    limit = max(settings.at_noise, 1.0 + 4.0 * float(np.sqrt(variance)))
    return (fit_.chi_square - gain) / max(fit_.degrees_of_freedom, 1) <= limit * noise


class _Search:
    """All explanations of a system's data that were fitted, by the names of their effects."""

    def __init__(self, system: System, settings: Settings, rows: Mask | None, former: Former | None) -> None:
        self.system, self.settings, self.former = system, settings, former or {}
        self.rows = training_rows(system) if rows is None else rows
        self.candidates = tuple(c for c in system.candidates if not c.sought)
        self.noise = 1.0
        self.pool: dict[frozenset[str], Explanation] = {}
        self.expanded: set[frozenset[str]] = set()
        self.scored: dict[frozenset[str], tuple[Linearisation, list[Score]]] = {}
        self.first: dict[str, tuple[float, Fit]] = {}  # by effect: its first refit with its gain
        self.predictions: dict[Fit, HeldOut] = {}

    @property
    def base_model(self) -> Explanation:
        """The base model alone."""
        return self.pool[frozenset()]

    def run(self, base: Fit) -> Diagnosis:
        self.pool[frozenset()] = Explanation((), base)
        self.noise = self._noise(base)
        first = self._first_explanation()
        if first is None:
            return _refusal(base, self.settings)
        linear, scores = self._scored(first)
        by_chance = chance(linear, scores, self.noise) if scores else None
        best, alternatives = self._selected()
        if self.system.frees_shapes and first is self.base_model and self._add_free_shapes(best):
            best, alternatives = self._selected()
        best = replace(best, fit=settled(self.system, best.fit))
        after = self.base_model if alternatives is None else best
        pairs = () if alternatives is None else zip(best.candidates, alternatives, strict=True)
        found = tuple(self._found(best, *pair) for pair in pairs)
        ranked = tuple(replace(e, length=self.length(e)) for e in self._ranked())
        return Diagnosis(
            *self._verdict(after, found),
            found,
            base,
            after.fit,
            self._held_out(base),
            self._held_out(after.fit),
            self.noise,
            self._all_outcomes(scores, found),
            self.settings,
            best if alternatives is None else None,
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

    def _first_explanation(self) -> Explanation | None:
        """The explanation from whose residuals other effects are scored first; None where no fit follows the data.

        Far from the data, first-order scores are meaningless: then the shortest of the known explanations is used.
        """
        for names, values in self.former.items():
            self._explanation(tuple(c for c in self.system.candidates if c.name in names), values)
        if self.base_model.fit.converged or _near_enough(self.system, self.base_model.fit):
            return self.base_model
        self.expanded.add(frozenset())
        return min((e for e in self._ranked() if e.candidates), key=self.length, default=None)

    def _selected(self) -> tuple[Explanation, list[list[Alternative]] | None]:
        """The selected explanation, and the alternatives of each of its effects; None where it explains too little."""
        self._explore()
        while (best := self._best_supported()).candidates:
            if not self._at_noise(best.fit) and not self._explains_most(best):
                return best, None
            if (smaller := self._without_weakest(best)) is not None:
                self.pool[best.names] = replace(best, plausible=False)  # it does not stand out from its residual
                self.pool.setdefault(smaller.names, smaller)
                self._explore()
                continue
            alternatives = [self._alternatives(best, c) for c in best.candidates]
            self._explore()
            if self._best_supported() is best:
                return best, alternatives
        return best, []

    def _add_free_shapes(self, best: Explanation) -> bool:
        """Add explanations by laws of free shape, in place of all effects or of the faintest; True if there are any.

        An effect whose location is unknown (a flat of the rim) has no derivative at its null, so no score proposes it.
        It is therefore also tried in addition to effects that leave too much, and in place of the faintest one, which
        may imitate it: an inertia, or a pattern that is off centre. What imitates it need not predict.
        """
        at_noise, nothing, before = self._at_noise(best.fit), self.base_model, len(self.pool)
        several = self._ranked()[0]
        sought = [c for c in self.system.candidates if c.sought and c.name not in best.names | several.names]
        whole = [nothing] if not at_noise or len(several.candidates) > 1 else []
        for e in whole if at_noise or best is nothing else [nothing, best]:
            below = e.fit.cost - (1.0 - WORTH_A_SHAPE) * self.noise * e.fit.excess(self.noise)
            wanted = [c for c in self.system.candidates if c.shape] if e is nothing else sought
            self._add_with_free_shape(e, wanted, 0.0, below)
        if at_noise and several.candidates:
            rest = min((self._refit_without(several, c) for c in several.candidates), key=lambda e: e.fit.cost)
            gain = rest.fit.cost - several.fit.cost
            if gain <= FAINT * self.noise:
                self._add_with_free_shape(rest, sought, FIRST_ORDER * max(gain, 0.0), several.fit.cost)
        return len(self.pool) > before

    def _add_with_free_shape(self, e: Explanation, laws: Sequence[Candidate], least: float, below: float) -> None:
        """Add the explanations with one of these laws more, its shape free, whose residuals are noise."""
        price, budget = self.noise * bic_penalty(self.system.weights), self.system.budget
        for law in laws:
            answer = budget.open(kept=FOR_LAWS) and with_free_shape(self.system, e.fit, law, least, below, price)
            if answer and self._at_noise(answer[1]):
                new = Explanation((*e.candidates, answer[0]), answer[1])
                self.pool.setdefault(new.names, new)

    def _noise(self, fit_: Fit) -> float:
        stated = self.settings.noise
        return max(noise_variance(self.system, fit_) if stated is None else stated, 1e-12)

    def length(self, e: Explanation) -> float:
        """See the function of that name; infinite for an implausible explanation."""
        return length(self.system, self.settings, self.noise, e.fit, e.candidates) if e.plausible else np.inf

    def _price(self, candidates: Sequence[Candidate]) -> float:
        """Penalty of further effects, as in their length."""
        numbers, one = len({n for c in candidates for n in c.names}), bic_penalty(self.system.weights)
        return len(candidates) * self.threshold(1) + (numbers - len(candidates)) * one

    def threshold(self, k: int) -> float:
        """See the function of that name."""
        return threshold(self.system, self.settings, k)

    def _ranked(self) -> list[Explanation]:
        """Plausible explanations, shortest first."""
        return sorted((e for e in self.pool.values() if np.isfinite(self.length(e))), key=self.length)

    def _explore(self) -> None:
        """Extend and reduce the shortest explanations of each number of effects until none gets shorter."""
        while True:
            ranked = self._ranked()
            best = ranked[0]
            if best.candidates:
                # a large effect contaminates the estimate of the noise: once it is fitted, the estimate is better
                self.noise = min(self.noise, self._noise(best.fit))
            few = ranked[:1]
            if not self._at_noise(best.fit):  # several effects may be short only together
                few += self._shortest_of_each_number(ranked)
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

    def _shortest_of_each_number(self, ranked: Sequence[Explanation]) -> list[Explanation]:
        """The shortest explanations of each number of effects, as long as one effect more describes much more.

        A sum whose terms each remove a small part approximates any motion.
        """
        few, left = list[Explanation](), np.inf
        for n in range(self.settings.max_effects + 1):
            alike = [e for e in ranked if len(e.candidates) == n][:WIDTH]
            before, left = left, min((e.fit.excess(self.noise) for e in alike), default=left)
            if n > 1 and leaves_most(left, before):
                break
            few += alike
        return few

    def _refit(self, e: Explanation, extra: tuple[Candidate, ...]) -> None:
        together = (*e.candidates, *extra)
        names = _names(together)
        if names in self.pool and not self.system.several_minima:
            return
        # the prediction is not smooth in an effect with a threshold, and its refit is slow: only where it is needed
        if any(c.threshold for c in extra) and any(self._removes_most(e, other) for other in self.pool.values()):
            return
        fitted = self._best_fit(e, extra)
        if fitted is None:  # there is no start
            return
        gain = (e.fit.cost - fitted.cost) / self.noise
        new = Explanation(together, fitted, self._has_ended(e.fit, fitted))
        if self.length(new) < self.length(e) and self._is_implausible(new, extra):
            new = replace(new, plausible=False)
        if names not in self.pool or self.length(new) < self.length(self.pool[names]):
            self.pool[names] = new
        if len(extra) == 1:
            self.first.setdefault(extra[0].name, (gain, fitted))

    def _explanation(self, of: tuple[Candidate, ...], start: Values, rival: Explanation | None = None) -> Explanation:
        """By these effects, fitted from `start` if they were not before.

        rival : effects that it lacks have to be plausible, and the fit is given up where it cannot become as short
        """
        names = _names(of)
        if names not in self.pool:
            gain = self.noise * (CLASS_GAIN + self._price(rival.candidates)) if rival else np.inf
            fitted = self._fit(of, start, wanted=rival.fit.cost + gain if rival else np.inf)
            new = Explanation(of, fitted, self._has_ended(self.base_model.fit, fitted))
            tested = [c for c in of if c not in rival.candidates] if rival else []
            self.pool[names] = replace(new, plausible=False) if tested and self._is_implausible(new, tested) else new
        return self.pool[names]

    def _has_ended(self, before: Fit, fitted: Fit) -> bool:
        """Converged; or, where chi-square is rough, with little left to gain?"""
        gain = (before.cost - fitted.cost) / self.noise
        return fitted.converged or (self.system.several_minima and fitted.promised < ROUGH * gain)

    def _refit_without(self, e: Explanation, c: Candidate) -> Explanation:
        return self._explanation(*_without(e, c), e)

    def _enlarged(self, e: Explanation, with_thresholds: bool) -> list[tuple[Candidate, ...]]:
        """Further effects, and pairs of them where one is not enough, with which `e` is worth a refit."""
        if len(e.candidates) >= self.settings.max_effects:
            return []
        linear, scores = self._scored(e)
        if not scores:
            return []
        ranked = sorted(scores, key=lambda s: self._price([s.candidate]) - s.gain / self.noise)
        best = ranked[0].gain
        # near the noise the first order is exact; far from it, a nonlinear refit may do better than its score
        worth = [
            s
            for i, s in enumerate(ranked[: self.settings.shortlist])
            if s.gain / self.noise > 0.5 * self.threshold(len(s.candidate.names)) and (i < 4 or s.gain > 0.3 * best)
        ]
        proposed: list[tuple[Candidate, ...]] = [(s.candidate,) for s in worth]
        if self._at_noise(e.fit, best):
            return proposed
        if worth and len(e.candidates) + 2 <= self.settings.max_effects:
            pairs = list(combinations([s.candidate for s in ranked[:14] if s.visible], 2))
            gains = [linear.gain_of(list(dict.fromkeys([*a.names, *b.names])))[0] for a, b in pairs]
            longer = [self._price(pair) - gain / self.noise for pair, gain in zip(pairs, gains, strict=True)]
            proposed += [pairs[i] for i in np.argsort(longer, kind="stable")[:3]]
        if with_thresholds:
            proposed += [(c,) for c in self.system.candidates if c.threshold and c.name not in e.names]
        return proposed

    def _scored(self, e: Explanation) -> tuple[Linearisation, list[Score]]:
        """First-order gain of each further effect."""
        if e.names not in self.scored:
            linear = Linearisation(self.system, e.fit, self.candidates)
            if not linear.usable:
                self.candidates = tuple(c for c in self.candidates if self._has_derivative(c, e.fit.values))
                linear = Linearisation(self.system, e.fit, self.candidates)
            others = [c for c in self.candidates if c.name not in e.names]
            self.scored[e.names] = linear, score_all(linear, others)
        return self.scored[e.names]

    def _has_derivative(self, candidate: Candidate, values: Values) -> bool:
        null = {q.name: q.null for q in candidate.quantities}
        return bool(np.isfinite(self.system.linearise(null | dict(values), candidate.names)[1]).all())

    def _best_supported(self) -> Explanation:
        """The shortest explanation that predicts the held-out data better than subsets of its effects do."""
        ranked = self._ranked()
        for e in [e for e in ranked if e.candidates][: self.settings.judged]:
            if self.length(e) > self.length(self.base_model):
                break
            parent = next((other for other in ranked if other.names < e.names), self.base_model)
            held = self._held_out_gain(parent.fit, e.fit)
            enough = OBVIOUS * self._price([c for c in e.candidates if c.name not in parent.names])
            obvious = held > -CLASS_GAIN and (parent.fit.cost - e.fit.cost) / self.noise > enough
            if held > 0 or obvious:
                return e
        return self.base_model

    def _held_out_gain(self, before: Fit, after: Fit) -> float:
        """Gain of twice the held-out log predictive density, in units of the noise."""
        return self._held_out(after).gain_over(self._held_out(before), self.noise)

    def _explains_most(self, after: Explanation) -> bool:
        """Does an explanation remove nearly all of the excess chi-square, of the fit and of the held-out data?

        Wrong effects gain a lot as well where the true one is not in the catalogue, but they leave a good part.
        """
        before = self.base_model
        excess = [e.fit.excess(self.noise) for e in (before, after)]
        held = [self._held_out(e.fit) for e in (before, after)]
        free = [h.chi_square / self.noise - h.expected for h in held]
        # where the held-out data hardly move, no model errs there: then the excess of the whole is the measure
        at_stake = max(free[0], excess[0] * held[0].n_data / max(before.fit.n_data, 1))
        share = self.settings.unexplained_share
        return excess[1] < share * excess[0] and free[1] < share * at_stake

    def _quantities(self, candidates: Sequence[Candidate]) -> tuple[Quantity, ...]:
        new = {q.name: q for c in candidates for q in c.quantities}
        return tuple(q for q in self.system.base if q.name not in new) + tuple(new.values())

    def _held_out(self, fit_: Fit) -> HeldOut:
        if fit_ not in self.predictions:
            self.predictions[fit_] = held_out(self.system, fit_.quantities, fit_.values, self.rows)
        return self.predictions[fit_]

    def _fit(self, of: Sequence[Candidate], start: Values, patient: bool = False, wanted: float = np.inf) -> Fit:
        """With these effects.

        patient : without a limit of steps, beyond which a trial has not converged
        wanted : cost without which the fit is of no use
        """
        key = _names(of)
        known = self.pool[key].fit if key in self.pool else None
        if known is not None and (known.converged or not key):
            return known
        return (fit if patient else attempt)(self.system, self._quantities(of), start, wanted=wanted)

    def _best_fit(self, current: Explanation, extra: Sequence[Candidate]) -> Fit | None:
        """Refit with the extra candidates; None where one with a threshold has no start."""
        together, start = [*current.candidates, *extra], dict[str, float]()
        for c in extra:
            if c.threshold:
                if not (starts := self.system.starts(c, current.fit.values)):
                    return None
                start |= dict(zip(c.names, starts[0], strict=True))
        if extra and all(c.threshold for c in extra):
            followed = self._fitted_stepwise(current, together, start)
            if followed is not None and self._at_noise(followed):
                return followed
        fits = [self._fit(together, current.fit.values | start)]
        declared = {q.name: q.declared for q in self.system.base if q.declared is not None}
        if declared and not fits[0].converged:
            # other parameters may have moved too far to compensate for the missing effect: start them as declared
            fits.append(self._fit(together, current.fit.values | declared))
        return min(fits, key=lambda f: (not f.converged, f.cost))

    def _fitted_stepwise(self, current: Explanation, together: Sequence[Candidate], start: Values) -> Fit | None:
        """Refit over longer and longer first parts of the data; None where one of these is not fitted to the noise.

        Every instant at which a threshold is crossed makes local minima of chi-square. Where the residuals are small
        from the start, a fit stays in the right one.
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

    def _removes_most(self, before: Explanation, after: Explanation) -> bool:
        """Does another explanation remove nine tenths of the excess chi-square, and come near the noise?"""
        near = after.fit.reduced_chi_square < FAR * self.noise
        return after.fit.converged and near and after.fit.excess(self.noise) < 0.1 * before.fit.excess(self.noise)

    def _at_noise(self, fit_: Fit, gain: float = 0.0) -> bool:
        return is_noise(fit_, self.settings, self.noise, gain)

    def _is_implausible(self, trial: Explanation, extra: Sequence[Candidate]) -> bool:
        """Is an amount at its bound, or do some of the effects cancel each other in what they predict?

        Enough effects of opposite signs fit any motion, as polynomials do: such a sum says nothing about its cause.
        """
        values = trial.fit.values
        limits = [(values[q.name], q) for c in extra if c.kind == "measurement" for q in c.quantities]
        if any(v != q.null and not q.lower < v < q.upper for v, q in limits):
            return True
        if len(trial.candidates) < 2:
            return False
        amounts = {q.name: values[q.name] - q.null for c in trial.candidates for q in c.quantities}
        parts = dict(zip(amounts, np.moveaxis(self.system.linearise(values, list(amounts))[1], -1, 0), strict=True))
        signals = [sum(amounts[name] * parts[name] for name in c.names) for c in trial.candidates]
        sums = [several for k in range(2, len(signals) + 1) for several in combinations(signals, k)]
        return any(np.sum(sum(own) ** 2) < CANCELLING * min(np.sum(x**2) for x in own) for own in sums)

    def _without_weakest(self, e: Explanation) -> Explanation | None:
        """Without the least significant effect, if autocorrelated noise may gain as much."""
        if self.settings.noise is not None:
            return None
        losses = []
        for c in e.candidates:
            smaller = self._refit_without(e, c)
            loss = (smaller.fit.cost - e.fit.cost) / self.noise
            enough = noise_gain(self.system, e.fit, self.noise, c, self.threshold(len(c.names)))
            losses.append((loss / enough, c.name, smaller))
        least, _, smaller = min(losses, default=(np.inf, "", e))
        return smaller if least < 1.0 else None

    def _alternatives(self, e: Explanation, effect: Candidate) -> list[Alternative]:
        """Effects that predict nearly the same signal, refitted in place of one; they join the explanations."""
        if not self.system.budget.open(kept=FOR_LAWS):
            return []
        rest, start = _without(e, effect)
        reduced = _restricted(e.fit, self._quantities(rest))
        linear = Linearisation(self.system, reduced, [*self.candidates, effect])
        shape = {q.name for q in effect.shape}  # shape parameters are no amounts of the effect
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
            other = self._explanation((*rest, candidate), start, e)
            loss = (other.fit.cost - e.fit.cost) / self.noise
            if other.fit.converged and loss < CLASS_GAIN:
                found.append(Alternative(candidate, angles[candidate.name], loss, other.fit))
        return found

    def _found(self, e: Explanation, candidate: Candidate, alternatives: list[Alternative]) -> Found:
        without = self._fit(*_without(e, candidate), patient=True)
        held_gain = self._held_out_gain(without, e.fit)
        gain = (without.cost - e.fit.cost) / self.noise
        return Found(candidate, gain, held_gain, self.threshold(len(candidate.names)), tuple(alternatives))

    def _all_outcomes(self, scores: Sequence[Score], found: tuple[Found, ...]) -> tuple[Tried, ...]:
        scored = {s.candidate.name for s in scores}  # the others are effects of the explanation that was first
        others = [f for f in found if f.candidate.name not in scored]
        lost = [c for c in self.system.candidates if not c.sought and c not in self.candidates]
        without = (Tried(c, 0.0, None, None, "the motion has no derivative by it where it is absent") for c in lost)
        return (*_chosen(others), *(self._outcome(s, found) for s in scores), *without)

    def _outcome(self, score: Score, found: tuple[Found, ...]) -> Tried:
        c, limit, first_order = score.candidate, self.threshold(len(score.candidate.names)), score.gain / self.noise
        refit_gain, trial = self.first.get(c.name, (None, None))
        gain, held, stuck = first_order if refit_gain is None else refit_gain, None, False
        if trial is not None:
            stuck = not trial.converged
            held = self._held_out_gain(self.base_model.fit, trial) if trial in self.predictions else None
        same = {r.candidate.name: f.candidate.name for f in found for r in f.cannot_be_told_from}
        if c.name in {f.candidate.name for f in found}:
            reason = "chosen"
        elif c.name in same:
            reason = f"indistinguishable from {same[c.name]}"
        elif not score.visible and trial is None:
            reason = "leaves no trace in this recording that other fitted quantities do not absorb"
        elif gain <= limit:
            # where an effect was found, the score against the base model bounds nothing
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
    """Is the gain that the base fit still promises negligible against its excess chi-square?

    Where equations jump, chi-square is rough, and far above the noise a fit may not converge.
    """
    return system.several_minima and base.promised < ROUGH * base.excess(1.0)


def _refusal(base: Fit, settings: Settings) -> Diagnosis:
    reason = (
        f"the base fit has not converged (chi-square {base.reduced_chi_square:.3g} per degree of freedom after "
        f"{base.n_iterations} iterations): before it has, every candidate seems to help, so that nothing is attributed"
    )
    return Diagnosis("unexplained", reason, (), base, base, None, None, np.nan, (), settings)


def _bounds(score: Score) -> str:
    """Upper bounds (95 %) of an effect that is not significant."""
    sizes = zip(score.candidate.quantities, np.abs(score.values), score.sigma, strict=True)
    open_ = [(q, size + TWO_SIDED * sigma) for q, size, sigma in sizes if np.isfinite(size + sigma)]
    most = ", ".join(f"{q.part} < {b:.2g} {'' if q.unit == '1' else q.unit}".rstrip() for q, b in open_)
    return f"; only bounded: {most} (95 %)" if most else ""


def _surprise(candidate: Candidate, fit_: Fit) -> float:
    """-2 log of a heavy-tailed (Cauchy) prior of the sizes, relative to its value at the typical size."""
    size = max(abs(fit_.values[q.name] - q.null) / q.typical for q in candidate.quantities)
    return max(0.0, 2.0 * float(np.log((1.0 + size**2) / 2.0)))


def _without(e: Explanation, candidate: Candidate) -> tuple[tuple[Candidate, ...], dict[str, float]]:
    """The other effects, and values with the candidate's quantities at null, unless another effect has them too."""
    rest = tuple(c for c in e.candidates if c is not candidate)
    kept = {n for c in rest for n in c.names}
    return rest, e.fit.values | {q.name: q.null for q in candidate.quantities if q.name not in kept}


def _restricted(fit_: Fit, quantities: tuple[Quantity, ...]) -> Fit:
    """The same fit with fewer quantities free."""
    kept = {q.name for q in quantities}
    index = [i for i, name in enumerate(fit_.shared) if name in kept]
    return replace(fit_, quantities=quantities, covariance=fit_.covariance[np.ix_(index, index)])
