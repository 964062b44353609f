"""The answer for many recordings: its report, its figures, and its JSON."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from disctrack.diagnosis.pages import planned
from disctrack.diagnosis.together.discs import DiscsTogether
from disctrack.discrepancy.document import declared_json, document, fit_errors, tried_table
from disctrack.discrepancy.joint.covariates import Hypothesis, alike
from disctrack.discrepancy.joint.sharing import EACH
from disctrack.discrepancy.joint.together import Bound, Dependence, OfRecording
from disctrack.discrepancy.search import Diagnosis
from disctrack.discrepancy.system import Quantity
from disctrack.discrepancy.words import effect_text, significance_text
from disctrack.files.json_text import plain
from disctrack.report.blocks import Facts, Figures, Items, Listing, Report, Said, Section, Text
from disctrack.report.numbers import Measured, in_unit, measured, probability, rounded
from disctrack.report.palette import AMBER, BLUE, MUTED

if TYPE_CHECKING:
    from disctrack.report.figures import Drawn

SHOWN = 12  # effects whose standard deviations are tabled by number of recordings; all are in the JSON
NAMED = 8  # recordings that are named on an axis; more are counted
UNSEEN = 1e3  # times its typical size: an effect whose standard deviation is larger is not seen at all
AIR = "air"


def verdict_text(answer: DiscsTogether) -> str:
    """What is missing in all of them."""
    d, n, left_out = answer.diagnosis, len(answer.used), [r for r in answer.recordings if r.reason]
    of_all = f"{n} recordings together" + (f" ({len(left_out)} left out)" if left_out else "")
    effects = "; and ".join(effect_text(f, d) for f in d.found)
    if d.held_out_after is None:
        return f"{of_all}: no answer, {d.reason}."
    if d.verdict == "nothing missing":
        return f"{of_all}: nothing is missing."
    if d.verdict == "found":
        return f"{of_all}. Missing in the model: {effects}."
    if effects:
        return f"{of_all}. Something is missing that the catalogue does not name; nearest is {effects}."
    return f"{of_all}. Something is missing that no effect of the catalogue describes."


def accuracy_text(answer: DiscsTogether) -> str:
    """What is left, and who does not fit the others."""
    d = answer.diagnosis
    if d.held_out_after is None:
        return ""
    before, after = (rounded(f.reduced_chi_square, 4) for f in (d.before, d.after))
    fell = f"; chi-square per degree of freedom fell from {before} to {after}" if d.found else ""
    return f"Residuals: {after} of the expected variance{fell}."


def misfits_text(answer: DiscsTogether) -> str:
    """Recordings that do not fit the others; empty where all do."""
    apart = [r.name for r in answer.recordings if r.reason.startswith("does")]
    return f"{', '.join(apart)} {'does' if len(apart) == 1 else 'do'} not fit the others." if apart else ""


def sentence(answer: DiscsTogether) -> str:
    """The answer in one or a few sentences."""
    texts = verdict_text(answer), accuracy_text(answer), misfits_text(answer)
    return " ".join(text for text in texts if text)


def _free(d: Diagnosis) -> list[Quantity]:
    return [q for q in d.after.quantities if not np.isfinite(q.prior_sigma)]


def _law(d: Diagnosis, q: Quantity) -> Measured:
    return Measured(d.after.values[q.name], d.after.sigma(q.name), q.unit)


def _dependence(x: Dependence) -> str:
    best = x.hypotheses[0]
    refused = [h.text for h in x.hypotheses if not h.holds and h.parts < 2]  # the others are in the page's table
    if not best.holds:
        text = f"{x.quantity}: a value for each {x.by}"
        text += ", by no rule that was tested" if len(x.hypotheses) > 1 else ""
    else:
        text = f"{x.quantity}: {best.text}{_exponents(best)}"
        text += f", p {probability(best.p_value)}" if best.degrees > 0 else ""
        text += "".join(f"; or {h.text}{_exponents(h)}: indistinguishable here" for h in alike(x.hypotheses))
    return text + (f"; rejected: {'; '.join(refused)}" if refused else "")


def _unit(number: str, x: Dependence) -> str:
    return x.unit if number.startswith("constant") else "1"


def _exponents(h: Hypothesis) -> str:
    exponents = {k: vs for k, vs in h.numbers.items() if not k.startswith("constant")}
    said = ", ".join(f"{k} {Measured(*vs)}" for k, vs in exponents.items())
    return f" ({said})" if said else ""


def as_json(answer: DiscsTogether) -> dict[str, Any]:
    """The keys of diagnosis.json as far as they apply; and recordings, bounds, dependences."""
    d = answer.diagnosis
    sides = {
        key: fit_errors(fit, held) | {"parameters": declared_json(fit)}
        for key, fit, held in (("before", d.before, d.held_out_before), ("after", d.after, d.held_out_after))
    }
    found = document(d, "shared by all recordings", sentence(answer)) | {
        **sides,
        "notes": list(answer.notes),
        "unusable": list(answer.unusable),
        "recordings": [_recording_json(r) for r in answer.recordings],
        "bounds": [_bound_json(b) for b in answer.bounds],
        "dependences": [_dependence_json(x) for x in answer.dependences],
        "plan": planned.as_json(answer.plan),
    }
    return dict(plain(found))


def _known(numbers: Mapping[str, tuple[float, float]]) -> dict[str, dict[str, float]]:
    return {name: {"value": value, "sigma": sigma} for name, (value, sigma) in numbers.items()}


def _dependence_json(x: Dependence) -> dict[str, Any]:
    tested = [vars(h) | {"numbers": _known(h.numbers), "p_value": h.p_value, "holds": h.holds} for h in x.hypotheses]
    return vars(x) | {"groups": _known(x.groups), "hypotheses": tested}


def _recording_json(r: OfRecording) -> dict[str, Any]:
    told: dict[str, Any] = {"name": r.name, **r.labels, "left_out": r.reason}
    if (f := r.fits_in) is not None:
        told |= {"chi_square_shared": f.chi_square, "difference_to_the_others": f.statistic}
        told |= {"degrees": f.degrees, "p_value": f.p_value}
    if (a := r.alone) is not None:
        numbers = _known({n: (a.values[n], sigma * a.inflation[n]) for n, sigma in a.sigmas.items()})
        told["alone"] = {"chi_square": a.chi_square, "degrees": a.degrees, "parameters": numbers}
    return told


def _bound_json(b: Bound) -> dict[str, Any]:
    c, by_number = b.candidate, np.array(list(b.by_number.values()))
    numbers = [
        {"name": q.name, "unit": q.unit, "value": value, "sigma": sigma,
         "sigma_by_number_of_recordings": dict(zip(b.by_number, sigmas, strict=True))}
        for q, value, sigma, sigmas in zip(c.quantities, b.values, b.sigma, by_number.T, strict=True)
    ]  # fmt: skip
    return {"candidate": c.name, "kind": c.kind, "title": c.title, "parameters": numbers, "upper_limit_95": b.upper}


def report_of(answer: DiscsTogether, drawn: Sequence[Drawn] = (), files: Sequence[Path] = ()) -> Report:
    """All of the answer."""
    d = answer.diagnosis
    effects = [f"{effect_text(f, d)}. {significance_text(f)}." for f in d.found]
    tables = [table for x in answer.dependences for table in _dependence_tables(x)]
    return Report(
        "Many recordings: what does the model lack?",
        verdict_text(answer),
        accuracy_text(answer),
        [Said(text, "warning") for text in (misfits_text(answer), *answer.notes) if text],
        blocks=[
            Text(f"Verdict: {d.verdict}, because {d.reason}."),
            Section("Missing effects", [Items(effects)]),
            Section(
                "Laws, all recordings together (± 1 σ)",
                [Facts([(q.name, _law(d, q)) for q in _free(d)]), Figures(drawn)],
            ),
            Section(
                "How the laws depend on what was declared",
                [Items([_dependence(x) for x in answer.dependences]), *tables],
            ),
            Section("Each recording against the others", [_recordings(answer)]),
            Section("What many recordings bring", _by_number(answer)),
            planned.section(answer.plan),
            Section("What was tried", [tried_table(d)]),
        ],
        files=files,
        page=next((file for file in files if file.suffix == ".html"), None),
    )


def _dependence_tables(x: Dependence) -> list[Listing]:
    rows = [
        (
            h.text,
            ", ".join(f"{k} {Measured(*vs, _unit(k, x))}" for k, vs in h.numbers.items()),
            f"{rounded(h.chi_square)} / {h.degrees}",
            rounded(h.p_value, 2) if h.degrees > 0 else "",
            "holds" if h.holds else "rejected",
        )
        for h in x.hypotheses
    ]
    header = ("hypothesis", "numbers", "chi-square / degrees", "p", "")
    return [
        Listing((x.quantity, "value (± 1 σ)"), [(g, Measured(*vs, x.unit)) for g, vs in x.groups.items()]),
        Listing(header, rows, f"How these values of {x.quantity} depend on each other"),
    ]


def _recordings(answer: DiscsTogether) -> Listing:
    read = [r for r in answer.recordings if r.labels]
    kinds = [k for k in ("disc", "surface", "rig", "air") if len({r.labels[k] for r in read}) > 1]
    rows, classes = [], []
    for r in answer.recordings:
        cells = [r.name, *(r.labels.get(k, "") for k in kinds)]
        if r.fits_in is None or r.alone is None:
            cells += ["", "", "", r.reason]
        else:
            f = r.fits_in
            cells += [
                rounded(f.chi_square / max(r.alone.degrees, 1), 4),
                rounded(r.alone.chi_square / max(r.alone.degrees, 1), 4),
                f"{rounded(f.statistic)} / {f.degrees} (p {probability(f.p_value)})",
                "",
            ]
        rows.append(cells)
        classes.append("failed" if r.reason else "")
    header = ["recording", *kinds, "chi-square, shared", "its own", "difference / degrees", ""]
    caption = "Chi-square per datum with the shared quantities, and with values of its own; their difference"
    return Listing(header, rows, caption, classes=[c or "ok" for c in classes])


def _by_number(answer: DiscsTogether) -> list[Text | Listing]:
    shown = _of_interest(answer)
    numbers = sorted({k for b in shown for k in b.by_number})
    rows = []
    for b in shown:
        for i, q in enumerate(b.candidate.quantities):
            sigma = [rounded(x, 2) if np.isfinite(x := float(b.by_number[k][i])) else "not seen" for k in numbers]
            rows.append(["" if i else _short(b.candidate.title), in_unit(q.name, q.unit), *sigma, *_in_all(b, i, "1")])
    of = [f"{k}" if k > 1 else "σ from 1 recording" for k in numbers]
    header = ["effect", "number", *of, "all together (± 1 σ)", "at most (95 %)"]
    said = (
        "Standard deviation of an effect's size from the first so many recordings, once initial states, laws, "
        "calibration and dots have taken their share. It falls with the root of their number until what they have in "
        "common, calibration or dots, sets the limit. What was not found is smaller than the last column says."
    )
    others = [
        ["" if i else b.candidate.title, q.name, *_in_all(b, i, q.unit)]
        for b in answer.bounds
        if b not in shown
        for i, q in enumerate(b.candidate.quantities)
    ]
    rest = Listing(("effect", "number", *header[-2:]), others, folded="All other effects")
    return [Text(said), Listing(header, rows), rest]


def _short(title: str) -> str:
    """Without the formula."""
    return re.split(r", (?=\S+ (?:=|<=) )", title)[0]


def _in_all(b: Bound, i: int, unit: str) -> list[str]:
    """Size of its i-th number from all recordings, and the upper limit of a single one."""
    value = measured(float(b.values[i]), float(b.sigma[i]), unit) if np.isfinite(b.sigma[i]) else "not seen"
    return [value, "" if b.upper is None else measured(b.upper, unit=unit)]


def _of_interest(answer: DiscsTogether) -> list[Bound]:
    """What was found, and the effects that one recording sees worst for their usual size: those of the air first."""
    found = {f.candidate.name for f in answer.diagnosis.found}

    def rank(b: Bound) -> tuple[int, float]:
        q = b.candidate.quantities[0]
        first = min(b.by_number)
        sigma = float(b.by_number[first][0])
        share = sigma / q.typical if np.isfinite(q.typical) and np.isfinite(sigma) else 0.0
        return (0 if b.candidate.name in found else 1 if AIR in q.belongs_to else 2, -share)

    def seen(b: Bound) -> bool:
        sigma, typical = b.by_number[max(b.by_number)][0], b.candidate.quantities[0].typical
        return bool(np.isfinite(sigma)) and sigma <= UNSEEN * typical

    usable = [b for b in answer.bounds if seen(b) and not (b.candidate.name.endswith(f"({EACH})") and rank(b)[0])]
    return sorted(usable, key=rank)[:SHOWN]


def figures(answer: DiscsTogether) -> tuple[Drawn, ...]:
    """Every shared law: what each recording says alone, and what all say together."""
    from matplotlib.ticker import MaxNLocator  # wanted on pages only

    from disctrack.report.figures import Drawn, panels

    sharing, after = answer.system.sharing, answer.diagnosis.after
    alone = [r.alone for r in answer.recordings if not r.reason]
    names = [r.name for r in answer.recordings if not r.reason]
    drawn = []
    for number, q in enumerate(_free(answer.diagnosis)[:SHOWN], start=1):
        points = []
        for i, a in enumerate(alone):
            for local in sharing.local_names(i, [q.name]):
                sigma = 0.0 if a is None else a.sigmas.get(local, 0.0) * a.inflation.get(local, 1.0)
                if a is not None and a.converged and np.isfinite(sigma) and sigma > 0:
                    points.append((i, a.values[local], sigma))
        if len(points) < 2:
            continue
        figure, (axes,) = panels(9.5, 2.6)
        x, y, s = (np.array(c) for c in zip(*points, strict=True))
        of_group = x if len(names) > NAMED else np.arange(len(x))
        value, sigma = after.values[q.name], after.sigma(q.name)
        axes.axhspan(value - 2 * sigma, value + 2 * sigma, color=AMBER, alpha=0.35, lw=0)
        axes.axhline(value, color=AMBER, lw=1)
        axes.errorbar(of_group, y, s, fmt="o", ms=3, lw=1, color=BLUE, ecolor=MUTED)
        if len(names) <= NAMED:
            axes.set_xticks(of_group, [names[i] for i in x])
        else:
            axes.xaxis.set_major_locator(MaxNLocator(integer=True))
            axes.set_xlabel("recording, from 0")
        axes.set_ylabel(in_unit(q.part.partition("[")[0], q.unit))
        caption = "Each recording alone with its standard deviation; the band is two of all together."
        drawn.append(Drawn(f"{number:02d}_{q.name.replace('.', '_').split('[')[0]}", q.name, caption, figure))
    return tuple(drawn)
