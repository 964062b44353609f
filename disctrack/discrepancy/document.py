"""A diagnosis of any system, not of the disc alone: the keys of diagnosis.json, and the tables of its report."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from disctrack.discrepancy.fit import Fit
from disctrack.discrepancy.held_out import HeldOut
from disctrack.discrepancy.search import Diagnosis, Found
from disctrack.discrepancy.significance import as_sigmas
from disctrack.discrepancy.words import shown, together
from disctrack.numbers import measured, rounded, score
from disctrack.report.blocks import Listing, Section


def parameters_json(quantities: Any, fit: Fit) -> list[dict[str, Any]]:
    """Fitted numbers with their standard deviations."""
    named = [(q, *shown(q, fit)) for q in quantities]
    return [{"name": name, **vars(size), "meaning": q.meaning} for q, name, size in named]


def effect_json(found: Found, after: Fit) -> dict[str, Any]:
    """One effect found, of any system.   after : fit of the enlarged model"""
    c = found.candidate
    return {
        "name": c.effect,
        "candidate": c.name,
        "kind": c.kind,
        "title": c.title,
        "source": c.source,
        "parameters": parameters_json(c.quantities, after),
        "correlated": [vars(pair) for pair in together(found, after)],
        "class": [
            {
                "name": r.candidate.name,
                "angle_deg": np.degrees(r.angle),
                "delta_chi_square": r.loss,
                "parameters": parameters_json(r.candidate.quantities, r.fit),
            }
            for r in found.cannot_be_told_from
        ],
        "score": found.gain,
        "threshold": found.threshold,
        "significance_sigma": as_sigmas(found.gain, len(c.quantities)),
        "held_out_gain": found.held_out_gain,
    }


def explanations_json(d: Diagnosis) -> list[dict[str, Any]]:
    """Sets of effects that describe the data as shortly as the answer, with their odds against it."""
    return [
        {"effects": list(names), "longer_by": longer, "odds": float(np.exp(-0.5 * longer))}
        for names, longer in d.explanations
    ]


def declared_json(fit: Fit, with_known: bool = False) -> dict[str, Any]:
    """Numbers of the declared laws with their standard deviations.   with_known : of those with a prior, too"""
    laws = [q for q in fit.quantities if not q.is_initial and (with_known or not np.isfinite(q.prior_sigma))]
    return {q.name: {"value": fit.values[q.name], "sigma": fit.sigma(q.name), "unit": q.unit} for q in laws}


def fit_errors(fit: Fit, held: HeldOut | None, noise: float = 1.0) -> dict[str, Any]:
    """Keys `before` and `after` as far as every system has them; the system adds errors in its own units.

    noise : variance of the noise over that stated; the chi-squares are in units of it
    """
    ratio = None if held is None or not np.isfinite(held.chi_square) else held.ratio_to_floor / np.sqrt(noise)
    return {
        "reduced_chi_square": fit.reduced_chi_square / noise,
        "held_out": {"ratio_to_noise_floor": ratio},
        "parameters": declared_json(fit, with_known=True),
    }


def document(
    d: Diagnosis,
    model: str,
    sentence: str,
    before: Mapping[str, Any] | None = None,
    after: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """All of a diagnosis in JSON's types; the keys are those that `disctrack diagnose` writes.

    before, after : errors in the system's own units, if it has such
    """
    return {
        "verdict": d.verdict,
        "sentence": sentence,
        "reason": d.reason,
        "model": model,
        "effects": [effect_json(f, d.after) for f in d.found],
        "before": fit_errors(d.before, d.held_out_before, d.noise) | dict(before or {}),
        "after": fit_errors(d.after, d.held_out_after, d.noise) | dict(after or {}),
        "noise_variance_over_stated": d.noise,
        "explanations": explanations_json(d),
        "tried": [
            {
                "name": t.candidate.name,
                "kind": t.candidate.kind,
                "score": t.score,
                "refit_gain": t.gain,
                "held_out_gain": t.held_out_gain,
                "reason": t.reason,
            }
            for t in d.tried
        ],
        "settings": vars(d.settings),
    }


def tables(d: Diagnosis, hidden: tuple[str, ...] = ("state.", "learned.")) -> list[Section]:
    """What competes with the answer, the fitted numbers before and after, and what was tried.

    hidden : beginnings of the names of numbers that are not listed; a learned law is shown by its course
    """
    fitted = [q for q in d.after.quantities if not (q.name.startswith(hidden) or q.is_initial)]
    sides = [
        [measured(f.values[q.name], f.sigma(q.name), q.unit) if q.name in f.names else "" for f in (d.before, d.after)]
        for q in fitted
    ]
    chi = [rounded(f.reduced_chi_square / d.noise, 4) for f in (d.before, d.after)]
    rows = [("chi-square per degree of freedom", *chi), *((q.name, *s) for q, s in zip(fitted, sides, strict=True))]
    return [
        Section("Explanations that compete", [explanations_table(d)]),
        Section("Fitted numbers", [Listing(("value ± 1 σ", "before", "after"), rows if fitted else ())]),
        Section("What was tried", [tried_table(d)]),
    ]


def explanations_table(d: Diagnosis) -> Listing:
    """Sets of effects whose lengths the data do not separate; empty where there is only one."""
    sets = explanations_json(d)
    rows = [
        (", ".join(s["effects"]) or "nothing is missing", score(s["longer_by"]), rounded(s["odds"], 2)) for s in sets
    ]
    caption = (
        "Longer by: -2 log evidence over that of the answer, which is chi-square, the price of the numbers and the "
        "surprise of their values."
    )
    return Listing(("effects", "longer by", "odds against the answer"), rows if len(rows) > 1 else (), caption)


def tried_table(d: Diagnosis) -> Listing:
    """What became of every candidate; columns in which nothing stands are left out."""
    rows = [
        (t.candidate.title, t.candidate.name, score(t.score), score(t.gain), score(t.held_out_gain), t.reason)
        for t in d.tried
    ]
    header = ("candidate", "name", "score", "gain, refitted", "gain, held out", "outcome")
    filled = [i for i in range(len(header)) if any(row[i] for row in rows)]
    caption = (
        "Score: decrease of chi-square to first order if the candidate is added; gain: the decrease after a fit; held "
        "out: over data that the fit has not seen."
    )
    shown = [[row[i] for i in filled] for row in rows]
    return Listing([header[i] for i in filled], shown, caption, folded=f"All {len(rows)} candidates")
