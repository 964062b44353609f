"""The report of a diagnosis: one HTML page that needs nothing else, and its figures."""

from __future__ import annotations

import base64
import io
from html import escape
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg

from disctrack.analyse.figures import Drawn
from disctrack.diagnosis.disc.diagnosis import DiscDiagnosis
from disctrack.diagnosis.disc.errors import HORIZONS, Ahead, Errors
from disctrack.diagnosis.disc.free_runs import Evidence
from disctrack.diagnosis.engine.search import Found
from disctrack.diagnosis.pages.figures import all_figures
from disctrack.diagnosis.pages.words import effect_text, law_text, quantity_text
from disctrack.files.whole import whole_file, write_whole

_DPI = 150
_STYLE = """body{font:16px/1.5 system-ui,sans-serif;color:#1d2733;background:#fff;margin:0}
main{max-width:60rem;margin:0 auto;padding:1.5rem}h1{font-size:1.5rem}h2{font-size:1.15rem;margin-top:2rem}
.lead{font-size:1.1rem;border-left:4px solid #1f6f8b;padding-left:.8rem}table{border-collapse:collapse;width:100%}
th,td{text-align:left;padding:.25rem .6rem;border-bottom:1px solid #e3e8ed;font-variant-numeric:tabular-nums}
img{max-width:100%}figcaption{color:#6b7885;font-size:.9rem}figure{margin:1rem 0}.wide{overflow-x:auto}"""


def write_report(folder: Path, result: DiscDiagnosis, beside: Evidence | None, recording: str) -> tuple[Path, ...]:
    """Write diagnosis.html and figures/*.png; returns the files. Raises OutputError."""
    files, pictures = [], []
    with rc_context({"font.size": 10}):
        for drawn in all_figures(result, beside):
            FigureCanvasAgg(drawn.figure)
            path = folder / "figures" / f"{drawn.name}.png"
            buffer = io.BytesIO()
            drawn.figure.savefig(buffer, format="png", dpi=_DPI)
            with whole_file(path) as part:
                part.write_bytes(buffer.getvalue())
            files.append(path)
            pictures.append(_figure(drawn, buffer.getvalue()))
    page = folder / "diagnosis.html"
    write_whole(page, _page(result, beside, recording, pictures).encode())
    return (page, *files)


def _figure(drawn: Drawn, png: bytes) -> str:
    source = base64.b64encode(png).decode()
    return (
        f'<figure><img alt="{escape(drawn.title)}" src="data:image/png;base64,{source}">'
        f"<figcaption>{escape(drawn.caption)}</figcaption></figure>"
    )


def _page(result: DiscDiagnosis, beside: Evidence | None, recording: str, pictures: list[str]) -> str:
    title = escape(f"{recording}: what does the model lack?")
    parts = [
        f'<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><style>{_STYLE}</style></head>'
        f"<body><main><h1>{title}</h1><p class=lead>{escape(result.sentence)}</p>",
        f"<p>Verdict: <b>{escape(result.diagnosis.verdict)}</b>. Model: {escape(result.model)}. "
        f"{escape(result.diagnosis.reason[:1].upper() + result.diagnosis.reason[1:])}.</p>",
        "".join(f"<p>{escape(text[:1].upper() + text[1:])}.</p>" for text in result.notes),
        _effects(result),
        _before_after(result, beside),
        *pictures,
        _tried(result),
    ]
    return "\n".join(part for part in parts if part) + "\n</main></body></html>\n"


def _effects(result: DiscDiagnosis) -> str:
    items = "".join(
        f"<li>{escape(effect_text(f, result.diagnosis))}. Without it chi-square rises by {f.gain:.5g}, "
        f"{np.sqrt(max(f.gain, 0.0)):.4g} sigmas (noise alone: {f.threshold:.3g}); on held-out data it gains "
        f"{f.held_out_gain:.4g}. "
        f"{escape(_class_text(f, result))}</li>"
        for f in result.diagnosis.found
    )
    if result.learned is not None:
        learned = result.learned
        items += (
            f"<li>{escape(law_text(learned.law, learned.fit))}; mean power {1e3 * learned.power:.3g} mW, chosen in "
            f"{100 * min(learned.law.share):.0f} % of the resamples; chi-square falls by {learned.gain:.5g}.</li>"
        )
    return f"<h2>Missing effects</h2><ul>{items}</ul>" if items else ""


DISTINCT = 5.0  # sigmas from which on a recording tells two effects apart


def _class_text(found: Found, result: DiscDiagnosis) -> str:
    """Angles to the rivals, and the recordings that would separate them."""
    texts = []
    for rival in found.cannot_be_told_from:
        plan = result.separated_by.get(found.candidate.name, {}).get(rival.candidate.name)
        name = rival.candidate.name
        text = f"From {name} its predicted residual differs by an angle of {np.degrees(rival.angle):.2g} deg; "
        if plan is None or plan.sigmas < DISTINCT:
            text += "no recording looked at (3 to 30 deg, spin 0.5 and 5 rad/s, up to 1 s) separates them."
        else:
            text += f"to separate them, {plan.text}."
        texts.append(text)
    return " ".join(texts)


def _before_after(result: DiscDiagnosis, beside: Evidence | None) -> str:
    before, after = result.before, result.after
    if before is None or after is None or beside is None:
        return ""
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
    body = "".join(f"<tr><td>{escape(a)}<td>{escape(b)}<td>{escape(c)}</tr>" for a, b, c in rows)
    reached = {a.horizon for a in after.ahead} | {a.horizon for _, a in beside.ahead}
    short = [f"{h:g}" for h in HORIZONS if h not in reached]
    remark = f"<p>The recording is too short for free runs of {' and '.join(short)} s.</p>" if short else ""
    head = "<table><tr><th><th>before<th>after</tr>"
    return f"<h2>Before and after</h2><div class=wide>{head}{body}</table></div>{remark}"


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


def _energy(result: DiscDiagnosis, beside: Evidence) -> list[tuple[str, str, str]]:
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


def _tried(result: DiscDiagnosis) -> str:
    rows = "".join(
        f"<tr><td>{escape(t.candidate.name)}<td>{t.score:.4g}<td>{'' if t.gain is None else format(t.gain, '.4g')}"
        f"<td>{'' if t.held_out_gain is None else format(t.held_out_gain, '.4g')}<td>{escape(t.reason)}</tr>"
        for t in result.diagnosis.tried
    )
    head = "<tr><th>candidate<th>score<th>gain, refitted<th>gain, held out<th>outcome</tr>"
    return f"<h2>What was tried</h2><div class=wide><table>{head}{rows}</table></div>" if rows else ""
