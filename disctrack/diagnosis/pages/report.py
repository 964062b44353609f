"""The report of a diagnosis: one HTML page that needs nothing else, and its figures."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from disctrack.diagnosis.answer import DiscDiagnosis
from disctrack.diagnosis.errors import HORIZONS, Ahead, Errors
from disctrack.diagnosis.free_runs import ModelFreeEvidence
from disctrack.diagnosis.model_file import NONE, PAPER
from disctrack.diagnosis.pages import planned
from disctrack.diagnosis.pages.figures import all_figures
from disctrack.diagnosis.pages.words import UNFOLLOWED, law_text
from disctrack.discrepancy.search import Diagnosis, Found, Tried
from disctrack.discrepancy.significance import as_sigmas
from disctrack.discrepancy.words import effect_text, quantity_text
from disctrack.files.whole import write_whole
from disctrack.report.figures import draw
from disctrack.report.parts import Markup, bullets, gallery, page, paragraph, section, table, text


def write_report(
    folder: Path, result: DiscDiagnosis, beside: ModelFreeEvidence | None, recording: str, as_files: bool = False
) -> tuple[Path, ...]:
    """Write diagnosis.html, and on request figures/*.png, *.pdf; returns the files. Raises OutputError."""
    figures = all_figures(result, beside)
    files, pictures = draw(folder, figures, ("png", "pdf") if as_files else ())
    written = folder / "diagnosis.html"
    write_whole(written, _page(result, beside, recording, gallery(figures, pictures)).encode())
    return (written, *files)


def _page(result: DiscDiagnosis, beside: ModelFreeEvidence | None, recording: str, figures: str) -> str:
    verdict = (
        f"Verdict: <b>{text(result.diagnosis.verdict)}</b>. Model: {text(MODELS.get(result.model, result.model))}. "
    )
    parts = [
        paragraph(result.sentence, "lead"),
        paragraph(Markup(verdict + text(_said(result.diagnosis.reason)))),
        *(paragraph(_said(note)) for note in result.notes),
        section("Missing effects", [_effects(result)]),
        section("What would settle it", planned.html(result.plan)),
        section("Explanations that compete", [explanations_table(result.diagnosis)]),
        section("Before and after", _before_after(result, beside)),
        section("In pictures", [figures]),
        section("What was tried", [tried_table(result.diagnosis.tried)]),
    ]
    return page(f"{recording}: what does the model lack?", parts)


MODELS = {PAPER: "rolling with the losses of Ma et al. 2014 (paper)", NONE: "rolling without losses (none)"}
WORDS = (
    "Reduced chi-square: mean square of what is left over that of the noise, 1 where only noise is left. rms: "
    "root mean square, over dots and both image axes, or over the three axes of the position. Ljung-Box: where it "
    "is small, errors of neighbouring frames are alike, as those of noise are not. Free run: the model, fitted to "
    "the first part of the recording, goes on alone over the rest, the held-out data; its noise floor is what it "
    "would err by if it lacked nothing."
)


def _said(note: str) -> str:
    return f"{note[:1].upper()}{note[1:]}."


def _effects(result: DiscDiagnosis) -> str:
    items = [
        f"{effect_text(f, result.diagnosis)}. {_significance(f)}. {_class_text(f, result)}"
        for f in result.diagnosis.found
    ]
    if result.learned is not None:
        learned = result.learned
        items.append(
            f"{law_text(learned.law, learned.fit)}; mean power {1e3 * learned.power:.3g} mW; "
            f"chi-square falls by {learned.gain:.5g}."
        )
    return bullets(items)


def _significance(found: Found) -> str:
    if not np.isfinite(found.gain):
        return f"{UNFOLLOWED[:1].upper()}{UNFOLLOWED[1:]}"
    return (
        f"Without it chi-square rises by {found.gain:.5g}, "
        f"{as_sigmas(found.gain, len(found.candidate.quantities)):.4g} sigmas (noise alone: {found.threshold:.3g}); "
        f"on held-out data it gains {found.held_out_gain:.4g}"
    )


DISTINCT = 5.0  # sigmas from which on a recording tells two effects apart


def _class_text(found: Found, result: DiscDiagnosis) -> str:
    """Angles to the rivals, and the recordings that would separate them."""
    texts = []
    for rival in found.cannot_be_told_from:
        plan = result.separated_by.get(found.candidate.name, {}).get(rival.candidate.name)
        name = rival.candidate.name
        text = f"From {name} its predicted residual differs by an angle of {np.degrees(rival.angle):.2g} deg; "
        if plan is None or plan.answers[0] < DISTINCT:
            text += "no recording looked at (3 to 30 deg, spin 0.5 and 5 rad/s, up to 1 s) separates them."
        else:
            text += f"to separate them, {plan.proposal.text}: {plan.answers[0]:.3g} sigmas apart."
        texts.append(text)
    return " ".join(texts)


def _before_after(result: DiscDiagnosis, beside: ModelFreeEvidence | None) -> list[str]:
    before, after = result.before, result.after
    if before is None or after is None or beside is None:
        return []
    both = (before, after)
    rows = [
        ("reduced chi-square of the dots", *(f"{e.reduced_chi_square:.4g}" for e in both)),
        ("reduced chi-square of the poses", *(f"{e.reduced_chi_square_pose:.4g}" for e in both)),
        ("rms of the dots [px]", *(f"{e.rms_px:.4f}" for e in both)),
        ("rms of the position [um]", *(f"{e.position_um:.3g}" for e in both)),
        ("rms of the nutation angle [mdeg]", *(f"{e.theta_mdeg:.3g}" for e in both)),
        ("Ljung-Box: probability of so much memory in noise", *(f"{e.whiteness.p_value:.2g}" for e in both)),
        ("highest line of the spectrum", *(_line(e) for e in both)),
        ("free run over its noise floor", *(f"{e.ratio_to_floor:.4g}" for e in both)),
        *(row for b, a in zip(before.ahead, after.ahead, strict=True) for row in _ahead(b, a)),
        *(row for b, a in beside.ahead for row in _ahead(b, a)),
        *_laws(result),
        *_energy(result, beside),
    ]
    reached = {a.horizon for a in after.ahead} | {a.horizon for _, a in beside.ahead}
    short = [f"{h:g}" for h in HORIZONS if h not in reached]
    if not result.diagnosis.found and result.learned is None:  # nothing was added: one column says it
        rows = [(row[0], row[1]) for row in rows if not row[0].startswith("change of ")]
    remark = f"The recording is too short for free runs of {' and '.join(short)} s." if short else ""
    header = ("", "before", "after") if len(rows[0]) > 2 else ("", "model")
    return [table("", header, rows), paragraph(WORDS), paragraph(remark)]


def _line(errors: Errors) -> str:
    """The strongest line of the pose residual: where, near what, and whether noise has as strong ones."""
    w = errors.whiteness
    i = int(np.argmin(w.peak_p_value))
    near = f" ({w.peak_near[i]})" if w.peak_near[i] else ""
    return f"{w.peak_frequency[i]:.4g} Hz{near}, p = {min(1.0, w.peak_p_value[i] * len(w.peak_p_value)):.2g}"


def _ahead(b: Ahead, a: Ahead) -> list[tuple[str, str, str]]:
    text = f"free run {b.horizon:g} s ahead: "
    return [
        (text + f"nutation [deg], noise {b.noise_theta_deg:.2g}", f"{b.theta_deg:.3g}", f"{a.theta_deg:.3g}"),
        (text + f"precession [deg], noise {b.noise_psi_deg:.2g}", f"{b.psi_deg:.3g}", f"{a.psi_deg:.3g}"),
        (text + f"position [mm], noise {b.noise_position_mm:.2g}", f"{b.position_mm:.3g}", f"{a.position_mm:.3g}"),
    ]


def _laws(result: DiscDiagnosis) -> list[tuple[str, str, str]]:
    """Parameters that the model had already, before and after."""
    first, last = result.diagnosis.before, result.after_fit
    rows = []
    for q in first.quantities:
        if q.name in result.system.model.values:
            start, end = (quantity_text(f.values[q.name], f.sigma(q.name), q.unit) for f in (first, last))
            rows.append((q.name, start, end))
            change = last.values[q.name] - first.values[q.name]
            rows.append((f"change of {q.name}", "", f"{change:+.3g} {q.unit if q.unit != '1' else ''}".rstrip()))
    return rows


def _energy(result: DiscDiagnosis, beside: ModelFreeEvidence) -> list[tuple[str, str, str]]:
    """Energy balance of both models, and the loss that the poses alone show."""
    rows = []
    for name in {**beside.energy_before, **result.energy}:
        before, after = (
            "" if v is None else f"{1e3 * v:.5g}" for v in (beside.energy_before.get(name), result.energy.get(name))
        )
        rows.append((f"energy {name} [mJ]", before, after))
    if beside.measured is not None:
        loss, sigma = 1e3 * beside.measured.energy_lost, 1e3 * beside.measured.energy_lost_sigma
        text = quantity_text(loss, sigma, "1")
        rows.append(("energy lost, from the poses of the disc as declared [mJ]", text, text))
    return rows


def explanations_table(d: Diagnosis) -> str:
    """Sets of effects whose lengths the data do not tell apart; empty where there is only one."""
    rows = [
        (", ".join(names) or "nothing is missing", f"{longer:.1f}", f"{np.exp(-0.5 * longer):.2g}")
        for names, longer in d.explanations
    ]
    words = (
        "-2 log evidence over that of the answer: chi-square, the price of the numbers, the surprise of their values"
    )
    return table(words, ("effects", "longer by", "odds"), rows) if len(rows) > 1 else ""


def tried_table(tried: Sequence[Tried]) -> str:
    """What became of every candidate; empty where none was looked at."""
    number = lambda value: "" if value is None else f"{value:.4g}"  # noqa: E731
    rows = [
        (t.candidate.title, t.candidate.name, number(t.score), number(t.gain), number(t.held_out_gain), t.reason)
        for t in tried
    ]
    header = ("candidate", "name", "score", "gain, refitted", "gain, held out", "outcome")
    filled = [i for i in range(len(header)) if any(row[i] for row in rows)]
    said = (
        "Score: by how much chi-square would fall if the candidate were added, to first order; gain: after a fit; "
        "held out: over data that the fit has not seen."
    )
    return table(said, [header[i] for i in filled], [[row[i] for i in filled] for row in rows]) if rows else ""
