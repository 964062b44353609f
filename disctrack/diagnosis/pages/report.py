"""The report of a diagnosis."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from disctrack.diagnosis.answer import DiscDiagnosis
from disctrack.diagnosis.errors import HORIZONS, Ahead, Errors
from disctrack.diagnosis.free_runs import ModelFreeEvidence
from disctrack.diagnosis.model_file import NONE, PAPER
from disctrack.diagnosis.pages import planned
from disctrack.diagnosis.pages.words import accuracy_text, law_text, remarks, verdict_text
from disctrack.discrepancy.document import explanations_table, tried_table
from disctrack.discrepancy.search import Found
from disctrack.discrepancy.words import effect_text, significance_text
from disctrack.report.blocks import Cell, Figures, Items, Listing, Report, Said, Says, Section, Text
from disctrack.report.numbers import Measured, probability, rounded, score

if TYPE_CHECKING:
    from disctrack.report.figures import Drawn

MODELS = {PAPER: "rolling with the losses of Ma et al. 2014 (paper)", NONE: "rolling without losses (none)"}
WORDS = (
    "Reduced chi-square: mean square of the residuals over that of the noise, 1 where only noise is left. rms: "
    "root mean square, over dots and both image axes, or over the three axes of the position. Ljung-Box: small where "
    "residuals of neighbouring frames are alike, as those of white noise are not. Free run: the model, fitted to the "
    "first part of the recording, continues alone over the rest, the held-out data; its noise floor is the error that "
    "it would have if it lacked nothing."
)


def report_of(
    result: DiscDiagnosis,
    beside: ModelFreeEvidence | None,
    recording: str,
    *,
    findings: Sequence[Says] = (),
    drawn: "Sequence[Drawn]" = (),
    files: Sequence[Path] = (),
) -> Report:
    """All of a diagnosis. findings : of the measurement that was diagnosed;  files : that were written"""
    d = result.diagnosis
    by_chance = [] if d.chance is None else [
        f"Probability that noise alone produces this improvement: p {probability(d.chance.p_value)} "
        f"({d.chance.tests:.0f} independent candidates)."
    ]  # fmt: skip
    return Report(
        f"{recording}: what does the model lack?",
        verdict_text(result),
        accuracy_text(result),
        [*findings, *map(Said, remarks(result)), *(Said(f"{note[:1].upper()}{note[1:]}.") for note in result.notes)],
        blocks=[
            Text(f"Verdict: {d.verdict}, because {d.reason}. Model: {MODELS.get(result.model, result.model)}."),
            Section("Missing effects", [Items([*_effects(result), *by_chance])]),
            planned.section(result.plan),
            Section("Explanations that compete", [explanations_table(d)]),
            Section("Before and after" if result.has_more else "The model", _before_after(result, beside)),
            Section("In pictures", [Figures(drawn)]),
            Section("What was tried", [tried_table(d)]),
        ],
        files=files,
        page=next((file for file in files if file.suffix == ".html"), None),
    )


def _effects(result: DiscDiagnosis) -> list[str]:
    d = result.diagnosis
    items = [f"{effect_text(f, d)}. {significance_text(f)}. {_alternatives(f)}".rstrip() for f in d.found]
    if result.learned is not None:
        learned = result.learned
        items.append(
            f"{law_text(learned.law, learned.fit)}; mean power {Measured(learned.power, unit='W')}; "
            f"chi-square falls by {score(learned.gain)}."
        )
    return items


def _alternatives(found: Found) -> str:
    """Angles to the indistinguishable alternatives."""
    return " ".join(
        f"Its predicted residual and that of {r.candidate.name} differ by an angle of {np.degrees(r.angle):.2g} deg."
        for r in found.cannot_be_told_from
    )


def _before_after(result: DiscDiagnosis, beside: ModelFreeEvidence | None) -> list[Listing | Text]:
    before, after = result.before, result.after
    if before is None or after is None or beside is None:
        return []
    both = (before, after)
    rows: list[tuple[str, Cell, Cell]] = [
        ("reduced chi-square of the dots", *_pair(rounded(e.reduced_chi_square, 4) for e in both)),
        ("reduced chi-square of the poses", *_pair(rounded(e.reduced_chi_square_pose, 4) for e in both)),
        ("rms of the dots [px]", *_pair(rounded(e.rms_px) for e in both)),
        ("rms of the position [µm]", *_pair(rounded(e.rms_position_um) for e in both)),
        ("rms of the nutation angle [mdeg]", *_pair(rounded(e.rms_theta_mdeg) for e in both)),
        ("Ljung-Box: autocorrelation", *_pair(f"p {probability(e.whiteness.p_value)}" for e in both)),
        ("highest line of the spectrum", *_pair(map(_line, both))),
        ("free run over its noise floor", *_pair(rounded(e.ratio_to_floor, 4) for e in both)),
        *(row for b, a in (*zip(before.ahead, after.ahead, strict=True), *beside.ahead) for row in _ahead(b, a)),
        *_laws(result),
        *_energy(result, beside),
    ]
    reached = {a.horizon_s for a in after.ahead} | {a.horizon_s for _, a in beside.ahead}
    short = [f"{h:g}" for h in HORIZONS if h not in reached]
    remark = f"The recording is too short for free runs of {' and '.join(short)} s." if short else ""
    one = [(name, value) for name, value, _ in rows if not name.startswith("change of ")]
    made = Listing(("", "before", "after"), rows) if result.has_more else Listing(("", "model"), one)
    return [made, Text(WORDS), Text(remark)]


def _pair(made: Iterable[str]) -> tuple[str, str]:
    before, after = made
    return before, after


def _line(errors: Errors) -> str:
    """The strongest line of the pose residual: where, near what, and whether noise has as strong ones."""
    w = errors.whiteness
    i = int(np.argmin(w.peak_p_value))
    near = f" ({w.peak_near[i]})" if w.peak_near[i] else ""
    return f"{w.peak_frequency[i]:.4g} Hz{near}, p {probability(min(1.0, w.peak_p_value[i] * len(w.peak_p_value)))}"


def _ahead(b: Ahead, a: Ahead) -> list[tuple[str, Cell, Cell]]:
    quantities = (("nutation [deg]", "theta_deg"), ("precession [deg]", "psi_deg"), ("position [mm]", "position_mm"))
    return [
        (
            f"free run {b.horizon_s:g} s ahead: {what}, noise {rounded(getattr(b, f'noise_{name}'), 2)}",
            *_pair(rounded(getattr(x, name)) for x in (b, a)),
        )
        for what, name in quantities
    ]


def _laws(result: DiscDiagnosis) -> list[tuple[str, Cell, Cell]]:
    """Parameters that the model had already, before and after (1 sigma)."""
    first, last = result.diagnosis.before, result.after_fit
    rows: list[tuple[str, Cell, Cell]] = []
    for q in first.quantities:
        if q.name in result.system.model.values:
            start, end = (Measured(f.values[q.name], f.sigma(q.name), q.unit) for f in (first, last))
            rows.append((f"{q.name} (± 1 σ)", start, end))
            rows.append((f"change of {q.name}", "", Measured(end.value - start.value, unit=q.unit)))
    return rows


def _energy(result: DiscDiagnosis, beside: ModelFreeEvidence) -> list[tuple[str, Cell, Cell]]:
    """Energy balance of both models, and the loss that the poses alone show."""
    sides = beside.energy_before, result.energy
    rows: list[tuple[str, Cell, Cell]] = [
        (f"energy {name} [mJ]", *_pair("" if name not in side else rounded(1e3 * side[name], 5) for side in sides))
        for name in {**beside.energy_before, **result.energy}
    ]
    if beside.measured is not None:
        lost = Measured(beside.measured.energy_lost, beside.measured.energy_lost_sigma, "J")
        rows.append(("energy lost, from the poses alone (± 1 σ)", lost, ""))
    return rows
