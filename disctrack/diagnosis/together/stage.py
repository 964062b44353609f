"""The stage of the joint diagnosis: trajectory files in; one page with figures, diagnosis.json and one sentence out."""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from disctrack.diagnosis.answer import unnamed
from disctrack.diagnosis.model_file import PAPER
from disctrack.diagnosis.pages.output import plan_json, planned_section
from disctrack.diagnosis.recorded import Recorded, read_recorded
from disctrack.diagnosis.together.recordings import diagnose_together
from disctrack.discrepancy.document import document, effect_text, significance_text, tried
from disctrack.discrepancy.joint.covariates import equivalent
from disctrack.discrepancy.joint.together import Bound, Dependence, OfRecording, TogetherDiagnosis
from disctrack.discrepancy.search import Diagnosis
from disctrack.discrepancy.system import Quantity
from disctrack.errors import AnalysisError, TrajectoryFileError
from disctrack.files.json_text import json_file, plain
from disctrack.files.whole import keep, refuse_existing, write_whole
from disctrack.findings import Kind, Severity, of_kind
from disctrack.numbers import Measured, in_unit, measured, probability, rounded
from disctrack.report.blocks import Drawn, Facts, Figures, Listing, Report, Section
from disctrack.report.html import write_page
from disctrack.report.palette import AMBER, BLUE, MUTED
from disctrack.trajectory.file import read_provenance
from disctrack.trajectory.reuse import content_of, hash_of, remember, reusable

FOLDER = "together_diagnosis"


def run_together(
    paths: Sequence[Path],
    output: Path | None = None,
    *,
    model: str = PAPER,
    overwrite: bool = False,
    reuse: bool = False,
    settle: bool = False,
    processes: int = 1,
    progress: Callable[[str], None] = lambda text: None,
) -> Report:
    """Diagnose trajectory files together; write diagnosis.json and diagnosis.html with figures.

    output : folder; by default `together_diagnosis` in the deepest common folder of all files
    settle : also compute which further recordings would answer the open questions
    Files that cannot be read are left out, and reported.
    reuse : an earlier result that is complete and of the same files, model and version
    returns : its report, with the page; `data["unusable"]` are recordings that could not be read or fitted
    Raises TrajectoryFileError if there is no such file, AnalysisError, SceneError, ModelError, OutputError.
    """
    paths = [Path(p) for p in paths]
    for p in paths:
        keep(p)
    whole = [p.resolve() for p in paths]
    if twice := sorted(str(p) for p, q in zip(paths, whole, strict=True) if whole.count(q) > 1):
        raise AnalysisError(f"{twice[0]}: given more than once. Each recording counts once: name each file once.")
    common = Path(os.path.commonpath([p.parent for p in whole]))  # the deepest common folder
    folder = Path(output) if output is not None else common / FOLDER
    report, html = folder / "diagnosis.json", folder / "diagnosis.html"
    progress("reading")
    read, unread = _read(paths)
    if not read:
        raise AnalysisError("; ".join(f"{path}: {reason}" for path, reason in unread.items()))
    contents = [read_provenance(p).fingerprint for p in read]
    origin = hash_of({"model": content_of(model), "plan": settle, "files": contents, "unread": unread})
    if reuse and (earlier := reusable(folder, origin)) is not None:
        return earlier
    refuse_existing(report, overwrite)
    names = [r.name for r in read.values()]
    recordings = [  # of the same name are named by their files
        replace(r, name=p.resolve().relative_to(common).as_posix()) if names.count(r.name) > 1 else r
        for p, r in read.items()
    ]
    result = diagnose_together(recordings, model, processes=processes, progress=progress, settle=settle, unread=unread)
    content = {"files": [str(p) for p in paths], **as_json(result)}
    summary = replace(report_of(result, figures(result), (html, report)), data=content)
    files = write_page(html, summary, ["png"])
    write_whole(report, json_file(content))
    remember(folder, origin, summary, (report, html, *files))
    return summary


def _read(paths: Sequence[Path]) -> tuple[dict[Path, Recorded], dict[str, str]]:
    """Recordings by file, and why others cannot be read: one broken file does not stop the diagnosis of the rest."""
    read, unread = dict[Path, Recorded](), dict[str, str]()
    for path in paths:
        try:
            read[path] = read_recorded(path)
        except TrajectoryFileError as error:
            if not path.is_file():  # mistyped
                raise
            unread[str(path)] = str(error).removeprefix(f"{path}: ")
    return read, unread


MANY = (
    "Standard deviation of an effect's size from the given number of recordings, marginalised over initial states, "
    "laws, calibration and dots. It falls with the square root of the number, down to the limit by the calibration or "
    "the dots that they share. The last column is an upper limit of effects that were not found."
)


def verdict_text(answer: TogetherDiagnosis) -> str:
    """The effect missing in all recordings."""
    d, left_out = answer.diagnosis, [r for r in answer.recordings if r.reason]
    n = len(answer.recordings) - len(left_out)
    of_all = f"{n} recordings together" + (f" ({len(left_out)} left out)" if left_out else "")
    effects = "; and ".join(effect_text(f, d) for f in d.found)
    if d.held_out_after is None:
        return f"{of_all}: no answer, {d.reason}."
    if d.verdict == "nothing missing":
        return f"{of_all}: nothing is missing."
    return f"{of_all}. {f'Missing in the model: {effects}.' if d.verdict == 'found' else unnamed(effects)}"


def accuracy_text(answer: TogetherDiagnosis) -> str:
    """Size of the residuals."""
    d = answer.diagnosis
    if d.held_out_after is None:
        return ""
    before, after = (rounded(f.reduced_chi_square, 4) for f in (d.before, d.after))
    fell = f"; chi-square per degree of freedom fell from {before} to {after}" if d.found else ""
    return f"Residuals: {after} of the expected variance{fell}."


def misfits_text(answer: TogetherDiagnosis) -> str:
    """Recordings that are inconsistent with the others; empty if none is."""
    apart = [r.name for r in answer.recordings if r.reason and r.name not in answer.unusable]
    return f"{', '.join(apart)} {'does' if len(apart) == 1 else 'do'} not fit the others." if apart else ""


def _free(d: Diagnosis) -> list[Quantity]:
    return [q for q in d.after.quantities if not np.isfinite(q.prior_sigma)]


def _dependence(x: Dependence) -> str:
    """The hypothesis that describes the values of the groups best; a table of the page has all hypotheses."""
    if not x.hypotheses[0].holds:
        return f"{x.quantity}: a value for each {x.by}; every hypothesis is rejected"
    others = "".join(f"; or {h.text}: indistinguishable here" for h in equivalent(x.hypotheses))
    return f"{x.quantity}: {x.hypotheses[0].text}{others}"


def as_json(answer: TogetherDiagnosis) -> dict[str, Any]:
    """The keys of diagnosis.json that apply; and recordings, bounds, dependences."""
    d = answer.diagnosis
    sentence = " ".join(filter(None, (verdict_text(answer), accuracy_text(answer), misfits_text(answer))))
    found = document(d, "shared by all recordings", sentence, with_known=False) | {
        "notes": list(answer.notes),
        "unusable": list(answer.unusable),
        "recordings": [_recording_json(r) for r in answer.recordings],
        "bounds": [_bound_json(b) for b in answer.bounds],
        "dependences": [_dependence_json(x) for x in answer.dependences],
        "plan": plan_json(answer.plan),
    }
    return dict(plain(found))


def _known(numbers: Mapping[str, tuple[float, float]]) -> dict[str, dict[str, float]]:
    return {name: {"value": value, "sigma": sigma} for name, (value, sigma) in numbers.items()}


def _dependence_json(x: Dependence) -> dict[str, Any]:
    tested = [vars(h) | {"numbers": _known(h.numbers), "p_value": h.p_value, "holds": h.holds} for h in x.hypotheses]
    return vars(x) | {"groups": _known(x.groups), "hypotheses": tested}


def _recording_json(r: OfRecording) -> dict[str, Any]:
    found: dict[str, Any] = {"name": r.name, **r.labels, "left_out": r.reason}
    if (f := r.consistency) is not None:
        found |= {"chi_square_shared": f.chi_square, "difference_to_the_others": f.statistic}
        found |= {"degrees": f.degrees, "p_value": f.p_value}
    if (a := r.alone) is not None:
        shared = [q.name for q in a.quantities if q.belongs_to and not np.isfinite(q.prior_sigma)]
        numbers = _known({name: (a.values[name], a.sigma(name)) for name in shared})
        found["alone"] = {"chi_square": a.chi_square, "degrees": a.degrees_of_freedom, "parameters": numbers}
    return found


def _bound_json(b: Bound) -> dict[str, Any]:
    c, numbers = b.candidate, []
    for i, q in enumerate(c.quantities):
        by_number = {k: sigmas[i] for k, sigmas in b.by_number.items()}
        known = {"value": b.values[i], "sigma": b.sigma[i], "sigma_by_number_of_recordings": by_number}
        numbers.append({"name": q.name, "unit": q.unit, **known})
    return {"candidate": c.name, "kind": c.kind, "title": c.title, "parameters": numbers, "upper_limit_95": b.upper}


def report_of(answer: TogetherDiagnosis, drawn: Sequence[Drawn], files: Sequence[Path]) -> Report:
    """The whole report.   files : that were written, page first"""
    d = answer.diagnosis
    effects = [f"{effect_text(f, d)}. {significance_text(f)}." for f in d.found]
    laws = [(q.name, Measured(d.after.values[q.name], d.after.sigma(q.name), q.unit)) for q in _free(d)]
    values = [table for x in answer.dependences for table in _dependence_tables(x)]
    dependences = [[_dependence(x) for x in answer.dependences], *values]
    return Report(
        "Many recordings: what does the model lack?",
        verdict_text(answer),
        accuracy_text(answer),
        of_kind(Kind.DIAGNOSIS, Severity.WARNING, filter(None, (misfits_text(answer), *answer.notes))),
        blocks=[
            f"Verdict: {d.verdict}, because {d.reason}.",
            Section("Missing effects", [effects]),
            Section("Laws, all recordings together (± 1 σ)", [Facts(laws), Figures(drawn)]),
            Section("How the laws depend on what was declared", dependences),
            Section("Each recording against the others", [_recordings(answer)]),
            Section("What many recordings bring", [MANY, _by_number(answer)]),
            planned_section(answer.plan),
            tried(d),
        ],
        files=files,
    )


def _dependence_tables(x: Dependence) -> list[Listing]:
    rows = []
    for h in x.hypotheses:
        units = {k: x.unit if k.startswith("constant") else "1" for k in h.numbers}
        numbers = ", ".join(f"{k} {Measured(*vs, units[k])}" for k, vs in h.numbers.items())
        p = rounded(h.p_value, 2) if h.degrees > 0 else ""
        holds = "holds" if h.holds else "rejected"
        rows.append((h.text, numbers, f"{rounded(h.chi_square)} / {h.degrees}", p, holds))
    header = ("hypothesis", "numbers", "chi-square / degrees", "p", "")
    return [
        Listing((x.quantity, "value (± 1 σ)"), [(g, Measured(*vs, x.unit)) for g, vs in x.groups.items()]),
        Listing(header, rows, f"How these values of {x.quantity} depend on each other"),
    ]


def _recordings(answer: TogetherDiagnosis) -> Listing:
    read = [r for r in answer.recordings if r.labels]
    kinds = [k for k in ("disc", "surface", "rig", "air") if len({r.labels[k] for r in read}) > 1]
    rows = []
    for r in answer.recordings:
        cells = ["", "", "", r.reason]
        if r.consistency is not None and r.alone is not None:
            f, degrees = r.consistency, max(r.alone.degrees_of_freedom, 1)
            cells = [rounded(chi_square / degrees, 4) for chi_square in (f.chi_square, r.alone.chi_square)]
            cells += [f"{rounded(f.statistic)} / {f.degrees} (p {probability(f.p_value)})", ""]
        rows.append([r.name, *(r.labels.get(k, "") for k in kinds), *cells])
    header = ["recording", *kinds, "chi-square, shared", "its own", "difference / degrees", ""]
    caption = "Chi-square per datum with the shared values of the quantities, and with its own; their difference"
    return Listing(header, rows, caption, classes=["failed" if r.reason else "ok" for r in answer.recordings])


def _by_number(answer: TogetherDiagnosis) -> Listing:
    numbers = sorted({k for b in answer.bounds for k in b.by_number})
    rows = []
    for b in answer.bounds:
        for i, q in enumerate(b.candidate.quantities):
            sigmas = [float(b.by_number[k][i]) for k in numbers]
            seen = [rounded(sigma, 2) if np.isfinite(sigma) else "not seen" for sigma in sigmas]
            value = measured(float(b.values[i]), float(b.sigma[i])) if np.isfinite(b.sigma[i]) else "not seen"
            most = "" if b.upper is None else measured(b.upper)
            rows.append(["" if i else b.candidate.title, in_unit(q.name, q.unit), *seen, value, most])
    of = [f"{k}" if k > 1 else "σ from 1 recording" for k in numbers]
    header = ["effect", "number", *of, "all together (± 1 σ)", "at most (95 %)"]
    return Listing(header, rows, folded="All effects")


def figures(answer: TogetherDiagnosis) -> tuple[Drawn, ...]:
    """Every shared law: its value by each recording alone, and by all together."""
    from matplotlib.ticker import MaxNLocator  # needed for pages only

    from disctrack.report.figures import panels

    sharing, after = answer.system.sharing, answer.diagnosis.after
    used = [r for r in answer.recordings if not r.reason]
    names, drawn = {float(i): r.name for i, r in enumerate(used)}, []
    for number, q in enumerate(_free(answer.diagnosis), start=1):
        points = []
        for i, a in enumerate(r.alone for r in used):
            for local in sharing.local_names(i, [q.name]):
                if a is not None and a.converged and a.sigma(local) > 0:
                    points.append((i, a.values[local], a.sigma(local)))
        if len(points) < 2:
            continue
        figure, (axes,) = panels(9.5, 2.6)
        x, y, s = (np.array(c) for c in zip(*points, strict=True))
        value, sigma = after.values[q.name], after.sigma(q.name)
        axes.axhspan(value - 2 * sigma, value + 2 * sigma, color=AMBER, alpha=0.35, lw=0)
        axes.axhline(value, color=AMBER, lw=1)
        axes.errorbar(x, y, s, fmt="o", ms=3, lw=1, color=BLUE, ecolor=MUTED)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.xaxis.set_major_formatter(lambda i, _: names.get(i, ""))
        axes.set_ylabel(in_unit(q.stem.removeprefix(f"{q.owner}."), q.unit))
        caption = "Each recording alone, ± 1 σ; the band is ± 2 σ of all together."
        drawn.append(Drawn(f"{number:02d}_{q.name.replace('.', '_').split('[')[0]}", q.name, caption, figure))
    return tuple(drawn)
