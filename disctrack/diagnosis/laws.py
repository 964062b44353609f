"""Laws outside the catalogue: proposed by their gain to first order, and compared by evidence with known effects.

The response of a fitted motion to small forces gives the first-order gain of every law of a library. The law that
gains most and its nearest alternatives are fitted, and a further term is searched for in the residuals. Each term pays
an Occam factor for its parameters, and for multiple comparisons by the size of the library. A law together with the
known effects that remain significant is an explanation; the answer is the shortest one.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from disctrack.diagnosis.disc_system import DiscSystem
from disctrack.diagnosis.errors import ResidualTests, residual_tests
from disctrack.diagnosis.law_library import Family, LearnedLaw, differ_from_zero
from disctrack.diagnosis.missing_force import Gain, law_of, scan
from disctrack.discrepancy.fit import TRIAL, Fit, attempt, settled
from disctrack.discrepancy.search import CLASS_GAIN, FAR, Diagnosis, Explanation, Found, equivalent, length, noise_gain
from disctrack.discrepancy.shape import leaves_most
from disctrack.discrepancy.significance import SURE, bic_penalty
from disctrack.discrepancy.system import System

MAX_TERMS = 3
REFITTED = 5  # families that are fitted in each round ...
OF_ONE_KIND = 2  # ... at most of one kind
LONGER = 2  # further ones of other kinds with more parameters, if known effects describe the data
EXACT = 0.02  # of chi-square: error of a first-order gain if the motion is far from the data
UNLIKELY = 1e-3  # odds below which a law is dropped
NEARLY = 20.0  # chi-square by which a refit may be better than the first order ...
COARSE = 0.1  # ... and share of the excess, by which a refit of a shape between grid points may be better


def learn(
    system: DiscSystem, base: Fit, noise: float, along: Fit | None = None, against: float = np.inf,
    to_noise: bool = False,
) -> LearnedLaw | None:  # fmt: skip
    """The law of few terms that describes what is missing; None if none survives, or where there is no first order.

    noise : variance of the residual's noise over that stated
    along : fit of other effects that follows the data more closely than the base does: the law is looked for along its
    motion, in the place of what it has beyond the base
    against : chi-square over the noise that another explanation leaves; then only a law of a single term is sought, and
    only one that may, to first order, come as near to the data
    to_noise : what is noise ends the search for further terms, which else goes on while each gains more than its price.
    So does a term after which more than half of the excess chi-square is left, far from the noise
    """
    price, law, known = bic_penalty(system.weights), None, system
    current, shortest = base, base.cost / noise
    first = scan(system, along, base.quantities) if along is not None else None
    along = along if first is not None else None
    scanned = first or scan(system, base)
    while scanned is not None:
        library = scanned.library()
        looked = 2.0 * float(np.log(len(library)))
        worth = [g for g in scanned.gains(library) if g.gain / noise > price * g.family.n_numbers + looked]
        begin, inexact = (base_alone(base, along), along.cost) if along is not None else (current, scanned.chi_square)
        chosen = _worth_a_refit(worth, scanned.chi_square, inexact, noise, price, against)
        trials = [_refitted(system, base, law, begin, g, noise) for g in chosen if system.budget.open()]
        lengths = [t.cost / noise + sum(price * f.n_numbers + looked for f in one.families) for one, t in trials]
        if not trials or min(lengths) >= shortest:
            break
        shortest, along = min(lengths), None
        near = [one.title for (one, _), its in zip(trials, lengths, strict=True) if its - shortest < CLASS_GAIN]
        before, (law, current) = current, trials.pop(lengths.index(shortest))
        # how short a law is decides which is named; what the recording determines is what all that fit it agree in
        odds = [(one, _odds(t, current, noise)) for one, t in trials if t.converged]
        alike = tuple(title for title in dict.fromkeys(near) if title != law.title)
        others = tuple((one, share) for one, share in odds if share > UNLIKELY)
        law = replace(law, alike=alike, others=others, looked=looked)
        known = system.knowing(law)
        enough = len(law.families) == MAX_TERMS or np.isfinite(against)
        # far from the data, a sum whose terms each remove a small part approximates any motion
        slow = leaves_most(current.excess(noise), before.excess(noise))
        enough |= slow and current.reduced_chi_square > FAR * noise
        if enough or (to_noise and _leaves_noise(known, current, noise)):
            break
        scanned = scan(known, current)
    return without_idle_terms(system, law, current) if law is not None else None


def _leaves_noise(known: DiscSystem, fitted: Fit, noise: float) -> bool:
    if fitted.reduced_chi_square > noise * (1.0 + 4.0 * float(np.sqrt(2.0 / np.sum(known.weights)))):
        return False
    return not residual_tests(known, fitted, noise).of_the_motion


def base_alone(base: Fit, along: Fit) -> Fit:
    """The base fit with the other fit as initial guess, the effects outside the base at zero."""
    beyond = {q.name: q.null for q in along.quantities if q.name not in base.names}
    return replace(base, values=base.values | along.values | beyond)


def shortest_to_first_order(system: DiscSystem, base: Fit, along: Fit, noise: float) -> float:
    """Length of the best law without shape parameters, to first order; infinite if the disc slips.

    along : fit of known effects, which the law replaces
    """
    scanned = scan(system, along, base.quantities)
    if scanned is None:
        return np.inf
    library, price = scanned.library(), bic_penalty(system.weights)
    gains = scanned.gains(family for family in library if not family.shape)
    nearest = min((scanned.chi_square - g.gain) / noise + price * g.family.n_numbers for g in gains)
    return nearest + 2.0 * float(np.log(len(library))) + price * base.n_free


def _odds(fitted: Fit, best: Fit, noise: float) -> float:
    return float(np.exp(-0.5 * max(fitted.cost - best.cost, 0.0) / noise))


def _worth_a_refit(
    worth: Sequence[Gain], chi_square: float, inexact: float, noise: float, price: float, against: float
) -> list[Gain]:
    """The best ones, of each kind only a few: to first order many of one kind are alike.

    inexact : chi-square of the motion at which the gains were computed
    against : as for `learn`
    """
    left = {id(g): (chi_square - g.gain) / noise for g in worth}
    if np.isfinite(against):
        beyond = max(chi_square / noise - against, 0.0)
        worth = [g for g in worth if left[id(g)] < against + NEARLY + (COARSE if g.family.shape else EXACT) * beyond]

    def rank(g: Gain) -> tuple[float, float]:
        return price * g.family.n_numbers + max(left[id(g)], EXACT * inexact / noise), left[id(g)]

    found, kinds = list[Gain](), list[str]()
    for g in sorted(worth, key=rank):
        if kinds.count(g.family.kind) < OF_ONE_KIND and len(found) < REFITTED:
            found.append(g)
            kinds.append(g.family.kind)
    if np.isfinite(against):
        # laws that fit as well with more parameters are not named, but contribute to the uncertainty of the force
        found += sorted((g for g in worth if g.family.kind not in kinds), key=lambda g: -g.gain)[:LONGER]
    return found


def _refitted(
    system: DiscSystem, base: Fit, law: LearnedLaw | None, current: Fit, new: Gain, noise: float
) -> tuple[LearnedLaw, Fit]:
    """The law enlarged by a family, fitted to the data."""
    before = law.families if law else ()
    values = [current.values[n] for n in law.candidate.names] if law else []
    enlarged = law_of(system.model, (*before, new.family), np.array([*values, *new.values, *new.family.shape.values()]))
    enlarged = replace(enlarged, values=current.values | dict(enlarged.values))
    known = system.knowing(enlarged)
    shape, far = {name for names in enlarged.shapes for name in names}, current.reduced_chi_square > FAR * noise
    fits = [] if shape and far else [with_law(known, base, enlarged)]
    if shape and not any(f.converged for f in fits):  # it has many minima: freed where everything else fits
        held = with_law(known, base, enlarged, shape)
        fits.append(with_law(known, base, replace(enlarged, values=held.values)))
    fitted = min(fits, key=lambda f: f.cost)
    return replace(enlarged, values=fitted.values), fitted


def with_law(system: System, base: Fit, law: LearnedLaw, held: Collection[str] = ()) -> Fit:
    """Fit of the base model and the law's parameters, except those held."""
    moved = (q for q in law.candidate.quantities if q.name not in held)
    return attempt(system, (*base.quantities, *moved), base.values | dict(law.values), TRIAL)


def without_idle_terms(system: DiscSystem, law: LearnedLaw, fitted: Fit) -> LearnedLaw:
    """The law without the terms that are not significant in its fit; unchanged if none is.

    Single terms of a family may be insignificant by correlation although the family is not: both are tested jointly.
    """
    kept, values = list[Family](), list[float]()
    for family, amounts, shapes in zip(law.families, law.amounts, law.shapes, strict=True):
        busy = busy_amounts(fitted, amounts)
        if busy:
            names = tuple(family.names[i] for i in busy if family.names)
            # unless its numbers have names, a family is named after its first term
            title = family.title if names or 0 in busy else f"{family.title}, without its first term"
            kept.append(replace(family, title=title, terms=tuple(family.terms[i] for i in busy), names=names))
            values += [*busy.values(), *(fitted.values[n] for n in shapes)]
    if not kept or len(values) == len(law.candidate.quantities):
        return law
    shorter = law_of(system.model, kept, np.array(values))
    started = fitted.values | dict(shorter.values)
    return replace(shorter, values=started, alike=law.alike, others=law.others, looked=law.looked)


def busy_amounts(fitted: Fit, names: Sequence[str]) -> dict[int, float]:
    """Indices of the significant amounts, with their values if the others are zero; empty if none is significant.

    Backward elimination: the least significant amount is removed, and the others are estimated again.
    """
    amounts, covariance = fitted.amounts(names)
    if not differ_from_zero(amounts, covariance):
        return {}
    size = np.where(np.diag(covariance) > 0, np.sqrt(np.diag(covariance)), 1.0)
    precision = np.linalg.pinv(covariance / np.outer(size, size), rcond=1e-12, hermitian=True)
    right, there = precision @ (amounts / size), list(range(len(names)))
    while True:
        inverse = np.linalg.pinv(precision[np.ix_(there, there)], rcond=1e-12, hermitian=True)
        left = inverse @ right[there]
        sigmas = np.abs(left) / np.sqrt(np.maximum(np.diag(inverse), 1e-300))
        if len(there) == 1 or sigmas.min() > SURE:
            return {i: float(value * size[i]) for i, value in zip(there, left, strict=True)}
        del there[int(np.argmin(sigmas))]


@dataclass(frozen=True, kw_only=True)
class WithLaw(Explanation):
    """An explanation by a law and known effects, fitted together."""

    law: LearnedLaw
    kept: tuple[Found, ...]

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of its effects, and the law in words."""
        return (*super().effects, self.law.title)


def explained_by_law(system: DiscSystem, diagnosis: Diagnosis, left: ResidualTests) -> tuple[WithLaw | None, Diagnosis]:
    """The explanation with a law if it is the shortest; and the diagnosis with all explanations with laws in its list.

    Among indistinguishable ones, that with the fewest known effects.
    """
    noise, answers = diagnosis.noise, list[WithLaw]()
    for kept in _subsets(system, diagnosis, left.doubtful):
        answer = _law_with(system, diagnosis, kept) if system.budget.open() else None
        if answer is not None and answer.fit.converged:
            answers.append(answer)
            if diagnosis.verdict != "found" and _leaves_noise(system.knowing(answer.law), answer.fit, noise):
                break  # beside further effects it would be longer
    if not answers:
        return None, diagnosis
    best = min(equivalent(answers), key=lambda a: sum(f.candidate.kind == "motion" for f in a.kept))
    chi_square, at_noise = best.fit.reduced_chi_square, diagnosis.settings.at_noise * noise
    ranked = sorted((*diagnosis.ranked, *answers), key=lambda e: e.length)
    listed = replace(diagnosis, ranked=tuple(ranked), length=ranked[0].length)
    many = len(best.law.families) + sum(f.candidate.kind == "motion" for f in best.kept)
    if not best.length < _known(system, diagnosis, many) or _is_known(diagnosis, best.fit):
        text = f"a single law outside the catalogue describes the data too ({chi_square:.4g}): {best.law.title}"
        return None, replace(listed, remarks=(*diagnosis.remarks, text)) if chi_square <= at_noise else diagnosis
    if chi_square > FAR * noise:
        return None, diagnosis
    exact = settled(judged_as(diagnosis, system.knowing(best.law)), best.fit)
    return replace(best, fit=exact, law=replace(best.law, others=_others(best, answers, diagnosis))), listed


def _is_known(diagnosis: Diagnosis, by_law: Fit) -> bool:
    """Does a single known effect describe the data as well as the law?"""
    alone = sum(f.candidate.kind == "motion" for f in diagnosis.found) == 1
    return alone and diagnosis.after.cost <= by_law.cost


def _known(system: System, diagnosis: Diagnosis, many: int) -> float:
    """Length of the shortest explanation by known effects.

    Among equals known effects are preferred to a law, if they are not more effects of the motion than the law needs.
    """
    found = [f.candidate for f in diagnosis.found]
    answer = length(system, diagnosis.settings, diagnosis.noise, diagnosis.after, found)
    lengths = [(answer, found), *((e.length, e.candidates) for e in diagnosis.ranked)]
    return min(its - CLASS_GAIN * (0 < sum(c.kind == "motion" for c in of) <= many) for its, of in lengths)


def _subsets(system: DiscSystem, diagnosis: Diagnosis, doubtful: bool) -> tuple[tuple[Found, ...], ...]:
    """Subsets of the effects found with each of which a law is combined, to replace the others.

    A known effect may approximate an unknown law. A single one is compared with laws if its residuals are `doubtful`,
    or if a law describes the data as well to first order; of several effects, each and all are. Faults of the
    measurement are kept together with the law, unless they become insignificant: no force displaces a dot on the face.
    """
    of_motion = tuple(f for f in diagnosis.found if f.candidate.kind == "motion")
    faults = tuple(f for f in diagnosis.found if f.candidate.kind != "motion")
    if diagnosis.verdict == "nothing missing" or diagnosis.held_out_before is None:
        return ()
    if diagnosis.verdict != "found":  # the effects found explain most of it, and a law may explain the rest
        return (faults, diagnosis.found) if of_motion else (faults,)
    if doubtful or len(of_motion) > 1:
        return (faults, *((*faults, f) for f in of_motion))
    if not of_motion:
        return ()
    near = shortest_to_first_order(system, base_with(diagnosis.before, faults), diagnosis.after, diagnosis.noise)
    return (faults,) if of_motion[0].candidate.sought or near - CLASS_GAIN < _known(system, diagnosis, 1) else ()


def judged_as(diagnosis: Diagnosis, system: System) -> System:
    """The system whitened by the noise that the diagnosis found."""
    return (diagnosis.judged or system).over(system)


def base_with(base: Fit, kept: Sequence[Found]) -> Fit:
    """The base fit with the quantities of these effects added to it."""
    quantities = {q.name: q for q in base.quantities} | {q.name: q for f in kept for q in f.candidate.quantities}
    return replace(base, quantities=tuple(quantities.values()))


def _law_with(system: DiscSystem, diagnosis: Diagnosis, kept: tuple[Found, ...]) -> WithLaw | None:
    """The law that replaces the effects found, except `kept`; None if there is none."""
    noise, base = diagnosis.noise, base_with(diagnosis.before, kept)
    nearest = diagnosis.nearest.fit if diagnosis.nearest else None
    along = diagnosis.after if diagnosis.found else nearest
    against = along.cost / noise if diagnosis.verdict == "found" and along else np.inf
    law = learn(system, base, noise, along, against, to_noise=not diagnosis.found)
    if law is None:
        return None
    known = system.knowing(law)
    fitted = with_law(judged_as(diagnosis, known), base, law)
    shorter = without_idle_terms(system, law, fitted)
    if fitted.converged and shorter is not law:
        law, known = shorter, system.knowing(shorter)
        fitted = with_law(judged_as(diagnosis, known), base, law)
    judged, again = judged_as(diagnosis, known), list(kept)
    for found in kept:  # is it still significant with the law?
        rest = [f for f in again if f is not found]
        enough = noise_gain(judged, fitted, noise, found.candidate, found.threshold)
        held = fitted.values | {q.name: q.null for q in found.candidate.quantities}
        without = with_law(judged, base_with(diagnosis.before, rest), replace(law, values=held))
        gain = (without.cost - fitted.cost) / noise
        if without.converged and gain < enough:
            again, fitted = rest, without
        else:
            again[again.index(found)] = replace(found, gain=float(gain), cannot_be_told_from=())
    known_effects = tuple(f.candidate for f in again)
    its = length(system, diagnosis.settings, noise, fitted, known_effects) + law.looked * len(law.families)
    return WithLaw(candidates=known_effects, fit=fitted, length=its, law=law, kept=tuple(again))


def _others(best: WithLaw, answers: Sequence[WithLaw], diagnosis: Diagnosis) -> tuple[tuple[LearnedLaw, float], ...]:
    """All that describes the data as well, with its odds: other laws, also with other effects, and known effects."""
    noise, others = diagnosis.noise, list(best.law.others)
    for other in answers:
        if other is not best and other.fit.converged:
            share = _odds(other.fit, best.fit, noise)
            others.append((replace(other.law, values=other.fit.values), share))
            others += [(law, share * its) for law, its in other.law.others]
    if diagnosis.verdict == "found":
        nothing = replace(best.law, families=(), values=diagnosis.after.values)  # by known effects alone
        others.append((nothing, _odds(diagnosis.after, best.fit, noise)))
    return tuple((law, share) for law, share in others if share > UNLIKELY)
