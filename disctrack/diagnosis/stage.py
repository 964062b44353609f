"""The stage: trajectory file in; diagnosis.json, enlarged model and the group `diagnosis` out."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calibration.kit.brief import Brief
from calibration.kit.threads import one_blas_thread
from calibration.kit.types import checked
from disctrack.diagnosis.answer import DiscDiagnosis, Learned
from disctrack.diagnosis.disc_system import DiscSystem
from disctrack.diagnosis.errors import ResidualTests, energy_balance, errors, ranges_text, residual_tests, valid_ranges
from disctrack.diagnosis.form_misfit import with_form
from disctrack.diagnosis.laws import WithLaw, explained_by_law, judged_as
from disctrack.diagnosis.missing_force import missing_text
from disctrack.diagnosis.model_file import PAPER, declared_model, model_toml
from disctrack.diagnosis.motion_search import diagnose_motion, with_slip
from disctrack.diagnosis.pages.output import as_json, report_of, write_diagnosis
from disctrack.diagnosis.plan import open_questions, plan, planner_alone
from disctrack.diagnosis.recorded import read_recorded
from disctrack.diagnosis.supplement import supplement
from disctrack.discrepancy.fit import Fit
from disctrack.discrepancy.held_out import held_out, training_rows
from disctrack.discrepancy.noise import with_autocorrelation
from disctrack.discrepancy.score import Linearisation, score_all
from disctrack.discrepancy.search import Diagnosis, Found, Settings
from disctrack.discrepancy.significance import wald
from disctrack.discrepancy.system import USED_UP
from disctrack.errors import AnalysisError, told_as
from disctrack.files.json_text import json_file
from disctrack.files.whole import keep, refuse_existing, refuse_input, write_whole
from disctrack.report.blocks import Report
from disctrack.report.html import write_page
from disctrack.trajectory import Trajectory
from disctrack.trajectory.file import trajectory_in
from disctrack.trajectory.reuse import content_of, origin_of, remember


@dataclass(frozen=True, repr=False)
class DiagnoseOutcome(Brief):
    """What `run_diagnose` did."""

    result: DiscDiagnosis
    files: tuple[Path, ...]
    summary: Report

    def facts(self) -> dict[str, str]:
        """What a glance should tell (`Brief`)."""
        return {**self.result.facts(), "files": ", ".join(file.name for file in self.files)}


@one_blas_thread
@checked
def diagnose(trajectory: Trajectory, model: str = PAPER, settings: Settings | None = None) -> DiscDiagnosis:
    """Which effect is missing from the model? Fit, search, refit, test.

    model : "paper", "none", or a TOML file (`model_file.declared_model`)
    Raises AnalysisError, SceneError, ModelError.

        >>> diagnose("clip").sentence.partition(".")[0]
        'Nothing is missing'
    """
    declared, faults = declared_model(trajectory, model)
    system, diagnosis, rolling = diagnose_motion(trajectory, declared, faults, settings)
    if diagnosis.held_out_before is None or diagnosis.held_out_after is None:
        return DiscDiagnosis(system, diagnosis, str(model), notes=diagnosis.remarks)
    tests = residual_tests(system, diagnosis.after, diagnosis.noise)
    diagnosis = _verdict_by_residuals(diagnosis, tests)
    found, diagnosis = explained_by_law(system, diagnosis, tests)
    holds, learned, notes = {}, None, diagnosis.remarks
    if diagnosis.verdict == "unexplained":
        holds = valid_ranges(system, judged_as(diagnosis, system), diagnosis.before, diagnosis.noise)
        notes = (*notes, ranges_text(holds), "" if found else missing_text(system, diagnosis.after))
    if found is not None:
        system, learned, diagnosis, not_claimed = _with_law(system, diagnosis, found)
        tests, notes = residual_tests(system, diagnosis.after, diagnosis.noise), (*notes, *not_claimed)
    else:
        diagnosis = replace(diagnosis, after=with_autocorrelation(judged_as(diagnosis, system), diagnosis.after))
    notes = (*notes, "" if system.budget.open() else USED_UP)
    diagnosis = with_slip(system, diagnosis, rolling)
    before = errors(system, diagnosis.before, diagnosis.held_out_before)
    after = errors(system, diagnosis.after, diagnosis.held_out_after)
    energy, texts = energy_balance(system, diagnosis.after.values), tuple(note for note in notes if note)
    return DiscDiagnosis(system, diagnosis, str(model), before, after, energy, learned, texts, holds, tests)


def with_plan(result: DiscDiagnosis) -> DiscDiagnosis:
    """The diagnosis with further recordings that would answer its open questions; unchanged if it has no answer."""
    diagnosis = result.diagnosis
    if result.after is None or not diagnosis.after.converged:
        return result
    candidates = [c for c in result.system.candidates if c.kind == "motion" and not (c.threshold or c.sought)]
    scores = score_all(Linearisation(result.system, diagnosis.after, candidates), candidates)
    questions = open_questions(diagnosis, scores)
    planner = planner_alone(result.system, diagnosis.after, questions, diagnosis.noise)
    return replace(result, plan=plan(planner, questions, result.system, diagnosis.after.values))


def _verdict_by_residuals(diagnosis: Diagnosis, tests: ResidualTests) -> Diagnosis:
    """The verdict, corrected by whether the residuals are those of the motion or of the measurement.

    Residuals may be autocorrelated although chi-square is small, and chi-square may be large by errors of the dots.
    """
    if not diagnosis.after.converged:
        return diagnosis
    verdict, but = diagnosis.verdict, ""
    if verdict != "unexplained" and tests.of_the_motion:
        verdict = "unexplained"
        but = (
            f"are not noise (p = {tests.pose_p_value:.1g} over {tests.n_tests} tests), while those that no pose can "
            "absorb are"
        )
    elif verdict == "unexplained" and tests.of_the_measurement:
        verdict = "found" if diagnosis.found else "nothing missing"
        but = (
            f"({tests.pose_chi_square:.3g} of the noise) are no more than errors of the measurement leave in those "
            f"that no pose can absorb ({tests.other_chi_square:.3g})"
        )
    reason = f"{diagnosis.reason}; but the residuals of the poses {but}" if but else diagnosis.reason
    return replace(diagnosis, verdict=verdict, reason=reason)


def _with_law(
    system: DiscSystem, diagnosis: Diagnosis, found: WithLaw
) -> tuple[DiscSystem, Learned, Diagnosis, tuple[str, ...]]:
    """The system extended by the law, the law with its time course, the diagnosis with it, and remarks."""
    law, fitted, kept, noise = found.law, found.fit, found.kept, diagnosis.noise
    known = system.knowing(law)
    judged = judged_as(diagnosis, known)
    held = held_out(judged, fitted.quantities, fitted.values, training_rows(known))
    assert diagnosis.held_out_before is not None
    held_gain = held.gain_over(diagnosis.held_out_before, noise)
    work = energy_balance(known, fitted.values)[f"by {law.candidate.name}"]
    power = -work / float(known.time[-1] - known.time[0])
    white = residual_tests(known, fitted, noise).white
    as_found = known, with_autocorrelation(judged, fitted), law, noise, not white
    after, of_another, course, misfit = with_form(*as_found, _of_motion(kept))
    established, not_claimed = _for_any_form(kept, of_another, law.looked)
    if _of_motion(established):  # an effect that is significant with any form of the law is no part of its misfit
        after, _, course, misfit = with_form(*as_found, _of_motion(f for f in kept if f not in established))
    gain = (diagnosis.before.cost - fitted.cost) / noise
    learned = Learned(law.candidate, gain, held_gain, np.nan, (), law, power, course, misfit)
    reason = f"{diagnosis.reason}; the law that was learned leaves {fitted.reduced_chi_square:.3g}"
    diagnosis = replace(
        diagnosis, verdict="unexplained", found=established, after=after, held_out_after=held, reason=reason
    )
    return known, learned, diagnosis, not_claimed


def _for_any_form(kept: Sequence[Found], fitted: Fit, looked: float) -> tuple[tuple[Found, ...], tuple[str, ...]]:
    """Effects that are significant even if the law has another form; and a note on each of the others.

    The others stay in the fit: together with the law they describe the data.
    kept : effects fitted with the law
    fitted : with standard deviations that hold if the law has another form than the one selected from the library
    looked : chi-square by which the selection of a law is corrected for multiple comparisons; an effect whose place or
        frequency was searched for is corrected likewise
    """
    established, notes = list[Found](), list[str]()
    for found in kept:
        candidate = found.candidate
        shape = {q.name for q in candidate.shape}  # an exponent or a frequency has no null hypothesis of zero
        gain = wald(*fitted.amounts([name for name in candidate.names if name not in shape]))
        if gain > found.threshold + looked * candidate.sought:
            established.append(found)
            continue
        notes.append(
            f"{candidate.title} [{candidate.name}] is fitted with the law but not claimed: if the law has another form "
            f"its significance is {np.sqrt(gain):.2g} sigma"
        )
    return tuple(established), tuple(notes)


def _of_motion(found: Iterable[Found]) -> set[str]:
    return {f.candidate.effect for f in found if f.candidate.kind == "motion"}


@checked
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

    output : folder; by default `<name>_diagnosis` next to the file
    settle : also compute which further recordings would answer the open questions
    figures : also write every figure of the page as PNG and PDF
    Raises TrajectoryFileError, AnalysisError, SceneError, ModelError, OutputError.

        >>> outcome = run_diagnose("clip/results/trajectory.h5", overwrite=True)
        >>> sorted(file.name for file in outcome.files)[:2]
        ['diagnosis.html', 'diagnosis.json']
    """
    from disctrack.diagnosis.pages.figures import all_figures  # needs matplotlib

    path = trajectory_in(Path(path))
    keep(path)
    keep(Path(model))
    folder = Path(output) if output is not None else path.parent / f"{path.stem}_diagnosis"
    report, page, toml = (folder / name for name in ("diagnosis.json", "diagnosis.html", "model.toml"))
    refuse_existing(report, overwrite)
    refuse_input(toml)
    recorded, origin = read_recorded(path), origin_of(path, {"model": content_of(model), "plan": settle})
    with told_as(AnalysisError, str(path), AnalysisError):
        result = diagnose(recorded.trajectory, model)
    result = with_plan(result) if settle else result
    more = supplement(result) if result.before is not None else None
    document = {"recording": recorded.name, **as_json(result, more)}
    write_diagnosis(path, result, more, document)
    write_whole(report, json_file(document))
    write_whole(toml, model_toml(result.system, result.diagnosis.after.values, recorded.name).encode())
    whole = report_of(result, more, recorded.name, all_figures(result, more), (page, report, toml, path))
    files = write_page(page, whole, ("png", "pdf") if figures else ())
    then = f"disctrack diagnose {path} --model {toml} -o {folder}_enlarged" if result.has_more else ""
    outcome = DiagnoseOutcome(result, (report, toml, page, *files), replace(whole, data=document, then=then))
    remember(folder, origin, outcome.summary, outcome.files)
    return outcome
