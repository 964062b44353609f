"""Joint diagnosis of many recordings.

Every recording is prepared and fitted alone. Quantities of the disc, the surface, the rig or the air are then shared,
the search over effects uses all recordings, and inconsistent recordings are named and left out. The cost is linear in
the number of recordings.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import stats

from calibration.kit.least_squares import triangle
from calibration.kit.types import Array
from disctrack.discrepancy.fit import Fit
from disctrack.discrepancy.joint.covariates import Hypothesis, hypotheses
from disctrack.discrepancy.joint.crew import Crew
from disctrack.discrepancy.joint.fitting_in import Blocks, ConsistencyTest, all_consistencies, inconsistent
from disctrack.discrepancy.joint.sharing import EACH, JointSystem, Member, Sharing
from disctrack.discrepancy.score import Linearisation, score_all, sigmas, span
from disctrack.discrepancy.search import Diagnosis, Found, Settings, explain
from disctrack.discrepancy.significance import FALSE_ALARM, TWO_SIDED
from disctrack.discrepancy.system import Candidate
from disctrack.errors import AnalysisError, DiscTrackError

TEST_EVERY = 3  # every third recording is held out


@dataclass(frozen=True)
class OfRecording:
    """Result for one recording."""

    name: str
    labels: dict[str, str]
    reason: str  # why it was left out; empty if it was not
    consistency: ConsistencyTest | None = None  # against all others, in the final model
    alone: Fit | None = None  # the final model fitted to it alone; sigmas with the autocorrelation of its residuals


@dataclass(frozen=True)
class Bound:
    """Size and bounds of an effect, found or not."""

    candidate: Candidate
    values: Array  # (k,) to first order where it was not found
    sigma: Array  # (k,)
    by_number: dict[int, Array]  # number of recordings, the first ones -> (k,) standard deviations
    upper: float | None  # upper bound (95 %) of an effect with a single parameter


@dataclass(frozen=True)
class Dependence:
    """Dependence of a law's coefficient on the groups of recordings."""

    quantity: str
    unit: str
    by: str  # kinds in which the groups differ: "surface", "disc and surface", ...
    groups: dict[str, tuple[float, float]]  # value and standard deviation
    hypotheses: tuple[Hypothesis, ...]


@dataclass(frozen=True)
class TogetherDiagnosis:
    """Result for many recordings."""

    diagnosis: Diagnosis
    system: JointSystem
    recordings: tuple[OfRecording, ...]
    bounds: tuple[Bound, ...]
    dependences: tuple[Dependence, ...]
    notes: tuple[str, ...]
    unusable: tuple[str, ...] = ()  # recordings that could not be read or fitted
    plan: Any = None  # proposed further recordings, if any


def answer_together(
    crew: Crew,
    described: Sequence[tuple[str, Mapping[str, str]]],
    in_common: Callable[[list[Any]], list[Any]],
    progress: Callable[[str], None],
    unread: Mapping[str, str],
) -> TogetherDiagnosis:
    """Joint diagnosis of all recordings of the crew.

    crew : objects with the methods `summary`, `with_common` (a Member), `share`, `reduce` and `alone` (a Fit, and the
        same with sigmas that allow for autocorrelated residuals)
    described : name and labels of each
    in_common : arguments of `with_common` for all recordings, by their summaries: errors that they share
    unread : further recordings that are reported as left out, and why
    The crew keeps the recordings that were used.
    Raises AnalysisError where fewer than two can be used.
    """
    settings = Settings(noise=1.0)
    names, n = [name for name, _ in described], len(described)
    summaries = crew.call("summary", [()] * n)
    reasons = {i: str(s) for i, s in enumerate(summaries) if isinstance(s, DiscTrackError)}
    kept = [i for i in range(n) if i not in reasons]
    crew.keep(kept)
    refitted = crew.call("with_common", [(s,) for s in in_common([summaries[i] for i in kept])])
    members: dict[int, Member] = dict(zip(kept, refitted, strict=True))
    reasons |= {i: str(m) for i, m in members.items() if isinstance(m, DiscTrackError)}
    unusable = (*(names[i] for i in reasons), *unread)
    while True:
        kept = [i for i in kept if i not in reasons]
        if len(kept) < 2:
            left_out = {names[i]: reason for i, reason in reasons.items()} | dict(unread)
            said = "; ".join(f"{name}: {reason}" for name, reason in list(left_out.items())[:5])
            raise AnalysisError(f"fewer than two recordings can be diagnosed together. {said}")
        crew.keep(kept)
        system = JointSystem(Sharing([members[i] for i in kept]), crew)
        progress(f"{len(kept)} recordings together: {len(system.base)} shared quantities")
        diagnosis = _searched(system, settings)
        most = len(kept) - (2 * n + 2) // 3
        effects = [c for c in system.candidates if not c.name.endswith(f"({EACH})")]
        blocks = Blocks(system, diagnosis.after, effects)
        out = inconsistent(blocks, settings.false_alarm, most)
        if not out:
            break
        for k, effect in out.items():
            reasons[kept[k]] = "does not fit the others" + (f"; it differs most by: {effect}" if effect else "")
    progress("each recording against the others")
    diagnosis, alone = _with_autocorrelation(system, diagnosis, crew)
    judged = {kept[k]: (own, alone[k]) for k, (own, _) in all_consistencies(blocks, range(len(kept))).items()}
    recordings = [
        OfRecording(name, dict(labels), reasons.get(i, ""), *judged.get(i, ()))
        for i, (name, labels) in enumerate(described)
    ]
    recordings += [OfRecording(name, {}, reason) for name, reason in unread.items()]
    laws = _bounds(system, diagnosis), _dependences(system, diagnosis)
    return TogetherDiagnosis(diagnosis, system, tuple(recordings), *laws, _notes(recordings, unusable), unusable)


def _searched(system: JointSystem, settings: Settings) -> Diagnosis:
    """The answer without alternatives that generalise the effect found: a value for each group in place of one for all.

    Every third recording is held out.
    """
    n = len(system.time)
    training = np.arange(n) % TEST_EVERY != TEST_EVERY - 1 if n >= TEST_EVERY else np.arange(n) == 0
    diagnosis = explain(system, system.sharing.start(), settings, training)
    found = list[Found]()
    for f in diagnosis.found:
        others = (r for r in f.cannot_be_told_from if r.candidate.name != f"{f.candidate.name} ({EACH})")
        found.append(replace(f, cannot_be_told_from=tuple(others)))
    return replace(diagnosis, found=tuple(found))


def _with_autocorrelation(system: JointSystem, diagnosis: Diagnosis, crew: Crew) -> tuple[Diagnosis, list[Fit | None]]:
    """With sigmas that allow for autocorrelated residuals; and the fit of each recording alone."""
    after, sharing = diagnosis.after, system.sharing
    extra = [n for f in diagnosis.found for n in f.candidate.names]
    numbers = range(len(sharing.members))
    requested = [(sharing.local_values(i, after.values), sharing.local_names(i, extra)) for i in numbers]
    alone = [None if isinstance(a, DiscTrackError) else a for a in crew.call("alone", requested)]
    fitted = [(i, *fits) for i, fits in enumerate(alone) if fits is not None and fits[0].converged]
    growth = np.ones(len(after.quantities))
    for k, q in enumerate(after.quantities):
        if np.isfinite(q.prior_sigma):
            continue
        named = [(*fits, local) for i, *fits in fitted for local in sharing.local_names(i, [q.name])]
        sigma = np.array([(white.sigma(n), grown.sigma(n)) for white, grown, n in named if white.sigma(n) > 0])
        if sigma.size:
            growth[k] = np.sqrt(max(np.average((sigma[:, 1] / sigma[:, 0]) ** 2, weights=sigma[:, 0] ** -2), 1.0))
    after = replace(after, covariance=after.covariance * np.outer(growth, growth))
    return replace(diagnosis, after=after), [None if fits is None else fits[1] for fits in alone]


def _bounds(system: JointSystem, diagnosis: Diagnosis) -> tuple[Bound, ...]:
    """Every candidate to first order in the final model, and its sigma by the number of recordings."""
    after = diagnosis.after
    found = {f.candidate.name for f in diagnosis.found}
    n = len(system.time)
    numbers = sorted({2**k for k in range(n.bit_length())} | {n})  # for which sigmas are reported
    whole = Linearisation(system, after, system.candidates)
    scores = {s.candidate.name: s for s in score_all(whole, system.candidates)}
    first = sigmas_of_first(system, after, numbers)
    bounds = []
    for c in system.candidates:
        if c.name in found:
            values = np.array([after.values[name] for name in c.names])
            sigma = np.array([after.sigma(name) for name in c.names])
        else:
            values, sigma = scores[c.name].values, scores[c.name].sigma
        single = len(c.names) == 1 and c.name not in found and bool(np.isfinite(sigma[0]))
        upper = float(abs(values[0] - c.quantities[0].null) + TWO_SIDED * sigma[0]) if single else None
        bounds.append(Bound(c, values, sigma, {k: first[k][c.name] for k in numbers}, upper))
    return tuple(bounds)


def sigmas_of_first(system: JointSystem, fit_: Fit, numbers: Sequence[int]) -> dict[int, dict[str, Array]]:
    """Standard deviations of every candidate from the first `numbers` of recordings, with all quantities of the fit."""
    known = {q.name: q for q in fit_.quantities}
    new = {q.name: q for c in system.candidates for q in c.quantities if q.name not in known}
    everything = [*known.values(), *new.values()]
    column = {q.name: i for i, q in enumerate(everything)}
    _, derivative = system.linearise({q.name: q.null for q in new.values()} | fit_.values, list(column))
    priors = np.diag([1.0 / q.prior_sigma for q in everything])
    found: dict[int, dict[str, Array]] = {k: {} for k in numbers}
    for k in numbers:
        rows = triangle(derivative[:k].reshape(-1, len(everything)))
        for c in system.candidates:  # without the tolerances of what it frees
            own, others = [column[n] for n in c.names], [column[n] for n in known if n not in c.names]
            matrix = np.concatenate([rows, np.delete(priors, own, axis=0)])
            found[k][c.name] = sigmas(matrix[:, own], span(matrix[:, others]))
    return found


def _dependences(system: JointSystem, diagnosis: Diagnosis) -> tuple[Dependence, ...]:
    """Of every law with a value for each of several groups: relations between these."""
    after, sharing = diagnosis.after, system.sharing
    found = []
    for local, groups in sharing.all_groups().items():
        names = [n for n in groups.values() if n in after.names and after.sigma(n) > 0]
        if len(names) < len(groups):
            continue
        values, covariance = np.array([after.values[n] for n in names]), after.amounts(names)[1]
        q = after.quantities[after.names.index(names[0])]
        if np.isfinite(q.prior_sigma):  # a tolerance and not a law
            continue
        tested = hypotheses(values, covariance, sharing.covariates_of(local), sharing.kinds_of(local))
        shown = {g: (after.values[n], after.sigma(n)) for g, n in groups.items()}
        found.append(Dependence(local, q.unit, " and ".join(sharing.differing(q)), shown, tuple(tested)))
    return tuple(found)


def _notes(recordings: Sequence[OfRecording], unusable: Sequence[str]) -> tuple[str, ...]:
    how = dict.fromkeys(unusable, "was left out: ")
    notes = [f"{r.name} {how.get(r.name, '')}{r.reason}" for r in recordings if r.reason]
    for r in recordings:
        if (test := r.consistency) is not None and test.p_value * len(recordings) < FALSE_ALARM:
            by = f"it differs most by: {test.differs_by}; " if test.differs_by else ""
            notes.append(
                f"{r.name} does not fit the others (p = {test.p_value:.1g}), and yet is among them: {by}more than a "
                "third would have to go, and the sizes are those of no recording"
            )
        if r.alone is not None and r.alone.converged:
            ratio = r.alone.reduced_chi_square
            excess = (ratio - 1) / np.sqrt(2 / r.alone.degrees_of_freedom)
            if stats.norm.sf(excess) * len(recordings) < FALSE_ALARM and ratio > 1.1:
                notes.append(f"{r.name} is not described by the model even alone (chi-square {ratio:.3g})")
    return tuple(notes)
