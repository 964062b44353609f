"""The report of a diagnosis."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from disctrack.diagnosis.answer import DiscDiagnosis
from disctrack.diagnosis.errors import Errors
from disctrack.diagnosis.model_file import NONE, PAPER
from disctrack.diagnosis.plan import ENOUGH, Plan
from disctrack.diagnosis.supplement import HORIZONS, Supplement
from disctrack.discrepancy.document import effect_text, explanations_table, significance_text, tried_table
from disctrack.discrepancy.significance import TWO_SIDED
from disctrack.findings import Finding, Kind, Severity, of_kind
from disctrack.numbers import Measured, in_unit, measured, probability, rounded, score
from disctrack.report.blocks import Cell, Drawn, Figures, Listing, Report, Section

MODELS = {PAPER: "rolling with the losses of Ma et al. 2014 (paper)", NONE: "rolling without losses (none)"}
WORDS = (
    "Reduced chi-square: mean square of the residuals over that of the noise, 1 if they are noise. rms: "
    "root mean square, over dots and both image axes, or over the three axes of the position. Ljung-Box: p-value of "
    "the autocorrelation of the residuals, small if they are not white noise. Free run: the model, fitted to the "
    "first part of the recording, predicts the rest, the held-out data; its noise floor is the error of a complete "
    "model."
)
PLANNED = (
    "Computed from the fitted model: each recording is simulated with the same cameras and noise, and its Fisher "
    "information is added to the present one. Laws, cameras and dots are shared, each recording has its own initial "
    "state. Another disc has its own k_m, the laws in question keep their coefficients; air drag scales with the "
    "density. More dots and a third view count as further data with the same noise."
)
Row = tuple[str, Cell, Cell]


def report_of(
    result: DiscDiagnosis,
    more: Supplement | None,
    recording: str,
    drawn: Sequence[Drawn],
    findings: Sequence[Finding],
    files: Sequence[Path],
) -> Report:
    """The whole report.   findings : on the measurement that was diagnosed;  files : that were written, page first"""
    d = result.diagnosis
    effects = [f"{effect_text(f, d)}. {significance_text(f)}." for f in d.found]
    if (learned := result.learned) is not None:
        power, gain = Measured(learned.power, unit="W"), score(learned.gain)
        effects.append(f"{learned.text(d.after)}; mean power {power}; chi-square falls by {gain}.")
    if d.chance is not None:
        effects.append(
            f"Probability that noise alone produces this improvement: p {probability(d.chance.p_value)} "
            f"({d.chance.tests:.0f} independent candidates)."
        )
    notes = [*result.remarks, *(f"{note[:1].upper()}{note[1:]}." for note in result.notes)]
    return Report(
        f"{recording}: what does the model lack?",
        result.verdict_text,
        result.accuracy_text,
        [*findings, *of_kind(Kind.DIAGNOSIS, Severity.NOTE, notes)],
        blocks=[
            f"Verdict: {d.verdict}, because {d.reason}. Model: {MODELS.get(result.model, result.model)}.",
            Section("Missing effects", [effects, *_learned_law(result)]),
            planned_section(result.plan),
            Section("Explanations that compete", [explanations_table(d)]),
            Section("Before and after" if result.has_more else "The model", _before_after(result, more)),
            Section("In pictures", [Figures(drawn)]),
            Section("What was tried", [tried_table(d)]),
        ],
        files=files,
        page=files[0],
    )


def _learned_law(result: DiscDiagnosis) -> list[Listing]:
    """Formulas and numbers of the law that was learned, as in model.toml."""
    if (learned := result.learned) is None:
        return []
    rows: list[tuple[str, Cell]] = [*learned.law.formulas.items(), *learned.numbers(result.diagnosis.after)]
    return [Listing(("", "law (SI; ± 1 σ)"), rows, folded="Formulas and numbers of the law")]


def _before_after(result: DiscDiagnosis, more: Supplement | None) -> list[Listing | str]:
    before, after = result.before, result.after
    if before is None or after is None or more is None:
        return []
    shown: dict[str, Callable[[Errors], str]] = {
        "reduced chi-square of the dots": lambda e: rounded(e.reduced_chi_square, 4),
        "reduced chi-square of the poses": lambda e: rounded(e.reduced_chi_square_pose, 4),
        "rms of the dots [px]": lambda e: rounded(e.rms_px),
        "rms of the position [µm]": lambda e: rounded(e.rms_position_um),
        "rms of the nutation angle [mdeg]": lambda e: rounded(e.rms_theta_mdeg),
        "Ljung-Box: autocorrelation": lambda e: f"p {probability(e.whiteness.p_value)}",
        "highest line of the spectrum": _line,
        "free run over its noise floor": lambda e: rounded(e.ratio_to_floor, 4),
    }
    rows: list[Row] = [(name, of(before), of(after)) for name, of in shown.items()]
    words = {"theta_deg": "nutation [deg]", "psi_deg": "precession [deg]", "position_mm": "position [mm]"}
    for first, last in more.ahead:
        for key, what in words.items():
            noise = rounded(first[f"noise_{key}"], 2)
            name = f"free run {first['horizon_s']:g} s ahead: {what}, noise {noise}"
            rows.append((name, rounded(first[key]), rounded(last[key])))
    rows += [*_laws(result), *_energy(result, more)]
    reached = [runs[0]["horizon_s"] for runs in more.ahead]
    short = [f"{h:g}" for h in HORIZONS if h not in reached]
    remark = f"The recording is too short for free runs of {' and '.join(short)} s." if short else ""
    one = [(name, value) for name, value, _ in rows if not name.startswith("change of ")]
    table = Listing(("", "before", "after"), rows) if result.has_more else Listing(("", "model"), one)
    return [table, WORDS, remark]


def _line(errors: Errors) -> str:
    """The most significant line in the spectrum of the pose residual: frequency, known frequency near it, p-value."""
    w = errors.whiteness
    i = int(np.argmin(w.peak_p_value))
    near = f" ({w.peak_near[i]})" if w.peak_near[i] else ""
    return f"{w.peak_frequency_hz[i]:.4g} Hz{near}, p {probability(min(1.0, w.peak_p_value[i] * len(w.peak_p_value)))}"


def _laws(result: DiscDiagnosis) -> list[Row]:
    """Parameters that the model had already, before and after (1 sigma)."""
    first, last = result.diagnosis.before, result.diagnosis.after
    rows: list[Row] = []
    for q in first.quantities:
        if q.name in result.system.model.values:
            start, end = (Measured(f.values[q.name], f.sigma(q.name), q.unit) for f in (first, last))
            rows.append((f"{q.name} (± 1 σ)", start, end))
            rows.append((f"change of {q.name}", "", Measured(end.value - start.value, unit=q.unit)))
    return rows


def _energy(result: DiscDiagnosis, more: Supplement) -> list[Row]:
    """Energy balance of both models, and the loss computed from the poses without a model."""
    before, after = ({k: rounded(1e3 * v, 5) for k, v in side.items()} for side in (more.energy_before, result.energy))
    rows: list[Row] = [(f"energy {k} [mJ]", before.get(k, ""), after.get(k, "")) for k in {**before, **after}]
    if more.energy_lost is not None:
        rows.append(("energy lost, from the poses alone (± 1 σ)", more.energy_lost, ""))
    return rows


def planned_section(plan: Plan | None) -> Section:
    """The open questions, the most informative recording for each, and all others."""
    title = "Recordings that would settle what is open"
    if plan is None or not plan.questions:
        return Section(title, ())
    best = [plan.best(i) for i in range(len(plan.questions))]
    header, answers = ["one more recording", "lasts [s]"], []
    for question, now, proposed in zip(plan.questions, plan.now, best, strict=True):
        effect, unit = question[0].name, question[0].quantities[0].unit
        between = " or ".join(c.name for c in question) if len(question) > 1 else ""
        header.append(f"{between} [sigmas]" if between else in_unit(f"σ of {effect}", unit))
        if proposed is None:
            answers.append(f"For {between or f'the size of {effect}'} no recording that was tried can be made.")
            continue
        i, text = len(answers), proposed.proposal.text
        if not between:
            limit, at_present = _limit(proposed.answers[i], unit), _limit(now, unit)
            answers.append(f"The size of {effect} is known to {at_present} (95 %), and would be to {limit}: {text}.")
        elif proposed.answers[i] < ENOUGH:
            answers.append(f"No recording that was tried separates {between.replace(' or ', ' from ')}.")
        else:
            sigmas = rounded(proposed.answers[i])
            answers.append(f"To separate {between.replace(' or ', ' from ')}: {text} ({sigmas} sigmas).")
    different = {r.answers: r for r in reversed(plan.rows)}.values()  # longer films than the motion add nothing
    rows = [(r in best, (r.proposal.text, rounded(r.duration, 2), *map(_cell, r.answers))) for r in different]
    shown = [("none: what there is", "", *map(_cell, plan.now)), *(cells for is_best, cells in rows if is_best)]
    others = [cells for is_best, cells in rows[::-1] if not is_best]
    tables = Listing(header, shown), Listing(header, others, folded="All other recordings")
    return Section(title, [answers, PLANNED, *tables])


def _cell(value: float) -> str:
    return rounded(value, 2) if np.isfinite(value) else "not seen"


def _limit(sigma: float, unit: str) -> str:
    return measured(TWO_SIDED * sigma, unit=unit) if np.isfinite(sigma) else "nothing"
