"""The stage: trajectory file in; diagnosis.json, enlarged model and the group `diagnosis` out."""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calibration.kit.brief import Brief
from calibration.kit.threads import one_blas_thread
from disctrack.diagnosis.answer import DiscDiagnosis, Learned
from disctrack.diagnosis.declared_dots import with_declared_dots
from disctrack.diagnosis.disc_system import DiscSystem
from disctrack.diagnosis.errors import energy_balance, errors
from disctrack.diagnosis.form_misfit import with_form
from disctrack.diagnosis.learned_law import (
    ALIKE,
    UNLIKELY,
    LearnedLaw,
    in_two_steps,
    learn,
    shortest_to_first_order,
    with_law,
    without_idle_terms,
)
from disctrack.diagnosis.left_over import LeftOver, left_over
from disctrack.diagnosis.model_file import PAPER, declared_model, model_toml
from disctrack.diagnosis.pages.output import as_json, lines, write_diagnosis
from disctrack.diagnosis.pages.words import law_text, sentence
from disctrack.diagnosis.plan import open_questions, plan, separations
from disctrack.diagnosis.regimes import regimes
from disctrack.diagnosis.slip_start import diagnose_motion, with_slip
from disctrack.discrepancy.fit import Fit, fit
from disctrack.discrepancy.held_out import held_out, training_rows
from disctrack.discrepancy.noise import inflation, with_memory
from disctrack.discrepancy.score import Linearisation, score_all
from disctrack.discrepancy.search import Diagnosis, Found, Settings, length, threshold
from disctrack.discrepancy.shape import refine_shapes
from disctrack.discrepancy.significance import price_of_a_number, wald
from disctrack.discrepancy.system import System
from disctrack.errors import AnalysisError
from disctrack.files.inputs import keep, refuse_input
from disctrack.files.json_text import json_file
from disctrack.files.whole import write_whole
from disctrack.trajectory import Trajectory
from disctrack.trajectory.file import read_findings, read_provenance, read_trajectory, trajectory_in
from disctrack.trajectory.reuse import refuse_other

TRIED_BESIDE = 3  # effects of the catalogue beside what was found, where what is left is not noise
DOUBTFUL = 0.05  # probability of what a single known effect leaves, below which laws outside the catalogue compete


@dataclass(frozen=True, repr=False)
class DiagnoseOutcome(Brief):
    """What `run_diagnose` did."""

    result: DiscDiagnosis
    files: tuple[Path, ...]
    summary: tuple[str, ...]

    def facts(self) -> dict[str, str]:
        """What a glance should tell (`Brief`)."""
        return {**self.result.facts(), "files": ", ".join(file.name for file in self.files)}


@one_blas_thread
def diagnose(
    trajectory: Trajectory, model: str = PAPER, settings: Settings | None = None, *, separate: bool = True
) -> DiscDiagnosis:
    """What does the model lack? Fit, trace, refit, judge.

    model    : "paper", "none", or a TOML file (`model_file.declared_model`)
    separate : also look for recordings that would tell apart what this one does not
    Raises AnalysisError, SceneError, ModelError.
    """
    declared = declared_model(trajectory, model)
    answer = diagnose_motion(trajectory, declared.model, declared.faults, settings)
    system, diagnosis = answer.system, answer.diagnosis
    if diagnosis.held_out_before is None or diagnosis.held_out_after is None:
        text = sentence(diagnosis, diagnosis.after, None, None)
        return DiscDiagnosis(system, diagnosis, declared.name, text, None, None, {}, notes=answer.notes)
    diagnosis, remarks = refine_shapes(system, diagnosis)
    left = left_over(system, diagnosis.after, diagnosis.noise)
    diagnosis = judged_by_what_is_left(diagnosis, left)
    kinds = _doubtful(left, system) if diagnosis.verdict == "found" else ()
    if kinds:
        diagnosis = _with_another_known(system, diagnosis, kinds)
        left = left_over(system, diagnosis.after, diagnosis.noise)
    learned, kept, also = _beyond_the_catalogue(system, diagnosis, left)
    parts = None
    if diagnosis.verdict == "unexplained" and diagnosis.before.converged:
        parts = regimes(system, _judged(diagnosis, system), diagnosis.before, diagnosis.noise)
        also = (*also, parts.text)
    if learned is not None:
        system = system.knowing(learned.law.effect)
        reason = (
            f"{diagnosis.reason}; the law {learned.law.candidate.title} leaves {learned.fit.reduced_chi_square:.3g}"
        )
        enlarged = learned.fit if kept else diagnosis.after
        diagnosis = replace(diagnosis, verdict="unexplained", found=kept, after=enlarged, reason=reason)
    if answer.slip is not None:
        diagnosis = with_slip(system, diagnosis, answer.slip)
    held_before, held_after = diagnosis.held_out_before, diagnosis.held_out_after
    assert held_before is not None
    assert held_after is not None
    if learned is not None:
        remembering = with_memory(_judged(diagnosis, system), learned.fit)
        left = left_over(system, learned.fit, diagnosis.noise)
        not_noise = left is not None and not left.white
        as_found = (system, remembering, learned.law, diagnosis.noise, not_noise)
        formed = with_form(*as_found, _of_motion(kept))
        diagnosis, doubted = _beside_any_form(diagnosis, kept, formed.of_another, learned.law.looked)
        if _of_motion(diagnosis.found):  # what holds beside any law does not stand in with this one
            formed = with_form(*as_found, _of_motion(f for f in kept if f not in diagnosis.found))
        learned = replace(learned, fit=formed.fit, course=formed.course)
        also = (*also, *doubted)
    else:
        diagnosis = replace(diagnosis, after=with_memory(_judged(diagnosis, system), diagnosis.after))
    fit_ = learned.fit if learned else diagnosis.after
    before = errors(system, diagnosis.before, held_before)
    after = errors(system, fit_, learned.held_out if learned else held_after)
    text = sentence(diagnosis, fit_, after, learned.law if learned else None, system.systematic, left)
    energy = energy_balance(system, fit_.values)
    apart = {
        f.candidate.name: separations(system, fit_, f.candidate, [r.candidate for r in f.cannot_be_told_from])
        for f in diagnosis.found
        if f.cannot_be_told_from and separate
    }
    notes = (*answer.notes, *remarks, *also)
    return DiscDiagnosis(
        system, diagnosis, declared.name, text, before, after, energy, learned, apart, notes=notes, regimes=parts
    )


def with_plan(result: DiscDiagnosis) -> DiscDiagnosis:
    """The diagnosis with the recordings that would settle what it leaves open; as it is where it has no answer."""
    diagnosis = result.diagnosis
    if result.after is None or not diagnosis.after.converged:
        return result
    questions = open_questions(diagnosis, result.system)
    return replace(result, plan=plan(result.system, diagnosis.after, questions, diagnosis.noise))


def judged_by_what_is_left(diagnosis: Diagnosis, left: LeftOver | None) -> Diagnosis:
    """The verdict on the motion: what is left may be its, although chi-square is small, or the measurement's."""
    if left is None or not diagnosis.after.converged:
        return diagnosis
    if diagnosis.verdict != "unexplained" and left.of_the_motion:
        reason = (
            f"{diagnosis.reason}; but what is left of the poses is not noise (p = {left.pose_p_value:.1g} over "
            f"{left.n_tests} tests), while the numbers that no pose takes are"
        )
        return replace(diagnosis, verdict="unexplained", reason=reason)
    if diagnosis.verdict == "unexplained" and left.of_the_measurement:
        reason = (
            f"{diagnosis.reason}; but what is left in the poses ({left.pose_chi_square:.3g} of the noise) is no more "
            f"than errors of the measurement leave in the numbers that no pose takes ({left.other_chi_square:.3g})"
        )
        return replace(diagnosis, verdict="found" if diagnosis.found else "nothing missing", reason=reason)
    return diagnosis


def _judged(diagnosis: Diagnosis, system: DiscSystem) -> System:
    """The system with its noise as the diagnosis found it."""
    return (diagnosis.judged or system).over(system)


@dataclass(frozen=True)
class _Beside:
    """A law outside the catalogue with the known effects that stay beside it."""

    law: LearnedLaw
    system: DiscSystem  # knows the law
    fit: Fit
    kept: tuple[Found, ...]  # of the effects found
    length: float  # chi-square with the price of its numbers, and of having been looked for


def _doubtful(left: LeftOver | None, system: DiscSystem) -> tuple[str, ...]:
    """Of what kind an effect may be missing, although chi-square is that of noise.

    One of the motion, where the poses' part is less like noise than that of one recording in twenty, and the numbers
    that no pose takes do not show as much of it: what those show is the measurement's, and is in the poses as well. One
    of the measurement also where those are, unless lenses or dots are seen to err in ways that no effect names.
    """
    if left is None:
        return ()
    of_all = left.other_p_value < DOUBTFUL
    if left.pose_p_value < DOUBTFUL and not (of_all and left.as_in_all):
        return ("motion", "measurement")
    return ("measurement",) if of_all and not system.systematic.present else ()


def _with_another_known(system: DiscSystem, diagnosis: Diagnosis, kinds: Collection[str]) -> Diagnosis:
    """With one more effect of these kinds, where chi-square is that of noise and what is left is not.

    A law whose frequency or place was looked for took the place of all others, and none was tried beside it.
    """
    settings, noise = diagnosis.settings, diagnosis.noise
    if len(diagnosis.found) >= settings.max_effects or diagnosis.held_out_after is None:
        return diagnosis
    judged, fitted = _judged(diagnosis, system), diagnosis.after
    taken = {q.name for f in diagnosis.found for q in f.candidate.quantities}
    others = [c for c in system.candidates if c.kind in kinds and not (c.sought or c.threshold or taken & set(c.names))]
    rows = training_rows(system, settings.train_fraction)
    best = diagnosis
    for s in score_all(Linearisation(judged, fitted, others), others)[:TRIED_BESIDE]:
        candidate = s.candidate
        enough = threshold(system, settings, len(candidate.names))
        if s.gain / noise < enough:
            break
        quantities = {q.name: q for q in (*fitted.quantities, *candidate.quantities)}
        enlarged = fit(judged, tuple(quantities.values()), fitted.values)
        gain = (fitted.cost - enlarged.cost) / noise
        if not (enlarged.converged and gain > enough):
            continue
        held = held_out(judged, enlarged.quantities, enlarged.values, rows)
        held_gain = 2 * (held.log_density - diagnosis.held_out_after.log_density) / noise
        found = (*diagnosis.found, Found(candidate, float(gain), float(held_gain), enough, ()))
        answer = replace(diagnosis, found=found, after=enlarged, held_out_after=held)
        shorter = _length(system, answer, enlarged, found) < _length(system, best, best.after, best.found)
        best = answer if held_gain > 0 and shorter else best
    return best


def _beyond_the_catalogue(
    system: DiscSystem, diagnosis: Diagnosis, left: LeftOver | None
) -> tuple[Learned | None, tuple[Found, ...], tuple[str, ...]]:
    """A law outside the catalogue if that describes the data better, for its length, than the catalogue does.

    Beside it the known effects that stay, and remarks on what describes the data as well. A single known effect has to
    compete where what it leaves of the motion is less like noise than that of one recording in twenty: it may stand in
    for a law that is not known. So may each of several, or all: the law is looked for in the place of all of them, and
    beside each.
    Faults of the measurement stay beside it, unless the law makes them idle: no force displaces a dot on the face.
    """
    doubtful = "motion" in _doubtful(left, system)
    explained = diagnosis.verdict == "found"
    of_motion, faults = (
        tuple(f for f in diagnosis.found if (f.candidate.kind == "motion") == motion) for motion in (True, False)
    )
    looked_for = any(f.candidate.sought for f in of_motion)
    sets: list[tuple[Found, ...]] = [faults]
    if diagnosis.verdict == "nothing missing":
        return None, (), ()
    if diagnosis.held_out_before is None or (explained and not of_motion and not doubtful):
        return None, (), ()
    base = diagnosis.before
    known = _length(system, diagnosis, diagnosis.after, diagnosis.found)
    if explained and len(of_motion) == 1 and not (doubtful or looked_for):
        beside = _beside_them(base, faults)
        if not shortest_to_first_order(system, beside, diagnosis.after, diagnosis.noise) < known:
            return None, (), ()
    if explained and (doubtful or len(of_motion) > 1):
        sets += [(*faults, f) for f in of_motion]
    elif of_motion and not explained:  # they describe most of it, and the law may be what is left
        sets.append(diagnosis.found)
    answers = [_law_beside(system, diagnosis, kept) for kept in sets]
    best = _with_fewest_claims([a for a in answers if a is not None])
    if best is None:
        return None, (), ()
    plain, law, system, fitted = system, best.law, best.system, best.fit
    law = replace(law, rivals=_rivals(best, [a for a in answers if a is not best], diagnosis, explained))
    judged = _judged(diagnosis, system)
    saved = known - best.length
    # of two that are as good, what is known; a sum of known effects, or one that was looked for, has no such credit
    enough = ALIKE if explained and of_motion and len(diagnosis.found) == 1 and not looked_for else 0.0
    if not (fitted.converged and saved > enough) or _one_alone_does(plain, diagnosis, of_motion, best):
        return None, (), _also(diagnosis, law, fitted)
    rows = training_rows(system, diagnosis.settings.train_fraction)
    held = held_out(judged, fitted.quantities, fitted.values, rows)
    held_gain = 2 * (held.log_density - diagnosis.held_out_before.log_density) / diagnosis.noise
    gain = (base.cost - fitted.cost) / diagnosis.noise
    work = energy_balance(system, fitted.values)[f"by {law.candidate.name}"]
    power = -work / float(system.time[-1] - system.time[0])
    alike = [*law.alike, *(_words(a) for a in answers if a is not None and a is not best and _as_good(a, best))]
    notes = [f"{other} describes what is missing as well" for other in alike]
    if diagnosis.found and diagnosis.after.reduced_chi_square <= diagnosis.settings.at_noise * diagnosis.noise:
        known_ones = ", ".join(f.candidate.name for f in diagnosis.found)
        notes.append(
            f"known effects together ({known_ones}) leave {diagnosis.after.reduced_chi_square:.4g} of the expected "
            f"variance where the law leaves {fitted.reduced_chi_square:.4g}: with their prices the law is ahead by "
            f"{saved:.4g}"
        )
    return Learned(law, fitted, held, gain, float(held_gain), power), best.kept, tuple(notes)


def _with_fewest_claims(answers: Sequence[_Beside]) -> _Beside | None:
    """Of the laws that describe the data as well as the shortest, the one beside the fewest known effects.

    An effect is claimed beside a law where without it all laws are longer.
    """
    if not answers:
        return None
    shortest = min(answers, key=lambda a: (not a.fit.converged, a.length))
    as_good = [a for a in answers if _as_good(a, shortest)]
    return min(as_good, key=lambda a: (sum(f.candidate.kind == "motion" for f in a.kept), a.length), default=shortest)


def _as_good(answer: _Beside, best: _Beside) -> bool:
    return answer.fit.converged and answer.length - best.length < ALIKE


def _words(answer: _Beside) -> str:
    known = ", ".join(f.candidate.name for f in answer.kept)
    return f"{answer.law.title}, beside {known}," if known else answer.law.title


def _one_alone_does(system: DiscSystem, diagnosis: Diagnosis, of_motion: Sequence[Found], best: _Beside) -> bool:
    """True where a known effect alone describes what the law does, to the price of a number: it is that effect."""
    if len(diagnosis.found) < 2:
        return False  # which has competed by itself
    judged = _judged(diagnosis, system)
    most = best.fit.cost + diagnosis.noise * price_of_a_number(system.weights)
    faults = tuple(f for f in best.kept if f.candidate.kind != "motion")
    others = {q.name for f in diagnosis.found for q in f.candidate.quantities}
    for found in of_motion:
        if found in best.kept:
            continue
        beside = _beside_them(diagnosis.before, (*faults, found))
        own = {q.name for q in beside.quantities}
        start = {name: value for name, value in diagnosis.after.values.items() if name in own or name not in others}
        alone = fit(judged, beside.quantities, start)
        if alone.converged and alone.cost <= most:
            return True
    return False


def _length(system: DiscSystem, diagnosis: Diagnosis, fitted: Fit, found: Sequence[Found]) -> float:
    return length(system, diagnosis.settings, diagnosis.noise, fitted, [f.candidate for f in found])


def _law_beside(system: DiscSystem, diagnosis: Diagnosis, kept: tuple[Found, ...]) -> _Beside | None:
    """The law that takes the place of what was found but for `kept`; None if there is none."""
    explained = diagnosis.verdict == "found"
    base = _beside_them(diagnosis.before, kept)
    along = diagnosis.after if diagnosis.found else diagnosis.nearest
    rival = along.cost / diagnosis.noise if explained and along else np.inf
    law = learn(system, base, diagnosis.noise, along, rival, competes=bool(diagnosis.found))
    if law is None:
        return None
    known = system.knowing(law.effect)
    judged = _judged(diagnosis, known)
    fitted = with_law(judged, base, law)
    shorter = without_idle_terms(law, fitted)
    if fitted.converged and shorter is not law:
        law, known = shorter, system.knowing(shorter.effect)
        judged = _judged(diagnosis, known)
        fitted = with_law(judged, base, law)
    again = list(kept)
    for found in kept:  # in what the law leaves, is it still an effect?
        rest = [f for f in again if f is not found]
        enough = found.threshold * _as_noise_with_memory(judged, fitted, found.candidate.names, diagnosis.noise)
        held = fitted.values | {q.name: q.null for q in found.candidate.quantities}
        without = in_two_steps(judged, _beside_them(diagnosis.before, rest), replace(law, values=held))
        gain = (without.cost - fitted.cost) / diagnosis.noise
        if without.converged and gain < enough:
            again, fitted = rest, without
        else:
            again[again.index(found)] = replace(found, gain=float(gain), cannot_be_told_from=())
    length = _length(system, diagnosis, fitted, again) + law.looked * len(law.families)
    return _Beside(law, known, fitted, tuple(again), length)


def _as_noise_with_memory(system: System, fitted: Fit, names: Sequence[str], noise: float) -> float:
    """By how much more than white noise what is left, with its memory, lets these numbers gain."""
    factors = dict(zip(fitted.names, inflation(system, fitted), strict=True))
    return float(max(1.0, fitted.reduced_chi_square / noise) * max(factors[name] for name in names) ** 2)


def _beside_any_form(
    diagnosis: Diagnosis, kept: Sequence[Found], fitted: Fit, looked: float
) -> tuple[Diagnosis, tuple[str, ...]]:
    """Without effects beside a law that stand out no longer once the law's form may be another; and a note of each.

    They stay in the fit: with the law they describe the data.
    kept : effects beside the law.   fitted : with sigmas as they are if the law's form is another's: a library seldom
    holds the law that no catalogue names.   looked : chi-square that a law pays for having been looked for; so does an
    effect whose place or frequency was
    """
    doubted, notes = list[Found](), list[str]()
    for found in kept:
        candidate = found.candidate
        shape = {q.name for q in candidate.shape}  # an exponent or a frequency is no amount
        sizes = [q for q in candidate.quantities if q.name not in shape]
        index = [fitted.names.index(q.name) for q in sizes]
        amounts = np.array([fitted.values[q.name] - q.null for q in sizes])
        gain = wald(amounts, fitted.covariance[np.ix_(index, index)])
        if gain > found.threshold + looked * candidate.sought:
            continue
        doubted.append(found)
        notes.append(
            f"{candidate.title} [{candidate.name}] helps the law to describe the data, and is not claimed: with what "
            f"the law's form may be off by it stands out by {np.sqrt(gain):.2g} sigma"
        )
    established = tuple(found for found in diagnosis.found if found not in doubted)
    return replace(diagnosis, found=established), tuple(notes)


def _of_motion(found: Iterable[Found]) -> set[str]:
    return {f.candidate.effect for f in found if f.candidate.kind == "motion"}


def _rivals(
    best: _Beside, others: Sequence[_Beside | None], diagnosis: Diagnosis, explained: bool
) -> tuple[tuple[LearnedLaw, float], ...]:
    """Whatever describes the data as well, with its odds: other laws, beside other effects, and known effects alone."""

    def odds(fitted: Fit) -> float:
        return float(np.exp(-0.5 * max(fitted.cost - best.fit.cost, 0.0) / diagnosis.noise))

    rivals = list(best.law.rivals)
    for other in others:
        if other is not None and other.fit.converged:
            share = odds(other.fit)
            rivals.append((replace(other.law, values=other.fit.values), share))
            rivals += [(law, share * its) for law, its in other.law.rivals]
    if explained:
        nothing = replace(best.law, families=(), values=diagnosis.after.values)  # beside known effects
        rivals.append((nothing, odds(diagnosis.after)))
    return tuple((law, share) for law, share in rivals if share > UNLIKELY)


def _beside_them(base: Fit, kept: Sequence[Found]) -> Fit:
    """The base fit, with the quantities of these effects to be fitted along."""
    quantities = {q.name: q for q in base.quantities} | {q.name: q for f in kept for q in f.candidate.quantities}
    return replace(base, quantities=tuple(quantities.values()))


def _also(diagnosis: Diagnosis, law: LearnedLaw, fitted: Fit) -> tuple[str, ...]:
    """A law that describes the data too, though not in fewer numbers than the known effects."""
    if not fitted.converged or fitted.reduced_chi_square > diagnosis.settings.at_noise * diagnosis.noise:
        return ()
    text = law_text(law, fitted)
    return (f"a single law beside the catalogue describes the data too ({fitted.reduced_chi_square:.4g}): {text}",)


def run_diagnose(
    path: str | Path,
    output: str | Path | None = None,
    *,
    model: str = PAPER,
    overwrite: bool = False,
    settle: bool = False,
    figures: bool = False,
) -> DiagnoseOutcome:
    """Diagnose a trajectory file; write diagnosis.json, diagnosis.html with figures, model.toml, and the file's group.

    output : folder; without it `<name>_diagnosis` beside the file
    settle : also compute which further recordings would settle what is left open
    figures : also write every figure of the page as PNG and PDF
    Raises TrajectoryFileError, AnalysisError, SceneError, ModelError, OutputError.
    """
    from disctrack.diagnosis.free_runs import evidence
    from disctrack.diagnosis.pages.report import write_report  # matplotlib is wanted here only

    path = trajectory_in(Path(path))
    keep(path)
    keep(Path(model))
    folder = Path(output) if output is not None else path.parent / f"{path.stem}_diagnosis"
    report = folder / "diagnosis.json"
    refuse_other(report, overwrite)
    for name in (report.name, "model.toml"):
        refuse_input(folder / name)
    provenance = read_provenance(path)
    trajectory = with_declared_dots(read_trajectory(path), read_findings(path))
    try:
        result = diagnose(trajectory, model)
    except AnalysisError as error:
        raise AnalysisError(f"{path}: {error}") from error
    result = with_plan(result) if settle else result
    beside = evidence(result) if result.before is not None else None
    document = {"recording": provenance.recording, **as_json(result, beside)}
    write_diagnosis(path, result, beside, document)
    write_whole(report, json_file(document))
    toml = folder / "model.toml"
    text = model_toml(result.system, result.after_fit.values, provenance.recording)
    write_whole(toml, text.encode())
    pages = write_report(folder, result, beside, provenance.recording, figures)
    said = lines(result, beside)
    return DiagnoseOutcome(result, (report, toml, *pages), tuple(said))
