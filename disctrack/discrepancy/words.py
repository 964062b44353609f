"""What a diagnosis found, in words: any system's effects with their sizes, and what bounds them."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import takewhile

import numpy as np

from disctrack.discrepancy.fit import Fit
from disctrack.discrepancy.search import Diagnosis, Found
from disctrack.discrepancy.significance import TWO_SIDED, as_sigmas
from disctrack.discrepancy.system import Quantity
from disctrack.numbers import Measured, measured, rounded, score

STRONG = 0.9  # of a correlation, from which on a standard deviation alone misleads by more than twice


@dataclass(frozen=True)
class Correlated:
    """Two fitted quantities, and first + factor * second with the factor that makes it known best."""

    first: str
    second: str
    correlation: float
    factor: float  # in the unit of the first per unit of the second
    value: float  # of the combination, in the unit of the first
    sigma: float


def shown(q: Quantity, fit: Fit) -> tuple[str, Measured]:
    """Name and size of a fitted quantity as people know it: 1 / mu of a friction is fitted, and mu is shown."""
    value, sigma = fit.values[q.name], fit.sigma(q.name)
    if q.reciprocal and value > 0:
        return q.reciprocal, Measured(1.0 / value, sigma / value**2, q.unit)
    return q.part, Measured(value, sigma, q.unit)


def effect_text(found: Found, diagnosis: Diagnosis) -> str:
    """One effect with its size, and the alternatives that these data do not separate from it."""
    fit = diagnosis.after
    # a free velocity at the first instant says nothing to people that the remark on slip does not
    amounts = [shown(q, fit) for q in found.candidate.quantities if not q.is_initial]
    sizes = ", ".join(f"{name} = {size}" for name, size in amounts)
    text = f"{found.candidate.title} [{found.candidate.name}]: {sizes}{together_text(found, diagnosis)}"
    text += "".join(f"; {bound}" for bound in bounds(found, fit))
    if found.cannot_be_told_from:
        text += f"; indistinguishable here: {', '.join(r.candidate.name for r in found.cannot_be_told_from)}"
    return text


def significance_text(found: Found) -> str:
    """What is lost without the effect."""
    if not np.isfinite(found.gain):
        return "Without it the model follows no part of the recording"  # so that there is no chi-square to compare
    sigmas = as_sigmas(found.gain, len(found.candidate.quantities))
    return (
        f"Without it chi-square rises by {score(found.gain)}, {rounded(sigmas)} sigmas (noise alone: "
        f"{score(found.threshold)}); on held-out data it gains {score(found.held_out_gain)}"
    )


def bounds(found: Found, fit: Fit) -> list[str]:
    """Numbers of the effect that may be zero: how large they may be, and what keeps them open."""
    texts = []
    spread = np.array([fit.sigma(name) for name in fit.names])
    for q in found.candidate.quantities:
        name, size = shown(q, fit)
        if q.is_initial or q.reciprocal or q.null != 0.0:  # a limit is no size
            continue
        if not size.sigma > 0 or abs(size.value) >= TWO_SIDED * size.sigma:
            continue
        i = fit.names.index(q.name)
        shared = np.abs(fit.covariance_with(q.name)) / np.where(spread > 0, spread, np.inf) / spread[i]
        shared[i] = 0.0
        partner = int(np.argmax(shared))
        why = f"as {fit.names[partner]} moves with it" if shared[partner] > STRONG else "by the noise"
        most = measured(abs(size.value) + TWO_SIDED * size.sigma, unit=q.unit)
        texts.append(f"{name} is only bounded, |{name}| < {most} (95 %), {why}")
    return texts


def together(found: Found, fit: Fit) -> tuple[Correlated, ...]:
    """Numbers of the effect that move together with each other or with those of a declared law."""
    laws = [q.name for q in fit.quantities if not (np.isfinite(q.prior_sigma) or q.is_initial)]
    return correlated(fit, [q.name for q in found.candidate.quantities if not q.reciprocal], laws)


def together_text(found: Found, diagnosis: Diagnosis) -> str:
    """What their standard deviations alone do not say; a pair that an earlier effect's text has named is left out."""
    fit = diagnosis.after
    units = {q.name: q.unit for q in fit.quantities}
    earlier = takewhile(lambda effect: effect is not found, diagnosis.found)
    named = {frozenset((pair.first, pair.second)) for effect in earlier for pair in together(effect, fit)}
    text = ""
    for pair in together(found, fit):
        if frozenset((pair.first, pair.second)) in named:
            continue
        factor = f"{'+' if pair.factor >= 0 else '-'} {rounded(abs(pair.factor), 4)}"
        known = measured(pair.value, pair.sigma, units[pair.first])
        text += f" (correlation {pair.correlation:.4f}: better known is {pair.first} {factor} {pair.second} = {known})"
    return text


def correlated(fit: Fit, names: Sequence[str], among: Sequence[str]) -> tuple[Correlated, ...]:
    """The strongest partner of each of `names`, from `among`; every pair once, and only where it is strong."""
    found: dict[frozenset[str], Correlated] = {}
    for first in names:
        pairs = [pair for second in among if second != first and (pair := _pair(fit, first, second))]
        best = max(pairs, key=lambda p: abs(p.correlation), default=None)
        if best is not None and abs(best.correlation) >= STRONG:
            found.setdefault(frozenset((best.first, best.second)), best)
    return tuple(found.values())


def _pair(fit: Fit, first: str, second: str) -> Correlated | None:
    if first not in fit.shared or second not in fit.shared:
        return None
    (a, cross), (_, b) = fit.amounts([first, second])[1]
    if not (a > 0 and b > 0):  # one stands at a bound
        return None
    factor = float(-cross / b)
    value = fit.values[first] + factor * fit.values[second]
    rho = float(np.clip(cross / np.sqrt(a * b), -1.0, 1.0))
    return Correlated(first, second, rho, factor, float(value), float(np.sqrt(max(a - cross * cross / b, 0.0))))
