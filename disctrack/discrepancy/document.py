"""A diagnosis of any system, not of the disc alone, in the words and keys of diagnosis.json."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from disctrack.discrepancy.fit import Fit
from disctrack.discrepancy.held_out import HeldOut
from disctrack.discrepancy.search import Diagnosis, Found, Tried
from disctrack.discrepancy.significance import as_sigmas
from disctrack.discrepancy.words import shown, together

_NOTHING: Mapping[str, Any] = MappingProxyType({})


def parameters_json(quantities: Any, fit: Fit) -> list[dict[str, Any]]:
    """Fitted numbers with their standard deviations."""
    found = []
    for q in quantities:
        name, value, sigma = shown(q, fit)
        amount = {"name": name, "value": value, "sigma": sigma}
        found.append(amount | {"unit": q.unit, "meaning": q.meaning})
    return found


def effect_json(found: Found, after: Fit, apart: Mapping[str, Any] = _NOTHING) -> dict[str, Any]:
    """One effect found, of any system.

    after : fit of the enlarged model
    apart : what would separate the effect from its rivals, by their names
    """
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
                "separated_by": apart.get(r.candidate.name),
            }
            for r in found.cannot_be_told_from
        ],
        "score": found.gain,
        "threshold": found.threshold,
        "significance_sigma": as_sigmas(found.gain, len(c.quantities)),
        "held_out_gain": found.held_out_gain,
    }


def tried_json(tried: Tried) -> dict[str, Any]:
    """What became of one candidate, of any system."""
    return {
        "name": tried.candidate.name,
        "kind": tried.candidate.kind,
        "score": tried.score,
        "refit_gain": tried.gain,
        "held_out_gain": tried.held_out_gain,
        "reason": tried.reason,
    }


def explanations_json(d: Diagnosis) -> list[dict[str, Any]]:
    """Sets of effects that describe the data as shortly as the answer, with their odds against it."""
    return [
        {"effects": list(names), "longer_by": longer, "odds": float(np.exp(-0.5 * longer))}
        for names, longer in d.explanations
    ]


def declared_json(fit: Fit) -> dict[str, Any]:
    """Numbers of the declared laws with their standard deviations."""
    laws = [q for q in fit.quantities if not q.is_initial and not np.isfinite(q.prior_sigma)]
    return {q.name: {"value": fit.values[q.name], "sigma": fit.sigma(q.name), "unit": q.unit} for q in laws}


def fit_errors(fit: Fit, held: HeldOut | None, noise: float = 1.0) -> dict[str, Any]:
    """Keys `before` and `after` as far as every system has them; the system adds errors in its own units.

    noise : variance of the noise over that stated; the chi-squares are in units of it
    """
    ratio = None if held is None or not np.isfinite(held.chi_square) else held.ratio_to_floor / np.sqrt(noise)
    free = {q.name: q for q in fit.quantities if not q.is_initial}
    return {
        "reduced_chi_square": fit.reduced_chi_square / noise,
        "held_out": {"ratio_to_noise_floor": ratio},
        "parameters": {
            name: {"value": fit.values[name], "sigma": fit.sigma(name), "unit": q.unit} for name, q in free.items()
        },
    }


def document(
    d: Diagnosis,
    model: str,
    sentence: str,
    before: Mapping[str, Any] = _NOTHING,
    after: Mapping[str, Any] = _NOTHING,
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
        "before": fit_errors(d.before, d.held_out_before, d.noise) | dict(before),
        "after": fit_errors(d.after, d.held_out_after, d.noise) | dict(after),
        "noise_variance_over_stated": d.noise,
        "explanations": explanations_json(d),
        "tried": [tried_json(t) for t in d.tried],
        "settings": vars(d.settings),
    }


def table(d: Diagnosis) -> list[str]:
    """Chi-square before and after, fitted numbers, and what was tried, for people."""
    chi = [f.reduced_chi_square / d.noise for f in (d.before, d.after)]
    lines = [f"{'chi-square per degree':<30}{chi[0]:12.4g}{chi[1]:12.4g}{1:12}"]
    lines += ["", f"{'fitted':<30}{'value':>14}{'sigma':>12}"]
    for name in d.after.names:
        if not name.startswith(("state.", "learned.")):  # a law is told by its course
            lines.append(f"{name:<30}{d.after.values[name]:14.6g}{d.after.sigma(name):12.2g}")
    lines += ["", f"{'tried':<30}{'gain':>12}  outcome"]
    for t in d.tried:
        lines.append(f"{t.candidate.name:<30}{t.score if t.gain is None else t.gain:12.4g}  {t.reason}")
    return lines
