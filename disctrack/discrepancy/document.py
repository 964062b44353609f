"""A diagnosis of any system in words, as the keys of diagnosis.json, and as tables."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import takewhile
from typing import Any

import numpy as np

from disctrack.discrepancy.fit import Fit
from disctrack.discrepancy.held_out import HeldOut
from disctrack.discrepancy.search import Diagnosis, Found
from disctrack.discrepancy.significance import TWO_SIDED, as_sigmas
from disctrack.discrepancy.system import Quantity
from disctrack.numbers import Measured, measured, rounded, score
from disctrack.report.blocks import Listing, Section

STRONG = 0.9  # correlation, from which on a standard deviation alone misleads by more than a factor of two


@dataclass(frozen=True)
class Correlated:
    """Two fitted quantities, and their best determined combination first + factor * second."""

    first: str
    second: str
    correlation: float
    factor: float  # in the unit of the first per unit of the second
    value: float  # of the combination, in the unit of the first
    sigma: float


def shown(q: Quantity, fit: Fit) -> tuple[str, Measured]:
    """Name and size of a fitted quantity in its usual form: 1 / mu of a friction is fitted, and mu is shown."""
    value, sigma = fit.values[q.name], fit.sigma(q.name)
    if q.reciprocal and value > 0:
        return q.reciprocal, Measured(1.0 / value, sigma / value**2, q.unit)
    return q.part, Measured(value, sigma, q.unit)


def effect_text(found: Found, diagnosis: Diagnosis) -> str:
    """One effect with its size, and the alternatives that these data do not distinguish from it."""
    fit = diagnosis.after
    # initial velocities are part of the remark on slip
    amounts = [shown(q, fit) for q in found.candidate.quantities if not q.is_initial]
    sizes = ", ".join(f"{name} = {size}" for name, size in amounts)
    text = f"{found.candidate.title} [{found.candidate.name}]: {sizes}{correlation_text(found, diagnosis)}"
    text += "".join(f"; {bound}" for bound in bounds(found, fit))
    if found.cannot_be_told_from:
        text += f"; indistinguishable here: {', '.join(r.candidate.name for r in found.cannot_be_told_from)}"
    return text


def significance_text(found: Found) -> str:
    """Increase of chi-square without the effect, and its gain on held-out data."""
    if not np.isfinite(found.gain):
        return "Without it the model follows no part of the recording"  # so that there is no chi-square to compare
    sigmas = as_sigmas(found.gain, len(found.candidate.quantities))
    return (
        f"Without it chi-square rises by {score(found.gain)}, {rounded(sigmas)} sigmas (noise alone: "
        f"{score(found.threshold)}); on held-out data it gains {score(found.held_out_gain)}"
    )


def bounds(found: Found, fit: Fit) -> list[str]:
    """Upper bounds of parameters of the effect that may be zero, and what limits them."""
    texts = []
    for q in found.candidate.quantities:
        name, size = shown(q, fit)
        if q.is_initial or q.reciprocal or q.null != 0.0:  # not an amount
            continue
        if not size.sigma > 0 or abs(size.value) >= TWO_SIDED * size.sigma:
            continue
        pair = correlated(fit, [q.name], fit.names)
        why = f"as {pair[0].second} moves with it" if pair else "by the noise"
        most = measured(abs(size.value) + TWO_SIDED * size.sigma, unit=q.unit)
        texts.append(f"{name} is only bounded, |{name}| < {most} (95 %), {why}")
    return texts


def correlated_pairs(found: Found, fit: Fit) -> tuple[Correlated, ...]:
    """Parameters of the effect that are strongly correlated with each other or with those of a declared law."""
    laws = [q.name for q in fit.quantities if not (np.isfinite(q.prior_sigma) or q.is_initial)]
    return correlated(fit, [q.name for q in found.candidate.quantities if not q.reciprocal], laws)


def correlation_text(found: Found, diagnosis: Diagnosis) -> str:
    """Strong correlations, without pairs that the text of an earlier effect gives."""
    fit = diagnosis.after
    units = {q.name: q.unit for q in fit.quantities}
    earlier = takewhile(lambda effect: effect is not found, diagnosis.found)
    named = {frozenset((pair.first, pair.second)) for effect in earlier for pair in correlated_pairs(effect, fit)}
    text = ""
    for pair in correlated_pairs(found, fit):
        if frozenset((pair.first, pair.second)) in named:
            continue
        factor = f"{'+' if pair.factor >= 0 else '-'} {rounded(abs(pair.factor), 4)}"
        known = measured(pair.value, pair.sigma, units[pair.first])
        text += f" (correlation {pair.correlation:.4f}: better known is {pair.first} {factor} {pair.second} = {known})"
    return text


def correlated(fit: Fit, names: Sequence[str], among: Sequence[str]) -> tuple[Correlated, ...]:
    """The strongest correlation of each of `names` with one of `among`, if it is strong; every pair once."""
    found: dict[frozenset[str], Correlated] = {}
    sigmas = {name: fit.sigma(name) for name in fit.names}
    for first in (name for name in names if name in fit.shared and sigmas[name] > 0):
        across = dict(zip(fit.names, fit.covariance_with(first), strict=True))
        others = {n: across[n] / (sigmas[first] * sigmas[n]) for n in among if n != first and sigmas[n] > 0}
        second = max(others, key=lambda n: abs(others[n]), default=first)
        if abs(rho := float(np.clip(others.get(second, 0.0), -1.0, 1.0))) >= STRONG:
            factor = float(-across[second] / sigmas[second] ** 2)
            value = float(fit.values[first] + factor * fit.values[second])
            sigma = float(sigmas[first] * np.sqrt(1.0 - rho**2))
            found.setdefault(frozenset((first, second)), Correlated(first, second, rho, factor, value, sigma))
    return tuple(found.values())


def parameters_json(quantities: Any, fit: Fit) -> list[dict[str, Any]]:
    """Fitted parameters with their standard deviations."""
    named = [(q, *shown(q, fit)) for q in quantities]
    return [{"name": name, **vars(size), "meaning": q.meaning} for q, name, size in named]


def effect_json(found: Found, after: Fit) -> dict[str, Any]:
    """One effect found.   after : fit of the extended model"""
    c = found.candidate
    return {
        "name": c.effect,
        "candidate": c.name,
        "kind": c.kind,
        "title": c.title,
        "source": c.source,
        "parameters": parameters_json(c.quantities, after),
        "correlated": correlated_pairs(found, after),
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
    """Sets of effects that are indistinguishable from the answer, with their odds against it."""
    return [
        {"effects": list(names), "longer_by": longer, "odds": float(np.exp(-0.5 * longer))}
        for names, longer in d.explanations
    ]


def fit_errors(fit: Fit, held: HeldOut | None, noise: float, with_known: bool) -> dict[str, Any]:
    """Keys `before` and `after` that all systems have; the system adds errors in its own units.

    noise : variance of the noise over that stated; the chi-squares are in units of it
    with_known : as for `document`
    """
    laws = [q for q in fit.quantities if not q.is_initial and (with_known or not np.isfinite(q.prior_sigma))]
    ratio = None if held is None or not np.isfinite(held.chi_square) else held.ratio_to_floor / np.sqrt(noise)
    return {
        "reduced_chi_square": fit.reduced_chi_square / noise,
        "held_out": {"ratio_to_noise_floor": ratio},
        "parameters": {q.name: Measured(fit.values[q.name], fit.sigma(q.name), q.unit) for q in laws},
    }


def document(
    d: Diagnosis, model: str, sentence: str, before: Mapping[str, Any] = {}, after: Mapping[str, Any] = {}, *,
    with_known: bool = True,
) -> dict[str, Any]:  # fmt: skip
    """The diagnosis in types that `json_text.plain` knows; the keys are those that `disctrack diagnose` writes.

    before, after : errors in the system's own units, if it has such
    with_known : are parameters with a prior among those of the laws?
    """
    return {
        "verdict": d.verdict,
        "sentence": sentence,
        "reason": d.reason,
        "model": model,
        "effects": [effect_json(f, d.after) for f in d.found],
        "before": fit_errors(d.before, d.held_out_before, d.noise, with_known) | dict(before),
        "after": fit_errors(d.after, d.held_out_after, d.noise, with_known) | dict(after),
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
        "settings": d.settings,
    }


def tables(d: Diagnosis) -> list[Section]:
    """Indistinguishable explanations, fitted parameters before and after, and the outcome of all candidates.

    A learned law is shown by its course, and not by its parameters.
    """
    fitted = [q for q in d.after.quantities if not (q.owner == "learned" or q.is_initial)]
    fits = d.before, d.after
    rows = [("chi-square per degree of freedom", *(rounded(f.reduced_chi_square / d.noise, 4) for f in fits))]
    for q in fitted:
        sizes = (measured(f.values[q.name], f.sigma(q.name), q.unit) if q.name in f.names else "" for f in fits)
        rows.append((q.name, *sizes))
    return [
        explanations(d),
        Section("Fitted numbers", [Listing(("value ± 1 σ", "before", "after"), rows if fitted else ())]),
        tried(d),
    ]


def explanations(d: Diagnosis) -> Section:
    """Sets of effects that are indistinguishable from the answer; empty where there is only one."""
    sets = explanations_json(d)
    rows = [
        (", ".join(s["effects"]) or "nothing is missing", score(s["longer_by"]), rounded(s["odds"], 2)) for s in sets
    ]
    caption = (
        "Longer by: -2 log evidence minus that of the answer; it is chi-square, a penalty for each parameter, and the "
        "prior of the sizes."
    )
    listed = Listing(("effects", "longer by", "odds against the answer"), rows if len(rows) > 1 else (), caption)
    return Section("Explanations that compete", [listed])


def tried(d: Diagnosis) -> Section:
    """Outcome of every candidate; empty columns are omitted."""
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
    cells = [[row[i] for i in filled] for row in rows]
    listed = Listing([header[i] for i in filled], cells, caption, folded=f"All {len(rows)} candidates")
    return Section("What was tried", [listed])
