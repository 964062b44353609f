"""A diagnosis as a report, as JSON, and as a group of the trajectory file."""

from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from calibration.kit.types import Array
from disctrack.diagnosis.answer import DiscDiagnosis, Learned
from disctrack.diagnosis.errors import Ahead, Errors
from disctrack.diagnosis.law_library import locked
from disctrack.diagnosis.model_file import NONE, PAPER
from disctrack.diagnosis.plan import ENOUGH, Plan
from disctrack.diagnosis.supplement import HORIZONS, Supplement
from disctrack.discrepancy.document import document, effect_json, effect_text, explanations, significance_text, tried
from disctrack.discrepancy.fit import Fit
from disctrack.discrepancy.significance import TWO_SIDED
from disctrack.files.json_text import json_text, plain
from disctrack.files.labelled_arrays import Variable
from disctrack.findings import Kind, Severity, carried, of_kind
from disctrack.frames import COORDINATES, POSE_COMPONENTS
from disctrack.numbers import Measured, in_unit, measured, probability, rounded, score
from disctrack.report.blocks import Cell, Drawn, Figures, Listing, Report, Section
from disctrack.trajectory import among
from disctrack.trajectory.file import write_group

GROUP = "diagnosis"
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
    result: DiscDiagnosis, more: Supplement | None, recording: str, drawn: Sequence[Drawn], files: Sequence[Path]
) -> Report:
    """The whole report.   files : that were written, page first"""
    d, measurement = result.diagnosis, result.system.trajectory
    effects, laws = [f"{effect_text(f, d)}. {significance_text(f)}." for f in d.found], list[Listing]()
    if (learned := result.learned) is not None:
        power, gain = Measured(learned.power, unit="W"), score(learned.gain)
        effects.append(f"{learned.text(d.after)}; mean power {power}; chi-square falls by {gain}.")
        rows: list[tuple[str, Cell]] = [*learned.law.formulas.items(), *learned.numbers(d.after)]  # as in model.toml
        laws.append(Listing(("", "law (SI; ± 1 σ)"), rows, folded="Formulas and numbers of the law"))
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
        [*carried(measurement.findings), *of_kind(Kind.DIAGNOSIS, Severity.NOTE, notes)],
        blocks=[
            f"Verdict: {d.verdict}, because {d.reason}. Model: {MODELS.get(result.model, result.model)}.",
            Section("Missing effects", [effects, *laws]),
            planned_section(result.plan),
            explanations(d),
            Section("Before and after" if result.has_more else "The model", _before_after(result, more)),
            Section("In pictures", [Figures(drawn)]),
            tried(d),
        ],
        files=files,
    )


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


def _errors(errors: Errors | None, ahead: list[Ahead]) -> dict[str, Any]:
    if errors is None:
        return {}
    found = asdict(errors)
    tests, ratio = found.pop("whiteness"), found.pop("ratio_to_floor")
    p_value = tests.pop("p_value")
    by_component = {name: dict(zip(POSE_COMPONENTS, plain(values), strict=True)) for name, values in tests.items()}
    return found | {
        "held_out": {"ratio_to_noise_floor": ratio, "free_run": ahead},
        "whiteness": {"p_value": p_value, **by_component},
    }


def _learned(learned: Learned, fit: Fit) -> dict[str, Any]:
    law, course = learned.law, {}
    if (known := learned.course) is not None:
        course = {"time_s": known.time, "N_m": known.values, "sigma_N_m": known.sigma, "misfit_of_form": learned.misfit}
    return effect_json(learned, fit) | {
        "kind": "learned",
        "formulas": law.formulas,
        "meaning": law.title,
        "alike": list(law.alike),
        "phase_locked": locked(law),
        "mean_power_W": learned.power,
        "moment_about_contact": course,
    }


def as_json(result: DiscDiagnosis, more: Supplement | None = None) -> dict[str, Any]:
    """All of a diagnosis in JSON's types; the keys are those of diagnosis.json."""
    d, frame, rows = result.diagnosis, result.system.trajectory.frame, result.system.rows
    ahead = ([run[side] for run in more.ahead] if more else [] for side in range(2))
    before, after = (_errors(e, runs) for e, runs in zip((result.before, result.after), ahead, strict=True))
    found = document(d, result.model, result.sentence, before, after, with_known=False)
    found["effects"] += [_learned(result.learned, d.after)] if result.learned else []
    found |= {
        "notes": list(result.notes),
        "frames": [int(frame[rows.start]), int(frame[rows.stop - 1])],
        "chance": vars(d.chance) if d.chance else {},
        "holds": result.holds,
        "energy_J": result.energy,
        "energy_before_J": more.energy_before if more else {},
        "plan": plan_json(result.plan),
    }
    return dict(plain(found))


def plan_json(plan: Plan | None) -> dict[str, Any] | None:
    """Further recordings that would answer the open questions."""
    if plan is None:
        return None
    return {
        "questions": [
            {"effect": effect.name, "alternative": other[0].name if other else None, "now": x}
            for (effect, *other), x in zip(plan.questions, plan.now, strict=True)
        ],
        "recordings": [
            {**vars(r.proposal), "text": r.proposal.text, "lasts_s": r.duration, "answers": list(r.answers)}
            for r in plan.rows
        ],
        "meaning": "answers: sigmas between effect and alternative; without one the standard deviation of the size",
    }


def write_diagnosis(path: Path, result: DiscDiagnosis, more: Supplement | None, document: dict[str, Any]) -> None:
    """Add the group `diagnosis` to the trajectory file: residuals before and after, and the answer as JSON."""
    system, n = result.system, len(result.system.trajectory)
    variables, coordinates = dict[str, Variable](), np.array(COORDINATES)
    axes = {"coordinate": Variable(coordinates, ("coordinate",), "1", "coordinate")}
    axes["contact_axis"] = Variable(np.array(["n0", "m0", "k"]), ("contact_axis",), "1", "axis of the contact frame")
    for name, fit in (("before", result.diagnosis.before), ("after", result.diagnosis.after)):
        residual, predicted = np.full((2, n, 6), np.nan)
        if result.before is not None:
            full = (system.weights >= 6)[:, None]
            residual[system.rows] = np.where(full, system.pose_residual(fit.values), np.nan)
            predicted[system.rows] = system.poses(fit.values)
        what = f"whitened pose residual {name} the missing effects were added; variance 1 if only noise is left"
        variables[f"residual_{name}"] = Variable(residual, ("time", "pose_component"), "1", what)
        what = f"x, y, z, psi, theta, phi of the model {name}"
        variables[f"q_{name}"] = Variable(predicted, ("time", "coordinate"), "m and rad", what)
    if more is not None and more.force is not None:
        force, sigma = (among(n, system.rows.start, part) for part in (more.force.values, more.force.sigma))
        what = "mass times measured acceleration, minus the force of the model before"
        variables |= _with_sigma("missing_force", force, sigma, "time", "N", what)
    if more is not None and (missing := more.moment) is not None:
        axes["probe_time"] = Variable(missing.time, ("probe_time",), "s", "middle of a probe of the moment")
        what = "contact moment that the model before fails to supply"
        variables |= _with_sigma("missing_moment", missing.values, missing.sigma, "probe_time", "N m", what)
    effects = {effect["name"]: effect for effect in document["effects"]}
    attributes = {**document, "effects": effects, "diagnosis": json_text(document)}
    write_group(path, GROUP, variables, axes=axes, attributes=attributes)


def _with_sigma(name: str, values: Array, sigma: Array, over: str, unit: str, what: str) -> dict[str, Variable]:
    dims = (over, "contact_axis")
    of_sigma = Variable(sigma, dims, unit, f"standard deviation: {what}")
    return {name: Variable(values, dims, unit, what), f"{name}_sigma": of_sigma}
