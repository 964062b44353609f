"""The answer for many recordings: a sentence, lines for the terminal, JSON, and one page."""

import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.ticker import MaxNLocator

from disctrack.diagnosis.pages import planned
from disctrack.diagnosis.pages.report import tried_table
from disctrack.diagnosis.together.discs import DiscsTogether
from disctrack.discrepancy.document import declared_json, effect_json, tried_json
from disctrack.discrepancy.joint.covariates import Hypothesis, alike
from disctrack.discrepancy.joint.sharing import EACH
from disctrack.discrepancy.joint.together import Bound, Dependence, OfRecording
from disctrack.discrepancy.search import Diagnosis, Found
from disctrack.discrepancy.significance import as_sigmas
from disctrack.discrepancy.system import Quantity
from disctrack.discrepancy.words import effect_text, quantity_text
from disctrack.files.json_text import plain
from disctrack.report.figures import Drawn, panels
from disctrack.report.palette import AMBER, BLUE, MUTED
from disctrack.report.parts import bullets, details, page, paragraph, section, table, typeset, warning

SHOWN = 12  # effects whose standard deviations are tabled by number of recordings; all are in the JSON
NAMED = 8  # recordings that are named on an axis; more are counted
UNSEEN = 1e3  # times its typical size: an effect whose standard deviation is larger is not seen at all
AIR = "air"


def sentence(answer: DiscsTogether) -> str:
    """The answer in one or a few sentences."""
    d = answer.diagnosis
    n, left_out = len(answer.used), [r for r in answer.recordings if r.reason]
    of_all = f"{n} recordings together" + (f" ({len(left_out)} left out)" if left_out else "")
    if d.held_out_after is None:
        return f"{of_all}: no answer, {d.reason}."
    left = f"{d.after.reduced_chi_square:.4g} of the expected variance is left"
    if d.verdict == "nothing missing":
        text = f"{of_all}: nothing is missing; {left}."
    else:
        effects = "; and ".join(_effect_text(f, d) for f in d.found)
        falls = (
            f"chi-square per degree of freedom falls from {d.before.reduced_chi_square:.4g} to "
            f"{d.after.reduced_chi_square:.4g}"
        )
        if d.verdict == "found":
            text = f"{of_all}. Missing in the model: {effects}; {falls}."
        elif effects:
            text = f"{of_all}. Something is missing that the catalogue does not name; nearest is {effects}; {falls}."
        else:
            text = f"{of_all}. Something is missing that no effect of the catalogue describes; {left}."
    apart = [r.name for r in left_out if r.reason.startswith("does")]
    if apart:
        text += f" {_listed(apart)} {'does' if len(apart) == 1 else 'do'} not fit the others."
    return text


def _effect_text(found: Found, d: Diagnosis) -> str:
    return effect_text(found, d).replace("this recording", "these recordings")


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def lines(answer: DiscsTogether) -> list[str]:
    """For the terminal."""
    d = answer.diagnosis
    said = [f"{'verdict':<13} {d.verdict}", f"{'':<13} {sentence(answer)}"]
    said += [f"{'note':<13} {note}" for note in answer.notes]
    said += [
        f"{'significance':<13} {f.candidate.name}: chi-square rises by {f.gain:.4g} without it (noise alone: "
        f"{f.threshold:.3g}); gain on recordings that were held out {f.held_out_gain:.4g}"
        for f in d.found
    ]
    said += [f"{'law':<13} {text}" for text in _laws(d)]
    said += [f"{'depends':<13} {_dependence(x)}" for x in answer.dependences]
    return said if answer.plan is None else [*said, *planned.lines(answer.plan)]


def _free(d: Diagnosis) -> list[Quantity]:
    return [q for q in d.after.quantities if not np.isfinite(q.prior_sigma)]


def _laws(d: Diagnosis) -> list[str]:
    return [f"{q.name} = {quantity_text(d.after.values[q.name], d.after.sigma(q.name), q.unit)}" for q in _free(d)]


def _dependence(x: Dependence) -> str:
    best = x.hypotheses[0]
    refused = [h.text for h in x.hypotheses if not h.holds and h.parts < 2]  # the others are in the page's table
    if not best.holds:
        text = f"{x.quantity}: a value for each {x.by}"
        text += ", by no rule that was tested" if len(x.hypotheses) > 1 else ""
    else:
        text = f"{x.quantity}: {best.text}{_exponents(best)}"
        text += f", p = {best.p_value:.2g}" if best.degrees > 0 else ""
        text += "".join(f"; or {h.text}{_exponents(h)}: cannot be told apart here" for h in alike(x.hypotheses))
    return text + (f"; refused: {'; '.join(refused)}" if refused else "")


def _unit(number: str, x: Dependence) -> str:
    return x.unit if number.startswith("constant") else "1"


def _exponents(h: Hypothesis) -> str:
    exponents = {k: vs for k, vs in h.numbers.items() if not k.startswith("constant")}
    said = ", ".join(f"{k} {quantity_text(*vs, '1')}" for k, vs in exponents.items())
    return f" ({said})" if said else ""


def as_json(answer: DiscsTogether) -> dict[str, Any]:
    """The keys of diagnosis.json as far as they apply; and recordings, bounds, dependences."""
    d = answer.diagnosis
    both = {
        key: {
            "reduced_chi_square": fit.reduced_chi_square,
            "held_out": {"ratio_to_noise_floor": None if held is None else held.ratio_to_floor},
            "parameters": declared_json(fit),
        }
        for key, fit, held in (("before", d.before, d.held_out_before), ("after", d.after, d.held_out_after))
    }
    document = {
        "verdict": d.verdict,
        "sentence": sentence(answer),
        "reason": d.reason,
        "notes": list(answer.notes),
        "effects": [effect_json(f, d.after) for f in d.found],
        **both,
        "unusable": list(answer.unusable),
        "recordings": [_recording_json(r) for r in answer.recordings],
        "bounds": [_bound_json(b) for b in answer.bounds],
        "dependences": [
            {
                "quantity": x.quantity,
                "unit": x.unit,
                "by": x.by,
                "groups": {g: {"value": v, "sigma": s} for g, (v, s) in x.groups.items()},
                "hypotheses": [
                    {
                        "text": h.text,
                        "numbers": {k: {"value": v, "sigma": s} for k, (v, s) in h.numbers.items()},
                        "chi_square": h.chi_square,
                        "degrees": h.degrees,
                        "p_value": h.p_value,
                        "holds": h.holds,
                    }
                    for h in x.hypotheses
                ],
            }
            for x in answer.dependences
        ],
        "plan": planned.as_json(answer.plan),
        "tried": [tried_json(t) for t in d.tried],
        "settings": vars(d.settings),
    }
    return dict(plain(document))


def _recording_json(r: OfRecording) -> dict[str, Any]:
    told: dict[str, Any] = {"name": r.name, **r.labels, "left_out": r.reason}
    if r.fits_in is not None:
        told |= {
            "chi_square_shared": r.fits_in.chi_square,
            "difference_to_the_others": r.fits_in.statistic,
            "degrees": r.fits_in.degrees,
            "p_value": r.fits_in.p_value,
        }
    if r.alone is not None:
        told["alone"] = {
            "chi_square": r.alone.chi_square,
            "degrees": r.alone.degrees,
            "parameters": {
                n: {"value": r.alone.values[n], "sigma": s * r.alone.inflation[n]} for n, s in r.alone.sigmas.items()
            },
        }
    return told


def _bound_json(b: Bound) -> dict[str, Any]:
    return {
        "candidate": b.candidate.name,
        "kind": b.candidate.kind,
        "title": b.candidate.title,
        "parameters": [
            {
                "name": q.name,
                "unit": q.unit,
                "value": float(v),
                "sigma": float(s),
                "sigma_by_number_of_recordings": {str(k): float(x[i]) for k, x in b.by_number.items()},
            }
            for i, (q, v, s) in enumerate(zip(b.candidate.quantities, b.values, b.sigma, strict=True))
        ],
        "upper_limit_95": b.upper,
    }


def whole_page(answer: DiscsTogether, pictures: str) -> str:
    """The page, with the figures' HTML."""
    d = answer.diagnosis
    parts = [
        paragraph(sentence(answer), "lead"),
        paragraph(f"Verdict: {d.verdict}. {d.reason[:1].upper()}{d.reason[1:]}."),
        warning("Not all recordings go together", answer.notes),
        section("Missing effects", [bullets(_effects(answer))]),
        section("Laws, all recordings together", [bullets(_laws(d)), pictures]),
        section("How the laws depend on what was declared", [_dependence_table(x) for x in answer.dependences]),
        section("Each recording against the others", [_recordings(answer)]),
        section("What many recordings bring", [_by_number(answer)]),
        section("What would settle it", planned.html(answer.plan)),
        section("What was tried", [details("All candidates", [tried]) if (tried := tried_table(d.tried)) else ""]),
    ]
    return page("Many recordings: what does the model lack?", parts)


def _effects(answer: DiscsTogether) -> list[str]:
    d = answer.diagnosis
    return [
        f"{_effect_text(f, d)}. Without it chi-square rises by {f.gain:.5g}, "
        f"{as_sigmas(f.gain, len(f.candidate.quantities)):.4g} sigmas (noise alone: {f.threshold:.3g}); on recordings "
        f"that were held out it gains {f.held_out_gain:.4g}."
        for f in d.found
    ]


def _dependence_table(x: Dependence) -> str:
    rows = [
        (
            h.text,
            ", ".join(f"{k} {quantity_text(*vs, _unit(k, x))}" for k, vs in h.numbers.items()),
            f"{h.chi_square:.3g} / {h.degrees}",
            f"{h.p_value:.2g}" if h.degrees > 0 else "",
            "holds" if h.holds else "refused",
        )
        for h in x.hypotheses
    ]
    groups = table("", (x.quantity, "value"), [(g, quantity_text(*vs, x.unit)) for g, vs in x.groups.items()])
    return groups + table(
        f"How these values of {x.quantity} hang together",
        ("hypothesis", "numbers", "chi-square / degrees", "p", ""),
        rows,
    )


def _recordings(answer: DiscsTogether) -> str:
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
                f"{f.chi_square / max(r.alone.degrees, 1):.4g}",
                f"{r.alone.chi_square / max(r.alone.degrees, 1):.4g}",
                f"{f.statistic:.3g} / {f.degrees} (p = {f.p_value:.2g})",
                "",
            ]
        rows.append(cells)
        classes.append("failed" if r.reason else "")
    header = ["recording", *kinds, "chi-square, shared", "its own", "difference / degrees", ""]
    caption = "Chi-square per datum with the shared quantities, and with values of its own; their difference"
    return table(caption, header, rows, [c or "ok" for c in classes])


def _by_number(answer: DiscsTogether) -> str:
    shown = _of_interest(answer)
    numbers = sorted({k for b in shown for k in b.by_number})
    rows = []
    for b in shown:
        for i, q in enumerate(b.candidate.quantities):
            sigma = [f"{x:.2g}" if np.isfinite(x := float(b.by_number[k][i])) else "unseen" for k in numbers]
            name = q.name + (f" [{q.unit}]" if q.unit != "1" else "")
            rows.append(["" if i else _short(b.candidate.title), name, *sigma, *_in_all(b, i, "1")])
    of = [f"{k}" if k > 1 else "sigma from 1 recording" for k in numbers]
    header = ["effect", "number", *of, "all together", "at most (95 %)"]
    said = (
        "Standard deviation of an effect's size from the first so many recordings, once initial states, laws, "
        "calibration and dots have taken their share. It falls with the root of their number until what they have in "
        "common, calibration or dots, sets the limit. What was not found is smaller than the last column says."
    )
    rest = [b for b in answer.bounds if b not in shown]
    others = [
        ["" if i else b.candidate.title, q.name, *_in_all(b, i, q.unit)]
        for b in rest
        for i, q in enumerate(b.candidate.quantities)
    ]
    more = table("", ("effect", "number", "all together", "at most (95 %)"), others)
    return paragraph(said) + table("", header, rows) + details("All other effects", [more])


def _short(title: str) -> str:
    """Without the formula."""
    return re.split(r", (?=\S+ (?:=|<=) )", title)[0]


def _in_all(b: Bound, i: int, unit: str) -> list[str]:
    """Size of its i-th number from all recordings, and the upper limit of a single one."""
    value = quantity_text(float(b.values[i]), float(b.sigma[i]), unit) if np.isfinite(b.sigma[i]) else "unseen"
    return [value, "" if b.upper is None else quantity_text(float(f"{b.upper:.2g}"), 0.0, unit)]


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
        unit = f" ({typeset(q.unit)})" if q.unit != "1" else ""
        axes.set_ylabel(q.part.partition("[")[0] + unit)
        caption = "Each recording alone with its standard deviation; the band is two of all together."
        drawn.append(Drawn(f"{number:02d}_{q.name.replace('.', '_').split('[')[0]}", q.name, caption, figure))
    return tuple(drawn)
